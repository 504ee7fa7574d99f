//! One-dimensional k-means, exact up to the width of a bin, by dynamic programming with divide and conquer over the split point.

use super::k_means::Histogram;

/// Least number of bins, and number of bins per cluster; the larger count is used. Values within a bin count as one, and means stay exact.
///
/// Let E be the sum of squares about the bins' means, at most a quarter of a bin's squared width per value. The cost is at most
/// (√best + √E)² + E: an optimal split never separates equal values, and moving each value to its bin's mean changes the root of a cost
/// by at most √E.
const BINS: (usize, usize) = (256, 16);

/// Optimal clusters of values for every count up to a bound.
pub struct ClusterTable {
    lo: f64,
    points: Vec<(f64, f64)>,
    /// For each count from 2, and each end: start of the last run of the optimal split of the points before that end.
    from: Vec<Vec<u32>>,
}

impl ClusterTable {
    /// Finds the optimal splits of weighted values into 1 to `most` runs.
    pub fn new(values: &[f32], weights: &[f32], most: usize) -> Self {
        let Some(h) = Histogram::new(values, weights, BINS.0.max(BINS.1 * most)) else {
            return Self { lo: 0.0, points: Vec::new(), from: Vec::new() };
        };
        let points: Vec<(f64, f64)> = h.weight.iter().zip(&h.moment).filter(|(w, _)| **w > 0.0).map(|(w, m)| (*w, m / w)).collect();
        let from = split(&points, most.min(points.len()));
        Self { lo: h.lo, points, from }
    }

    /// The optimal cluster centres in ascending order: at most `n`, and at most the `most` of the table.
    pub fn centres(&self, n: usize) -> Vec<f64> {
        if self.points.is_empty() {
            return vec![0.0];
        }
        let mut end = self.points.len();
        let mut centres = Vec::with_capacity(n);
        for arg in self.from[..self.from.len().min(n.saturating_sub(1))].iter().rev() {
            let start = arg[end] as usize;
            centres.push(self.lo + mean(&self.points[start..end]));
            end = start;
        }
        centres.push(self.lo + mean(&self.points[..end]));
        centres.reverse();
        centres
    }

    /// Root-mean-square distance of the values from the centres of `n` clusters, values within a bin counted as one; NaN without values.
    pub fn deviation(&self, n: usize) -> f64 {
        let centres = self.centres(n);
        let (weight, squares) = self.points.iter().fold((0.0, 0.0), |(weight, squares), (w, at)| {
            let distance = centres.iter().map(|centre| (self.lo + at - centre).abs()).fold(f64::INFINITY, f64::min);
            (weight + w, squares + w * distance * distance)
        });
        (squares / weight).sqrt()
    }
}

fn mean(points: &[(f64, f64)]) -> f64 {
    let (w, m) = points.iter().fold((0.0, 0.0), |(w, m), p| (w + p.0, m + p.0 * p.1));
    m / w
}

/// Prefix sums about the overall mean, which avoids cancellation of squares.
struct Sums(Vec<[f64; 3]>);

impl Sums {
    fn new(points: &[(f64, f64)]) -> Self {
        let centre = mean(points);
        let mut all = Vec::with_capacity(points.len() + 1);
        let (mut w, mut m, mut q) = (0.0, 0.0, 0.0);
        all.push([0.0; 3]);
        for &(pw, px) in points {
            let x = px - centre;
            w += pw;
            m += pw * x;
            q += pw * x * x;
            all.push([w, m, q]);
        }
        Self(all)
    }

    /// Sum of squared distances of points `a..b` to their mean.
    fn cost(&self, a: usize, b: usize) -> f64 {
        let (from, to) = (&self.0[a], &self.0[b]);
        let (w, m, q) = (to[0] - from[0], to[1] - from[1], to[2] - from[2]);
        if w > 0.0 { (q - m * m / w).max(0.0) } else { 0.0 }
    }
}

/// Splits ascending points into up to `n` runs of least total cost; returns [`ClusterTable::from`].
fn split(points: &[(f64, f64)], n: usize) -> Vec<Vec<u32>> {
    let (sums, len) = (Sums::new(points), points.len());
    let mut cost: Vec<f64> = (0..=len).map(|b| sums.cost(0, b)).collect();
    let mut from = Vec::with_capacity(n);
    let mut todo = Vec::new();
    for k in 1..n {
        let mut next = vec![f64::INFINITY; len + 1];
        let mut arg = vec![0; len + 1];
        // the best split point never decreases with the end, so each half of the ends searches only its own range
        todo.push((k + 1, len, k, len));
        while let Some((lo, hi, from_lo, from_hi)) = todo.pop() {
            if lo > hi {
                continue;
            }
            let mid = usize::midpoint(lo, hi);
            let mut best = (f64::INFINITY, from_lo);
            for a in from_lo..=from_hi.min(mid - 1) {
                let c = cost[a] + sums.cost(a, mid);
                if c < best.0 {
                    best = (c, a);
                }
            }
            (next[mid], arg[mid]) = (best.0, best.1 as u32);
            todo.push((mid + 1, hi, best.1, from_hi));
            todo.push((lo, mid - 1, from_lo, best.1));
        }
        cost = next;
        from.push(arg);
    }
    from
}
