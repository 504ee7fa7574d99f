#![allow(clippy::unwrap_used, reason = "test")]

use proptest::prelude::*;

use super::chunk::{self, Area};
use super::layers::{TURN, TURNS};
use super::schema::{self, Video};
use super::*;
use crate::layers::STEADY;
use crate::{Geometry, Grid, Inpainter, Intrinsics, Photo, Plane, Tile, ViewBox};

/// Tiles that differ, with labels in patches; every third tile has a background plane.
fn geometry(width: u32, height: u32, size: u32, seed: u32) -> Geometry {
    let grid = Grid::new(width, height, size);
    let share = |i: u32| f64::from(i.wrapping_mul(0x9E37_79B1) >> 16) / 65_536.0;
    let tile = |t: u32| {
        let (r, n) = (grid.rect(t), 1 + (t.wrapping_mul(7) + seed) % 5);
        let plane = |i: u32| Plane { a: share(t * 64 + i + seed), b: share(i + seed) / 4.0 - 0.1, c: 0.02 * f64::from(i) }.quantised();
        Tile {
            planes: (0..n).map(plane).collect(),
            labels: (0..r.h).flat_map(|y| (0..r.w).map(move |x| (((x + r.x) / 9 + (y + r.y) / 13) % n) as u8)).collect(),
            background: (t % 3 == 1).then(|| plane(9)),
        }
    };
    let tiles = (0..grid.tiles()).map(tile).collect();
    Geometry { grid, intrinsics: Intrinsics::centred(width, height, 300.0), view_box: ViewBox::cube(0.03), tiles, matte_band: 0 }
}

/// A frame `elapsed` after the previous one, with its own tiles.
fn after(elapsed: Option<std::time::Duration>) -> FrameTiming {
    FrameTiming { elapsed, ..FrameTiming::default() }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn areas_cover_exactly_the_wanted_tiles(w in 1u32..300, h in 1u32..300, bits in any::<u64>()) {
        let grid = Grid::new(w, h, 64);
        let wanted = |t: u32| bits >> (t % 64) & 1 == 1;
        let mut found: Vec<u32> = Area::covering(&grid, wanted).into_iter().flat_map(|a| a.tiles(&grid)).collect();
        found.sort_unstable();
        prop_assert_eq!(found, (0..grid.tiles()).filter(|t| wanted(*t)).collect::<Vec<_>>());
    }

    #[test]
    fn tiles_round_trip_in_any_chunks(w in 1u32..200, h in 1u32..200, size in 16u32..70, seed in 0u32..100, bits in any::<u64>()) {
        let whole = geometry(w, h, size, seed);
        let grid = whole.grid;
        let chunks = |wanted: &dyn Fn(u32) -> bool, version| -> Vec<_> {
            Area::covering(&grid, wanted).into_iter().map(|a| chunk::encode(&grid, a, &whole.tiles, version).unwrap()).collect()
        };
        let first = |t: u32| bits >> (t % 64) & 1 == 1;
        let mut model = TileState::new(&TileState::hello(&whole)).unwrap();
        let taken = model.take(&schema::Geometry { frame: 1, chunks: chunks(&first, 1) }).unwrap();
        prop_assert!(taken.iter().all(|t| first(*t)));
        let rest = schema::Geometry { frame: 2, chunks: chunks(&|t| !first(t), 2) };
        let bytes = write(schema::message::Kind::Geometry(rest));
        let Kind::Geometry(rest) = read(bytes).unwrap() else { panic!("another kind") };
        model.take(&rest).unwrap();
        prop_assert_eq!(model.geometry(), Some(&whole));
        // older chunks, and the same ones again
        prop_assert_eq!(model.take(&schema::Geometry { frame: 1, chunks: chunks(&|_| true, 1) }).unwrap(), Vec::<u32>::new());
    }

    /// After any sequence of changes, the incremental layers are those of the last tiles and frame alone, and tiles reported as unchanged
    /// are unchanged.
    #[test]
    fn incremental_layers_equal_a_fresh_start(
        w in 40u32..260, h in 40u32..200,
        steps in prop::collection::vec((any::<u64>(), any::<[u16; 4]>()), 1..5),
    ) {
        let mut now = geometry(w, h, 64, 0);
        now.view_box = ViewBox { x: 0.05, y: 0.03, z: 0.04 };
        let grid = now.grid;
        let mut photo = Photo { width: w, height: h, rgb: (0..w * h).map(|i| [(i % 251) as u8, (i / w) as u8, (i * 7 / 3) as u8]).collect() };
        let mut kept = Layers::default();
        prop_assert_eq!(kept.update(&now, |_| false, photo.clone(), after(Some(TURN))).layers.len(), grid.tiles() as usize);
        for (seed, (bits, [x, y, side, colour])) in (1u32..).zip(steps) {
            let other = geometry(w, h, 64, seed);
            let changed = |t: u32| bits >> (t % 64) & 7 == 7;
            for t in (0..grid.tiles()).filter(|t| changed(*t)) {
                now.tiles[t as usize] = other.tiles[t as usize].clone();
            }
            let (x, y, side) = (u32::from(x) % w, u32::from(y) % h, u32::from(side) % 40);
            for at in (y..h.min(y + side)).flat_map(|y| (x..w.min(x + side)).map(move |x| y * w + x)) {
                photo.rgb[at as usize] = colour.to_le_bytes().map(|c| c ^ at as u8).into_iter().chain([9]).collect::<Vec<_>>().try_into().unwrap();
            }
            let before: Vec<_> = (0..grid.tiles()).map(|t| kept.tile(t).cloned()).collect();
            let mut changes = kept.update(&now, changed, photo.clone(), after(Some(TURN)));
            // hidden colours follow, one group at a time, or all at once after the same total time
            let (frames, elapsed) = if seed % 2 == 0 { (TURNS, TURN) } else { (1, TURN * TURNS) };
            for _ in 0..frames {
                changes.texels.extend(kept.update(&now, |_| false, photo.clone(), after(Some(elapsed))).texels);
            }
            let mut fresh = Layers::default();
            fresh.update(&now, |_| true, photo.clone(), after(Some(TURN)));
            for t in 0..grid.tiles() {
                let (is, was, should) = (kept.tile(t).unwrap(), before[t as usize].as_ref().unwrap(), fresh.tile(t).unwrap());
                prop_assert!(is.layers == should.layers && is.texels == should.texels, "tile {}", t);
                prop_assert!(changes.texels.contains(&t) || is.texels == was.texels, "tile {}", t);
                prop_assert!(changes.layers.contains(&t) || is.layers == was.layers, "tile {}", t);
            }
            // a repeated frame changes nothing
            prop_assert_eq!(kept.update(&now, |_| false, photo.clone(), after(Some(TURN))), Changes::default());
        }
    }

    /// After any changes, hidden texels show remembered colours, and inpainted ones otherwise.
    #[test]
    fn layers_with_a_memory_show_what_is_remembered(
        w in 40u32..200, h in 40u32..140,
        steps in prop::collection::vec((any::<u64>(), any::<[u16; 4]>()), 1..4), rate in prop::sample::select(vec![1u32, 2, 5, 15, 30]),
    ) {
        let mut now = geometry(w, h, 64, 0);
        now.view_box = ViewBox { x: 0.05, y: 0.03, z: 0.04 };
        let (grid, elapsed) = (now.grid, Some(TURN * rate));
        let mut photo = Photo { width: w, height: h, rgb: (0..w * h).map(|i| [(i % 251) as u8, (i / w) as u8, (i * 7 / 3) as u8]).collect() };
        let mut kept = Layers::with_memory();
        kept.update(&now, |_| false, photo.clone(), after(elapsed));
        for (seed, (bits, [x, y, side, colour])) in (1u32..).zip(steps) {
            // long enough to remember everything that stays
            for _ in 0..=STEADY + 1 {
                kept.update(&now, |_| false, photo.clone(), after(elapsed));
            }
            let other = geometry(w, h, 64, seed);
            let changed = |t: u32| bits >> (t % 64) & 3 == 3;
            for t in (0..grid.tiles()).filter(|t| changed(*t)) {
                now.tiles[t as usize] = other.tiles[t as usize].clone();
            }
            let (x, y, side) = (u32::from(x) % w, u32::from(y) % h, u32::from(side) % 60);
            for at in (y..h.min(y + side)).flat_map(|y| (x..w.min(x + side)).map(move |x| y * w + x)) {
                photo.rgb[at as usize] = [colour as u8, (colour >> 8) as u8, at as u8];
            }
            kept.update(&now, changed, photo.clone(), after(elapsed));
            // until no label follows, everything is remembered, and every hidden colour has had its turn since
            for _ in 0..=MAX_MOTION_FRAMES + u32::from(STEADY) + 1 + TURNS {
                kept.update(&now, |_| false, photo.clone(), after(elapsed));
            }
            let masks = now.masks();
            let shown: Vec<Vec<_>> = (0..grid.tiles()).map(|t| {
                let part = kept.tile(t).unwrap();
                let ends = part.layers.iter().skip(1).map(|l| l.first_hidden).chain([part.texels.hidden.len()]);
                part.layers.iter().zip(ends).map(|(l, end)| part.texels.hidden[l.first_hidden..end].to_vec()).collect()
            }).collect();
            let mut wanted = Inpainter::new(&photo, &now).fill_all(&masks);
            kept.memory().unwrap().recall(0, &masks, &mut wanted);
            prop_assert!(shown == wanted);
            let laid = (0..).zip(&masks).all(|(t, m)| kept.tile(t).unwrap().layers.iter().map(|l| (l.rect, l.plane)).eq(m.layers.iter().map(|m| (m.rect, m.plane))));
            prop_assert!(laid);
        }
    }

    #[test]
    fn a_changed_byte_of_a_chunk_is_an_error(seed in 0u32..50, at in any::<u16>(), flip in 1u8..) {
        let whole = geometry(130, 100, 64, seed);
        let good = chunk::encode(&whole.grid, Area::all(&whole.grid), &whole.tiles, 7).unwrap();
        let mut bad = good.clone();
        let mut labels = bad.label_data.to_vec();
        let at = usize::from(at) % labels.len();
        labels[at] ^= flip;
        bad.label_data = labels.into();
        prop_assert!(chunk::decode(&whole.grid, &bad).is_err());
        for wrong in [schema::Chunk { column: 1, ..good.clone() }, schema::Chunk { version: 8, ..good.clone() }, schema::Chunk { planes: 1, ..good }] {
            prop_assert!(chunk::decode(&whole.grid, &wrong).is_err());
        }
    }
}

#[test]
fn a_message_too_long_or_of_no_kind_is_refused() {
    let video = |n: usize| write(Kind::Video(Video { data: vec![0; n].into(), ..Video::default() }));
    let most = MAX_MESSAGE - (video(MAX_MESSAGE).len() - MAX_MESSAGE);
    assert_eq!(video(most).len(), MAX_MESSAGE);
    assert!(read(video(most)).is_ok());
    assert!(read(video(most + 1)).is_err());
    assert!(read(prost::bytes::Bytes::new()).is_err());
}

#[test]
fn chunks_are_counted_before_they_take_memory() {
    let of = |count: usize| write(Kind::Snapshot(schema::Geometry { frame: 1, chunks: vec![schema::Chunk::default(); count] }));
    assert!(read(of(MAX_CHUNKS)).is_ok());
    assert!(read(of(MAX_CHUNKS + 1)).is_err());
    // a field may be split into parts
    let twice = [of(MAX_CHUNKS), of(1)].concat();
    assert!(read(twice.into()).is_err());
}

/// Set `TMPI_BLESS=live` to write the seeds.
#[test]
fn seeds_of_the_fuzzer_are_messages() {
    let whole = geometry(130, 100, 64, 3);
    let chunk = |area| chunk::encode(&whole.grid, area, &whole.tiles, 7).unwrap();
    let runs = Area::covering(&whole.grid, |t| t % 3 != 1).into_iter().map(chunk).collect();
    let seeds = [
        ("hello", Kind::Hello(TileState::hello(&whole))),
        ("snapshot", Kind::Snapshot(schema::Geometry { frame: 7, chunks: vec![chunk(Area::all(&whole.grid))] })),
        ("geometry", Kind::Geometry(schema::Geometry { frame: 7, chunks: runs })),
        ("video", Kind::Video(Video { frame: 3, time: 5, key: true, layer: 1, data: vec![1; 20].into() })),
        ("bye", Kind::Bye(schema::Bye { reason: "the end".into(), again: true, ..schema::Bye::default() })),
    ];
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds/message");
    for (name, kind) in seeds {
        let (file, bytes) = (folder.join(name), write(kind));
        if std::env::var("TMPI_BLESS").is_ok_and(|v| v == "live") {
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(&file, &bytes).unwrap();
        }
        // retrained models write other bytes; old seeds must stay readable
        assert!(read(std::fs::read(&file).unwrap().into()).is_ok(), "{name}");
        fuzz_message(&bytes);
    }
}

#[test]
fn a_room_beyond_the_bounds_is_refused() {
    let hello = TileState::hello(&geometry(130, 100, 64, 0));
    assert!(TileState::new(&hello).is_ok());
    assert!(matches!(TileState::new(&schema::Hello { version: VERSION + 1, ..hello.clone() }), Err(LiveError::Newer { .. })));
    assert!(TileState::new(&schema::Hello { width: 1920, height: 1088, ..hello.clone() }).is_ok());
    assert!(TileState::new(&schema::Hello { width: 1920, height: 1089, ..hello.clone() }).is_err());
    assert!(TileState::new(&schema::Hello { tile_size: 16, tile_stride: 14, ..hello.clone() }).is_ok());
    assert!(TileState::new(&schema::Hello { tile_size: 15, tile_stride: 14, ..hello.clone() }).is_err());
    assert!(TileState::new(&schema::Hello { width: 0, ..hello.clone() }).is_err());
    assert!(TileState::new(&schema::Hello { fx: f64::NAN, ..hello }).is_err());
}
