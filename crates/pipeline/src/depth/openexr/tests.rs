use std::io::Cursor;

use exr::compression::Compression;
use exr::image::write::WritableImage;
use exr::image::{AnyChannel, AnyChannels, Blocks, Encoding, FlatSamples, Image, Layer, Levels};
use exr::math::{RoundingMode, Vec2};
use exr::meta::attribute::{IntegerBounds, LineOrder};
use exr::meta::header::{ImageAttributes, LayerAttributes};
use proptest::prelude::*;

use super::super::{DepthKind, from_map};
use super::*;

const SCAN_LINES: Blocks = Blocks::ScanLines;
const TILES: Blocks = Blocks::Tiles(Vec2(16, 8));

fn encoding(compression: Compression, blocks: Blocks) -> Encoding {
    Encoding { compression, blocks, line_order: LineOrder::Increasing }
}

fn channels(named: &[(&str, FlatSamples)]) -> AnyChannels<FlatSamples> {
    AnyChannels::sort(named.iter().map(|(name, samples)| AnyChannel::new(*name, samples.clone())).collect())
}

fn file(encoding: Encoding, (width, height): (usize, usize), named: &[(&str, FlatSamples)]) -> Vec<u8> {
    let image = Image::from_encoded_channels(Vec2(width, height), encoding, channels(named));
    let mut bytes = Cursor::new(Vec::new());
    image.write().to_buffered(&mut bytes).unwrap();
    bytes.into_inner()
}

fn floats(values: &[f32]) -> FlatSamples {
    FlatSamples::F32(values.to_vec())
}

fn halves(values: &[f32]) -> FlatSamples {
    FlatSamples::F16(values.iter().copied().map(f16::from_f32).collect())
}

/// A row of floats in the channel Z, packed by ZIP.
fn row(values: &[f32]) -> Vec<u8> {
    file(encoding(Compression::ZIP16, SCAN_LINES), (values.len(), 1), &[("Z", floats(values))])
}

fn values_of(bytes: &[u8]) -> Vec<f32> {
    read(bytes, &Limits::default()).unwrap().values
}

fn refused(bytes: &[u8], limits: &Limits) -> String {
    let [checked, read] = [check(bytes, limits).err(), read(bytes, limits).err()].map(|error| error.unwrap().to_string());
    assert_eq!(checked, read);
    checked
}

/// Overwrites the value of an attribute.
fn patched(file: &[u8], name: &str, kind: &str, from: usize, value: &[u8]) -> Vec<u8> {
    let attribute = format!("{name}\0{kind}\0");
    let at = file.windows(attribute.len()).position(|bytes| bytes == attribute.as_bytes()).unwrap() + attribute.len() + 4 + from;
    let mut file = file.to_vec();
    file[at..at + value.len()].copy_from_slice(value);
    file
}

/// The bytes of the last column and row of a window that begins at 0.
fn ends(width: i32, height: i32) -> [u8; 8] {
    let mut bytes = [0; 8];
    bytes[..4].copy_from_slice(&(width - 1).to_le_bytes());
    bytes[4..].copy_from_slice(&(height - 1).to_le_bytes());
    bytes
}

#[test]
fn all_kinds_of_files_hold_the_same_values() {
    let (width, height) = (37, 21);
    // whole numbers that 16 bits hold
    let want: Vec<f32> = (0..width * height).map(|i| ((i % width) * 3 + (i / width) * 5) as f32).collect();
    let whole = FlatSamples::U32(want.iter().map(|v| *v as u32).collect());
    for compression in
        [Compression::Uncompressed, Compression::RLE, Compression::ZIP1, Compression::ZIP16, Compression::PIZ, Compression::PXR24]
    {
        for blocks in [SCAN_LINES, TILES, Blocks::Tiles(Vec2(64, 64))] {
            for samples in [floats(&want), halves(&want), whole.clone()] {
                let bytes = file(encoding(compression, blocks), (width, height), &[("A", samples.clone()), ("Z", samples)]);
                assert!(is_openexr(&bytes));
                assert_eq!(check(&bytes, &Limits::default()).unwrap(), (37, 21));
                assert_eq!(values_of(&bytes), want, "{compression:?} {blocks:?}");
            }
        }
    }
}

/// Files that another program wrote, and that FFmpeg reads, too.
#[test]
fn files_of_another_writer_are_read() {
    let all = |bytes: &[u8], (width, height): (u32, u32), want: &dyn Fn(u32, u32) -> f32| {
        assert_eq!(check(bytes, &Limits::default()).unwrap(), (width, height));
        let want: Vec<f32> = (0..height).flat_map(|y| (0..width).map(move |x| want(x, y))).collect();
        // in bits: one value is NaN
        assert_eq!(
            values_of(bytes).into_iter().map(f32::to_bits).collect::<Vec<_>>(),
            want.into_iter().map(f32::to_bits).collect::<Vec<_>>()
        );
    };
    // halves, not packed
    all(include_bytes!("../../../../../fuzz/seeds/depth/half.exr"), (9, 5), &|x, y| (x + y) as f32 / 16.0);
    // floats packed by ZIP, beside red, green and blue in halves
    all(include_bytes!("../../../../../fuzz/seeds/depth/zip.exr"), (20, 18), &|x, y| match (x, y) {
        (3, 2) => f32::INFINITY,
        (4, 2) => f32::NAN,
        _ => (2 + x / 5 * 3 + y / 4) as f32,
    });
    // tiles of whole numbers, packed as run lengths
    all(include_bytes!("../../../../../fuzz/seeds/depth/tiles.exr"), (20, 12), &|x, y| (1 + x / 7 + y / 3) as f32);
    // the second of two parts
    all(include_bytes!("../../../../../fuzz/seeds/depth/parts.exr"), (6, 4), &|x, y| (1 + x + y) as f32);
}

#[test]
fn infinite_and_unknown_values_are_those_of_a_portable_float_map() {
    let read = |values: &[f32], kind| from_map(&row(values), kind, &Limits::default(), values.len() as u32, 1).unwrap().0.delta;
    assert_eq!(read(&[2.0, f32::INFINITY, 8.0, f32::NAN], DepthKind::Metric), [1.0, 0.0, 0.25, 0.25]);
    assert_eq!(read(&[80.0, f32::INFINITY, 20.0, f32::NAN], DepthKind::Disparity), [1.0, 0.25, 0.25, 0.25]);
    assert_eq!(read(&[-3.0, 0.5], DepthKind::Inverted), [1.0, 0.5]);
    let error = from_map(&row(&[f32::NAN]), DepthKind::Disparity, &Limits::default(), 1, 1).unwrap_err().to_string();
    assert!(error.contains("no known depth"), "{error}");
}

#[test]
fn depth_is_one_of_several_channels_and_parts() {
    let zip = encoding(Compression::ZIP16, SCAN_LINES);
    let [low, high] = [[0.25, 0.5], [3.0, 4.0]];
    let named = [("A", halves(&low)), ("B", halves(&low)), ("G", halves(&low)), ("R", halves(&high)), ("Z", floats(&high))];
    assert_eq!(values_of(&file(zip, (2, 1), &named)), high);
    let layer = |name: &str, (width, height): (usize, usize), named: &[(&str, FlatSamples)]| {
        Layer::new(Vec2(width, height), LayerAttributes::named(name), zip, channels(named))
    };
    let layers = vec![layer("Layer.Combined", (2, 1), &named[..4]), layer("Layer.Depth", (2, 1), &[("V", floats(&high))])];
    let image = Image::from_layers(ImageAttributes::with_size((2, 1)), layers);
    let mut bytes = Cursor::new(Vec::new());
    image.write().to_buffered(&mut bytes).unwrap();
    assert_eq!(values_of(&bytes.into_inner()), high);
}

#[test]
fn red_green_and_blue_count_if_they_are_alike() {
    let with_red = |red: &[f32]| {
        let grey = [0.5, f32::INFINITY, 0.0, f32::NAN];
        let named = [("B", floats(&grey)), ("G", floats(&grey)), ("R", floats(red))];
        file(encoding(Compression::PIZ, TILES), (4, 1), &named)
    };
    let got = values_of(&with_red(&[0.501, f32::INFINITY, 0.0, f32::NAN]));
    assert_eq!(got[..3], [0.5, f32::INFINITY, 0.0]);
    assert!(got[3].is_nan(), "{got:?}");
    for red in [[0.52, f32::INFINITY, 0.0, f32::NAN], [0.5, 1.0, 0.0, f32::NAN], [0.5, f32::INFINITY, 0.0, 0.0]] {
        let bytes = with_red(&red);
        assert!(check(&bytes, &Limits::default()).is_ok());
        let error = read(&bytes, &Limits::default()).err().unwrap().to_string();
        assert!(error.contains("colour"), "{error}");
    }
}

#[test]
fn the_display_window_is_the_picture() {
    let stored = |at: (i32, i32), blocks| {
        let attributes = LayerAttributes::default().with_position(Vec2(at.0, at.1));
        let layer = Layer::new(
            Vec2(3, 2),
            attributes,
            encoding(Compression::ZIP1, blocks),
            channels(&[("Z", floats(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))]),
        );
        let image = Image::new(ImageAttributes::new(IntegerBounds::new(Vec2(10, 20), Vec2(4, 3))), layer);
        let mut bytes = Cursor::new(Vec::new());
        image.write().to_buffered(&mut bytes).unwrap();
        let bytes = bytes.into_inner();
        assert_eq!(check(&bytes, &Limits::default()).unwrap(), (4, 3));
        // 0 for unknown
        values_of(&bytes).into_iter().map(|v| if v.is_nan() { 0.0 } else { v }).collect::<Vec<_>>()
    };
    for blocks in [SCAN_LINES, TILES] {
        assert_eq!(stored((11, 21), blocks), [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.0, 4.0, 5.0, 6.0]);
        assert_eq!(stored((9, 19), blocks), [5.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(stored((12, 22), blocks), [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0]);
        assert_eq!(stored((-100, 500), blocks), [0.0; 12]);
    }
}

#[test]
fn smaller_copies_are_skipped() {
    let level = |side: usize, value: f32| FlatSamples::F32(vec![value; side * side]);
    let levels = Levels::Mip { rounding_mode: RoundingMode::Down, level_data: vec![level(4, 1.0), level(2, 2.0), level(1, 3.0)] };
    let list = AnyChannels::sort([AnyChannel::new("Z", levels)].into_iter().collect());
    let image = Image::from_encoded_channels(Vec2(4, 4), encoding(Compression::RLE, Blocks::Tiles(Vec2(2, 2))), list);
    let mut bytes = Cursor::new(Vec::new());
    image.write().to_buffered(&mut bytes).unwrap();
    let bytes = bytes.into_inner();
    assert_eq!(check(&bytes, &Limits::default()).unwrap(), (4, 4));
    assert_eq!(values_of(&bytes), [1.0; 16]);
}

#[test]
fn a_file_that_is_cut_short_is_refused_wherever_it_ends() {
    let values: Vec<f32> = (0..200).map(|i| (i * 37 % 101) as f32).collect();
    for blocks in [SCAN_LINES, TILES] {
        let bytes = file(encoding(Compression::ZIP16, blocks), (20, 10), &[("Z", floats(&values))]);
        assert_eq!(values_of(&bytes), values);
        for end in 4..bytes.len() {
            let error = refused(&bytes[..end], &Limits::default());
            assert!(error.contains("cut short"), "{end}: {error}");
        }
    }
}

#[test]
fn limits_are_checked_before_pixels_are_read() {
    let values = [0.5; 200];
    let bytes = file(encoding(Compression::ZIP16, SCAN_LINES), (20, 10), &[("Z", floats(&values))]);
    // the values, and four times the ten lines
    let limits = Limits { pixels: 200, side: 20, bytes: bytes.len(), decoder_memory: 800 + 4 * 800, ..Limits::default() };
    assert_eq!(check(&bytes, &limits).unwrap(), (20, 10));
    assert!(read(&bytes, &limits).is_ok());
    for (over, named) in [
        (Limits { pixels: 199, ..limits }, "limit of 199 pixels"),
        (Limits { side: 19, ..limits }, "limit of 19 pixels a side"),
        (Limits { bytes: bytes.len() - 1, ..limits }, "bytes"),
        (Limits { decoder_memory: 3999, ..limits }, "4000 bytes, over the limit of 3999 bytes"),
    ] {
        let error = refused(&bytes, &over);
        assert!(error.contains(named), "{error}");
    }
    // a header that announces more than the file has
    for window in ["dataWindow", "displayWindow"] {
        for (width, height, named) in
            [(60_000, 2, "60000×2 is over the limit of 16384 pixels a side"), (16_000, 16_000, "16000×16000 is over")]
        {
            let huge = patched(&bytes, window, "box2i", 8, &ends(width, height));
            let error = refused(&huge, &Limits::default());
            assert!(error.contains(named), "{error}");
            assert_eq!(head(&huge, &Limits::default()).unwrap_err().to_string(), error);
        }
    }
    // many channels of many pixels
    let many: Vec<String> = (0..40).map(|n| format!("c{n:02}")).chain(["Z".into()]).collect();
    let named: Vec<(&str, FlatSamples)> = many.iter().map(|name| (name.as_str(), floats(&[0.5]))).collect();
    let one = file(encoding(Compression::Uncompressed, SCAN_LINES), (1, 1), &named);
    assert!(check(&one, &Limits::default()).is_ok());
    let huge = patched(&patched(&one, "dataWindow", "box2i", 8, &ends(5000, 5000)), "displayWindow", "box2i", 8, &ends(5000, 5000));
    let error = refused(&huge, &Limits::default());
    assert!(error.contains("4100000000 bytes, over the limit of 536870912 bytes"), "{error}");
}

#[test]
fn other_compressions_are_named() {
    let bytes = row(&[0.5]);
    for (number, named) in [(8, "dwaa"), (9, "dwab"), (200, "compression")] {
        let error = refused(&patched(&bytes, "compression", "compression", 0, &[number]), &Limits::default());
        assert!(error.contains(named), "{error}");
    }
}

#[test]
fn a_size_is_known_as_soon_as_its_bytes_arrive() {
    let bytes = file(encoding(Compression::ZIP16, SCAN_LINES), (20, 10), &[("Z", floats(&[0.5; 200]))]);
    let mut arrived = 4;
    let seen = loop {
        match head(&bytes[..arrived], &Limits::default()).unwrap() {
            Head::Needs(more) if more > arrived && arrived < bytes.len() => arrived = more.min(bytes.len()),
            seen => break seen,
        }
    };
    assert_eq!(seen, Head::Size(20, 10));
    assert!(arrived <= bytes.len());
    assert_eq!(head(&bytes, &Limits::default()).unwrap(), seen);
}

proptest! {
    #[test]
    fn any_bytes_are_read_or_refused(
        kind in 0..6_usize,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..12),
        end in any::<prop::sample::Index>(),
        whole in any::<bool>(),
    ) {
        let compression =
            [Compression::Uncompressed, Compression::RLE, Compression::ZIP16, Compression::PIZ, Compression::PXR24, Compression::B44][kind];
        let values: Vec<f32> = (0..200).map(|i| (i * i % 101) as f32).collect();
        let blocks = if whole { SCAN_LINES } else { TILES };
        let mut bytes = file(encoding(compression, blocks), (20, 10), &[("V", halves(&values)), ("Z", floats(&values))]);
        for (at, byte) in changes {
            let at = at.index(bytes.len() - 4) + 4;
            bytes[at] = byte;
        }
        if !whole {
            bytes.truncate(end.index(bytes.len()) + 4);
        }
        // few pixels, so that a changed size costs no time
        let limits = Limits { pixels: 40_000, decoder_memory: 16 << 20, ..Limits::default() };
        let checked = check(&bytes, &limits);
        if let Ok(Grey { width, height, values }) = read(&bytes, &limits) {
            prop_assert_eq!(checked.unwrap(), (width, height));
            prop_assert_eq!(values.len(), width as usize * height as usize);
        }
        prop_assert!(check(&bytes, &limits).is_err() || head(&bytes, &limits).is_ok());
    }
}
