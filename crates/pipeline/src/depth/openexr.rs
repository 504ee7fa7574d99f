//! OpenEXR pictures: depth maps as renderers write them.

use std::collections::BTreeSet;
use std::io::Cursor;

use exr::block::UncompressedBlock;
use exr::block::chunk::CompressedBlock;
use exr::block::reader::Reader;
use exr::compression::Compression;
use exr::math::Vec2;
use exr::meta::MetaData;
use exr::meta::attribute::{ChannelDescription, SampleType};
use exr::meta::header::Header;
use half::f16;

use super::DepthError;
use super::grey::{Grey, not_a_map};
use crate::photo::{self, Head, Limits, PhotoError};

/// Most bytes of all headers, which take up to 64 times as much memory. Renderers' lists of masks take some 100 kB.
const HEADERS: usize = 512 << 10;
/// Most blocks of pixels that are packed by PIZ, each of which takes a millisecond to read, however small it is.
const PIZ_BLOCKS: usize = 1 << 15;

/// Whether a file is an OpenEXR picture.
pub(super) fn is_openexr(bytes: &[u8]) -> bool {
    bytes.starts_with(&exr::meta::magic_number::BYTES)
}

/// Checks by its headers that a map is within the limits and has a channel that can be depth; returns its width and height.
pub(super) fn check(bytes: &[u8], limits: &Limits) -> Result<(u32, u32), DepthError> {
    Depth::of(bytes, limits).map(|depth| depth.size).map_err(|e| not_a_map(&e))
}

/// Reads a map's size from its first bytes while the rest is still arriving.
///
/// # Errors
/// The [`DepthError::Map`] that [`check`] returns for the whole file.
pub(super) fn head(bytes: &[u8], limits: &Limits) -> Result<Head, DepthError> {
    let depth = photo::guarded(|| Depth::find(bytes, limits)).map_err(|e| not_a_map(&e))?;
    // twice as many, because each look begins at the start
    Ok(depth.map_or(Head::Needs(2 * bytes.len()), |depth| Head::Size(depth.size.0, depth.size.1)))
}

/// Reads the values of the channel that holds depth as stored: any float, including NaN and infinity. Pixels that are not stored are NaN.
pub(super) fn read(bytes: &[u8], limits: &Limits) -> Result<Grey, DepthError> {
    let depth = Depth::of(bytes, limits).map_err(|e| not_a_map(&e))?;
    let values = photo::guarded(|| depth.values(bytes).map_err(|e| broken(&e))).map_err(|e| not_a_map(&e))?;
    Ok(Grey { width: depth.size.0, height: depth.size.1, values })
}

fn broken(error: &exr::error::Error) -> PhotoError {
    PhotoError::Broken(format!("the OpenEXR file is broken, cut short or not supported ({error})"))
}

/// Where depth is in a file.
struct Depth {
    meta: MetaData,
    part: usize,
    channel: usize,
    /// Size of the display window, which is the picture.
    size: (u32, u32),
}

impl Depth {
    /// Reads the headers of a whole file.
    fn of(bytes: &[u8], limits: &Limits) -> Result<Self, PhotoError> {
        limits.check_bytes(bytes.len())?;
        photo::guarded(|| Self::find(bytes, limits))?.ok_or_else(|| PhotoError::Broken("the OpenEXR file is cut short".into()))
    }

    /// Reads the headers and checks the limits; `None` if the headers do not end in these bytes.
    fn find(bytes: &[u8], limits: &Limits) -> Result<Option<Self>, PhotoError> {
        let start = &bytes[..bytes.len().min(HEADERS)];
        let mut rest = Cursor::new(start);
        let read = exr::block::read(&mut rest, false).map(Reader::into_meta_data);
        let meta = match read {
            Ok(meta) => meta,
            Err(error) if rest.position() < start.len() as u64 => return Err(broken(&error)),
            Err(_) if start.len() < HEADERS => return Ok(None),
            Err(_) => return Err(PhotoError::Broken(format!("the headers of the OpenEXR file are over the limit of {HEADERS} bytes"))),
        };
        let (part, channel) = choose(&meta.headers)?;
        let header = &meta.headers[part];
        check_packing(header)?;
        let (stored, shown) = (header.layer_size, header.shared_attributes.display_window.size);
        for Vec2(width, height) in [shown, stored] {
            limits.check_size(width as u32, height as u32)?;
        }
        let bytes = |Vec2(w, h): Vec2<usize>, each: usize| (w as u64).saturating_mul(h as u64).saturating_mul(each as u64);
        // the decoder holds four blocks, which may be of any part; all samples of the part pass through it
        let blocks = meta.headers.iter().map(|header| bytes(header.max_block_pixel_size(), 4 * header.channels.bytes_per_pixel)).max();
        let held = bytes(shown, 4).saturating_add(blocks.unwrap_or(0));
        limits.check_memory(held.max(bytes(stored, header.channels.bytes_per_pixel)))?;
        Ok(Some(Self { part, channel, size: (shown.0 as u32, shown.1 as u32), meta }))
    }

    /// The values of the display window, row by row.
    fn values(&self, bytes: &[u8]) -> exr::error::Result<Vec<f32>> {
        let header = &self.meta.headers[self.part];
        let kind = header.channels.list[self.channel].sample_type;
        let (stored, shown) = (header.own_attributes.layer_position, header.shared_attributes.display_window.position);
        let (left, top) = (i64::from(stored.0) - i64::from(shown.0), i64::from(stored.1) - i64::from(shown.1));
        let width = self.size.0 as usize;
        let mut values = vec![f32::NAN; width * self.size.1 as usize];
        let mut missing = header.layer_size.area();
        for chunk in exr::block::read(Cursor::new(bytes), false)?.all_chunks(false)? {
            let chunk = chunk?;
            let is_smaller = matches!(&chunk.compressed_block, CompressedBlock::Tile(t) if !t.coordinates.is_largest_resolution_level());
            if chunk.layer_index != self.part || is_smaller {
                continue;
            }
            let block = UncompressedBlock::decompress_chunk(chunk, &self.meta, false)?;
            for line in block.lines(&header.channels).filter(|line| line.location.channel == self.channel) {
                let (x, y) = (line.location.position.0 as i64 + left, line.location.position.1 as i64 + top);
                let row = usize::try_from(y).ok().and_then(|y| values.chunks_exact_mut(width).nth(y));
                let samples = line.value.chunks_exact(kind.bytes_per_sample()).map(|bytes| sample(kind, bytes));
                // a negative number skips nothing
                let skip = |n: i64| usize::try_from(n).unwrap_or(0);
                for (value, sample) in row.into_iter().flatten().skip(skip(x)).zip(samples.skip(skip(-x))) {
                    *value = sample;
                }
            }
            // a hostile file may repeat its blocks
            missing = missing.saturating_sub(block.index.pixel_size.area());
            if missing == 0 {
                break;
            }
        }
        Ok(values)
    }
}

/// Refuses packed pixels that would take much time or memory to unpack.
fn check_packing(header: &Header) -> Result<(), PhotoError> {
    match header.compression {
        Compression::PIZ if header.chunk_count > PIZ_BLOCKS => {
            let count = header.chunk_count;
            Err(PhotoError::Broken(format!("the OpenEXR file has {count} blocks of PIZ, over the limit of {PIZ_BLOCKS}")))
        }
        Compression::Uncompressed | Compression::ZIP1 | Compression::ZIP16 | Compression::PIZ | Compression::PXR24 => Ok(()),
        // the decoder unpacks run lengths (RLE) without a bound
        other => Err(PhotoError::Broken(format!("the OpenEXR file has {other}, which is not read: save it with ZIP"))),
    }
}

/// The number that a sample stands for.
fn sample(kind: SampleType, bytes: &[u8]) -> f32 {
    match (kind, bytes) {
        (SampleType::F16, &[a, b]) => f16::from_ne_bytes([a, b]).to_f32(),
        (SampleType::F32, &[a, b, c, d]) => f32::from_ne_bytes([a, b, c, d]),
        (SampleType::U32, &[a, b, c, d]) => u32::from_ne_bytes([a, b, c, d]) as f32,
        _ => f32::NAN,
    }
}

/// The part and the channel that hold depth: the first of `Z`, `Depth`, `*.Z`, `*.Depth` or `*Depth.V`, `V`, `Y`; else the only channel
/// beside alpha. The case of letters does not matter.
fn choose(headers: &[Header]) -> Result<(usize, usize), PhotoError> {
    let name = |channel: &ChannelDescription| channel.name.to_string().to_lowercase();
    let is_opaque = |name: &str| !matches!(name.rsplit('.').next(), Some("a" | "alpha"));
    let only = headers.iter().flat_map(|header| &header.channels.list).filter(|channel| is_opaque(&name(channel))).count() == 1;
    let mut found = Vec::new();
    for (part, header) in headers.iter().enumerate() {
        let names: BTreeSet<String> = header.channels.list.iter().map(name).collect();
        for (index, name) in header.channels.list.iter().map(name).enumerate() {
            let (group, last) = name.split_at(name.rfind('.').map_or(0, |dot| dot + 1));
            let is_beside = |other: &str| names.contains(&format!("{group}{other}"));
            let rank = match (group, last) {
                // of positions, normals or motion; of texture coordinates
                (_, "z" | "y") if is_beside("x") => continue,
                (_, "v") if is_beside("u") => continue,
                ("", "z") => 0,
                ("", "depth") => 1,
                (_, "z" | "depth") => 2,
                (_, "v") if group.ends_with("depth.") => 2,
                ("", "v") => 3,
                ("", "y") => 4,
                _ if only && is_opaque(last) => 5,
                _ => continue,
            };
            found.push((rank, part, index));
        }
    }
    found.into_iter().min().map(|(_, part, index)| (part, index)).ok_or_else(|| {
        let names = headers.iter().flat_map(|header| &header.channels.list).map(|channel| channel.name.to_string());
        let first = names.take(12).collect::<Vec<_>>().join(", ");
        PhotoError::Broken(format!("no channel of the OpenEXR file is called Z, Depth, V or Y; the first are {first}"))
    })
}

#[cfg(test)]
mod tests {
    use exr::image::write::WritableImage;
    use exr::image::{AnyChannel, AnyChannels, Blocks, Encoding, FlatSamples, Image, Layer, Levels};
    use exr::math::RoundingMode;
    use exr::meta::BlockDescription;
    use exr::meta::attribute::{IntegerBounds, LevelMode, LineOrder, TileDescription};
    use exr::meta::header::{ImageAttributes, LayerAttributes};

    use super::*;

    const TILES: Blocks = Blocks::Tiles(Vec2(16, 8));

    /// 37 × 21 samples that begin at this place of a display window of this size.
    fn file((x, y): (i32, i32), compression: Compression, blocks: Blocks, samples: &FlatSamples) -> Vec<u8> {
        let encoding = Encoding { compression, blocks, line_order: LineOrder::Increasing };
        let channels = ["A", "Z"].map(|name| AnyChannel::new(name, samples.clone())).into_iter().collect();
        let attributes = LayerAttributes::default().with_position(Vec2(10 + x, 20 + y));
        let layer = Layer::new(Vec2(37, 21), attributes, encoding, AnyChannels::sort(channels));
        let mut bytes = Cursor::new(Vec::new());
        Image::new(ImageAttributes::new(IntegerBounds::new(Vec2(10, 20), Vec2(37, 21))), layer).write().to_buffered(&mut bytes).unwrap();
        bytes.into_inner()
    }

    /// Whole numbers that 16 bits hold.
    fn floats() -> Vec<f32> {
        (0..37 * 21).map(|i| (i % 37 * 3 + i / 37 * 5) as f32).collect()
    }

    fn values(bytes: &[u8]) -> Vec<f32> {
        read(bytes, &Limits::default()).unwrap().values
    }

    #[test]
    fn all_kinds_of_files_hold_the_same_values() {
        use Compression::{PIZ, PXR24, Uncompressed, ZIP1, ZIP16};
        let want = floats();
        let halves = FlatSamples::F16(want.iter().copied().map(f16::from_f32).collect());
        let whole = FlatSamples::U32(want.iter().map(|v| *v as u32).collect());
        for packed in [Uncompressed, ZIP1, ZIP16, PIZ, PXR24] {
            for blocks in [Blocks::ScanLines, TILES, Blocks::Tiles(Vec2(64, 64))] {
                for samples in [FlatSamples::F32(want.clone()), halves.clone(), whole.clone()] {
                    assert_eq!(values(&file((0, 0), packed, blocks, &samples)), want, "{packed:?} {blocks:?}");
                }
            }
        }
    }

    /// Files that another program wrote, and that ffmpeg reads, too: floats beside colours in halves, and the second of two parts.
    #[test]
    fn files_of_another_writer_are_read() {
        let zip = values(include_bytes!("../../../../fuzz/seeds/depth/zip.exr"));
        let want = |i: usize| if i == 43 { f32::INFINITY } else { (2 + i % 20 / 5 * 3 + i / 20 / 4) as f32 };
        assert!(zip.len() == 20 * 18 && zip[44].is_nan(), "{zip:?}");
        assert!(zip.iter().enumerate().all(|(i, got)| i == 44 || got.total_cmp(&want(i)).is_eq()), "{zip:?}");
        let want: Vec<f32> = (0..6 * 4).map(|i| (1 + i % 6 + i / 6) as f32).collect();
        assert_eq!(values(include_bytes!("../../../../fuzz/seeds/depth/parts.exr")), want);
    }

    #[test]
    fn depth_is_found_by_the_names_that_renderers_give_it() {
        let cases: [(&[&str], &str); 8] = [
            (&["A", "B", "G", "R", "Z"], "Z"),
            (&["B", "G", "R", "depth"], "depth"),
            (&["Depth.V", "Image.B", "Image.G", "Image.R"], "Depth.V"),
            (&["Layer.Combined.R", "Layer.Depth.Z", "Layer.Normal.X", "Layer.Normal.Z", "Layer.UV.U", "Layer.UV.V"], "Layer.Depth.Z"),
            (&["A", "Y"], "Y"),
            (&["A", "distance"], "distance"),
            (&["N.X", "N.Y", "N.Z"], "none"),
            (&["B", "G", "R"], "none"),
        ];
        for (names, want) in cases {
            let channels = names.iter().map(|name| ChannelDescription::named(*name, SampleType::F32)).collect();
            match choose(&[Header::new("".into(), (4, 3), channels)]) {
                Ok((_, channel)) => assert_eq!(names[channel], want),
                Err(error) => assert!(want == "none" && error.to_string().contains(&names.join(", ")), "{error}"),
            }
        }
    }

    #[test]
    fn the_display_window_is_the_picture() {
        let z = floats();
        let samples = FlatSamples::F32(z.clone());
        for (x, y) in [(3, 2), (-3, -2), (0, 40), (-100, 500)] {
            let moved = values(&file((x, y), Compression::ZIP1, TILES, &samples));
            for (i, got) in moved.iter().enumerate() {
                let (column, row) = (i as i32 % 37 - x, i as i32 / 37 - y);
                let is_stored = (0..37).contains(&column) && (0..21).contains(&row);
                assert!(if is_stored { got.total_cmp(&z[(row * 37 + column) as usize]).is_eq() } else { got.is_nan() }, "{x} {y} {i}");
            }
        }
    }

    #[test]
    fn smaller_copies_are_skipped() {
        let level = |side: usize, value: f32| FlatSamples::F32(vec![value; side * side]);
        let levels = Levels::Mip { rounding_mode: RoundingMode::Down, level_data: vec![level(4, 1.0), level(2, 2.0), level(1, 3.0)] };
        let channels = AnyChannels::sort([AnyChannel::new("Z", levels)].into_iter().collect());
        let encoding = Encoding { compression: Compression::ZIP1, blocks: Blocks::Tiles(Vec2(2, 2)), line_order: LineOrder::Increasing };
        let mut bytes = Cursor::new(Vec::new());
        Image::from_encoded_channels(Vec2(4, 4), encoding, channels).write().to_buffered(&mut bytes).unwrap();
        assert_eq!(values(&bytes.into_inner()), [1.0; 16]);
    }

    #[test]
    fn files_that_would_take_much_to_unpack_are_refused() {
        let checked = |compression, side| {
            let channels = [ChannelDescription::named("Z", SampleType::F32)].into_iter().collect();
            let tiles = TileDescription { tile_size: Vec2(1, 1), level_mode: LevelMode::Singular, rounding_mode: RoundingMode::Down };
            let header = Header::new("".into(), (side, 1), channels);
            check_packing(&header.with_encoding(compression, BlockDescription::Tiles(tiles), LineOrder::Increasing))
        };
        assert!(checked(Compression::PIZ, PIZ_BLOCKS).is_ok() && checked(Compression::ZIP1, PIZ_BLOCKS + 1).is_ok());
        assert!(checked(Compression::PIZ, PIZ_BLOCKS + 1).unwrap_err().to_string().contains("over the limit of 32768"));
        assert!(checked(Compression::RLE, 1).unwrap_err().to_string().contains("save it with ZIP"));
    }

    #[test]
    fn limits_are_checked_by_the_headers() {
        let bytes = file((0, 0), Compression::ZIP16, TILES, &FlatSamples::F32(floats()));
        // the values, and four tiles of two channels
        let limits = Limits { pixels: 777, side: 37, bytes: bytes.len(), decoder_memory: 4 * 777 + 4 * 1024, ..Limits::default() };
        assert!(is_openexr(&bytes) && check(&bytes, &limits).is_ok() && read(&bytes, &limits).is_ok());
        for (over, named) in [
            (Limits { pixels: 776, ..limits }, "limit of 776 pixels"),
            (Limits { side: 36, ..limits }, "limit of 36 pixels a side"),
            (Limits { bytes: bytes.len() - 1, ..limits }, "bytes"),
            (Limits { decoder_memory: 7203, ..limits }, "7204 bytes, over the limit of 7203 bytes"),
        ] {
            let [checked, read] = [check(&bytes, &over).err(), read(&bytes, &over).err()].map(|error| error.unwrap().to_string());
            assert!(checked == read && read.contains(named), "{read}");
        }
        for end in 4..bytes.len() {
            assert!(read(&bytes[..end], &limits).is_err());
            match head(&bytes[..end], &limits).unwrap() {
                Head::Needs(more) => assert!(more > end && check(&bytes[..end], &limits).is_err()),
                seen => assert_eq!(seen, Head::Size(37, 21)),
            }
        }
        assert_eq!(head(&bytes, &limits).unwrap(), Head::Size(37, 21));
    }
}
