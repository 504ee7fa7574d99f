//! Six photos whose reports tell errors of every kind, and each figure against the same one computed in `f64` by its definition: from the files, the
//! maps between the steps, and what a reader of the container gets.
//!
//! `cargo test -p tmpi-pipeline --test report -- --nocapture` prints the reports as they are told and as they are computed.
#![allow(clippy::unwrap_used, reason = "test")]

use std::sync::Arc;

use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};
use tmpi_core::container;
use tmpi_core::{Camera, DisparityMap, Geometry, Intrinsics, Photo, Pose, Scene, TileFrame, ViewBox, compose, texture};
use tmpi_pipeline::depth::{DepthError, DepthKind, Estimator, to_png};
use tmpi_pipeline::photo::{Limits, decode};
use tmpi_pipeline::run::{ErrorFigures, Moved};
use tmpi_pipeline::{Denoise, Made, Models, Options, Silent, Switch, make};
use tmpi_render::{Reference, Renderer};

/// Depth is given with every photo.
struct NoNetwork;

impl Estimator for NoNetwork {
    fn name(&self) -> &'static str {
        "none"
    }

    fn estimate(&self, _: &Photo) -> Result<DisparityMap, DepthError> {
        Err(DepthError::NotCarried)
    }
}

/// A photo, its map as a file, and what that holds by its definition.
struct Subject {
    name: &'static str,
    photo: Vec<u8>,
    map: Vec<u8>,
    values: DisparityMap,
    options: Options,
}

fn png(width: u32, height: u32, samples: &[u8], colour: ExtendedColorType) -> Vec<u8> {
    let mut file = Vec::new();
    PngEncoder::new(&mut file).write_image(samples, width, height, colour).unwrap();
    file
}

/// Waves and squares, without loss.
fn photo(width: u32, height: u32) -> Vec<u8> {
    let wave = |v: u32, by: f64| (127.5 + 100.0 * (f64::from(v) / by).sin()) as u8;
    let pixel = |x: u32, y: u32| [wave(x, 9.0), wave(y, 7.0), if (x / 30 + y / 20).is_multiple_of(2) { 200 } else { 90 }];
    let rgb: Vec<u8> = (0..width * height).flat_map(|i| pixel(i % width, i / width)).collect();
    png(width, height, &rgb, ExtendedColorType::Rgb8)
}

fn map(width: u32, height: u32, delta: impl Fn(u32, u32) -> f32) -> DisparityMap {
    DisparityMap { width, height, delta: (0..width * height).map(|i| delta(i % width, i / width)).collect() }
}

fn noise(x: u32, y: u32) -> f32 {
    let i = (y * 4099 + x).wrapping_mul(2_654_435_761);
    ((i ^ (i >> 15)).wrapping_mul(0x2C1B_3C6D) >> 8) as f32 / (1 << 24) as f32
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

/// Depth in metres, of which a twentieth is unknown and some lie before the nearest distance.
fn holes() -> (Subject, [f64; 2]) {
    let (width, height) = (100u32, 60u32);
    let known = |i: u32| if i == 11 { 100 } else { 1000 + (i % width) as u16 * 30 };
    let metric: Vec<u16> = (0..width * height).map(|i| if i % 20 == 7 { 0 } else { known(i) }).collect();
    let file = png(width, height, bytemuck::cast_slice(&metric), ExtendedColorType::L16);
    let mut sorted: Vec<u16> = metric.iter().copied().filter(|v| *v > 0).collect();
    sorted.sort_unstable();
    // but for a thousandth
    let nearest = sorted[sorted.len() / 1000];
    let share = |of: &dyn Fn(u16) -> bool| metric.iter().filter(|v| of(**v)).count() as f64 / metric.len() as f64;
    let shares = [share(&|v| v == 0), share(&|v| v > 0 && v < nearest)];
    // single unknown values take the farther neighbour
    let at = |i: usize| if metric[i] > 0 { (f32::from(nearest) / f32::from(metric[i])).min(1.0) } else { f32::NAN };
    let delta = (0..metric.len()).map(|i| if at(i).is_nan() { at(i - 1).min(at(i + 1)) } else { at(i) }).collect();
    let options = Options { depth_kind: DepthKind::Metric, verify_prune: true, ..Options::default() };
    (Subject { name: "holes", photo: photo(200, 120), map: file, values: DisparityMap { width, height, delta }, options }, shares)
}

/// Makes the photo with its options changed.
fn made(s: &Subject, change: impl FnOnce(&mut Options)) -> Made {
    let mut options = s.options.clone();
    change(&mut options);
    let models = Models { depth: Arc::new(NoNetwork), theta: None, psi: None };
    make(&models, &Limits::default(), &s.photo, Some(&s.map), &options, &Silent).unwrap()
}

/// Pixels between where two disparities are shown: largest of right and down over all corners of the view box.
fn shown_apart(k: &Intrinsics, v: &ViewBox, (x, y): (f64, f64), [a, b]: [f64; 2]) -> f64 {
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

/// A value between others, by linear interpolation of samples at half-integers.
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

/// What a step did to a map; none where it did nothing.
fn moved(k: &Intrinsics, v: &ViewBox, before: &DisparityMap, after: &DisparityMap) -> Option<Moved> {
    let width = before.width as usize;
    let place = |i: usize| ((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
    let each = before.delta.iter().zip(&after.delta).enumerate();
    let px = each.map(|(i, (a, b))| shown_apart(k, v, place(i), [f64::from(*a), f64::from(*b)]));
    let (sum, most) = px.fold((0.0, 0.0), |(sum, most): (f64, f64), px| (sum + px, most.max(px)));
    (before != after).then(|| Moved { mean_px: sum / before.delta.len() as f64, most_px: most, sampled: false })
}

/// How far a map at the photo's size is from the file's at the centres of the file's pixels; none where it has the photo's size.
fn resampled(k: &Intrinsics, v: &ViewBox, own: &DisparityMap, delta: &DisparityMap) -> Option<Moved> {
    let (w, size) = (own.width as usize, (delta.width, delta.height));
    let scale = (f64::from(size.0) / f64::from(own.width), f64::from(size.1) / f64::from(own.height));
    let px = own.delta.iter().enumerate().map(|(i, known)| {
        let place = (((i % w) as f64 + 0.5) * scale.0, ((i / w) as f64 + 0.5) * scale.1);
        let shown = between(size, place, |x, y| f64::from(delta.delta[y * size.0 as usize + x]));
        shown_apart(k, v, place, [f64::from(*known), shown])
    });
    let (sum, most) = px.fold((0.0, 0.0), |(sum, most): (f64, f64), px| (sum + px, most.max(px)));
    ((own.width, own.height) != size).then(|| Moved { mean_px: sum / own.delta.len() as f64, most_px: most, sampled: false })
}

/// Figures of planes: those of all tiles into `e`.
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
            let apart = |d: f64| shown_apart(&geometry.intrinsics, &geometry.view_box, place, [d, known]);
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

/// The view from the photo's own place, in `f64`.
fn identity(scene: &Arc<Scene>) -> Vec<[u8; 3]> {
    let camera = Camera { pose: Pose::default(), intrinsics: scene.intrinsics, width: scene.photo.width, height: scene.photo.height };
    Reference.render(scene, &camera).unwrap().rgba.iter().map(|p| [p[0], p[1], p[2]]).collect()
}

/// What leaving out changes in the views from the corners of the view box, in `f64`: largest difference in levels, and share of pixels that
/// differ by more than 8.
fn left_out(photo: &Photo, geometry: &Geometry) -> (u8, f64) {
    let scene = |masks| Arc::new(compose(photo.clone(), geometry, texture(photo, geometry, masks)));
    let (all, kept) = (scene(geometry.masks_unpruned()), scene(geometry.masks()));
    let v = geometry.view_box;
    let mut worst = (0, 0.0);
    for i in 0..8u32 {
        let side = |bit: u32, e: f64| if i >> bit & 1 == 0 { e } else { -e };
        let pose = Pose::at(side(0, v.x), side(1, v.y), side(2, v.z));
        let camera = Camera { pose, intrinsics: all.intrinsics, width: photo.width, height: photo.height };
        let [a, b] = [&all, &kept].map(|s| Reference.render(s, &camera).unwrap().rgba);
        let off: Vec<u8> = a.iter().zip(&b).map(|(a, b)| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap()).collect();
        let share = off.iter().filter(|o| **o > 8).count() as f64 / off.len() as f64;
        worst = (off.iter().copied().max().unwrap().max(worst.0), f64::max(share, worst.1));
    }
    worst
}

/// The photo enlarged again against what it was, over rows from `first` on, `step` apart.
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

/// Names of figures, what the report says of them, what they are, and how far these may lie apart.
type Figures = Vec<(&'static str, f64, f64, f64)>;

/// A step that the report tells of where it did something.
fn of_step(all: &mut Figures, name: [&'static str; 2], told: Option<Moved>, is: Option<Moved>) {
    assert_eq!(told.is_some(), is.is_some(), "{}: told {told:?}, is {is:?}", name[0]);
    let (Some(told), Some(is)) = (told, is) else { return };
    // of samples a mean is near, and the largest at most as large
    let slack = if told.sampled { 0.05 * is.mean_px } else { 1e-6 };
    all.push((name[0], told.mean_px, is.mean_px, slack));
    if told.sampled {
        assert!(told.most_px <= is.most_px + 1e-6, "{}", name[1]);
    } else {
        all.push((name[1], told.most_px, is.most_px, 1e-6));
    }
}

/// All figures of a photo's report beside those by definition.
fn figures(s: &Subject) -> Figures {
    let full = made(s, |_| {});
    let told = &full.report.error;
    let size = full.report.width.max(full.report.height);
    // the same as without a budget, at what that chose
    let chosen = |o: &mut Options| {
        (o.budget_ms, o.max_size) = (None, Some(size));
        o.max_error = told.planes.bound_px.unwrap_or(o.max_error);
    };
    let again = made(s, chosen);
    assert!(again.container == full.container, "{}: a budget does nothing but choose", s.name);
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
    assert_eq!(told.reduction.is_some(), small.width < whole.width);
    if let Some(reduction) = told.reduction {
        all.push(("reduction.scale", reduction.scale, f64::from(size) / f64::from(whole.width.max(whole.height)), 1e-12));
        let psnr = reduction.psnr.unwrap();
        all.push(("reduction.psnr", psnr, reduced(&small, &whole, (8, 17)), 1e-3));
        all.push(("reduction.psnr, all rows", psnr, reduced(&small, &whole, (0, 1)), 0.3));
    }
    of_step(&mut all, ["resampling.mean_px", "resampling.most_px"], told.resampling, resampled(&k, &v, &s.values, &raw.disparity));
    if told.resampling.is_none() {
        let off = raw.disparity.delta.iter().zip(&s.values.delta).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max);
        all.push(("the map as the file has it", off, 0.0, 1e-6));
    }
    of_step(&mut all, ["denoise.mean_px", "denoise.most_px"], told.denoise, moved(&k, &v, &raw.disparity, &clean.disparity));
    of_step(&mut all, ["snap.mean_px", "snap.most_px"], told.snap, moved(&k, &v, &clean.disparity, &full.disparity));

    let mut is = ErrorFigures { planes: told.planes, ..ErrorFigures::default() };
    planes(&mut is, &geometry, &full.disparity);
    assert_eq!(told.tile_px.len(), is.tile_px.len());
    let tile = told.tile_px.iter().zip(&is.tile_px).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    // errors are added up in `f32`, and the quartile is that of a histogram; tiles are told to a thousandth
    all.push(("depth_mae", told.depth_mae, is.depth_mae, 1e-6 + 1e-4 * is.depth_mae));
    all.push(("depth_mse", told.depth_mse, is.depth_mse, 1e-6 + 1e-4 * is.depth_mse));
    all.push(("depth_q25", told.depth_q25, is.depth_q25, 1e-6 + 3e-3 * is.depth_q25));
    all.push(("tile_px, largest difference", tile, 0.0, 1e-3));
    all.push(("planes.mean_px", told.planes.mean_px, is.planes.mean_px, 1e-6));
    all.push(("planes.smoothing_px", told.planes.smoothing_px, is.planes.smoothing_px, 1e-6));
    all.push(("planes.missed_tiles", told.planes.missed_tiles as f64, is.planes.missed_tiles as f64, 0.0));
    all.push(("planes.missed_mean_px", told.planes.missed_mean_px, is.planes.missed_mean_px, 1e-4));
    all.push(("planes.missed_most_px", told.planes.missed_most_px, is.planes.missed_most_px, 1e-4));
    let most = geometry.tiles.iter().map(|t| t.planes.len()).max().unwrap();
    assert!(most <= told.planes.most_planes as usize);
    // half a step of the container's grid for each of three coefficients, where a view shows most of it
    let corners = [(0.0, 0.0), (f64::from(full.report.width), 0.0), (0.0, f64::from(full.report.height))];
    let step = 1.5 * tmpi_core::Plane::STEP;
    let rounding = corners.map(|c| shown_apart(&k, &v, c, [1.0, 1.0 - step])).into_iter().fold(0.0, f64::max);
    assert!(told.planes.rounding_px > 0.0 && told.planes.rounding_px <= 1.01 * rounding, "{} of {rounding}", told.planes.rounding_px);

    let scene = Arc::new(container::decode(&full.container).unwrap());
    all.push(("codec_psnr", told.codec_psnr, psnr_of(&scene.photo.rgb, &small.rgb), 1e-9));
    assert_eq!(told.hidden_psnr, None, "hidden colours follow from the rest");
    if small.rgb.len() < 1_000_000 {
        // of some rows of tiles the report tells nearly what all have
        let slack = if told.identity_tiles == full.report.tiles { 1e-6 } else { 0.7 };
        all.push(("identity_psnr", told.identity_psnr, psnr_of(&identity(&scene), &small.rgb), slack));
    }
    if let Some(prune) = told.prune.filter(|_| s.options.verify_prune) {
        assert_eq!(prune.tiles, full.report.tiles);
        let (levels, share) = left_out(&small, &geometry);
        // borders of quads differ between the two renderers
        all.push(("prune.max_abs", f64::from(prune.max_abs), f64::from(levels), 8.0));
        all.push(("prune.share_off", prune.share_off, share, 1e-3));
    }
    all
}

fn hold(s: &Subject) {
    let all = figures(s);
    println!("{:<16}{:<32}{:>14}{:>14}", s.name, "figure", "told", "computed");
    for (name, told, is, _) in &all {
        println!("{:<16}{name:<32}{told:>14.6}{is:>14.6}", "");
    }
    for (name, told, is, slack) in all {
        assert!((told - is).abs() <= slack, "{}: {name} is told as {told}, and is {is}", s.name);
    }
}

#[test]
fn a_flat_photo() {
    hold(&subject("flat", (200, 150), &map(200, 150, |_, _| 0.5), Options::default()));
}

#[test]
fn a_noisy_depth_map() {
    let noisy = map(200, 150, |x, y| (0.4 + 0.1 * (noise(x, y) - 0.5)).clamp(0.0, 1.0));
    let options = Options { view_box: ViewBox { x: 0.119, y: 0.05, z: 0.2 }, verify_prune: true, ..Options::default() };
    hold(&subject("noisy depth", (200, 150), &noisy, options));
}

#[test]
fn a_zigzag() {
    let zigzag = map(300, 200, |x, y| ((x + y) as i32 % 10 - 5).unsigned_abs() as f32 / 5.0);
    hold(&subject("zigzag", (300, 200), &zigzag, Options { max_error: 0.2, verify_prune: true, ..Options::default() }));
}

#[test]
fn a_map_with_holes() {
    let (s, [filled, clipped]) = holes();
    let told = made(&s, |_| {}).report.error;
    assert_eq!((told.depth_filled, told.depth_clipped), (Some(filled), Some(clipped)));
    assert!(filled > 0.04 && clipped > 0.0);
    hold(&s);
}

#[test]
fn twelve_megapixels() {
    hold(&subject("12 MP", (4000, 3000), &map(1000, 750, |x, y| stairs(x / 2, y / 2)), Options::default()));
}

#[test]
fn a_budget() {
    let s = subject("budgeted", (900, 600), &map(900, 600, stairs), Options { budget_ms: Some(20.0), ..Options::default() });
    let report = made(&s, |_| {}).report;
    let budget = report.budget.unwrap();
    assert!(budget.chose.contains(&format!("--max-error {}", report.error.planes.bound_px.unwrap())), "{budget:?}");
    assert!(report.error.reduction.is_some() && budget.outcome_ms > 0.0 && budget.predicted_ms > 0.0);
    hold(&s);
}
