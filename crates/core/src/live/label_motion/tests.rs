//! Tests of the motion search.

use super::*;
use crate::live::{FrameTiming, Layers};
use crate::scene::packed_rgb::of_word;
use crate::{Grid, Intrinsics, Photo, Plane, ViewBox};

const W: u32 = 96;
const H: u32 = 64;

/// A wall, and in front of it an object of 24 × 30 pixels with its corner at `(x, y)`; labels match.
fn frame(x: u32, y: u32) -> (Geometry, Vec<u32>) {
    frame_on([0.2, 0.7], (x, y))
}

/// The same on planes of these disparities.
fn frame_on(deltas: [f64; 2], (x, y): (u32, u32)) -> (Geometry, Vec<u32>) {
    let inside = |i: u32| (x..x + 24).contains(&(i % W)) && (y..y + 30).contains(&(i / W));
    let wave = |a: u32, b: u32| (127.0 + 100.0 * (f64::from(a) / 3.0).sin() * (f64::from(b) / 4.0).cos()) as u8;
    let rgb = |i| if inside(i) { [200, wave(i % W - x, i / W - y), 40, 0] } else { [20, 40, wave(i % W, i / W) / 2, 0] };
    let colours = (0..W * H).map(|i| u32::from_le_bytes(rgb(i))).collect();
    let grid = Grid::new(W, H, 64);
    let planes = deltas.map(Plane::fronto_parallel).to_vec();
    let of = |t: u32| {
        let r = grid.rect(t);
        let labels = (0..r.area() as u32).map(|i| inside((r.y + i / r.w) * W + r.x + i % r.w).into()).collect();
        Tile { planes: planes.clone(), labels, background: None }
    };
    let tiles = (0..grid.tiles()).map(of).collect();
    (Geometry { grid, intrinsics: Intrinsics::centred(W, H, 50.0), view_box: ViewBox::cube(0.03), tiles, matte_band: 0 }, colours)
}

#[test]
fn labels_follow_an_object() {
    let moves = [(40, 16), (41, 16), (45, 16), (36, 19), (48, 8), (40, 27), (28, 28)];
    for (deltas, to) in [[0.2, 0.7], [0.0, 1.0], [0.5, 0.56]].into_iter().flat_map(|d| moves.map(|to| (d, to))) {
        // adjacent to the border between two tiles
        let (geometry, was) = frame_on(deltas, (40, 16));
        let surface = geometry.surface();
        let (other, now) = frame_on(deltas, to);
        let motion = MotionSearch::new(&geometry, &surface, (&was, &now), Duration::ZERO);
        let vectors = motion.vectors(&[]);
        for (t, (tile, other)) in (0..).zip(geometry.tiles.iter().zip(&other.tiles)) {
            let moved = vectors[t as usize].and_then(|vector| motion.moved(t, vector));
            let off = moved.as_ref().unwrap_or(tile).labels.iter().zip(&other.labels).filter(|(a, b)| a != b).count();
            assert_eq!(off, 0, "pixels of tile {t} at {deltas:?}, to {to:?}");
        }
    }
}

#[test]
fn an_object_with_steady_motion_is_found_beyond_the_search_range() {
    let (geometry, was) = frame(10, 16);
    let surface = geometry.surface();
    let thirtieth = Duration::from_micros(33_333);
    let labels = |motion: &MotionSearch, before: &[Option<MotionVector>]| -> Vec<_> {
        let tile = |(t, vector): (u32, Option<MotionVector>)| {
            vector.and_then(|vector| motion.moved(t, vector)).unwrap_or(geometry.tiles[t as usize].clone()).labels
        };
        (0..).zip(motion.vectors(before)).map(tile).collect()
    };
    let first = frame(20, 18).1;
    let motion = MotionSearch::new(&geometry, &surface, (&was, &first), thirtieth);
    let motion_vectors = motion.vectors(&[]);
    let (other, third) = frame(40, 22);
    let motion = MotionSearch::new(&geometry, &surface, (&was, &third), 3 * thirtieth);
    let expected: Vec<_> = other.tiles.into_iter().map(|t| t.labels).collect();
    assert!(labels(&motion, &[]) != expected, "not found without the previous motions");
    assert!(labels(&motion, &motion_vectors) == expected, "found with the previous motions");
}

#[test]
fn an_object_beyond_the_search_range_is_found_if_its_tiles_point_to_it() {
    // smooth, so that a part of the way explains it better than none
    let frame = |x: u32| {
        let (geometry, mut colours) = frame(x, 16);
        for (i, colour) in (0u32..).zip(&mut colours) {
            if (x..x + 24).contains(&(i % W)) && (16..46).contains(&(i / W)) {
                *colour = u32::from_le_bytes([200, (60 + 5 * (i % W - x)) as u8, (60 + 4 * (i / W - 16)) as u8, 0]);
            }
        }
        (geometry, colours)
    };
    let ((geometry, was), (other, now)) = (frame(10), frame(32));
    let surface = geometry.surface();
    let motion = MotionSearch::new(&geometry, &surface, (&was, &now), Duration::ZERO);
    for (t, vector) in (0..).zip(motion.vectors(&[])) {
        let moved = vector.and_then(|vector| motion.moved(t, vector)).unwrap_or_else(|| geometry.tiles[t as usize].clone());
        assert_eq!(moved.labels, other.tiles[t as usize].labels, "tile {t}");
    }
}

#[test]
fn a_tile_gets_a_plane_for_an_object_that_enters_it() {
    // into a tile that has only the wall
    let border = Grid::new(W, H, 64).rect(1).x;
    let (mut geometry, was) = frame(border - 25, 16);
    let (other, now) = frame(border - 14, 18);
    assert!(!geometry.tiles[1].labels.contains(&1) && other.tiles[1].labels.contains(&1));
    geometry.tiles[1].planes.truncate(1);
    let surface = geometry.surface();
    let motion = MotionSearch::new(&geometry, &surface, (&was, &now), Duration::ZERO);
    let moved = motion.vectors(&[])[1].and_then(|vector| motion.moved(1, vector)).unwrap();
    assert_eq!(moved.labels, other.tiles[1].labels);
    let off = |i: usize| (moved.planes[i].a - other.tiles[1].planes[i].a).abs();
    assert!(moved.planes.len() == 2 && off(0) < 1e-3 && off(1) < 1e-3, "{:?}", moved.planes);
}

#[test]
fn tiles_of_an_object_agree_on_its_motion_and_others_keep_theirs() {
    // textured above, plain below: the lower tiles see only vertical edges, which fit any motion up or down
    let (w, h) = (160, 160);
    let grid = Grid::new(w, h, 64);
    let frame = |x: u32, y: u32, other: u32| {
        let inside = move |u: u32, v: u32| (x..x + 40).contains(&u) && (y..y + 120).contains(&v);
        let second = move |u: u32, v: u32| (other..other + 20).contains(&u) && (16..40).contains(&v);
        let wave = |a: u32| (100.0 * (f64::from(a) / 3.0).sin()) as i32;
        let rgb = |i: u32| {
            let (u, v) = (i % w, i / w);
            match (inside(u, v), second(u, v)) {
                (true, _) if v < y + 40 => [200, (128 + wave(u - x + 2 * (v - y))) as u8, 40, 0],
                (true, _) => [200, 128, 40, 0],
                (_, true) => [40, (128 + wave(u - other + v)) as u8, 220, 0],
                _ => [20, 30, 50, 0],
            }
        };
        let tile = |t: u32| {
            let r = grid.rect(t);
            let near = |i: u32| inside(r.x + i % r.w, r.y + i / r.w) || second(r.x + i % r.w, r.y + i / r.w);
            let labels = (0..r.area() as u32).map(|i| near(i).into()).collect();
            Tile { planes: [0.2, 0.7].map(Plane::fronto_parallel).to_vec(), labels, background: None }
        };
        let tiles: Vec<Tile> = (0..grid.tiles()).map(tile).collect();
        let geometry = Geometry { grid, intrinsics: Intrinsics::centred(w, h, 80.0), view_box: ViewBox::cube(0.03), tiles, matte_band: 0 };
        (geometry, (0..w * h).map(|i| u32::from_le_bytes(rgb(i))).collect::<Vec<u32>>())
    };
    let ((geometry, was), (_, now)) = (frame(20, 20, 110), frame(28, 17, 104));
    let surface = geometry.surface();
    let vectors = MotionSearch::new(&geometry, &surface, (&was, &now), Duration::ZERO).vectors(&[]);
    let of = |x: u32, y: u32| {
        let at = (y / grid.stride).min(grid.rows() - 1) * grid.columns() + (x / grid.stride).min(grid.columns() - 1);
        vectors[at as usize].map(|v| (v.x, v.y))
    };
    assert_eq!([of(30, 30), of(30, 80), of(30, 130)], [Some((8, -3)); 3], "all of the object");
    assert_eq!(of(130, 20), Some((-6, 0)), "the other object");
}

#[test]
fn labels_of_late_tiles_catch_up_with_an_object() {
    let photo = |colours: &[u32]| Photo { width: W, height: H, rgb: colours.iter().map(|c| of_word(*c)).collect() };
    let frames: Vec<_> = [40, 44, 48, 52].map(|x| frame(x, 16)).into();
    let time = Some(Duration::from_millis(33));
    let labels = |geometry: &Geometry| geometry.tiles.iter().map(|t| t.labels.clone()).collect::<Vec<_>>();
    for (late, of) in [(0, 3), (1, 2), (2, 1), (3, 0)] {
        let mut layers = Layers::with_memory();
        for (n, (_, colours)) in (0u64..).zip(&frames) {
            let last = n == 3;
            let when = FrameTiming { frame: n, tiles: last.then(|| n - late), elapsed: time };
            let geometry = if last { &frames[of].0 } else { &frames[0].0 };
            layers.update(geometry, |_| last, photo(colours), when);
        }
        let shown = layers.moved_geometry().unwrap_or(&frames[of].0);
        assert!(labels(shown) == labels(&frames[3].0), "tiles of {late} frames before");
    }
}

#[test]
fn labels_of_a_frame_that_was_not_shown_follow_from_there() {
    let photo = |colours: &[u32]| Photo { width: W, height: H, rgb: colours.iter().map(|c| of_word(*c)).collect() };
    let frames: Vec<_> = [20, 32, 40, 48].map(|x| frame(x, 16)).into();
    let time = |frames: u32| frames * Duration::from_millis(33);
    let labels = |geometry: &Geometry| geometry.tiles.iter().map(|t| t.labels.clone()).collect::<Vec<_>>();
    let mut layers = Layers::with_memory();
    layers.update(&frames[0].0, |_| true, photo(&frames[0].1), FrameTiming { frame: 0, tiles: None, elapsed: Some(Duration::ZERO) });
    for n in [1, 2] {
        layers.skip(&photo(&frames[n].1), n as u64, time(n as u32));
    }
    let when = FrameTiming { frame: 3, tiles: Some(2), elapsed: Some(time(3)) };
    layers.update(&frames[2].0, |_| true, photo(&frames[3].1), when);
    let shown = layers.moved_geometry().unwrap_or(&frames[2].0);
    assert!(labels(shown) == labels(&frames[3].0));
}

#[test]
fn labels_stay_without_a_recognisable_motion() {
    let (geometry, was) = frame(30, 16);
    let surface = geometry.surface();
    let of = |now: &[u32]| {
        let motion = MotionSearch::new(&geometry, &surface, (&was, now), Duration::ZERO);
        (0..).zip(motion.vectors(&[])).filter_map(|(t, vector)| motion.moved(t, vector?)).count()
    };
    assert_eq!(of(&was), 0);
    // noise, a change of light, and an unrelated picture
    let each = |f: &dyn Fn(usize, [u8; 3]) -> [u8; 3]| -> Vec<u32> {
        let other = |(i, word): (usize, &u32)| f(i, of_word(*word));
        was.iter().enumerate().map(other).map(|[r, g, b]| u32::from_le_bytes([r, g, b, 0])).collect()
    };
    assert_eq!(of(&each(&|i, p| p.map(|v| v.saturating_add((i * 7 % 8) as u8)))), 0);
    assert_eq!(of(&each(&|_, p| p.map(|v| v / 2))), 0);
    assert_eq!(of(&each(&|i, _| [(i * 31 % 251) as u8, (i * 17 % 241) as u8, (i * 13 % 239) as u8])), 0);
}
