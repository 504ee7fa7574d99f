//! Regions and smaller levels of a container: each pixel has the mean colour of the pixels that it replaces and the depth of some of them,
//! and poses keep their meaning.

use std::panic::{AssertUnwindSafe, catch_unwind};

use tmpi_core::container::{self, ContainerError, EncodedPhoto, RegionPhoto, TileRect};
use tmpi_core::{Geometry, Intrinsics, Photo, Plane, Rect, TileFrame};
use tmpi_testing::pictures::noise;

use super::Checked;
use super::readers::geometry;

const FAMILY: &str = "levels and regions";

pub(super) fn run(checked: &mut Checked) {
    regions(checked, |file, tiles, level| container::region(file, tiles, level, RegionPhoto::Lossless));
}

/// Geometries, and some of their tiles.
fn sources() -> Vec<(&'static str, Geometry, TileRect)> {
    let slanted = [Plane { a: 0.2, b: 0.1, c: -0.05 }, Plane { a: 0.7, b: -0.1, c: 0.2 }];
    let two = [0.0, 1.0].map(Plane::fronto_parallel);
    let four = [0.1, 0.3, 0.5, 0.9].map(Plane::fronto_parallel);
    vec![
        ("noise on two values", geometry((201, 175), 64, &two, |x, y| u8::from(noise(x, y) < 0.5)), TileRect { columns: 1..4, rows: 0..2 }),
        ("thin bars on slopes", geometry((300, 130), 64, &slanted, |x, _| u8::from(x % 7 == 0)), TileRect { columns: 0..3, rows: 1..3 }),
        ("four values", geometry((127, 300), 64, &four, |x, y| ((x / 3 + y / 5) % 4) as u8), TileRect { columns: 0..2, rows: 2..5 }),
        ("one row", geometry((301, 1), 64, &two, |x, _| u8::from(x / 5 % 2 == 0)), TileRect { columns: 2..6, rows: 0..1 }),
        ("one column", geometry((1, 301), 64, &two, |_, y| u8::from(y / 5 % 2 == 0)), TileRect { columns: 0..1, rows: 2..6 }),
        (
            "a panorama",
            geometry((901, 41), 64, &slanted, |x, y| u8::from((x / 30 + y / 20) % 3 == 0)),
            TileRect { columns: 3..16, rows: 0..1 },
        ),
    ]
}

/// `kernel` makes a container of some tiles at a level.
pub(super) fn regions(checked: &mut Checked, kernel: impl Fn(&[u8], &TileRect, u8) -> Result<Vec<u8>, ContainerError>) {
    for (name, source, tiles) in sources() {
        let (width, height) = (source.grid.width, source.grid.height);
        let photo = Photo::from_fn(width, height, |x, y| [0, 7, 90].map(|more| (noise(x + more, y) * 255.0) as u8));
        let (rect, _) = source.grid.part(tiles.columns.clone(), tiles.rows.clone());
        let file = encoded(&photo, &source).unwrap_or_default();
        for level in 0..=container::LEVELS {
            let read = || container::read(&kernel(&file, &tiles, level)?);
            let made = catch_unwind(AssertUnwindSafe(read)).ok().and_then(Result::ok);
            let error =
                |of: &dyn Fn(&Photo, &Geometry) -> f64| made.as_ref().map_or(f64::INFINITY, |(photo, geometry)| of(photo, geometry));
            let name = |of: &str| format!("{of}, {name}, level {level}");
            // each halving rounds to nearest
            let rounding = 0.5 * f64::from(level) + 1e-9;
            checked.case(FAMILY, &name("colours"), "containers", "levels of 255", rounding, || {
                error(&|found, _| colours(&photo, rect, level, found))
            });
            checked.case(FAMILY, &name("depth"), "containers", "δ", 1e-6, || error(&|_, found| depth(&source, &tiles, level, found)));
            checked.case(FAMILY, &name("camera"), "containers", "pixels", 1e-9, || {
                error(&|_, found| camera(&source.intrinsics, rect, level, &found.intrinsics))
            });
        }
    }
}

fn encoded(photo: &Photo, geometry: &Geometry) -> Result<Vec<u8>, ContainerError> {
    container::encode_geometry(geometry, &EncodedPhoto::lossless(photo)?)
}

/// Largest difference of a colour from the mean of the pixels that it replaces. An odd last row or column counts twice.
fn colours(photo: &Photo, rect: Rect, level: u8, found: &Photo) -> f64 {
    let (mut w, mut h) = (rect.w, rect.h);
    let all = (rect.y..rect.y + h).flat_map(|y| (rect.x..rect.x + w).map(move |x| (x, y)));
    let mut want: Vec<[f64; 3]> = all.map(|(x, y)| photo.at(x, y).map(f64::from)).collect();
    for _ in 0..level {
        let at = |x: u32, y: u32| want[(y.min(h - 1) * w + x.min(w - 1)) as usize];
        let mean = |x: u32, y: u32| {
            let four = [at(2 * x, 2 * y), at(2 * x + 1, 2 * y), at(2 * x, 2 * y + 1), at(2 * x + 1, 2 * y + 1)];
            std::array::from_fn(|c| four.iter().map(|p| p[c]).sum::<f64>() / 4.0)
        };
        let (half_w, half_h) = (w.div_ceil(2), h.div_ceil(2));
        want = (0..half_h).flat_map(|y| (0..half_w).map(move |x| (x, y))).map(|(x, y)| mean(x, y)).collect();
        (w, h) = (half_w, half_h);
    }
    if (found.width, found.height) != (w, h) {
        return f64::INFINITY;
    }
    let pairs = found.rgb.as_flattened().iter().zip(want.as_flattened());
    pairs.map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max)
}

/// Largest difference of δ at a pixel from that of the nearest plane among the pixels that it replaces, at the same place; at half the size,
/// from that of the plane that most of them have, and the nearer one of two that have as many.
fn depth(source: &Geometry, tiles: &TileRect, level: u8, found: &Geometry) -> f64 {
    let (scale, columns) = (1 << level, tiles.columns.end - tiles.columns.start);
    let mut most: f64 = 0.0;
    if found.tiles.len() as u32 != columns * (tiles.rows.end - tiles.rows.start) {
        return f64::INFINITY;
    }
    for (t, tile) in (0..).zip(&found.tiles) {
        let index = (tiles.rows.start + t / columns) * source.grid.columns() + tiles.columns.start + t % columns;
        let Some(whole) = source.tiles.get(index as usize) else { return f64::INFINITY };
        let (r, own) = (source.grid.rect(index), found.grid.rect(t));
        if (own.w, own.h, tile.labels.len()) != (r.w.div_ceil(scale), r.h.div_ceil(scale), own.area()) {
            return f64::INFINITY;
        }
        let (frame, source_frame) = (TileFrame::of(&found.grid, t), TileFrame::of(&source.grid, index));
        for (i, label) in (0..).zip(&tile.labels) {
            let (x, y) = (i % own.w, i / own.w);
            let is = f64::from(frame.disparity(&tile.planes[usize::from(*label)], own.x + x, own.y + y));
            let middle = |at: u32, from: u32| f64::from(from) + (f64::from(at) + 0.5) * f64::from(scale);
            let u = (middle(x, r.x) - source_frame.centre.0) / source_frame.half;
            let v = (middle(y, r.y) - source_frame.centre.1) / source_frame.half;
            let replaced = (0..scale * scale).map(|k| {
                let (x, y) = ((scale * x + k % scale).min(r.w - 1), (scale * y + k / scale).min(r.h - 1));
                whole.labels[(y * r.w + x) as usize]
            });
            let replaced: Vec<u8> = replaced.collect();
            let votes = |label: &u8| replaced.iter().filter(|l| *l == label).count();
            let allowed = match level {
                1 => replaced.iter().max_by_key(|l| (votes(l), **l)).copied().into_iter().collect(),
                _ => replaced.clone(),
            };
            let errors = allowed.iter().map(|l| (whole.planes[usize::from(*l)].disparity(u, v) - is).abs());
            most = most.max(errors.fold(f64::INFINITY, f64::min));
        }
    }
    most
}

/// Largest difference from the camera that sees the same rays.
fn camera(source: &Intrinsics, rect: Rect, level: u8, found: &Intrinsics) -> f64 {
    let scale = f64::from(1 << level);
    let moved = [source.fx, source.fy, source.cx - f64::from(rect.x), source.cy - f64::from(rect.y)];
    let pairs = moved.into_iter().zip([found.fx, found.fy, found.cx, found.cy]);
    pairs.map(|(want, is)| (want / scale - is).abs()).fold(0.0, f64::max)
}
