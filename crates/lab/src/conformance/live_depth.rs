//! Depth from frame to frame: scale and shift that are known, and steps at the borders of what changed.

use tmpi_core::DisparityMap;
use tmpi_live::align::{Affine, fit, join_borders};
use tmpi_live::change::BLOCK;
use tmpi_testing::pictures::noise;

use super::{Checked, largest};

const FAMILY: &str = "live depth";

pub(super) fn run(checked: &mut Checked) {
    scales(checked, fit);
    noise_alone(checked);
    borders(checked, join_borders);
}

/// A slope with a step.
fn relief(width: u32, height: u32) -> DisparityMap {
    DisparityMap::from_fn(width, height, |x, y| 0.2 + 0.3 * x as f32 / width as f32 + if y < height / 3 { 0.2 } else { 0.0 })
}

/// `kernel` fits a new map to the last one where it is steady.
pub(super) fn scales(checked: &mut Checked, kernel: impl Fn(&DisparityMap, &DisparityMap, &[bool]) -> Affine) {
    let sides = [(60, 60), (400, 300), (50, 1), (1, 50), (1, 1), (0, 0)];
    let affine = [(1.0, 0.0), (0.5, 0.3), (1.6, -0.25), (3.9, -0.9)];
    for ((w, h), (scale, shift)) in sides.into_iter().flat_map(|side| affine.map(|a| (side, a))) {
        let new = relief(w, h);
        let last = DisparityMap { delta: new.delta.iter().map(|d| (scale * f64::from(*d) + shift) as f32).collect(), ..new };
        let name = format!("{w}×{h}, scale {scale}, shift {shift}");
        // every fifth pixel of what is steady is wrong, and all of what is not
        let mut wild = new.clone();
        let steady: Vec<bool> = (0..w * h).map(|i| i % 3 != 1).collect();
        for (i, d) in (0..).zip(&mut wild.delta).filter(|(i, _)| i % 3 == 1 || noise(*i, 77) < 0.2) {
            *d = noise(i, 78);
        }
        let all = [(name.clone(), &new, 1e-5), (format!("{name}, a fifth wrong"), &wild, 1e-3)];
        // a few pixels do not tell what is wrong
        for (name, from, bound) in all.into_iter().take(if w * h > 1000 { 2 } else { 1 }) {
            checked.case(FAMILY, &name, "scale and shift", "δ", bound, || {
                let Affine { scale, shift } = kernel(from, &last, &steady);
                let off = |(new, last): (&f32, &f32)| (scale * f64::from(*new) + shift - f64::from(*last)).abs();
                let is_finite = scale.is_finite() && shift.is_finite();
                if is_finite { new.delta.iter().zip(&last.delta).map(off).fold(0.0, f64::max) } else { f64::INFINITY }
            });
        }
    }
}

/// Noise of one surface is no scale, even if the last map has less of it.
fn noise_alone(checked: &mut Checked) {
    let flat = |by: f32, seed: u32| DisparityMap::from_fn(60, 60, |x, y| 0.4 + by * (noise(y * 60 + x, seed) - 0.5));
    for seed in 0..4 {
        checked.case(FAMILY, &format!("noise alone, {seed}"), "scale and shift", "of the scale", 1e-9, || {
            (fit(&flat(0.04, seed), &flat(0.008, seed + 100), &[true; 3600]).scale - 1.0).abs()
        });
    }
}

/// `kernel` joins stale blocks to steady ones. The offset between both maps is linear, so the offsets of all blocks follow from the steady ones.
pub(super) fn borders(checked: &mut Checked, kernel: impl Fn(&mut DisparityMap, &DisparityMap, &[bool], usize)) {
    for (w, h) in [(80u32, 80u32), (77, 61), (80, 8), (8, 80), (80, 1), (1, 80)] {
        let (across, down) = (w.div_ceil(BLOCK), h.div_ceil(BLOCK));
        let inner = |at: u32, count: u32| count == 1 || (3..7).contains(&at);
        let stale: Vec<bool> = (0..across * down).map(|b| inner(b % across, across) && inner(b / across, down)).collect();
        let last = relief(w, h);
        let off = |x: u32, y: u32| 0.04 + 0.0005 * x as f32 - 0.0003 * y as f32;
        let new = DisparityMap::from_fn(w, h, |x, y| last.delta[(y * w + x) as usize] - off(x, y));
        checked.case(FAMILY, &format!("{w}×{h}, stale blocks within steady ones"), "borders", "δ", 0.005, || {
            let mut joined = new.clone();
            kernel(&mut joined, &last, &stale, across as usize);
            let is_stale = |i: usize| stale[(i as u32 / w / BLOCK * across + i as u32 % w / BLOCK) as usize];
            let want = |i: usize| if is_stale(i) { last.delta[i] } else { new.delta[i] };
            largest(joined.delta.iter().enumerate().map(|(i, d)| f64::from((d - want(i)).abs())))
        });
    }
}
