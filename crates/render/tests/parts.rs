//! Regions and smaller levels of a container look as the whole does.
#![allow(clippy::unwrap_used, reason = "test")]

use std::sync::Arc;

use tmpi_core::container::fixtures::{bare_in, discs};
use tmpi_core::container::{RegionPhoto, TileRect, decode, level, region};
use tmpi_core::{Camera, Pose, Rect, Scene};
use tmpi_render::difference::psnr;
use tmpi_render::{Backend, select};

/// Views of the whole scene and of a part, both of the part's pixels.
fn views(whole: &Arc<Scene>, part: &Arc<Scene>, pose: Pose) -> [Vec<[u8; 4]>; 2] {
    let cpu = select(Backend::Cpu).unwrap();
    let (width, height) = (part.grid.width, part.grid.height);
    let camera = Camera { pose, intrinsics: part.intrinsics, width, height };
    [whole, part].map(|s| cpu.render(s, &camera).unwrap().rgba)
}

#[test]
fn away_from_its_border_a_region_looks_as_the_whole() {
    let whole = bare_in(None, &discs(500, 440));
    let tiles = TileRect::over_region(&whole, Rect { x: 120, y: 120, w: 250, h: 240 }).unwrap().unwrap();
    let [exact, coded] =
        [RegionPhoto::Lossless, RegionPhoto::Jpeg].map(|photo| Arc::new(decode(&region(&whole, &tiles, 0, photo).unwrap()).unwrap()));
    let whole = Arc::new(decode(&whole).unwrap());
    let b = whole.view_box;
    for (x, y, z) in [(0.0, 0.0, 0.0), (1.0, -1.0, 1.0), (-1.0, 1.0, 1.0), (1.0, 1.0, -1.0), (-1.0, -1.0, -1.0)] {
        let pose = Pose::at(x * b.x, y * b.y, z * b.z);
        let (w, h) = (exact.grid.width as usize, exact.grid.height as usize);
        let margin = exact.grid.size as usize;
        let inner = |view: &[[u8; 4]]| -> Vec<[u8; 4]> {
            (margin..h - margin).flat_map(|y| view[y * w + margin..(y + 1) * w - margin].to_vec()).collect()
        };
        let [all, part] = views(&whole, &exact, pose).map(|v| inner(&v));
        assert!(all == part, "({x}, {y}, {z})");
        let [_, part] = views(&whole, &coded, pose).map(|v| inner(&v));
        let psnr = psnr(all.as_flattened(), part.as_flattened());
        assert!(psnr > 38.0, "({x}, {y}, {z}): {psnr} dB");
    }
}

#[test]
fn a_smaller_level_looks_as_the_whole_at_its_size() {
    let file = bare_in(None, &discs(302, 200));
    let [whole, small] = [decode(&file), decode(&level(&file, 1).unwrap())].map(|scene| Arc::new(scene.unwrap()));
    let off = |(a, b): (&[u8; 4], &[u8; 4])| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > 8);
    let percent_off = |[a, b]: [&[[u8; 4]]; 2]| 100 * a.iter().zip(b).filter(|pixels| off(*pixels)).count() / a.len();
    let b = whole.view_box;
    let [all, seen] = views(&whole, &small, Pose::at(b.x, -b.y, b.z));
    let [_, still] = views(&whole, &small, Pose::default());
    let (between, without) = (percent_off([&all, &seen]), percent_off([&all, &still]));
    assert!(between < 1 && without > 9, "{between} % are off, {without} % of a view that does not move");
}
