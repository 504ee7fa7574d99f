//! Aligns the disparity of a new frame with that of the last one: fits scale and shift, and removes steps at borders.

use tmpi_core::DisparityMap;

use crate::change::BLOCK;

/// Maximum number of pixels that a fit samples.
const MAX_SAMPLES: usize = 8_000;
/// Maximum number of reweighting rounds.
const MAX_ROUNDS: usize = 20;
/// Residual, in units of the median residual, above which a pixel gets less weight.
const HUBER: f64 = 2.0;
/// Exponent of Huber's weight (1964). An exponent of 1 suffices for a mean, but lets outliers dominate a ratio of two spreads.
const POWER: i32 = 4;
/// Fraction of pixels that must be steady for a fit to use only those.
const MIN_STEADY: f64 = 0.05;
/// How far a frame without enough steady pixels returns to its own scale; otherwise each frame's error would persist.
const RETURN: f64 = 0.02;
/// Range of plausible scales.
const SCALES: (f64, f64) = (0.25, 4.0);
/// Least variance of a map with relief: values that differ by more than rounding.
const MIN_VARIANCE: f64 = 1e-9;
/// Least correlation of the two maps, squared, at which the ratio of their spreads is a scale. That of noise is far lower.
const MIN_CORRELATION: f64 = 0.5;

/// `δ = scale · δ' + shift`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Affine {
    /// Factor, positive.
    pub scale: f64,
    /// Offset.
    pub shift: f64,
}

impl Affine {
    /// Scale 1, shift 0.
    pub const IDENTITY: Self = Self { scale: 1.0, shift: 0.0 };

    /// Transforms each value and clamps it to 0 to 1.
    pub fn apply(&self, delta: &mut [f32]) {
        for d in delta {
            *d = (self.scale * f64::from(*d) + self.shift).clamp(0.0, 1.0) as f32;
        }
    }
}

/// Fits `new` to `last` over the pixels for which `steady` is true. If these are too few, it fits all pixels and moves the result slightly
/// towards [`Affine::IDENTITY`]. Both maps and `steady` have the same size.
///
/// This is a robust reduced-major-axis regression: the scale is the ratio of the spreads. Least squares would flatten each frame a little
/// more than the last, because of the noise in `new`.
///
/// The scale is 1, and only the shift is fitted, where the maps do not determine one: if one of them has a single value, if near and far have
/// changed places, or if the pixels that agree do not rise and fall together. The last is so if almost all pixels of a map with two values
/// have one of them: what spread remains is noise, and its ratio says nothing. Pixels that are not finite in both maps do not count; without
/// any others, the result is [`Affine::IDENTITY`].
pub fn fit(new: &DisparityMap, last: &DisparityMap, steady: &[bool]) -> Affine {
    let known = steady.iter().filter(|s| **s).count();
    let enough = known as f64 >= MIN_STEADY * steady.len().max(1) as f64;
    let step = if enough { known } else { steady.len() }.div_ceil(MAX_SAMPLES).max(1);
    let all = new.delta.iter().zip(&last.delta).zip(steady).filter(|(_, s)| !enough || **s);
    let pairs = all.step_by(step).map(|((a, b), _)| (f64::from(*a), f64::from(*b)));
    let pairs: Vec<(f64, f64)> = pairs.filter(|(a, b)| a.is_finite() && b.is_finite()).collect();
    let fitted = regress(&pairs);
    if enough {
        return fitted;
    }
    let back = |from: f64, to: f64| from + RETURN * (to - from);
    Affine { scale: back(fitted.scale, 1.0), shift: back(fitted.shift, 0.0) }
}

/// Rounds in which offsets diffuse into stale blocks. A block farther than that from all steady ones keeps its fitted disparity.
const DIFFUSION_ROUNDS: usize = 64;

/// Makes the `stale` blocks of `new`, already fitted to `last`, join the steady blocks around them: the offset between both maps at the
/// border diffuses into the stale blocks and fades with distance. A single scale and shift per map would leave a step at the border that no
/// surface has. Both maps have the same size; `stale` has one entry per block, `across` per row.
pub fn join_borders(new: &mut DisparityMap, last: &DisparityMap, stale: &[bool], across: usize) {
    let (width, side, down) = (new.width as usize, BLOCK as usize, stale.len() / across.max(1));
    let beside = |at: usize| {
        let (x, y) = (at % across, at / across);
        let rows = y.saturating_sub(1)..(y + 2).min(down);
        rows.flat_map(move |y| (x.saturating_sub(1)..(x + 2).min(across)).map(move |x| y * across + x))
    };
    let mut off = vec![0.0f64; stale.len()];
    for at in (0..stale.len()).filter(|at| !stale[*at] && beside(*at).any(|b| stale[b])) {
        let columns = at % across * side..((at % across + 1) * side).min(width);
        let rows = at / across * side..((at / across + 1) * side).min(new.height as usize);
        let pixels = rows.flat_map(|y| columns.clone().map(move |x| y * width + x));
        off[at] = median(pixels.map(|i| f64::from(last.delta[i]) - f64::from(new.delta[i])).collect());
    }
    for _ in 0..DIFFUSION_ROUNDS {
        for at in (0..stale.len()).filter(|at| stale[*at]) {
            let (sum, count) = beside(at).fold((0.0, 0.0), |(sum, count), b| (sum + off[b], count + 1.0));
            off[at] = sum / count;
        }
    }
    for (i, delta) in new.delta.iter_mut().enumerate() {
        let (x, y) = (i % width, i / width);
        if stale[y / side * across + x / side] {
            // interpolate between block centres
            let place = |v: usize, most: usize| ((v as f64 + 0.5) / f64::from(BLOCK) - 0.5).clamp(0.0, most as f64 - 1.0);
            let (u, v) = (place(x, across), place(y, down));
            let at = |x: usize, y: usize| off[y.min(down - 1) * across + x.min(across - 1)];
            let row = |y: usize| at(u as usize, y) + u.fract() * (at(u as usize + 1, y) - at(u as usize, y));
            let by = row(v as usize) + v.fract() * (row(v as usize + 1) - row(v as usize));
            *delta = (f64::from(*delta) + by).clamp(0.0, 1.0) as f32;
        }
    }
}

/// Weighted means and variances of pairs, and their covariance.
struct Moments {
    x: f64,
    y: f64,
    xx: f64,
    yy: f64,
    xy: f64,
}

impl Moments {
    /// `None` without weight.
    fn of(pairs: &[(f64, f64)], weights: &[f64]) -> Option<Self> {
        let total: f64 = weights.iter().sum();
        if total <= 0.0 {
            return None;
        }
        let all = || pairs.iter().zip(weights);
        let (mut x, mut y) = (0.0, 0.0);
        for ((a, b), w) in all() {
            x += w * a / total;
            y += w * b / total;
        }
        let mut out = Self { x, y, xx: 0.0, yy: 0.0, xy: 0.0 };
        for ((a, b), w) in all() {
            let (a, b, w) = (a - x, b - y, w / total);
            out.xx += w * a * a;
            out.yy += w * b * b;
            out.xy += w * a * b;
        }
        Some(out)
    }

    /// Ratio of the spreads, within [`SCALES`]; 1 without relief, or with near and far swapped.
    fn scale(&self) -> f64 {
        let has_relief = self.xx > MIN_VARIANCE && self.yy > MIN_VARIANCE && self.xy > 0.0;
        if has_relief { (self.yy / self.xx).sqrt().clamp(SCALES.0, SCALES.1) } else { 1.0 }
    }

    /// The map with this scale.
    fn at_scale(&self, scale: f64) -> Affine {
        Affine { scale, shift: self.y - scale * self.x }
    }

    /// True if the two rise and fall together.
    fn is_correlated(&self) -> bool {
        self.xy > 0.0 && self.xy * self.xy >= MIN_CORRELATION * self.xx * self.yy
    }
}

fn regress(pairs: &[(f64, f64)]) -> Affine {
    let (mut result, mut last) = (Affine::IDENTITY, Affine::IDENTITY);
    let mut weights = vec![1.0; pairs.len()];
    for _ in 0..MAX_ROUNDS {
        let Some(moments) = Moments::of(pairs, &weights) else { return result };
        let next = moments.at_scale(moments.scale());
        let residuals: Vec<f64> = pairs.iter().map(|(a, b)| (next.scale * a + next.shift - b).abs()).collect();
        let most = HUBER * median(residuals.clone()).max(1e-4);
        weights = residuals.iter().map(|r| if *r <= most { 1.0 } else { (most / r).powi(POWER) }).collect();
        let same = (next.scale - last.scale).abs() < 1e-5 && (next.shift - last.shift).abs() < 1e-5;
        last = next;
        // outliers of the first rounds hide what the rest has in common, so only the last weights tell
        result = if moments.is_correlated() { next } else { moments.at_scale(1.0) };
        if same {
            break;
        }
    }
    result
}

fn median(mut values: Vec<f64>) -> f64 {
    let at = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(at, f64::total_cmp).1 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use tmpi_testing::pictures::noise;

    fn relief(n: usize) -> DisparityMap {
        let third = n as u32 / 3;
        DisparityMap::from_fn(n as u32, n as u32, |x, y| 0.2 + 0.3 * x as f32 / n as f32 + if y < third { 0.2 } else { 0.0 })
    }

    /// Adds reproducible noise of amplitude `by`.
    fn noisy(map: &DisparityMap, by: f32, seed: u32) -> DisparityMap {
        DisparityMap { delta: (0..).zip(&map.delta).map(|(i, d)| d + by * (2.0 * noise(i, seed) - 1.0)).collect(), ..*map }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        /// Up to a third of the steady pixels may be outliers.
        #[test]
        fn scale_and_shift_are_recovered(scale in 0.5f64..2.0, shift in -0.2f64..0.2, wild in 0usize..8) {
            let last = relief(60);
            let mut new = noisy(&last, 0.005, 1);
            new.delta.iter_mut().for_each(|d| *d = ((f64::from(*d) - shift) / scale) as f32);
            let steady: Vec<bool> = (0..3600).map(|i| i % 5 != 0).collect();
            for i in (0..3600).filter(|i| i % 24 < wild || !steady[*i]) {
                new.delta[i] = (i % 10) as f32 / 10.0;
            }
            let result = fit(&new, &last, &steady);
            prop_assert!((result.scale / scale - 1.0).abs() < 0.1 && (result.shift - shift).abs() < 0.05, "{result:?}");
        }
    }

    #[test]
    fn maps_without_noise_are_fitted_exactly() {
        let two_values = DisparityMap { width: 60, height: 60, delta: (0..3600).map(|i| if i % 60 < 25 { 0.7 } else { 0.2 }).collect() };
        for (scale, shift) in [(1.0f32, 0.0f32), (0.8, 0.1), (1.3, -0.2), (0.5, 0.4)] {
            for new in [relief(60), two_values.clone()] {
                let last = DisparityMap { delta: new.delta.iter().map(|d| scale * d + shift).collect(), ..new };
                let result = fit(&new, &last, &[true; 3600]);
                assert!((result.scale - f64::from(scale)).abs() < 1e-5 && (result.shift - f64::from(shift)).abs() < 1e-5, "{result:?}");
            }
        }
        // near and far have changed places: no negative scale
        let swapped = DisparityMap { delta: relief(60).delta.iter().map(|d| 0.9 - d).collect(), ..relief(60) };
        assert!((fit(&swapped, &relief(60), &[true; 3600]).scale - 1.0).abs() < 1e-12);
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
    fn stale_blocks_join_their_surroundings_without_a_step() {
        let (n, across) = (80u32, 10);
        let last = DisparityMap { width: n, height: n, delta: (0..n * n).map(|i| 0.3 + 0.002 * (i % n) as f32).collect() };
        // blocks 3 to 6 are stale, and their new disparity is off by more to the right; an object is in their centre
        let stale: Vec<bool> = (0..100).map(|b| (3..7).contains(&(b % across)) && (3..7).contains(&(b / across))).collect();
        let thing = |i: u32| (36..44).contains(&(i % n)) && (36..44).contains(&(i / n));
        let off = |i: u32| 0.04 + 0.0005 * (i % n) as f32;
        let at = |i: u32| last.delta[i as usize] + off(i) + if thing(i) { 0.2 } else { 0.0 };
        let mut new = DisparityMap { delta: (0..n * n).map(at).collect(), ..last };
        let before = new.clone();
        join_borders(&mut new, &last, &stale, across);
        for i in 0..n * n {
            let (is, was) = (new.delta[i as usize], before.delta[i as usize]);
            if !stale[(i / n / 8 * 10 + i % n / 8) as usize] {
                assert!((is - was).abs() < 1e-6, "pixel {i} is not stale");
                continue;
            }
            let should = last.delta[i as usize] + if thing(i) { 0.2 } else { 0.0 };
            assert!((is - should).abs() < 0.01, "pixel {i}: {is}, expected {should}");
        }
        // all blocks stale, none stale, and a picture that ends within a block
        for (side, stale) in [(80, vec![true; 100]), (80, vec![false; 100]), (77, vec![true; 100])] {
            let of = |m: &DisparityMap| DisparityMap { width: side, height: side, delta: m.delta[..(side * side) as usize].to_vec() };
            let mut same = of(&before);
            join_borders(&mut same, &of(&last), &stale, across);
            assert_eq!(same.delta, of(&before).delta);
        }
    }

    /// A map with two values, of which every `share`th pixel has the second.
    fn two_values(first: f32, second: f32, share: usize) -> DisparityMap {
        let delta = (0..3600).map(|i| if i % share == 0 { second } else { first }).collect();
        DisparityMap { width: 60, height: 60, delta }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Also if few pixels have the second value, and some have it in one of the maps only. With so few, noise must not become a scale.
        #[test]
        fn maps_with_two_values_have_their_scale_or_none(
            scale in 0.5f32..2.0, shift in -0.1f32..0.1, share in 2usize..40, lost in 5u32..50, amount in [0.0f32..0.01, 0.0f32..0.01],
        ) {
            let exact = two_values(0.2, 0.6, share);
            let mut last = noisy(&exact, amount[0], 3);
            for (i, d) in (0u32..).zip(&mut last.delta) {
                let lost = noise(i, 9) < 1.0 / lost as f32 && exact.delta[i as usize] > 0.5;
                *d = scale * if lost { 0.2 } else { *d } + shift;
            }
            let result = fit(&noisy(&exact, amount[1], 7), &last, &[true; 3600]);
            let is_known = (result.scale / f64::from(scale) - 1.0).abs() < 0.1 || (result.scale - 1.0).abs() < 1e-12;
            prop_assert!(is_known && result.shift.is_finite(), "{result:?}");
        }

        /// The scale and the shift are finite and plausible for any maps, with NaN and infinity.
        #[test]
        fn any_maps_have_a_plausible_fit(
            new in prop::collection::vec(prop_oneof![6 => 0.0f32..1.0, 1 => any::<f32>(), 1 => Just(f32::NAN), 1 => Just(f32::INFINITY)], 64),
            last in prop::collection::vec(prop_oneof![6 => 0.0f32..1.0, 1 => any::<f32>(), 1 => Just(f32::NAN), 1 => Just(f32::INFINITY)], 64),
            steady in prop::collection::vec(any::<bool>(), 64),
        ) {
            let of = |delta: &Vec<f32>| DisparityMap { width: 8, height: 8, delta: delta.clone() };
            let result = fit(&of(&new), &of(&last), &steady);
            prop_assert!((SCALES.0..=SCALES.1).contains(&result.scale) && result.shift.is_finite(), "{result:?}");
        }
    }

    #[test]
    fn noise_is_not_a_scale() {
        let flat = two_values(0.4, 0.4, 2);
        for seed in 0..32 {
            // damped in the last map, as the room's are
            let result = fit(&noisy(&flat, 0.02, seed), &noisy(&flat, 0.004, seed + 100), &[true; 3600]);
            assert!((result.scale - 1.0).abs() < 1e-12 && result.shift.abs() < 2e-3, "{seed}: {result:?}");
        }
    }

    #[test]
    fn pixels_that_are_not_finite_do_not_count() {
        let last = relief(60);
        let mut new = DisparityMap { delta: last.delta.iter().map(|d| 1.25 * d - 0.1).collect(), ..last };
        for (i, bad) in [(7, f32::NAN), (100, f32::INFINITY), (3000, f32::NEG_INFINITY)] {
            new.delta[i] = bad;
        }
        let result = fit(&new, &last, &[true; 3600]);
        assert!((result.scale - 0.8).abs() < 1e-5 && (result.shift - 0.08).abs() < 1e-5, "{result:?}");
        let none = DisparityMap { delta: vec![f32::NAN; 3600], ..last };
        assert_eq!(fit(&none, &last, &[true; 3600]), Affine::IDENTITY);
    }

    #[test]
    fn flat_maps_are_only_shifted() {
        let flat = |d: f32| DisparityMap { width: 10, height: 10, delta: vec![d; 100] };
        let result = fit(&flat(0.3), &flat(0.5), &[true; 100]);
        assert!((result.scale - 1.0).abs() < 1e-12);
        assert!((result.shift - 0.2).abs() < 1e-6);
        assert_eq!(fit(&flat(0.3), &flat(0.5), &[]), Affine::IDENTITY);
    }
}
