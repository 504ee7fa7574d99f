//! Fuzzing targets for the readers of untrusted bytes. `fuzz.rs` runs them under libFuzzer; `tests/fuzz.rs` runs them on the seeds and on
//! changed seeds. Each target checks its **promise** and returns a bound of the memory that it may take.

use std::fmt::Display;
use std::str::FromStr;

use tmpi::{cli, server};
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::{FrameTiming, Layers, TileState};
use tmpi_core::{DisparityMap, Grid, Photo, Rect, container};
use tmpi_live::access_units::{Splitter, Unit};
use tmpi_live::depth_codec;
use tmpi_live::video::Decoder;
use tmpi_pipeline::depth::{self as maps, DepthKind, Read};
use tmpi_pipeline::{networks, photo, strokes};

mod arbitrary;
mod container_file;
mod room;

/// Runs a reader on the bytes and panics if it breaks its promise; returns the bound of its memory in bytes.
pub type Run = fn(&[u8]) -> usize;

pub const TARGETS: [(&str, Run); 27] = [
    ("container", container),
    ("built", built),
    ("levels", levels),
    ("labels", labels),
    ("planes", planes),
    ("message", message),
    ("room", room),
    ("video", video),
    ("vp9", vp9),
    ("measured", measured),
    ("query", query),
    ("export_order", export_order),
    ("jpeg", photo),
    ("png", photo),
    ("webp", photo),
    ("exif", exif),
    ("icc", icc),
    ("depth", depth),
    ("embedded_depth", embedded_depth),
    ("multipart", multipart),
    ("patch", patch),
    ("strokes", touch_up),
    ("forwarded", forwarded),
    ("link", link),
    ("names", names),
    ("onnx", onnx),
    ("config", config),
];

/// Bytes of memory that any reader may take on any input: threads, tables, messages.
const LEAST: usize = 4 << 20;
/// Bytes of memory for the tiles of the largest room, and for the chunks of a message.
const ROOM: usize = 8 << 20;
/// Containers with more pixels are not decoded here, because that would be slow.
const SLOW: u64 = 128 * 128;

/// A container, as given and with corrected checksums. Promise: an error or a consistent scene; memory by bytes, pixels and texels.
fn container(data: &[u8]) -> usize {
    let most = decoded(data);
    // a fuzzer hardly ever guesses a checksum
    container_file::with_checksums(data).map_or(most, |data| most.max(decoded(&data)) + 2 * data.len())
}

fn decoded(data: &[u8]) -> usize {
    let Ok(size) = container::fuzzing::size(data) else {
        assert!(container::decode(data).is_err(), "a container without a readable index was read");
        return LEAST + 2 * data.len();
    };
    // bounded by the file's size and the sizes in its index
    let most = LEAST + 8 * data.len() + 64 * size.pixels as usize + 12 * size.texels as usize;
    let sections = container::sections(data);
    if size.pixels > SLOW || size.texels > 64 * SLOW {
        return most;
    }
    if let Ok(scene) = container::decode(data) {
        assert_eq!(scene.validate(), Ok(()));
        assert!(sections.is_ok(), "a container was read whose sections cannot be listed");
    }
    most
}

/// Bytes of memory for building and reading the largest container built here.
const BUILT: usize = 256 << 20;

/// Builds a container, up to the size of a photo, and changes it in places. Promise: as for [`levels`], if the container is small.
fn built(data: &[u8]) -> usize {
    if let Some(file) = container_file::build(data) {
        if container::fuzzing::size(&file).is_ok_and(|size| size.pixels <= SLOW) {
            read_all(&file);
        } else if let Ok(scene) = container::decode(&file) {
            assert_eq!(scene.validate(), Ok(()));
        }
    }
    BUILT
}

/// Files derived from an untrusted container: levels, regions, chosen sections, unpacked. Promise: an error, the container itself, or a
/// readable container; no error if the original is readable.
fn levels(data: &[u8]) -> usize {
    if container::fuzzing::size(data).is_ok_and(|size| size.pixels <= SLOW && size.texels <= 64 * SLOW) {
        read_all(container_file::with_checksums(data).as_deref().unwrap_or(data));
    }
    BUILT
}

fn read_all(file: &[u8]) {
    let whole = container::decode(file);
    let same = |made: Result<Vec<u8>, _>, what: &str| match (&whole, made.and_then(|made| container::decode(&made))) {
        (Ok(whole), made) => assert!(made.is_ok_and(|made| made == *whole), "{what}: another scene"),
        (Err(_), made) => assert!(made.is_err(), "{what}: of no container"),
    };
    same(container::unpacked(file), "unpacked");
    same(container::select(file, &container::SECTIONS), "all sections");
    let geometry = container::read_geometry(file);
    assert!(geometry.is_ok() || whole.is_err(), "a scene without geometry");
    let Ok(geometry) = geometry else { return };
    let (width, height) = (geometry.grid.width, geometry.grid.height);
    let readable = |made: Result<Vec<u8>, _>| match made {
        // unchanged: the tiles cannot be halved, or the region covers all of them
        Ok(made) if made == file => None,
        Ok(made) => Some(container::decode(&made).unwrap_or_else(|e| panic!("a derived container cannot be read: {e}"))),
        Err(error) => {
            assert!(whole.is_err(), "a readable container cannot be derived from: {error}");
            None
        }
    };
    for level in [1, container::LEVELS] {
        let small = readable(container::level(file, level));
        assert!(small.is_none_or(|s| s.validate().is_ok() && s.grid.width <= width && s.grid.height <= height));
    }
    let region = Rect { x: width / 3, y: height / 3, w: width.div_ceil(4), h: height.div_ceil(4) };
    if let Ok(Some(tiles)) = container::TileRect::over_region(file, region) {
        let part = readable(container::region(file, &tiles, 0, container::RegionPhoto::Lossless));
        assert!(part.is_none_or(|part| part.grid.width >= region.w && part.grid.height >= region.h));
    }
}

fn grid(width: u8, height: u8, size: u8) -> Grid {
    Grid::new(u32::from(width) + 1, u32::from(height) + 1, u32::from(size) % 80 + 1)
}

/// The labels of a grid. Promise: labels below their tile's count, which survive writing and reading.
fn labels(data: &[u8]) -> usize {
    let Some((head, stream)) = data.split_first_chunk::<8>() else { return LEAST };
    let grid = grid(head[0], head[1], head[2]);
    let counts: Vec<u8> = (0..grid.tiles()).map(|t| head[3 + t as usize % 5] % 66).collect();
    container::fuzzing::labels(&grid, &counts, stream);
    LEAST + 8 * data.len() + 64 * (grid.width * grid.height) as usize
}

/// The planes of a grid, unpacked. Promise: writing them gives the same bytes.
fn planes(data: &[u8]) -> usize {
    let Some((head, columns)) = data.split_first_chunk::<4>() else { return LEAST };
    let grid = grid(head[0], head[1], head[2]);
    let tiles = grid.tiles() as usize;
    let given = columns.len().saturating_sub(tiles) / 6;
    // sometimes a count that does not fit the bytes
    let count = if head[3] < 250 { given } else { given + usize::from(head[3]) };
    container::fuzzing::planes(&grid, count, columns);
    LEAST + 32 * data.len() + 128 * tiles
}

/// A query for a view, a line end, and a `Range`. Promise: an error that names a parameter, or a camera within the limits.
fn query(data: &[u8]) -> usize {
    let text = String::from_utf8_lossy(data);
    let (query, range) = text.split_once('\n').unwrap_or((&text, "bytes=0-"));
    server::fuzzing::view(query);
    server::fuzzing::range(range, data.len());
    LEAST + 64 * data.len()
}

/// An order of an export file, a film, or a model: the query, a line end, and the body in JSON. Promise: an error, or a recipe with a format,
/// whose text reads back as the same recipe.
fn export_order(data: &[u8]) -> usize {
    let end = data.iter().position(|b| *b == b'\n').unwrap_or(data.len());
    let (query, body) = (String::from_utf8_lossy(&data[..end]), data.get(end + 1..).unwrap_or_default());
    server::fuzzing::export_order(&query, body);
    LEAST + 64 * data.len()
}

/// Limits of photos that are decoded here; larger ones would be slow.
const PHOTO: photo::Limits = photo::Limits {
    bytes: 64 << 20,
    pixels: SLOW,
    side: photo::Limits::SIDE,
    decoder_memory: photo::Limits::DECODER_MEMORY,
    memory: u64::MAX,
};
/// Bytes of memory that any decoder may take on any input: tables, rows and an unpacked profile.
const DECODER: usize = 24 << 20;

/// A photo of any format, at its own size and reduced. Promise: the early check agrees with the check of the whole file; decoding refuses
/// a checked photo only for its data; the photo is consistent; the stripped file decodes to the same photo; memory by bytes and pixels.
fn photo(data: &[u8]) -> usize {
    let checked = photo::check(data, &PHOTO);
    for end in [data.len().min(32), data.len() / 2] {
        if let Err(early) = photo::head(&data[..end], &PHOTO) {
            let late = checked.as_ref().map_err(ToString::to_string);
            assert!(late == Err(early.to_string()), "refused by its first bytes, but {late:?} as a whole");
        }
    }
    for most in [None, Some(5)] {
        match photo::decode(data, &PHOTO, most) {
            Ok(got) => {
                assert!(checked.is_ok(), "decoded a photo that the check refuses");
                assert_eq!(got.photo.rgb.len(), got.photo.width as usize * got.photo.height as usize);
                assert!(got.intrinsics.is_valid());
                if let Some(file) = got.stripped {
                    let again = photo::decode(&file, &PHOTO, None).map(|d| d.photo);
                    assert!(again.is_ok_and(|p| p == got.photo), "the stripped file is another photo");
                }
            }
            Err(photo::PhotoError::Broken(text)) => assert!(!text.contains("the decoder failed"), "a decoder panicked"),
            Err(_) => assert!(checked.is_err(), "the check accepts a photo over the limits"),
        }
    }
    LEAST + DECODER + 8 * data.len() + 64 * SLOW as usize
}

/// A TIFF structure. Promise: an orientation and a focal length in their ranges, and hardly any memory.
fn exif(data: &[u8]) -> usize {
    photo::fuzzing::exif(data);
    1 << 10
}

/// A colour profile. Promise: no panic; memory by its bytes and the tables of a conversion.
fn icc(data: &[u8]) -> usize {
    photo::fuzzing::icc(data);
    LEAST + DECODER + 32 * data.len()
}

fn check_map(map: &DisparityMap, width: u32, height: u32) {
    assert_eq!((map.width, map.height, map.delta.len()), (width, height, (width * height) as usize));
    assert!(map.delta.iter().all(|v| (0.0..=1.0).contains(v)));
}

/// A user's depth map, for a photo of another size. Promise: a finite value for each pixel; the check accepts every map that can be read.
fn depth(data: &[u8]) -> usize {
    let kind = if data.last().is_some_and(|b| b % 2 == 1) { DepthKind::Metric } else { DepthKind::Disparity };
    // OpenEXR files may have so many channels that few pixels take all of a decoder's memory
    let limits = photo::Limits { decoder_memory: DECODER as u64, ..PHOTO };
    if let Ok((map, _)) = maps::from_map(data, kind, &limits, 21, 13) {
        assert!(maps::check(data, &limits).is_ok(), "read a map that the check refuses");
        check_map(&map, 21, 13);
    }
    LEAST + DECODER + 8 * data.len() + 64 * SLOW as usize
}

/// A photo with embedded depth. Promise: as for a user's depth map.
fn embedded_depth(data: &[u8]) -> usize {
    if let Ok(Some(found)) = maps::embedded_depth(data)
        && let Ok(Read { map, .. }) = found.read(&PHOTO, 21, 13)
    {
        check_map(&map, 21, 13);
    }
    LEAST + DECODER + 16 * data.len() + 64 * SLOW as usize
}

/// The body of a form with the boundary `x`. Promise: a client error, or options.
fn multipart(data: &[u8]) -> usize {
    server::fuzzing::multipart(data);
    LEAST + 16 * data.len()
}

/// A merge patch of settings. Promise: an error that names its field, or settings that survive writing and reading.
fn patch(data: &[u8]) -> usize {
    server::fuzzing::patch(data);
    LEAST + 64 * data.len()
}

/// A message of a room, as given and with corrected checksums. Promise: an error or consistent tiles; memory by bytes and by the largest
/// room.
fn message(data: &[u8]) -> usize {
    tmpi_core::live::fuzz_message(data);
    if let Some(data) = room::with_checksums(data) {
        tmpi_core::live::fuzz_message(&data);
    }
    LEAST + ROOM + 64 * data.len()
}

/// Builds the tiles of a room and changes them in places. Promise: an error, or consistent tiles that can be shown; memory by the pixels.
fn room(data: &[u8]) -> usize {
    let (hello, messages) = room::build(data);
    let pixels = hello.width as usize * hello.height as usize;
    let most = LEAST + 8 * ROOM + 64 * data.len();
    let Ok(mut model) = TileState::new(&hello) else { return most };
    for message in messages {
        let bytes = tmpi_core::live::write(Kind::Geometry(message.clone()));
        let again = tmpi_core::live::read(bytes);
        assert!(again.is_err() || again.is_ok_and(|again| again == Kind::Geometry(message.clone())), "reading the message again differs");
        let _ = model.take(&message);
    }
    let Some(geometry) = model.geometry() else { return most + 128 * pixels };
    for (t, tile) in (0..).zip(&geometry.tiles) {
        assert_eq!(tile.labels.len(), geometry.grid.rect(t).area());
        assert!(tile.labels.iter().all(|l| usize::from(*l) < tile.planes.len()));
    }
    if pixels as u64 <= SLOW {
        let photo = Photo { width: hello.width, height: hello.height, rgb: vec![[7; 3]; pixels] };
        let changes = Layers::default().update(geometry, |_| true, photo, FrameTiming::default());
        assert_eq!(changes.texels.len(), geometry.tiles.len());
    }
    most + 2048 * pixels
}

/// Size of the video targets' frames.
const FRAME: (u32, u32) = (64, 48);

fn decode_frame(decoder: &mut dyn Decoder, data: &[u8]) {
    if let Ok(Some(photo)) = decoder.decode(data) {
        assert_eq!((photo.width, photo.height, photo.rgb.len()), (FRAME.0, FRAME.1, (FRAME.0 * FRAME.1) as usize));
    }
}

/// The access units of an H.264 stream that comes in pieces of `size` bytes.
fn units(stream: &[u8], size: usize) -> Option<Vec<Unit>> {
    let (mut splitter, mut units) = (Splitter::default(), Vec::new());
    for piece in stream.chunks(size.max(1)) {
        units.extend(splitter.push(piece).ok()?);
    }
    units.extend(splitter.finish());
    Some(units)
}

/// A publisher's H.264 frames. Promise: the same units for any sizes of the pieces; an error or a picture of the right size; memory by the
/// bytes and by that size.
fn video(data: &[u8]) -> usize {
    let whole = units(data, data.len());
    assert_eq!(units(data, 1 + data.len() % 64), whole, "the sizes of the pieces matter");
    if let Ok(mut decoder) = tmpi_live::video::decoder("avc1.42e01e", FRAME) {
        whole.iter().flatten().for_each(|unit| decode_frame(decoder.as_mut(), &unit.data));
    }
    LEAST + ROOM + 16 * data.len()
}

/// VP9 frames, each after its length in two bytes. Promise: as for [`video`].
fn vp9(data: &[u8]) -> usize {
    if let Ok(mut decoder) = tmpi_live::video::decoder("vp09.00.10.08", FRAME) {
        let mut rest = data;
        while let Some((length, frames)) = rest.split_first_chunk::<2>() {
            let (frame, after) = frames.split_at(usize::from(u16::from_le_bytes(*length)).min(frames.len()));
            decode_frame(decoder.as_mut(), frame);
            rest = after;
        }
    }
    LEAST + ROOM + 16 * data.len()
}

/// Depth that a publisher's camera measured, for a frame whose sides are the first two bytes. Promise: an error, or a map of that size
/// within 0 to 1 that survives packing; memory by that size, no matter how much the bytes unpack to.
fn measured(data: &[u8]) -> usize {
    let Some((head, packed)) = data.split_first_chunk::<2>() else { return LEAST };
    let (width, height) = (u32::from(head[0]) + 1, u32::from(head[1]) + 1);
    if let Ok(map) = depth_codec::unpack(packed, width, height) {
        check_map(&map, width, height);
        let again = depth_codec::pack(&map).and_then(|packed| depth_codec::unpack(&packed, width, height));
        assert!(again.is_ok_and(|again| again == map), "the map differs after packing");
    }
    LEAST + 2 * data.len() + 64 * (width * height) as usize
}

/// A merge patch of strokes, applied to a small photo. Promise: an error, with a field if it is JSON, or strokes that survive writing and
/// reading and leave a finite map within 0 to 1; memory by its bytes.
fn touch_up(data: &[u8]) -> usize {
    let most = LEAST + 128 * data.len();
    let strokes = match strokes::patch(data) {
        Ok(strokes) => strokes.unwrap_or_default(),
        Err(error) => {
            assert!(!error.detail.is_empty());
            return most;
        }
    };
    assert_eq!(strokes::read(&strokes::write(&strokes)).as_ref(), Ok(&strokes));
    let photo = Photo { width: 21, height: 13, rgb: (0..21 * 13).map(|i| [i as u8; 3]).collect() };
    let mut map = DisparityMap { width: 21, height: 13, delta: vec![0.5; 21 * 13] };
    strokes::apply(&photo, &mut map, None, &strokes);
    check_map(&map, 21, 13);
    most
}

/// Headers of proxies, one per line. Promise: headers of untrusted proxies do not count; an address, and an origin.
fn forwarded(data: &[u8]) -> usize {
    let text = String::from_utf8_lossy(data);
    let mut lines = text.lines();
    server::fuzzing::forwarded([(); 4].map(|()| lines.next().unwrap_or_default()));
    LEAST + 64 * data.len()
}

/// An address with a signed link. Promise: the address without it has none, and a link survives writing and reading.
fn link(data: &[u8]) -> usize {
    server::fuzzing::link(&String::from_utf8_lossy(data));
    LEAST + 64 * data.len()
}

/// A cursor of the list of photos, an id, a signed link. Promise: an error, or a value that survives writing and reading.
fn names(data: &[u8]) -> usize {
    let text = String::from_utf8_lossy(data);
    same_again::<tmpi_library::Cursor>(&text);
    same_again::<tmpi_library::PhotoId>(&text);
    same_again::<tmpi_library::Link>(&text);
    LEAST + 64 * data.len()
}

fn same_again<T: FromStr + Display + PartialEq>(text: &str) {
    if let Ok(read) = text.parse::<T>() {
        let written = read.to_string();
        assert!(written.parse::<T>().is_ok_and(|again| again == read), "{written} and {text} give different values");
    }
}

/// The graph of a network's file, read before ONNX Runtime loads it. Promise: `None`, or a picture input; memory by its bytes.
fn onnx(data: &[u8]) -> usize {
    if let Some(graph) = networks::onnx_graph(&mut std::io::Cursor::new(data)) {
        assert!(matches!(graph.shape.len(), 4 | 5) && graph.shape.iter().all(|extent| *extent >= -1));
        assert!(graph.external_data.is_sorted());
    }
    LEAST + 16 * data.len()
}

/// A file of settings. Promise: an error, or arguments for the command line.
fn config(data: &[u8]) -> usize {
    cli::fuzz_config(&String::from_utf8_lossy(data));
    LEAST + 256 * data.len()
}
