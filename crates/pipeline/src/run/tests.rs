//! Tests of the errors in the report. `tests/report.rs` compares the figures with their definitions.

use std::sync::Arc;

use super::*;
use crate::depth::to_png;
use crate::photo::Limits;
use image::ExtendedColorType;
use tmpi_core::{Photo, container};
use tmpi_render::{difference::psnr, draw_reference_view};
use tmpi_testing::pictures::{noise, png, waves as photo};

fn made(photo: &[u8], depth: &DisparityMap, options: &Options) -> Made {
    // all photos here come with a depth map
    let models = Models { depth: Arc::new(("none", |_: &Photo| Err(DepthError::NotEmbedded))), theta: None, psi: None };
    make(&models, &Limits::default(), photo, Some(&to_png(depth).unwrap()), options, &Silent).unwrap()
}

fn plain() -> Options {
    Options { denoise: Denoise::Off, snap: Switch::Off, ..Options::default() }
}

#[test]
fn the_error_bound_holds_if_the_planes_suffice() {
    let slopes = DisparityMap::from_fn(300, 200, |x, y| if x < 150 { 0.2 + 0.001 * y as f32 } else { 0.9 - 0.002 * (x - 150) as f32 });
    for max_error in [0.5, Options::MAX_ERROR, 4.0] {
        let planes = made(&photo(300, 200), &slopes, &Options { max_error, ..plain() }).report.error.planes;
        assert_eq!((planes.missed_tiles, planes.bound_px), (0, Some(max_error)), "{planes:?}");
    }
    let fixed = made(&photo(300, 200), &slopes, &Options { planes: PlaneCount::Fixed(2), ..plain() }).report.error.planes;
    assert_eq!((fixed.bound_px, fixed.missed_tiles, fixed.most_planes), (None, 0, 2));
}

#[test]
fn the_reference_view_is_measured_as_readers_draw_it() {
    // as a whole, and in the pixels of three rows of tiles that no other rows overlap
    for (height, rows) in [(200, vec![0..100, 100..200]), (1400, vec![288..336, 960..1008, 1352..1400])] {
        let (width, file) = (100, photo(100, height));
        let made = made(&file, &DisparityMap::from_fn(width, height, noise), &plain());
        let view = draw_reference_view(&container::decode(&made.container).unwrap()).unwrap();
        let shown: Vec<u8> = view.rgba.iter().flat_map(|p| [p[0], p[1], p[2]]).collect();
        let want = image::load_from_memory(&file).unwrap().into_rgb8().into_raw();
        let of_rows = |all: &[u8]| rows.iter().flat_map(|r| all[r.start * 300..r.end * 300].to_vec()).collect::<Vec<u8>>();
        let (found, drawn) = (made.report.error.identity_psnr, psnr(&of_rows(&shown), &of_rows(&want)));
        assert!((found - drawn).abs() < 1e-3, "{found}, drawn {drawn}");
    }
}

#[test]
fn large_photos_are_measured_on_some_rows_and_tiles() {
    let tall = made(&photo(100, 1400), &DisparityMap::from_fn(100, 1400, noise), &plain()).report;
    assert!(tall.error.identity_tiles < tall.tiles && tall.error.identity_tiles >= tall.tiles / 14, "{}", tall.error.identity_tiles);
    assert!(tall.error.identity_psnr < 60.0);
    let stairs = DisparityMap::from_fn(700, 500, |x, y| ((x / 50 + y / 40) % 5) as f32 / 5.0 + 0.1);
    let pruned = made(&photo(700, 500), &stairs, &plain()).report;
    let some = pruned.error.prune.unwrap();
    assert!(some.tiles < pruned.tiles && some.tiles >= 4 && some.share_off < 0.02, "{some:?}");
}

#[test]
fn the_memory_bound_counts_the_placed_planes() {
    let options = Options { max_error: 0.0, ..plain() };
    let report = made(&photo(200, 150), &DisparityMap::from_fn(200, 150, noise), &options).report;
    // noise takes six planes per tile
    assert_eq!(report.memory_bound_bytes, options.memory_with(&Sizes::of_photo((200, 150)), None, 6));
}

/// A map where this share of the tiles needs many planes.
fn busy(share: f64) -> DisparityMap {
    // nine tiles per row, 56 pixels apart
    let columns = (share * 9.0).round() as u32;
    DisparityMap::from_fn(500, 400, move |x, y| if x < columns * 56 { noise(x, y) } else { 0.5 })
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

#[test]
fn only_what_a_network_draws_too_small_is_widened() {
    let (w, h) = (96, 64);
    let out = |x: u32, y: u32| (x as f32 - 48.0).hypot(y as f32 - 32.0) - 20.0;
    let pixels: Vec<u8> = (0..w * h).flat_map(|i| if out(i % w, i / w) < 0.0 { [200, 40, 40] } else { [110; 3] }).collect();
    let file = png(w, h, &pixels, ExtendedColorType::Rgb8);
    let small = DisparityMap::from_fn(w, h, |x, y| if out(x, y) < -3.0 { 0.8 } else { 0.2 });
    let network = small.clone();
    let models = Models { depth: Arc::new(("small", move |_: &Photo| Ok(network.clone()))), theta: None, psi: None };
    let near = |depth: Option<&[u8]>, snap: Switch| {
        let options = Options { denoise: Denoise::Off, snap, ..Options::default() };
        let made = make(&models, &Limits::default(), &file, depth, &options, &Silent).unwrap();
        made.disparity.delta.iter().filter(|d| **d > 0.5).count()
    };
    let thing = (0..w * h).filter(|i| out(i % w, i / w) < 0.0).count();
    let given = to_png(&small).unwrap();
    assert!(near(None, Switch::Auto).abs_diff(thing) < 30, "{} of {thing} pixels", near(None, Switch::Auto));
    // snapping, too, gives the pixels that touch the near side to it, but none farther out
    assert!(near(None, Switch::On) + 150 < thing, "{} of {thing} pixels", near(None, Switch::On));
    assert!(near(Some(&given), Switch::Auto) + 150 < thing, "{} of {thing} pixels", near(Some(&given), Switch::Auto));
}
