//! Scale and shift between the disparity of two frames.

use tmpi_core::DisparityMap;

/// Pixels that a fit looks at, at most.
const SAMPLES: usize = 8_000;
/// Rounds of reweighting, at most.
const ROUNDS: usize = 20;
/// Residual in units of the median one beyond which a pixel counts less.
const HUBER: f64 = 2.0;
/// Power of Huber's weight (1964): the first, which would do for a mean, leaves the ratio of two spreads to what is wild in either.
const POWER: i32 = 4;
/// Pixels that must be known for a fit to them alone, as a share of all.
const ENOUGH: f64 = 0.05;
/// How far a frame that has nothing to hold on to goes back to its own scale: without it, each frame's error would stay for ever.
const RETURN: f64 = 0.02;
/// Scales beyond these are no camera's.
const SCALES: (f64, f64) = (0.25, 4.0);

/// `δ = scale · δ' + shift`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Affine {
    /// Factor, positive.
    pub scale: f64,
    /// What is added.
    pub shift: f64,
}

impl Affine {
    /// Changes nothing.
    pub const IDENTITY: Self = Self { scale: 1.0, shift: 0.0 };

    /// Applies to each value; the result is within 0 to 1.
    pub fn apply(&self, delta: &mut [f32]) {
        for d in delta {
            *d = (self.scale * f64::from(*d) + self.shift).clamp(0.0, 1.0) as f32;
        }
    }
}

/// Fits `new` to `last` over the pixels for which `steady` is true, or over all of them, going a little back to [`Affine::IDENTITY`],
/// where these are too few. Both maps are of one size, as is `steady`.
///
/// Robust reduced-major-axis regression: the scale is the ratio of the spreads, since least squares would make every frame a little
/// flatter than the last, by the noise of `new`.
#[must_use]
pub fn fit(new: &DisparityMap, last: &DisparityMap, steady: &[bool]) -> Affine {
    let known = steady.iter().filter(|s| **s).count();
    let held = known as f64 >= ENOUGH * steady.len().max(1) as f64;
    let step = if held { known } else { steady.len() }.div_ceil(SAMPLES).max(1);
    let all = new.delta.iter().zip(&last.delta).zip(steady).filter(|(_, s)| !held || **s);
    let pairs: Vec<(f64, f64)> = all.step_by(step).map(|((a, b), _)| (f64::from(*a), f64::from(*b))).collect();
    let fitted = regress(&pairs);
    if held {
        return fitted;
    }
    let back = |from: f64, to: f64| from + RETURN * (to - from);
    Affine { scale: back(fitted.scale, 1.0), shift: back(fitted.shift, 0.0) }
}

fn regress(pairs: &[(f64, f64)]) -> Affine {
    let mut found = Affine::IDENTITY;
    let mut weights = vec![1.0; pairs.len()];
    for _ in 0..ROUNDS {
        let total: f64 = weights.iter().sum();
        if total <= 0.0 {
            return found;
        }
        let mean = |f: fn(&(f64, f64)) -> f64| pairs.iter().zip(&weights).map(|(p, w)| w * f(p)).sum::<f64>() / total;
        let (x, y) = (mean(|p| p.0), mean(|p| p.1));
        let (mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0);
        for ((a, b), w) in pairs.iter().zip(&weights) {
            xx += w * (a - x) * (a - x);
            yy += w * (b - y) * (b - y);
            xy += w * (a - x) * (b - y);
        }
        // without relief, or where near and far have changed places, only the shift can be told
        let told = xx > 1e-9 * total && yy > 1e-9 * total && xy > 0.0;
        let scale = if told { (yy / xx).sqrt().clamp(SCALES.0, SCALES.1) } else { 1.0 };
        let next = Affine { scale, shift: y - scale * x };
        let residuals: Vec<f64> = pairs.iter().map(|(a, b)| (next.scale * a + next.shift - b).abs()).collect();
        let most = HUBER * median(residuals.clone()).max(1e-4);
        weights = residuals.iter().map(|r| if *r <= most { 1.0 } else { (most / r).powi(POWER) }).collect();
        let same = (next.scale - found.scale).abs() < 1e-5 && (next.shift - found.shift).abs() < 1e-5;
        found = next;
        if same {
            break;
        }
    }
    found
}

fn median(mut values: Vec<f64>) -> f64 {
    let at = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(at, f64::total_cmp).1 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn relief(n: usize) -> DisparityMap {
        let delta = (0..n * n).map(|i| 0.2 + 0.3 * (i % n) as f32 / n as f32 + if i / n < n / 3 { 0.2 } else { 0.0 }).collect();
        DisparityMap { width: n as u32, height: n as u32, delta }
    }

    /// Noise of about `by`, the same each time.
    fn noisy(map: &DisparityMap, by: f32, seed: u32) -> DisparityMap {
        let noise = |i: u32| ((i.wrapping_mul(0x9E37_79B1) ^ seed).wrapping_mul(0x85EB_CA77) >> 8) as f32 / (1u32 << 24) as f32 - 0.5;
        DisparityMap { delta: (0..).zip(&map.delta).map(|(i, d)| d + 2.0 * by * noise(i)).collect(), ..*map }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        /// A third of the steady pixels may be anything.
        #[test]
        fn scale_and_shift_come_back(scale in 0.5f64..2.0, shift in -0.2f64..0.2, wild in 0usize..8) {
            let last = relief(60);
            let mut new = noisy(&last, 0.005, 1);
            new.delta.iter_mut().for_each(|d| *d = ((f64::from(*d) - shift) / scale) as f32);
            let steady: Vec<bool> = (0..3600).map(|i| i % 5 != 0).collect();
            for i in (0..3600).filter(|i| i % 24 < wild || !steady[*i]) {
                new.delta[i] = (i % 10) as f32 / 10.0;
            }
            let found = fit(&new, &last, &steady);
            prop_assert!((found.scale / scale - 1.0).abs() < 0.1 && (found.shift - shift).abs() < 0.05, "{found:?}");
        }
    }

    #[test]
    fn relief_does_not_fade_over_a_thousand_frames_of_noise() {
        let truth = relief(40);
        let (mut last, none) = (truth.clone(), vec![false; 1600]);
        for frame in 0..1000 {
            let mut new = noisy(&truth, 0.05, frame);
            fit(&new, &last, &none).apply(&mut new.delta);
            last = new;
        }
        let spread = |m: &DisparityMap| {
            let mean = m.delta.iter().sum::<f32>() / 1600.0;
            (m.delta.iter().map(|d| (d - mean).powi(2)).sum::<f32>() / 1600.0).sqrt()
        };
        let kept = spread(&last) / spread(&truth);
        assert!((0.9..1.2).contains(&kept), "{kept}");
    }

    #[test]
    fn flat_maps_are_only_shifted() {
        let flat = |d: f32| DisparityMap { width: 10, height: 10, delta: vec![d; 100] };
        let found = fit(&flat(0.3), &flat(0.5), &[true; 100]);
        assert!((found.scale - 1.0).abs() < 1e-12);
        assert!((found.shift - 0.2).abs() < 1e-6);
        assert_eq!(fit(&flat(0.3), &flat(0.5), &[]), Affine::IDENTITY);
    }
}
