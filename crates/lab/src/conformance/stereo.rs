//! Stereo pairs of a scene of known disparities: what is measured of them, and what is refused.

use tmpi_core::{DisparityMap, Photo};
use tmpi_pipeline::stereo::measure;
use tmpi_testing::pictures::noise;

use super::Checked;

const FAMILY: &str = "stereo";
const SIZE: (u32, u32) = (220, 170);
/// Pixels beside an outline or a border that are not compared: windows of nine pixels, and what one of the eyes does not see.
const REACH: f64 = 8.0;

pub(super) fn run(checked: &mut Checked) {
    pairs(checked, measured);
}

/// Disparity of each pixel of the first picture, in pixels, without an estimate that tells anything.
pub(super) fn measured(first: &Photo, second: &Photo) -> Option<Vec<f64>> {
    let fused = measure(first, second).ok()?.fuse(first, &DisparityMap::from_fn(first.width, first.height, |_, _| 0.5));
    let (near, infinity) = (fused.figures.nearest_px, fused.figures.infinity_px);
    Some(fused.map.delta.iter().map(|d| infinity + f64::from(*d) * (near - infinity)).collect())
}

/// Spots a few pixels wide, 20 to 230, at a position between pixels.
fn spots(x: f64, y: f64) -> f64 {
    let (u, v) = (x / 3.0 + 500.0, y / 3.0 + 500.0);
    let ease = |t: f64| t * t * (3.0 - 2.0 * t);
    let at = |i: u32, j: u32| f64::from(noise(u as u32 + i, v as u32 + j));
    let line = |j: u32| at(0, j) + (at(1, j) - at(0, j)) * ease(u.fract());
    20.0 + 210.0 * (line(0) + (line(1) - line(0)) * ease(v.fract()))
}

/// A square in front of a wall.
#[derive(Clone, Copy)]
struct Pair {
    name: &'static str,
    /// Disparity of the wall and of the square, in pixels.
    disparity: [f64; 2],
    /// Rows by which the second picture is lower.
    lower: f64,
    /// The second picture's brightness by the first one's, and the pixel.
    light: fn(f64, u32, u32) -> f64,
}

impl Pair {
    fn square(x: f64, y: f64) -> bool {
        (70.0..150.0).contains(&x) && (50.0..120.0).contains(&y)
    }

    fn pictures(&self) -> [Photo; 2] {
        let shown = |is_near: bool, x: f64, y: f64| spots(x + if is_near { 700.0 } else { 0.0 }, y);
        let first = Photo::from_fn(SIZE.0, SIZE.1, |x, y| {
            let (x, y) = (f64::from(x), f64::from(y));
            [shown(Self::square(x, y), x, y).round() as u8; 3]
        });
        let second = Photo::from_fn(SIZE.0, SIZE.1, |x, y| {
            let (u, v) = (f64::from(x), f64::from(y) - self.lower);
            let [far, near] = self.disparity.map(|d| u + d);
            let value = if Self::square(near, v) { shown(true, near, v) } else { shown(false, far, v) };
            [(self.light)(value, x, y).round().clamp(0.0, 255.0) as u8; 3]
        });
        [first, second]
    }

    /// Mean error of the compared pixels, in pixels.
    fn off(&self, measured: &[f64]) -> f64 {
        let (w, h) = (f64::from(SIZE.0), f64::from(SIZE.1));
        let reach = REACH + self.disparity[0].abs().max(self.disparity[1].abs());
        let compared = |x: f64, y: f64| {
            let inside = x >= reach && x < w - reach && y >= REACH && y < h - REACH;
            let around = [(-reach, 0.0), (reach, 0.0), (0.0, -REACH), (0.0, REACH)].map(|(i, j)| Self::square(x + i, y + j));
            inside && around.iter().all(|is| *is == Self::square(x, y))
        };
        let places = (0..).zip(measured).map(|(i, d)| (f64::from(i % SIZE.0), f64::from(i / SIZE.0), d));
        let errors =
            places.filter(|(x, y, _)| compared(*x, *y)).map(|(x, y, d)| (d - self.disparity[usize::from(Self::square(x, y))]).abs());
        let errors: Vec<f64> = errors.collect();
        errors.iter().sum::<f64>() / errors.len() as f64
    }
}

/// `kernel` measures pairs as [`measured`] does.
pub(super) fn pairs(checked: &mut Checked, kernel: impl Fn(&Photo, &Photo) -> Option<Vec<f64>>) {
    let usual = Pair { name: "whole pixels", disparity: [2.0, 9.0], lower: 0.0, light: |v, _, _| v };
    let all = [
        usual,
        Pair { name: "parts of a pixel", disparity: [2.5, 9.25], ..usual },
        Pair { name: "crossed eyes", disparity: [-9.5, -2.0], ..usual },
        Pair { name: "before and behind the screen", disparity: [-6.0, 6.0], ..usual },
        Pair { name: "a darker second picture", light: |v, _, _| 0.5 * v, ..usual },
        Pair { name: "noise in the second picture", light: |v, x, y| v + 12.0 * f64::from(noise(x, y + 999)) - 6.0, ..usual },
        Pair { name: "a second picture that is 3 rows lower", lower: 3.0, ..usual },
    ];
    for pair in all {
        let [first, second] = pair.pictures();
        checked.case(FAMILY, pair.name, "matching", "pixels", 0.3, || kernel(&first, &second).map_or(f64::INFINITY, |d| pair.off(&d)));
    }
    let [first, second] = usual.pictures();
    let even = |v: u8| Photo::from_fn(SIZE.0, SIZE.1, |_, _| [v; 3]);
    let cut = |w, h| [&first, &second].map(|p| Photo::from_fn(w, h, |x, y| p.at(x, y)));
    let refused = [
        ("one picture twice", [first.clone(), first.clone()]),
        ("even pictures", [even(0), even(255)]),
        ("another shape", [first.clone(), cut(120, 170)[1].clone()]),
        ("one pixel", cut(1, 1)),
        ("one row", cut(220, 1)),
        ("one column", cut(1, 170)),
    ];
    for (name, [first, second]) in refused {
        checked.case(FAMILY, &format!("{name}, refused"), "matching", "not refused", 0.0, || {
            f64::from(u8::from(kernel(&first, &second).is_some()))
        });
    }
}
