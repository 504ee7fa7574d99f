//! Exact one-dimensional k-means by dynamic programming with divide and conquer over the split point.

use super::Samples;
use super::lloyd::Histogram;

/// Bins: values within range/4096 of each other count as one.
const BINS: usize = 4096;

/// The optimal cluster centres, at most `n`, ascending.
pub fn centres(s: &Samples, n: usize) -> Vec<f64> {
    let Some(h) = Histogram::new(s.deltas(), s.weights(), BINS) else { return vec![0.0] };
    let points: Vec<(f64, f64)> = h.weight.iter().zip(&h.moment).filter(|(w, _)| **w > 0.0).map(|(w, m)| (*w, m / w)).collect();
    let n = n.min(points.len());
    split(&points, n).iter().map(|&(a, b)| h.lo + mean(&points[a..b])).collect()
}

fn mean(points: &[(f64, f64)]) -> f64 {
    let (w, m) = points.iter().fold((0.0, 0.0), |(w, m), p| (w + p.0, m + p.0 * p.1));
    m / w
}

/// Prefix sums about the overall mean, so that squares do not cancel.
struct Sums {
    w: Vec<f64>,
    m: Vec<f64>,
    q: Vec<f64>,
}

impl Sums {
    fn new(points: &[(f64, f64)]) -> Self {
        let centre = mean(points);
        let mut s = Self { w: vec![0.0], m: vec![0.0], q: vec![0.0] };
        let (mut w, mut m, mut q) = (0.0, 0.0, 0.0);
        for &(pw, px) in points {
            let x = px - centre;
            w += pw;
            m += pw * x;
            q += pw * x * x;
            s.w.push(w);
            s.m.push(m);
            s.q.push(q);
        }
        s
    }

    /// Sum of squared distances of points `a..b` to their mean.
    fn cost(&self, a: usize, b: usize) -> f64 {
        let (w, m, q) = (self.w[b] - self.w[a], self.m[b] - self.m[a], self.q[b] - self.q[a]);
        if w > 0.0 { (q - m * m / w).max(0.0) } else { 0.0 }
    }
}

/// Splits ascending points into `n` runs of least total cost.
fn split(points: &[(f64, f64)], n: usize) -> Vec<(usize, usize)> {
    let (sums, len) = (Sums::new(points), points.len());
    let mut cost: Vec<f64> = (0..=len).map(|b| sums.cost(0, b)).collect();
    let mut from: Vec<Vec<usize>> = Vec::with_capacity(n);
    for k in 1..n {
        let mut next = vec![f64::INFINITY; len + 1];
        let mut arg = vec![0; len + 1];
        // the best split point grows with the end, so each half of the ends searches its own part only
        let mut todo = vec![(k + 1, len, k, len)];
        while let Some((lo, hi, from_lo, from_hi)) = todo.pop() {
            if lo > hi {
                continue;
            }
            let mid = usize::midpoint(lo, hi);
            for a in from_lo..=from_hi.min(mid - 1) {
                let c = cost[a] + sums.cost(a, mid);
                if c < next[mid] {
                    next[mid] = c;
                    arg[mid] = a;
                }
            }
            todo.push((mid + 1, hi, arg[mid], from_hi));
            todo.push((lo, mid - 1, from_lo, arg[mid]));
        }
        cost = next;
        from.push(arg);
    }
    let mut runs = Vec::with_capacity(n);
    let mut end = len;
    for arg in from.iter().rev() {
        let a = arg[end];
        runs.push((a, end));
        end = a;
    }
    runs.push((0, end));
    runs.reverse();
    runs
}
