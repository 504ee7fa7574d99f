//! Planes evenly spaced in disparity: the usual baseline.

use super::Samples;

/// `n` evenly spaced disparities from the tile's least to its greatest, both included. Their midpoint alone if both are equal or `n` is
/// below 2; 0 without samples.
pub fn centres(s: &Samples, n: usize) -> Vec<f64> {
    let (lo, hi) = s.delta.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), &d| (lo.min(f64::from(d)), hi.max(f64::from(d))));
    if lo >= hi || n < 2 {
        return vec![if lo.is_finite() { f64::midpoint(lo, hi) } else { 0.0 }];
    }
    (0..n).map(|i| lo + (hi - lo) * i as f64 / (n - 1) as f64).collect()
}
