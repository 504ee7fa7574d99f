//! Disparity maps: cleaning, snapping, enlarging, and smoothing of labels.

use super::reference::{Resized, guided, resized, smoothed_labels};
use super::{Checked, largest};
use tmpi_core::{DisparityMap, Grid, Photo, Plane};
use tmpi_pipeline::denoise::{local_planes, median_guided};
use tmpi_pipeline::depth::{DepthKind, from_map, upsample};
use tmpi_pipeline::edges;
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::planes::{NEIGHBOUR_COST, Samples, smooth_labels};
use tmpi_testing::pictures::noise;

pub(super) fn run(checked: &mut Checked) {
    denoise(checked, "local planes", local_planes::denoise);
    denoise(checked, "median and guided filter", |map| median_guided::denoise(&grey(map.width, map.height, |_, _| 128), map));
    snap(checked, "snap", |photo, map| edges::snap(photo, map, edges::Rim::Photo));
    snap(checked, "median", edges::median);
    snap(checked, "widen", edges::widen);
    enlarge(checked, upsample);
    resize(checked, |file, (w, h)| from_map(file, DepthKind::Disparity, &Limits::default(), w, h).ok().map(|(map, _)| map));
    labels(checked, smooth_labels);
}

/// Numbers of 0 to 1, the same everywhere.
fn even(seed: u32) -> impl Fn(u32, u32) -> f32 {
    move |x, y| noise(x, y + 1000 * seed)
}

pub(super) fn map(width: u32, height: u32, delta: impl Fn(u32, u32) -> f32) -> DisparityMap {
    DisparityMap::from_fn(width, height, delta)
}

fn grey(width: u32, height: u32, value: impl Fn(u32, u32) -> u8) -> Photo {
    Photo::from_fn(width, height, |x, y| [value(x, y); 3])
}

/// Largest difference; infinite where sizes differ or something is no number.
fn apart(a: &DisparityMap, b: &DisparityMap) -> f64 {
    if (a.width, a.height, a.delta.len()) != (b.width, b.height, b.delta.len()) {
        return f64::INFINITY;
    }
    let off = |(a, b): (&f32, &f32)| if a.is_finite() { f64::from((a - b).abs()) } else { f64::INFINITY };
    a.delta.iter().zip(&b.delta).map(off).fold(0.0, f64::max)
}

/// Root of the mean squared difference, less so many pixels on each side.
fn deviation(a: &DisparityMap, b: &DisparityMap, border: u32) -> f64 {
    let inner = |i: usize| {
        let (x, y) = (i as u32 % a.width, i as u32 / a.width);
        x >= border && y >= border && x + border < a.width && y + border < a.height
    };
    let squares: Vec<f64> =
        a.delta.iter().zip(&b.delta).enumerate().filter(|(i, _)| inner(*i)).map(|(_, (a, b))| f64::from(a - b).powi(2)).collect();
    (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
}

/// What no step may leave: the range of the map around each pixel; by how much it is left.
fn beyond(before: &DisparityMap, after: &DisparityMap, reach: u32) -> f64 {
    let off = |i: usize, d: f32| {
        let (x, y) = (i as u32 % before.width, i as u32 / before.width);
        let columns = x.saturating_sub(reach)..(x + reach + 1).min(before.width);
        let near = (y.saturating_sub(reach)..(y + reach + 1).min(before.height))
            .flat_map(|y| columns.clone().map(move |x| before.delta[(y * before.width + x) as usize]));
        let (low, high) = near.fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), d| (l.min(d), h.max(d)));
        if d.is_finite() { f64::from((low - d).max(d - high).max(0.0)) } else { f64::INFINITY }
    };
    after.delta.iter().enumerate().map(|(i, d)| off(i, *d)).fold(0.0, f64::max)
}

type Maps = Vec<(&'static str, DisparityMap)>;

/// Maps without noise: steps, slopes and ends of what there can be.
fn clean_maps() -> Maps {
    vec![
        ("one value", map(60, 40, |_, _| 0.5)),
        ("infinity alone", map(60, 40, |_, _| 0.0)),
        ("two values 1e-7 apart", map(60, 40, |x, _| if x < 30 { 0.5 } else { 0.500_000_1 })),
        ("two values, 0 and 1", map(60, 40, |x, _| if x < 30 { 0.0 } else { 1.0 })),
        ("a slope in steps of 16 bits", map(60, 40, |x, y| (x * 20 + y * 7) as f32 / 65_535.0)),
        ("one column", map(1, 500, |_, y| y as f32 / 499.0)),
        ("one row", map(500, 1, |x, _| x as f32 / 499.0)),
        ("one pixel", map(1, 1, |_, _| 0.7)),
    ]
}

/// `kernel` cleans a map. On what has no noise local planes change nothing; whatever they do stays within the map.
pub(super) fn denoise(checked: &mut Checked, subject: &'static str, kernel: impl Fn(&DisparityMap) -> DisparityMap) {
    const FAMILY: &str = "denoising";
    for (name, clean) in clean_maps() {
        // the guided filter rounds corners of slopes, and ends of a step
        let bound = if subject == "local planes" { 0.0 } else { 0.51 };
        checked.case(FAMILY, name, subject, "δ", bound, || apart(&kernel(&clean), &clean));
    }
    let flat = map(80, 60, |_, _| 0.5);
    checked.case(FAMILY, "holes of one pixel", subject, "δ", 1e-6, || {
        let holed = map(80, 60, |x, y| if x % 7 == 3 && y % 5 == 2 { 0.0 } else { 0.5 });
        apart(&kernel(&holed), &flat)
    });
    let normal = |x, y| ((20..32).map(|seed| even(seed)(x, y)).sum::<f32>() - 6.0) * 1e-3f32.sqrt();
    let truths: Maps = vec![
        ("noise on one value", flat),
        ("noise on a slope", map(80, 60, |x, y| 0.2 + 0.005 * x as f32 + 0.002 * y as f32)),
        ("noise on a step", map(80, 60, |x, _| if x < 40 { 0.2 } else { 0.7 })),
    ];
    // the guided filter blurs a step that the photo does not have
    for (name, truth) in truths.into_iter().filter(|(name, _)| subject == "local planes" || *name != "noise on a step") {
        let noisy = map(truth.width, truth.height, |x, y| (truth.delta[(y * truth.width + x) as usize] + normal(x, y)).clamp(0.0, 1.0));
        // a third of the noise that was put in, whose deviation is .032
        checked.case(FAMILY, name, subject, "δ, deviation", 0.0105, || deviation(&kernel(&noisy), &truth, 8));
    }
    for (w, h) in [(50, 40), (50, 1), (1, 50), (3, 3), (1, 1)] {
        let wild = map(w, h, even(2));
        checked.case(FAMILY, &format!("{w}×{h} of nothing but noise"), subject, "δ out of range", 1e-5, || {
            beyond(&wild, &kernel(&wild), 50)
        });
    }
}

/// `kernel` draws ramps to the photo's edges, or moves edges to those of the photo.
pub(super) fn snap(checked: &mut Checked, subject: &'static str, kernel: impl Fn(&Photo, &DisparityMap) -> DisparityMap) {
    const FAMILY: &str = "snapping";
    let edge = |w, h| grey(w, h, move |x, _| if x < w / 2 { 20 } else { 230 });
    for (name, clean) in clean_maps() {
        let photo = edge(clean.width, clean.height);
        checked.case(FAMILY, &format!("{name}, unchanged"), subject, "δ", 1e-6, || {
            // a step lies where the photo's edge does
            apart(&kernel(&photo, &clean), &clean)
        });
    }
    let step = map(60, 40, |x, _| if x < 30 { 0.2 } else { 0.8 });
    if subject == "snap" {
        for (name, half) in [("a step blurred over 3 pixels", 1u32), ("a step blurred over 5 pixels", 2)] {
            let blurred = map(60, 40, |x, _| {
                let columns = x.saturating_sub(half)..(x + half + 1).min(60);
                let n = columns.len() as f32;
                columns.map(|x| if x < 30 { 0.2 } else { 0.8 }).sum::<f32>() / n
            });
            checked.case(FAMILY, name, subject, "δ", 0.02, || apart(&kernel(&edge(60, 40), &blurred), &step));
        }
    }
    if subject == "widen" {
        let small = map(60, 40, |x, _| if x < 27 { 0.2 } else { 0.8 });
        let photo = grey(60, 40, |x, _| if x < 24 { 20 } else { 230 });
        let thing = map(60, 40, |x, _| if x < 24 { 0.2 } else { 0.8 });
        checked.case(FAMILY, "a thing 3 pixels too small", subject, "δ", 1e-6, || apart(&kernel(&photo, &small), &thing));
    }
    let wild = map(50, 40, even(3));
    let sixteen = map(50, 40, |x, y| (even(4)(x, y) * 65_535.0).round() / 65_535.0 * 1e-3);
    let zigzag = map(50, 40, |x, _| (x as i32 % 10 - 5).unsigned_abs() as f32 / 5.0);
    let (row, column) = (map(9, 1, |x, _| (x % 2) as f32), map(1, 9, |_, y| (y % 2) as f32));
    let all = [
        ("noise of 0 to 1", wild),
        ("noise near the horizon", sixteen),
        ("zigzag", zigzag),
        ("zigzag in one row", row),
        ("zigzag in one column", column),
    ];
    for (name, before) in all {
        // three passes look 3, 2 and 3 pixels around; edges are widened by up to 6
        checked.case(FAMILY, &format!("{name}, no new values"), subject, "δ out of range", 0.0, || {
            beyond(&before, &kernel(&edge(before.width, before.height), &before), 8)
        });
    }
}

/// `kernel` brings a small map to the photo's size.
pub(super) fn enlarge(checked: &mut Checked, kernel: impl Fn(&Photo, &DisparityMap) -> DisparityMap) {
    const FAMILY: &str = "enlarging";
    let noise = |w, h| Photo::from_fn(w, h, |x, y| [5, 6, 7].map(|seed| (even(seed)(x, y) * 255.0) as u8));
    let wild = |w, h| map(w, h, even(8));
    let cases: [(&str, Photo, DisparityMap); 10] = [
        ("noise in windows of 5", noise(500, 150), wild(500, 150)),
        ("noise by noise", noise(90, 70), wild(90, 70)),
        ("noise above the pixels that it works with", noise(420, 300), wild(105, 75)),
        ("a panorama above the pixels that it works with", noise(6000, 20), wild(300, 3)),
        ("noise by one colour", grey(90, 70, |_, _| 77), wild(90, 70)),
        ("two values by two colours", grey(90, 70, |x, _| if x < 45 { 0 } else { 255 }), map(90, 70, |x, _| f32::from(u8::from(x < 43)))),
        ("two values 1e-7 apart", noise(90, 70), map(90, 70, |x, _| if x < 45 { 0.5 } else { 0.500_000_1 })),
        ("one row", noise(200, 1), wild(200, 1)),
        ("one column", noise(1, 200), wild(1, 200)),
        ("one pixel", noise(1, 1), wild(1, 1)),
    ];
    for (name, photo, small) in cases {
        // values of 0 to 1 in `f32`, slopes of a photo's colours over the root of epsilon (.01)
        checked.case(FAMILY, &format!("{name}, against the definition"), "guided filter", "δ", 1e-4, || {
            let want = guided(&photo, &small);
            let got = kernel(&photo, &small);
            if got.delta.len() != want.len() {
                return f64::INFINITY;
            }
            largest(got.delta.iter().zip(want).map(|(g, w)| (f64::from(*g) - w).abs()))
        });
    }
    for (name, (w, h)) in [("to 16 times the size", (320u32, 240u32)), ("to one row", (300, 1)), ("to one column", (1, 300))] {
        checked.case(FAMILY, &format!("one value {name}"), "guided filter", "δ", 1e-5, || {
            apart(&kernel(&noise(w, h), &map(20, 15, |_, _| 0.3)), &map(w, h, |_, _| 0.3))
        });
    }
}

/// A portable float map of these values.
fn float_map(map: &DisparityMap) -> Vec<u8> {
    // its rows run upwards
    let rows = map.delta.chunks(map.width as usize).rev().flatten().flat_map(|v| v.to_le_bytes());
    format!("Pf\n{} {}\n-1.0\n", map.width, map.height).into_bytes().into_iter().chain(rows).collect()
}

/// The map with each hole (what is not finite) as far as the farther known value beside it in its row; rows of nothing else as the nearest one.
fn without_holes(map: &DisparityMap) -> DisparityMap {
    let (w, h) = (map.width as usize, map.height as usize);
    let known = |x: usize, y: usize| Some(map.delta[y * w + x]).filter(|v| v.is_finite());
    let has = |y: &usize| (0..w).any(|x| known(x, *y).is_some());
    let value = |x: u32, y: u32| {
        let (x, y) = (x as usize, y as usize);
        let y = (0..h).filter(has).min_by_key(|v| v.abs_diff(y)).unwrap_or(y);
        let beside = [(0..=x).rev().find_map(|x| known(x, y)), (x..w).find_map(|x| known(x, y))];
        beside.into_iter().flatten().fold(f32::INFINITY, f32::min)
    };
    DisparityMap::from_fn(map.width, map.height, value)
}

/// `kernel` reads a map's file at another size.
pub(super) fn resize(checked: &mut Checked, kernel: impl Fn(&[u8], (u32, u32)) -> Option<DisparityMap>) {
    /// Range of samples from which they belong to two surfaces.
    const EDGE: f64 = 0.03;
    let slope = |x: u32, y: u32| 0.1 + 0.0031 * x as f32 + 0.0013 * y as f32;
    let holes = |x: u32, y: u32| if (x / 5 + y / 4).is_multiple_of(3) || y == 7 { f32::NAN } else { slope(x / 20 * 20, 0) };
    let cases = [
        ("a slope", map(64, 48, slope)),
        ("a steep slope", map(64, 48, |x, _| x as f32 / 64.0)),
        ("a step", map(64, 48, |x, y| f32::from(u8::from(2 * x > y + 30)))),
        ("noise", map(64, 48, even(11))),
        ("holes of NaN", map(64, 48, holes)),
        ("a slope with holes of infinity", map(64, 48, |x, y| if x == 20 { f32::INFINITY } else { slope(x, y) })),
        ("one row", map(64, 1, slope)),
        ("one column", map(1, 48, slope)),
        ("one pixel", map(1, 1, slope)),
    ];
    let sizes = [(128, 96), (150, 97), (65, 48), (53, 40), (31, 23), (24, 100), (100, 20), (7, 5), (1, 48), (64, 1), (1, 1)];
    for (name, map) in cases {
        let full = without_holes(&map);
        for to in sizes {
            checked.case("resizing", &format!("{name}, to {} × {}", to.0, to.1), "depth map", "δ", 1e-6, || {
                let Some(got) = kernel(&float_map(&map), to).filter(|g| (g.width, g.height) == to) else { return f64::INFINITY };
                let off = |(got, want): (&f32, Resized)| {
                    let got = f64::from(*got);
                    let (low, high) = want.samples.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |m, v| (m.0.min(*v), m.1.max(*v)));
                    let mixed = (got - want.mean).abs();
                    if high - low > EDGE { want.samples.iter().map(|v| (v - got).abs()).fold(f64::INFINITY, f64::min) } else { mixed }
                };
                largest(got.delta.iter().zip(resized(&full, to)).map(off))
            });
        }
    }
}

/// `kernel` smooths labels: samples, planes, labels, target, weight of a neighbour.
pub(super) fn labels(checked: &mut Checked, kernel: impl Fn(&Samples, &[Plane], &mut [u8], f64, f32)) {
    // sixty-fourths, that no label is decided by rounding
    let sixty_fourths = |x, y| (even(9)(x, y) * 64.0).round() / 64.0;
    let planes = [Plane { a: 0.25, b: 0.125, c: 0.0 }, Plane { a: 0.25, b: -0.125, c: 0.0625 }, Plane { a: -0.0625, b: 0.25, c: 0.0 }];
    let cases: [(&str, DisparityMap); 7] = [
        ("noise", map(64, 64, sixty_fourths)),
        ("noise, 37×11", map(37, 11, sixty_fourths)),
        ("between planes that cross", map(64, 64, |_, _| 0.25)),
        ("near the horizon", map(64, 64, |x, _| if x < 20 { 0.0 } else { 1.0 / 64.0 })),
        ("two values", map(64, 64, |x, y| f32::from(u8::from((x / 3 + y / 5).is_multiple_of(2))))),
        ("one row", map(64, 1, |x, _| (x % 5) as f32 / 16.0)),
        ("one column", map(1, 64, |_, y| (y % 5) as f32 / 16.0)),
    ];
    for (name, delta) in cases {
        for (target, neighbour) in [(0.5, NEIGHBOUR_COST), (0.0625, NEIGHBOUR_COST), (0.03125, 1.0), (1.0, 0.0625)] {
            let name = format!("{name}, target {target}, neighbours {neighbour}");
            checked.case("label smoothing", &name, "conditional modes", "pixels", 0.0, || {
                let mut samples = Samples::default();
                samples.gather(&delta, None, &Grid::new(delta.width, delta.height, 64), 0);
                let mut got: Vec<u8> = (0..samples.len()).map(|i| ((i * 7 / 3 + i / 64) % planes.len()) as u8).collect();
                let mut want = got.clone();
                kernel(&samples, &planes, &mut got, target, neighbour);
                smoothed_labels(&samples, &planes, &mut want, target, f64::from(neighbour));
                got.iter().zip(&want).filter(|(g, w)| g != w).count() as f64
            });
        }
    }
}
