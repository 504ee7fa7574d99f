//! Planes evenly spaced in disparity: the common baseline.

use super::Samples;

/// `n` disparities from the least to the greatest of the tile, evenly spaced, both ends included.
pub fn centres(s: &Samples, n: usize) -> Vec<f64> {
    let (lo, hi) = s.deltas().iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), &d| (lo.min(f64::from(d)), hi.max(f64::from(d))));
    if lo >= hi || n < 2 {
        return vec![if lo.is_finite() { f64::midpoint(lo, hi) } else { 0.0 }];
    }
    (0..n).map(|i| lo + (hi - lo) * i as f64 / (n - 1) as f64).collect()
}
