//! Taps along one axis: which source samples make up a sample of the result, with which weights.

use super::resample::Filter;

/// Slope at 1 of `OpenCV`'s and `PyTorch`'s cubic.
const SLOPE: f64 = -0.75;

/// Taps along one axis: for each sample of the result, its first source sample and the weights from there on.
pub struct Taps(pub(super) Vec<(usize, Vec<f32>)>);

impl Taps {
    /// Resamples `from` samples to `to`, both at least 1, by a kernel that is stretched by the ratio when reducing. Weights sum to 1.
    pub fn stretched(from: usize, to: usize, filter: Filter) -> Self {
        let ratio = from as f64 / to as f64;
        let stretch = ratio.max(1.0);
        let reach = filter.support() * stretch;
        let tap = |i: usize| {
            let centre = (i as f64 + 0.5) * ratio;
            let first = (centre - reach).floor().max(0.0) as usize;
            let end = ((centre + reach).ceil() as usize).clamp(first + 1, from);
            let first = first.min(end - 1);
            let mut weights: Vec<f64> = (first..end).map(|s| filter.at((s as f64 + 0.5 - centre) / stretch)).collect();
            let sum: f64 = weights.iter().sum();
            if sum.abs() < 1e-12 {
                let middle = weights.len() / 2;
                weights[middle] = 1.0;
            } else {
                for w in &mut weights {
                    *w /= sum;
                }
            }
            (first, weights.into_iter().map(|w| w as f32).collect())
        };
        Self((0..to).map(tap).collect())
    }

    /// Resamples `from` samples to `to`, both at least 1, by a cubic of slope −¾ over four samples, whatever the ratio. The border is
    /// repeated. Equals `OpenCV`'s `INTER_CUBIC` and `PyTorch`'s `bicubic` without antialiasing.
    pub fn four(from: usize, to: usize) -> Self {
        Self((0..to).map(|i| gathered(&cubic(from, to, i))).collect())
    }

    /// Resamples `from` samples to `to`, at least 1 and at most `from`: the mean over what a sample covers, without slivers below a
    /// thousandth of a sample. Equals `OpenCV`'s `INTER_AREA`.
    pub fn covered(from: usize, to: usize) -> Self {
        let ratio = from as f64 / to as f64;
        let tap = |i: usize| {
            let begin = i as f64 * ratio;
            let (end, width) = (begin + ratio, ratio.min(from as f64 - begin));
            let last = (end as usize).min(from - 1);
            let first = (begin.ceil() as usize).min(last);
            let (before, after) = (first as f64 - begin, end - last as f64);
            let mut all: Vec<_> = (first..last).map(|s| (s, 1.0 / width)).collect();
            if before > 1e-3 {
                all.push((first - 1, before / width));
            }
            if after > 1e-3 {
                all.push((last, after.min(1.0).min(width) / width));
            }
            gathered(&all)
        };
        Self((0..to).map(tap).collect())
    }
}

/// The samples before and after position `at`, the same one at the border and beyond it, and the share of the latter. Sample 0 of the `n`
/// is at 0.
#[inline]
pub(crate) fn around(at: f64, n: usize) -> (usize, usize, f64) {
    let at = at.clamp(0.0, (n - 1) as f64);
    (at as usize, (at as usize + 1).min(n - 1), at.fract())
}

/// The value at a position between samples, by bilinear interpolation of those [`around`] it.
pub(crate) fn bilinear((x, y): (f64, f64), (w, h): (usize, usize), value: impl Fn(usize, usize) -> f64) -> f64 {
    let ((x0, x1, fx), (y0, y1, fy)) = (around(x, w), around(y, h));
    let line = |y: usize| value(x0, y) * (1.0 - fx) + value(x1, y) * fx;
    line(y0) * (1.0 - fy) + line(y1) * fy
}

/// The four source samples, clamped to the border, that make up sample `i` of `to`, and their weights.
fn cubic(from: usize, to: usize, i: usize) -> [(usize, f64); 4] {
    // in single precision, as in OpenCV and PyTorch
    let at = ((i as f64 + 0.5) * (from as f64 / to as f64) - 0.5) as f32;
    let low = at.floor();
    let t = f64::from(at - low);
    let near = |x: f64| ((SLOPE + 2.0) * x - (SLOPE + 3.0)) * x * x + 1.0;
    let far = |x: f64| SLOPE * (((x - 5.0) * x + 8.0) * x - 4.0);
    let weights = [far(t + 1.0), near(t), near(1.0 - t), far(2.0 - t)];
    std::array::from_fn(|k| ((low as i64 + k as i64 - 1).clamp(0, from as i64 - 1) as usize, weights[k]))
}

/// Weights of single samples, at least one, as one row.
fn gathered(all: &[(usize, f64)]) -> (usize, Vec<f32>) {
    let (first, last) = all.iter().fold((usize::MAX, 0), |m, &(at, _)| (m.0.min(at), m.1.max(at)));
    let mut weights = vec![0f64; last + 1 - first];
    for &(at, w) in all {
        weights[at - first] += w;
    }
    (first, weights.into_iter().map(|w| w as f32).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_same_size_changes_nothing() {
        for (i, (at, weights)) in Taps::four(9, 9).0.iter().enumerate() {
            let unit = weights.iter().position(|&w| (w - 1.0).abs() < 1e-6);
            assert_eq!(unit.map(|k| at + k), Some(i), "{weights:?}");
        }
    }

    proptest! {
        #[test]
        fn weights_lie_inside_and_sum_to_one(from in 1usize..300, to in 1usize..300) {
            for (taps, size, off) in [
                (Taps::four(from, to), from, 1e-5),
                (Taps::stretched(from, to, Filter::Cubic), from, 1e-5),
                // two slivers of a thousandth are left out
                (Taps::covered(from.max(to), to), from.max(to), 2.1e-3),
            ] {
                prop_assert_eq!(taps.0.len(), to);
                for (at, weights) in &taps.0 {
                    prop_assert!(!weights.is_empty() && at + weights.len() <= size);
                    prop_assert!((weights.iter().sum::<f32>() - 1.0).abs() < off);
                }
            }
        }
    }
}
