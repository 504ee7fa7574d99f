//! Makes six photos whose reports contain errors of every kind. Compares each figure with its definition, computed in `f64` from the files,
//! the maps between the steps, and what a reader of the container gets.
//!
//! `cargo test -p tmpi-pipeline --test report -- --nocapture` prints the reported and the computed figures.
#![allow(clippy::unwrap_used, reason = "test")]

use std::sync::Arc;

use image::ExtendedColorType;
use tmpi_core::container;
use tmpi_core::{Camera, Class, DisparityMap, Geometry, Intrinsics, Photo, Pose, Scene, TileFrame, ViewBox, compose, texture};
use tmpi_pipeline::depth::{DepthError, DepthKind, to_png};
use tmpi_pipeline::networks::{Network, OnnxError, Tensor};
use tmpi_pipeline::photo::{Limits, decode};
use tmpi_pipeline::run::{ErrorFigures, ParallaxShift, Report};
use tmpi_pipeline::stereo::Stereo;
use tmpi_pipeline::{Denoise, Made, Models, Options, Silent, Switch, make};
use tmpi_render::{Reference, Renderer, corners};
use tmpi_testing::pictures::{noise, png, waves as photo};

/// A photo, the file of its depth map, and the disparities that the file holds by definition.
struct Subject {
    name: &'static str,
    photo: Vec<u8>,
    map: Vec<u8>,
    values: DisparityMap,
    options: Options,
}

fn stairs(x: u32, y: u32) -> f32 {
    ((x / 50 + y / 40) % 5) as f32 / 5.0 + 0.1
}

fn subject(name: &'static str, (width, height): (u32, u32), values: &DisparityMap, options: Options) -> Subject {
    let map = to_png(values).unwrap();
    // the file has 16 bits
    let delta = image::load_from_memory(&map).unwrap().into_luma16().iter().map(|v| f32::from(*v) / 65_535.0).collect();
    Subject { name, photo: photo(width, height), map, values: DisparityMap { delta, ..*values }, options }
}

/// Depth in metres: a twentieth of the values is unknown, and some are nearer than the nearest distance. Also returns the shares of unknown
/// and of clipped values.
fn holes() -> (Subject, [f64; 2]) {
    let (width, height) = (100u32, 60u32);
    let known = |i: u32| if i == 11 { 100 } else { 1000 + (i % width) as u16 * 30 };
    let metric: Vec<u16> = (0..width * height).map(|i| if i % 20 == 7 { 0 } else { known(i) }).collect();
    let file = png(width, height, bytemuck::cast_slice(&metric), ExtendedColorType::L16);
    let mut sorted: Vec<u16> = metric.iter().copied().filter(|v| *v > 0).collect();
    sorted.sort_unstable();
    // the nearest distance ignores a thousandth of the values
    let nearest = sorted[sorted.len() / 1000];
    let share = |of: &dyn Fn(u16) -> bool| metric.iter().filter(|v| of(**v)).count() as f64 / metric.len() as f64;
    let shares = [share(&|v| v == 0), share(&|v| v > 0 && v < nearest)];
    // a single unknown value takes the disparity of its farther neighbour
    let at = |i: usize| if metric[i] > 0 { (f32::from(nearest) / f32::from(metric[i])).min(1.0) } else { f32::NAN };
    let delta = (0..metric.len()).map(|i| if at(i).is_nan() { at(i - 1).min(at(i + 1)) } else { at(i) }).collect();
    let options = Options { depth_kind: DepthKind::Metric, verify_prune: true, ..Options::default() };
    (Subject { name: "holes", photo: photo(200, 120), map: file, values: DisparityMap { width, height, delta }, options }, shares)
}

/// No networks: every photo comes with a depth map.
fn models() -> Models {
    Models { depth: Arc::new(("none", |_: &Photo| Err(DepthError::NotEmbedded))), theta: None, psi: None }
}

/// Makes the photo with changed options.
fn made(s: &Subject, change: impl FnOnce(&mut Options)) -> Made {
    let mut options = s.options.clone();
    change(&mut options);
    make(&models(), &Limits::default(), &s.photo, Some(&s.map), &options, &Silent).unwrap()
}

/// Distance in pixels between a point at two disparities: the larger of horizontal and vertical, over all corners of the view box.
fn distance_px(k: &Intrinsics, v: &ViewBox, (x, y): (f64, f64), [a, b]: [f64; 2]) -> f64 {
    let corner = |i: u32| {
        let side = |bit: u32, e: f64| if i >> bit & 1 == 0 { e } else { -e };
        let at = |d: f64| {
            let w = 1.0 - side(2, v.z) * d;
            [(x - k.cx - k.fx * side(0, v.x) * d) / w, (y - k.cy - k.fy * side(1, v.y) * d) / w]
        };
        let (a, b) = (at(a), at(b));
        (a[0] - b[0]).abs().max((a[1] - b[1]).abs())
    };
    (0..8).map(corner).fold(0.0, f64::max)
}

/// A value by bilinear interpolation of samples at half-integers.
fn between(size: (u32, u32), (x, y): (f64, f64), value: impl Fn(usize, usize) -> f64) -> f64 {
    let place = |p: f64, n: u32| {
        let p = (p - 0.5).clamp(0.0, f64::from(n - 1));
        (p as usize, (p as usize + 1).min(n as usize - 1), p.fract())
    };
    let ((x0, x1, across), (y0, y1, down)) = (place(x, size.0), place(y, size.1));
    let row = |y: usize| value(x0, y) * (1.0 - across) + value(x1, y) * across;
    row(y0) * (1.0 - down) + row(y1) * down
}

fn psnr(squares: f64, values: usize) -> f64 {
    if squares > 0.0 { 10.0 * (255.0f64.powi(2) * values as f64 / squares).log10() } else { 99.0 }
}

fn psnr_of(a: &[[u8; 3]], b: &[[u8; 3]]) -> f64 {
    assert_eq!(a.len(), b.len());
    let squares = a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum();
    psnr(squares, 3 * a.len())
}

/// How far a step shifted a map; `None` if it changed nothing.
fn moved(k: &Intrinsics, v: &ViewBox, before: &DisparityMap, after: &DisparityMap) -> Option<ParallaxShift> {
    let width = before.width as usize;
    let place = |i: usize| ((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
    let each = before.delta.iter().zip(&after.delta).enumerate();
    let px = each.map(|(i, (a, b))| distance_px(k, v, place(i), [f64::from(*a), f64::from(*b)]));
    let (sum, most) = px.fold((0.0, 0.0), |(sum, most): (f64, f64), px| (sum + px, most.max(px)));
    (before != after).then(|| ParallaxShift { mean_px: sum / before.delta.len() as f64, most_px: most, sampled: false })
}

/// Distance of a map at the photo's size from the file's map, at the centres of the file's pixels; `None` if both have the same size.
fn resampled(k: &Intrinsics, v: &ViewBox, own: &DisparityMap, delta: &DisparityMap) -> Option<ParallaxShift> {
    let (w, size) = (own.width as usize, (delta.width, delta.height));
    let scale = (f64::from(size.0) / f64::from(own.width), f64::from(size.1) / f64::from(own.height));
    let px = own.delta.iter().enumerate().map(|(i, known)| {
        let place = (((i % w) as f64 + 0.5) * scale.0, ((i / w) as f64 + 0.5) * scale.1);
        let shown = between(size, place, |x, y| f64::from(delta.delta[y * size.0 as usize + x]));
        distance_px(k, v, place, [f64::from(*known), shown])
    });
    let (sum, most) = px.fold((0.0, 0.0), |(sum, most): (f64, f64), px| (sum + px, most.max(px)));
    ((own.width, own.height) != size).then(|| ParallaxShift { mean_px: sum / own.delta.len() as f64, most_px: most, sampled: false })
}

/// Computes the figures of the planes of all tiles and writes them to `e`.
fn planes(e: &mut ErrorFigures, geometry: &Geometry, delta: &DisparityMap) {
    let (mut disparity, mut px, mut least, mut over) = (Vec::new(), 0.0, 0.0, Vec::new());
    for (i, tile) in geometry.tiles.iter().enumerate() {
        let (r, frame) = (geometry.grid.rect(i as u32), TileFrame::of(&geometry.grid, i as u32));
        let one = |p: usize| {
            let (x, y) = (r.x + p as u32 % r.w, r.y + p as u32 / r.w);
            let place = (f64::from(x) + 0.5, f64::from(y) + 0.5);
            let (u, v) = ((place.0 - frame.centre.0) / frame.half, (place.1 - frame.centre.1) / frame.half);
            let known = f64::from(delta.delta[y as usize * delta.width as usize + x as usize]);
            let shown = tile.planes[usize::from(tile.labels[p])].disparity(u, v);
            let nearest =
                tile.planes.iter().map(|q| q.disparity(u, v)).min_by(|a, b| (a - known).abs().total_cmp(&(b - known).abs())).unwrap();
            let apart = |d: f64| distance_px(&geometry.intrinsics, &geometry.view_box, place, [d, known]);
            [(shown - known).abs(), apart(shown), apart(nearest)]
        };
        let all: Vec<[f64; 3]> = (0..r.area()).map(one).collect();
        let sum = |c: usize| all.iter().map(|v| v[c]).sum::<f64>();
        e.tile_px.push(sum(1) / all.len() as f64);
        (px, least) = (px + sum(1), least + sum(2));
        disparity.extend(all.iter().map(|v| v[0]));
        let mut sorted: Vec<f64> = all.iter().map(|v| v[1]).collect();
        sorted.sort_by(f64::total_cmp);
        over.extend(e.planes.bound_px.map(|b| sorted[sorted.len() * 99 / 100] - b).filter(|o| *o > 0.0));
    }
    let n = disparity.len() as f64;
    e.depth_mae = disparity.iter().sum::<f64>() / n;
    e.depth_mse = disparity.iter().map(|d| d * d).sum::<f64>() / n;
    disparity.sort_by(f64::total_cmp);
    e.depth_q25 = disparity[disparity.len() / 4];
    (e.planes.mean_px, e.planes.smoothing_px) = (px / n, (px - least) / n);
    e.planes.missed_tiles = over.len();
    e.planes.missed_mean_px = over.iter().sum::<f64>() / over.len().max(1) as f64;
    e.planes.missed_most_px = over.iter().copied().fold(0.0, f64::max);
}

/// The reference view, in `f64`.
fn identity(scene: &Arc<Scene>) -> Vec<[u8; 3]> {
    let camera = Camera { pose: Pose::default(), intrinsics: scene.intrinsics, width: scene.photo.width, height: scene.photo.height };
    Reference.render(scene, &camera).unwrap().rgba.iter().map(|p| [p[0], p[1], p[2]]).collect()
}

/// Effect of pruning on the views from the corners of the view box, in `f64`: largest difference in levels, and share of pixels that differ
/// by more than 8 levels.
fn pruning(photo: &Photo, geometry: &Geometry) -> (u8, f64) {
    let scene = |masks| Arc::new(compose(photo.clone(), geometry, texture(photo, geometry, masks)));
    let (all, kept) = (scene(geometry.masks_unpruned()), scene(geometry.masks()));
    let mut worst = (0, 0.0);
    for pose in corners(&geometry.view_box, 0.0) {
        let camera = Camera { pose, intrinsics: all.intrinsics, width: photo.width, height: photo.height };
        let [a, b] = [&all, &kept].map(|s| Reference.render(s, &camera).unwrap().rgba);
        let off: Vec<u8> = a.iter().zip(&b).map(|(a, b)| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap()).collect();
        let share = off.iter().filter(|o| **o > 8).count() as f64 / off.len() as f64;
        worst = (off.iter().copied().max().unwrap().max(worst.0), f64::max(share, worst.1));
    }
    worst
}

/// PSNR in dB of the reduced photo, enlarged again, against the original, over rows from `first` on, `step` apart.
fn reduced(small: &Photo, whole: &Photo, (first, step): (usize, usize)) -> f64 {
    let size = (small.width, small.height);
    let scale = (f64::from(small.width) / f64::from(whole.width), f64::from(small.height) / f64::from(whole.height));
    let (mut squares, mut values) = (0.0, 0);
    for y in (first..whole.height as usize).step_by(step) {
        for x in 0..whole.width as usize {
            let place = ((x as f64 + 0.5) * scale.0, (y as f64 + 0.5) * scale.1);
            for c in 0..3 {
                let value = between(size, place, |x, y| f64::from(small.rgb[y * small.width as usize + x][c])).round();
                squares += (value - f64::from(whole.rgb[y * whole.width as usize + x][c])).powi(2);
                values += 1;
            }
        }
    }
    psnr(squares, values)
}

/// For each figure: its name, the reported value, the computed value, and the tolerance.
type Figures = Vec<(&'static str, f64, f64, f64)>;

/// Adds the figures of a step, which the report holds only if the step changed something.
fn add_step(all: &mut Figures, name: [&'static str; 2], reported: Option<ParallaxShift>, computed: Option<ParallaxShift>) {
    assert_eq!(reported.is_some(), computed.is_some(), "{}: reported {reported:?}, computed {computed:?}", name[0]);
    let (Some(reported), Some(computed)) = (reported, computed) else { return };
    // from a sample, the mean is close and the maximum is at most the true one
    let slack = if reported.sampled { 0.05 * computed.mean_px } else { 1e-6 };
    all.push((name[0], reported.mean_px, computed.mean_px, slack));
    if reported.sampled {
        assert!(reported.most_px <= computed.most_px + 1e-6, "{}", name[1]);
    } else {
        all.push((name[1], reported.most_px, computed.most_px, 1e-6));
    }
}

/// Numbers of planes and texels, and of those left out.
fn counts(report: &Report, geometry: &Geometry, scene: &Scene) -> Figures {
    let whole: usize = scene.layers.iter().map(|l| scene.grid.rect(l.tile).area()).sum();
    let kept = scene.texels.class.iter().filter(|c| **c != Class::Empty as u8).count();
    let placed: usize = geometry.tiles.iter().map(|t| t.planes.len()).sum();
    // mattes follow from the photo, which readers have from its compressed file
    let slack = 2e-4 * kept as f64;
    let counts = [
        ("texels", report.texels, kept),
        ("planes", report.planes, scene.layers.len()),
        ("left_out.texels", report.left_out.texels, whole - kept),
        ("left_out.bytes", report.left_out.bytes, 4 * (whole - kept)),
        ("left_out.planes", report.left_out.planes, report.tiles * report.error.planes.most_planes as usize - placed),
        ("left_out.tiles_not_refined", report.left_out.tiles_not_refined, geometry.tiles.len()),
    ];
    let slack_of = |name: &str| match name {
        "texels" | "left_out.texels" => slack,
        "left_out.bytes" => 4.0 * slack,
        _ => 0.0,
    };
    counts.map(|(name, reported, computed)| (name, reported as f64, computed as f64, slack_of(name))).into()
}

/// All figures of a photo's report, beside those computed by definition.
fn figures(s: &Subject) -> Figures {
    let full = made(s, |_| {});
    let reported = &full.report.error;
    let size = full.report.width.max(full.report.height);
    // the same without a budget, with the settings that the budget chose
    let chosen = |o: &mut Options| {
        (o.budget_ms, o.max_size) = (None, Some(size));
        o.max_error = reported.planes.bound_px.unwrap_or(o.max_error);
    };
    let again = made(s, chosen);
    assert!(again.container == full.container, "{}: a budget only chooses settings", s.name);
    let raw = made(s, |o| {
        chosen(o);
        (o.denoise, o.snap) = (Denoise::Off, Switch::Off);
    });
    let clean = made(s, |o| {
        chosen(o);
        o.snap = Switch::Off;
    });
    let geometry = container::read_geometry(&full.container).unwrap();
    let (k, v) = (geometry.intrinsics, geometry.view_box);
    assert_eq!(v, s.options.view_box);
    let mut all = Figures::new();

    let whole = decode(&s.photo, &Limits::default(), None).unwrap().photo;
    let small = decode(&s.photo, &Limits::default(), Some(size)).unwrap().photo;
    assert_eq!(reported.reduction.is_some(), small.width < whole.width);
    if let Some(reduction) = reported.reduction {
        all.push(("reduction.scale", reduction.scale, f64::from(size) / f64::from(whole.width.max(whole.height)), 1e-12));
        let psnr = reduction.psnr.unwrap();
        all.push(("reduction.psnr", psnr, reduced(&small, &whole, (8, 17)), 1e-3));
        all.push(("reduction.psnr, all rows", psnr, reduced(&small, &whole, (0, 1)), 0.3));
    }
    add_step(&mut all, ["resampling.mean_px", "resampling.most_px"], reported.resampling, resampled(&k, &v, &s.values, &raw.disparity));
    if reported.resampling.is_none() {
        let off = raw.disparity.delta.iter().zip(&s.values.delta).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max);
        all.push(("map against file, largest difference", off, 0.0, 1e-6));
    }
    add_step(&mut all, ["denoise.mean_px", "denoise.most_px"], reported.denoise, moved(&k, &v, &raw.disparity, &clean.disparity));
    add_step(&mut all, ["snap.mean_px", "snap.most_px"], reported.snap, moved(&k, &v, &clean.disparity, &full.disparity));

    let mut computed = ErrorFigures { planes: reported.planes, ..ErrorFigures::default() };
    planes(&mut computed, &geometry, &full.disparity);
    assert_eq!(reported.tile_px.len(), computed.tile_px.len());
    let tile = reported.tile_px.iter().zip(&computed.tile_px).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    // errors are summed in `f32`, the quartile comes from a histogram, and tiles are rounded to a thousandth
    all.push(("depth_mae", reported.depth_mae, computed.depth_mae, 1e-6 + 1e-4 * computed.depth_mae));
    all.push(("depth_mse", reported.depth_mse, computed.depth_mse, 1e-6 + 1e-4 * computed.depth_mse));
    all.push(("depth_q25", reported.depth_q25, computed.depth_q25, 1e-6 + 3e-3 * computed.depth_q25));
    all.push(("tile_px, largest difference", tile, 0.0, 1e-3));
    let [own, by_definition] = [&reported.tile_px, &computed.tile_px].map(|t| t.iter().sum::<f64>());
    all.push(("tile_px, sum", own, by_definition, 5e-4 * computed.tile_px.len() as f64));
    all.push(("planes.mean_px", reported.planes.mean_px, computed.planes.mean_px, 1e-6));
    all.push(("planes.smoothing_px", reported.planes.smoothing_px, computed.planes.smoothing_px, 1e-6));
    all.push(("planes.missed_tiles", reported.planes.missed_tiles as f64, computed.planes.missed_tiles as f64, 0.0));
    all.push(("planes.missed_mean_px", reported.planes.missed_mean_px, computed.planes.missed_mean_px, 1e-4));
    all.push(("planes.missed_most_px", reported.planes.missed_most_px, computed.planes.missed_most_px, 1e-4));
    let most = geometry.tiles.iter().map(|t| t.planes.len()).max().unwrap();
    assert!(most <= reported.planes.most_planes as usize);
    // half a step of the container's grid for each of three coefficients, at the point where it shifts a view most
    let corners = [(0.0, 0.0), (f64::from(full.report.width), 0.0), (0.0, f64::from(full.report.height))];
    let step = 1.5 * tmpi_core::Plane::STEP;
    let rounding = corners.map(|c| distance_px(&k, &v, c, [1.0, 1.0 - step])).into_iter().fold(0.0, f64::max);
    assert!(
        reported.planes.rounding_px > 0.0 && reported.planes.rounding_px <= 1.01 * rounding,
        "{} of {rounding}",
        reported.planes.rounding_px
    );

    assert_eq!(reported.unsearched_tiles, 0, "the view boxes are small");

    let scene = Arc::new(container::decode(&full.container).unwrap());
    all.extend(counts(&full.report, &geometry, &scene));
    all.push(("codec_psnr", reported.codec_psnr, psnr_of(&scene.photo.rgb, &small.rgb), 1e-9));
    assert_eq!(reported.hidden_psnr, None, "readers derive hidden colours");
    if small.rgb.len() < 1_000_000 {
        // if the report covers only some rows of tiles, its figure is close to that of all
        let slack = if reported.identity_tiles == full.report.tiles { 1e-6 } else { 0.7 };
        all.push(("identity_psnr", reported.identity_psnr, psnr_of(&identity(&scene), &small.rgb), slack));
    }
    if let Some(prune) = reported.prune.filter(|_| s.options.verify_prune) {
        assert_eq!(prune.tiles, full.report.tiles);
        let (levels, share) = pruning(&small, &geometry);
        // the two renderers differ at the borders of quads
        all.push(("prune.max_abs", f64::from(prune.max_abs), f64::from(levels), 8.0));
        all.push(("prune.share_off", prune.share_off, share, 1e-3));
    }
    all
}

/// Whether a reported figure of twice or half the value would be noticed.
fn is_telling(&(_, reported, computed, slack): &(&str, f64, f64, f64)) -> bool {
    [2.0, 0.5].iter().all(|by| (by * reported - computed).abs() > slack)
}

fn check(s: &Subject) {
    let all = figures(s);
    println!("{:<16}{:<40}{:>14}{:>14}", s.name, "figure", "reported", "computed");
    for (name, reported, computed, _) in &all {
        println!("{:<16}{name:<40}{reported:>14.6}{computed:>14.6}", "");
    }
    for (name, reported, computed, slack) in all {
        assert!((reported - computed).abs() <= slack, "{}: {name} is reported as {reported}, but computed as {computed}", s.name);
    }
}

fn flat() -> Subject {
    subject("flat", (200, 150), &DisparityMap::from_fn(200, 150, |_, _| 0.5), Options::default())
}

fn noisy() -> Subject {
    let noisy = DisparityMap::from_fn(200, 150, |x, y| (0.4 + 0.1 * (noise(x, y) - 0.5)).clamp(0.0, 1.0));
    let options = Options { view_box: ViewBox { x: 0.119, y: 0.05, z: 0.2 }, verify_prune: true, ..Options::default() };
    subject("noisy depth", (200, 150), &noisy, options)
}

fn zigzag() -> Subject {
    let zigzag = DisparityMap::from_fn(300, 200, |x, y| ((x + y) as i32 % 10 - 5).unsigned_abs() as f32 / 5.0);
    subject("zigzag", (300, 200), &zigzag, Options { max_error: 0.2, verify_prune: true, ..Options::default() })
}

fn budgeted() -> Subject {
    subject("budgeted", (900, 600), &DisparityMap::from_fn(900, 600, stairs), Options { budget_ms: Some(20.0), ..Options::default() })
}

#[test]
fn a_flat_photo() {
    check(&flat());
}

#[test]
fn a_noisy_depth_map() {
    check(&noisy());
}

#[test]
fn a_zigzag() {
    check(&zigzag());
}

#[test]
fn a_map_with_holes() {
    let (s, [filled, clipped]) = holes();
    let reported = made(&s, |_| {}).report.error;
    assert_eq!((reported.depth_filled, reported.depth_clipped), (Some(filled), Some(clipped)));
    assert!(filled > 0.04 && clipped > 0.0);
    check(&s);
}

#[test]
fn twelve_megapixels() {
    check(&subject("12 MP", (4000, 3000), &DisparityMap::from_fn(1000, 750, |x, y| stairs(x / 2, y / 2)), Options::default()));
}

#[test]
fn a_budget() {
    let s = budgeted();
    let report = made(&s, |_| {}).report;
    let budget = report.budget.unwrap();
    assert!(budget.chose.contains(&format!("--max-error {}", report.error.planes.bound_px.unwrap())), "{budget:?}");
    assert!(report.error.reduction.is_some() && budget.outcome_ms > 0.0 && budget.predicted_ms > 0.0);
    check(&s);
}

#[test]
fn twice_or_half_of_any_figure_would_be_noticed() {
    let all: Figures = [flat(), noisy(), zigzag(), holes().0, budgeted()].iter().flat_map(figures).collect();
    // differences are 0, and so are errors of pruning, which the tests of `run::prune_error` compute
    let zero = |name: &str| name.ends_with("largest difference") || name.starts_with("prune.");
    let telling: Vec<&str> = all.iter().filter(|f| is_telling(f)).map(|f| f.0).collect();
    let dull: Vec<&str> = all.iter().map(|f| f.0).filter(|name| !zero(name) && !telling.contains(name)).collect();
    assert!(dull.is_empty(), "{dull:?}");
}

/// Gives each hidden texel a colour by its place in the tile.
struct Psi;

fn psi_colour(x: u32, y: u32) -> [f32; 3] {
    [x as f32 / 70.0, y as f32 / 90.0, (x + y) as f32 / 150.0]
}

impl Network for Psi {
    fn run(&self, inputs: Vec<Tensor>) -> Result<Vec<Tensor>, OnnxError> {
        let [count, _, height, width] = inputs[0].shape[..] else { panic!("{:?}", inputs[0].shape) };
        let place = |i: usize| psi_colour((i % width) as u32, (i / width) as u32);
        let channels = (0..count * 3).flat_map(|n| (0..height * width).map(move |i| place(i)[n % 3]));
        Ok(vec![Tensor { shape: vec![count, 3, height, width], data: channels.collect() }])
    }
}

#[test]
fn hidden_colours_of_a_network() {
    let map = DisparityMap::from_fn(300, 200, |x, y| if (90..200).contains(&x) && (60..150).contains(&y) { 0.8 } else { 0.2 });
    let s = subject("hidden", (300, 200), &map, Options { refine: Switch::On, ..Options::default() });
    let models = Models { psi: Some(Arc::new(Psi)), ..models() };
    let made = make(&models, &Limits::default(), &s.photo, Some(&s.map), &s.options, &Silent).unwrap();
    let scene = container::decode(&made.container).unwrap();
    let (mut squares, mut values, mut refined) = (0.0, 0, std::collections::BTreeSet::new());
    for l in &scene.layers {
        let (tile, mut next) = (scene.grid.rect(l.tile), l.first_hidden);
        for i in (0..l.rect.area()).filter(|i| scene.texels.class[l.first_texel + i] == Class::Hidden as u8) {
            let (x, y) = (l.rect.x + i as u32 % l.rect.w - tile.x, l.rect.y + i as u32 / l.rect.w - tile.y);
            let want = psi_colour(x, y).map(|v| f64::from((255.0 * v).round().clamp(0.0, 255.0)));
            squares += want.iter().zip(scene.texels.hidden[next]).map(|(a, b)| (a - f64::from(b)).powi(2)).sum::<f64>();
            (next, values) = (next + 1, values + 3);
            refined.insert(l.tile);
        }
    }
    let want = psnr(squares, values);
    assert!(want < 90.0 && (made.report.error.hidden_psnr.unwrap() - want).abs() < 1e-6, "{:?} of {want}", made.report.error.hidden_psnr);
    assert!(!refined.is_empty() && made.report.left_out.tiles_not_refined == made.report.tiles - refined.len());
}

#[test]
fn figures_of_a_stereo_pair() {
    let (width, height) = (400u32, 300u32);
    let [far, near, rows] = [6, 14, 3];
    let unrelated = 300;
    let spot = |x: u32, y: u32| (noise(x / 3, y / 3) * 255.0) as u8;
    let eye = |colour: &dyn Fn(u32, u32) -> u8| {
        let rgb: Vec<u8> = (0..width * height).flat_map(|i| [colour(i % width, i / width); 3]).collect();
        png(width, height, &rgb, ExtendedColorType::Rgb8)
    };
    // the second eye sees a quarter of something else
    let shift = |y: u32| if y < height / 2 { far } else { near };
    let beside = |x: u32, y: u32| if x < unrelated { spot(x + shift(y), y) } else { spot(x + 5000, y + 700) };
    let (first, level, lower) = (eye(&spot), eye(&beside), eye(&|x, y| beside(x, y + rows)));
    let estimate =
        |p: &Photo| Ok::<_, DepthError>(DisparityMap::from_fn(p.width, p.height, |_, y| if y < p.height / 2 { 0.2 } else { 0.8 }));
    let models = Models { depth: Arc::new(("halves", estimate)), ..models() };
    let figures = |first: &[u8], second: &[u8]| {
        let options = Options { stereo: Stereo::Beside, ..Options::default() };
        make(&models, &Limits::default(), first, Some(second), &options, &Silent).unwrap().report.error.stereo.unwrap()
    };
    let close = |a: f64, b: f64, by: f64| assert!((a - b).abs() <= by, "{a}, not {b}");
    let f = figures(&first, &level);
    // matches end a shift before what is unrelated, and begin one after the left border
    close(f.measured, f64::from(unrelated) / f64::from(width), 0.05);
    close(f.estimated, 1.0 - f.measured, 0.06);
    for (a, b) in [(f.nearest_px, near), (f.farthest_px, far), (f.infinity_px, 0), (f.rows_before_px, 0), (f.rows_px, 0)] {
        close(a, b.into(), 1.0);
    }
    assert_eq!((f.crossed, f.width), (false, width));
    assert!(figures(&level, &first).crossed);
    let f = figures(&first, &lower);
    close(f.rows_before_px, rows.into(), 0.75);
    close(f.rows_px, 0.0, 0.75);
}
