//! Tests of the errors in the report. `tests/report.rs` compares the figures with their definitions.

use std::sync::Arc;

use super::*;
use crate::depth::to_png;
use crate::photo::Limits;
use tmpi_core::container;
use tmpi_core::{Camera, Photo, Pose};
use tmpi_render::difference::psnr;
use tmpi_render::{Cpu, Renderer};
use tmpi_testing::pictures::{noise, waves as photo};

/// A stand-in for the network: all photos here come with a depth map.
struct Flat;

impl Estimator for Flat {
    fn name(&self) -> &'static str {
        "flat"
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        Ok(DisparityMap { width: photo.width, height: photo.height, delta: vec![0.5; photo.rgb.len()] })
    }
}

fn map(width: u32, height: u32, delta: impl Fn(u32, u32) -> f32) -> DisparityMap {
    DisparityMap { width, height, delta: (0..width * height).map(|i| delta(i % width, i / width)).collect() }
}

fn made(photo: &[u8], depth: &DisparityMap, options: &Options) -> Made {
    let models = Models { depth: Arc::new(Flat), theta: None, psi: None };
    make(&models, &Limits::default(), photo, Some(&to_png(depth).unwrap()), options, &Silent).unwrap()
}

fn plain() -> Options {
    Options { denoise: Denoise::Off, snap: Switch::Off, ..Options::default() }
}

#[test]
fn a_flat_photo_has_only_the_error_of_its_codec() {
    let report = made(&photo(200, 150), &map(200, 150, |_, _| 0.5), &Options::default()).report;
    let e = &report.error;
    assert_eq!((e.reduction, e.resampling, e.denoise, e.snap), (None, None, None, None));
    assert_eq!((e.depth_filled, e.depth_clipped, e.prune, e.hidden_psnr), (None, None, None, None));
    assert_eq!((e.planes.missed_tiles, e.planes.bound_px), (0, Some(Options::MAX_ERROR)));
    assert!(e.planes.mean_px < 0.01 && e.planes.rounding_px < 0.02 && e.planes.smoothing_px.abs() < 1e-12, "{:?}", e.planes);
    assert!(e.codec_psnr < 60.0 && (e.codec_psnr - e.identity_psnr).abs() < 1.5, "{} {}", e.codec_psnr, e.identity_psnr);
}

#[test]
fn the_error_bound_holds_if_the_planes_suffice() {
    let slopes = map(300, 200, |x, y| if x < 150 { 0.2 + 0.001 * y as f32 } else { 0.9 - 0.002 * (x - 150) as f32 });
    for max_error in [0.5, Options::MAX_ERROR, 4.0] {
        let planes = made(&photo(300, 200), &slopes, &Options { max_error, ..plain() }).report.error.planes;
        assert_eq!((planes.missed_tiles, planes.bound_px), (0, Some(max_error)), "{planes:?}");
    }
    let fixed = made(&photo(300, 200), &slopes, &Options { planes: PlaneCount::Fixed(2), ..plain() }).report.error.planes;
    assert_eq!((fixed.bound_px, fixed.missed_tiles, fixed.most_planes), (None, 0, 2));
}

#[test]
fn the_report_holds_the_errors_of_a_reduction_and_of_a_budget() {
    let deep = map(400, 300, noise);
    let report = made(&photo(400, 300), &deep, &Options { max_size: Some(100), ..plain() }).report;
    let reduction = report.error.reduction.unwrap();
    assert!((reduction.scale - 0.25).abs() < 1e-12 && (10.0..40.0).contains(&reduction.psnr.unwrap()), "{reduction:?}");
    let hurried = made(&photo(400, 300), &deep, &Options { budget_ms: Some(1.0), ..plain() }).report;
    assert!(hurried.error.planes.bound_px.unwrap() > Options::MAX_ERROR && hurried.error.reduction.is_some(), "{:?}", hurried.error.planes);
}

#[test]
fn the_reference_view_is_drawn_from_the_container() {
    // with one row of tiles, the whole view is drawn
    let whole = photo(200, 60);
    for quality in [30, 90] {
        let made = made(&whole, &map(200, 60, |x, _| if x < 90 { 0.2 } else { 0.8 }), &Options { quality, ..plain() });
        let scene = Arc::new(container::decode(&made.container).unwrap());
        let camera = Camera { pose: Pose::default(), intrinsics: scene.intrinsics, width: 200, height: 60 };
        let drawn: Vec<u8> = Cpu::default().render(&scene, &camera).unwrap().rgba.iter().flat_map(|p| [p[0], p[1], p[2]]).collect();
        let given = crate::photo::decode(&whole, &Limits::default(), None).unwrap().photo;
        let e = &made.report.error;
        assert_eq!(e.identity_tiles, made.report.tiles);
        assert!((e.identity_psnr - psnr(&drawn, given.rgb.as_flattened())).abs() < 1e-9);
        assert!((e.codec_psnr - psnr(scene.photo.rgb.as_flattened(), given.rgb.as_flattened())).abs() < 1e-9);
    }
    // with many rows, only some are drawn
    let tall = made(&photo(100, 1400), &map(100, 1400, noise), &plain()).report;
    assert!(tall.error.identity_tiles < tall.tiles && tall.error.identity_tiles >= tall.tiles / 14, "{}", tall.error.identity_tiles);
    assert!(tall.error.identity_psnr < 60.0);
}

#[test]
fn pruning_is_measured_on_some_tiles_or_with_verify_prune_on_all() {
    let stairs = map(700, 500, |x, y| ((x / 50 + y / 40) % 5) as f32 / 5.0 + 0.1);
    let sampled = made(&photo(700, 500), &stairs, &plain()).report;
    let some = sampled.error.prune.unwrap();
    assert!(some.tiles < sampled.tiles && some.tiles >= 4 && some.share_off < 0.02, "{some:?}");
    let all = made(&photo(700, 500), &stairs, &Options { verify_prune: true, ..plain() }).report;
    assert_eq!(all.error.prune.unwrap().tiles, all.tiles);
}

#[test]
fn the_memory_bound_counts_the_placed_planes() {
    let options = Options { max_error: 0.0, ..plain() };
    let report = made(&photo(200, 150), &map(200, 150, noise), &options).report;
    // noise takes six planes per tile
    assert_eq!(report.memory_bound_bytes, options.memory_with(&Sizes::of_photo((200, 150)), None, 6));
}

/// A map where this share of the tiles needs many planes.
fn busy(share: f64) -> DisparityMap {
    // nine tiles per row, 56 pixels apart
    let columns = (share * 9.0).round() as u32;
    map(500, 400, move |x, y| if x < columns * 56 { noise(x, y) } else { 0.5 })
}

#[test]
fn a_budget_never_increases_planes_size_or_bytes() {
    for share in [0.0, 0.5, 0.9] {
        let make = |budget_ms| made(&photo(500, 400), &busy(share), &Options { budget_ms, ..plain() }).report;
        let plenty = make(Some(1e7));
        let budget = |report: &Report| report.budget.clone().unwrap();
        assert!((budget(&plenty).busy - share).abs() < 0.1, "{share}: {:?}", budget(&plenty));
        assert_eq!(plenty.error.planes.bound_px, Some(Options::MAX_ERROR));
        let free = make(None);
        assert_eq!((plenty.planes, plenty.bytes.total), (free.planes, free.bytes.total), "{share}: a sufficient budget changes nothing");
        for asked in [1.0, 30.0, 60.0] {
            let hurried = make(Some(asked));
            let (size, whole) = (hurried.width * hurried.height, free.width * free.height);
            assert!(hurried.planes <= free.planes && size <= whole && hurried.bytes.total <= free.bytes.total, "{share}, {asked} ms");
        }
        // one plane is enough for all tiles of a flat photo at any error: a larger error would save nothing
        let bound = make(Some(1.0)).error.planes.bound_px.unwrap();
        assert_eq!(bound > Options::MAX_ERROR, share > 0.0, "{share}: {bound}");
    }
}
