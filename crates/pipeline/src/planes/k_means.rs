//! Weighted k-means on a histogram (paper, section 3.2).

/// Number of bins between the least and the greatest value. Sums within a bin are exact, so a cluster boundary is off by at most one bin.
pub const BINS: usize = 256;
const ROUNDS: usize = 50;

/// Histogram of weighted values: for each bin, the weight and the weighted sum of offsets from the least value.
pub struct Histogram {
    /// Least value.
    pub lo: f64,
    /// Weight of each bin.
    pub weight: Vec<f64>,
    /// Weighted sum of `value − lo` of each bin.
    pub moment: Vec<f64>,
}

impl Histogram {
    /// Bins the values; `None` if no value has weight.
    pub fn new(values: &[f32], weights: &[f32], bins: usize) -> Option<Self> {
        let (lo, hi) = extremes(values, weights);
        if lo > hi {
            return None;
        }
        let (lo, range) = (f64::from(lo), f64::from(hi) - f64::from(lo));
        let scale = if range > 0.0 { bins as f64 / range } else { 0.0 };
        let (mut weight, mut moment) = (vec![0.0; bins], vec![0.0; bins]);
        for (&d, &w) in values.iter().zip(weights) {
            // a value without weight may be outside the range: `as` saturates, and it adds 0 to any bin
            let off = f64::from(d) - lo;
            let at = ((off * scale) as usize).min(bins - 1);
            weight[at] += f64::from(w);
            moment[at] += f64::from(w) * off;
        }
        Some(Self { lo, weight, moment })
    }

    /// Mean of the values in a range of bins; `None` if they have no weight.
    pub fn mean(&self, range: std::ops::Range<usize>) -> Option<f64> {
        let (w, m) = range.fold((0.0, 0.0), |(w, m), i| (w + self.weight[i], m + self.moment[i]));
        (w > 0.0).then(|| self.lo + m / w)
    }
}

/// Least and greatest value with weight; (∞, −∞) if none has weight.
fn extremes(values: &[f32], weights: &[f32]) -> (f32, f32) {
    const LANES: usize = 8;
    let (mut lo, mut hi) = ([f32::INFINITY; LANES], [f32::NEG_INFINITY; LANES]);
    for (d, w) in values.chunks(LANES).zip(weights.chunks(LANES)) {
        for (((lo, hi), &d), &w) in lo.iter_mut().zip(&mut hi).zip(d).zip(w) {
            let (low, high) = if w > 0.0 { (d, d) } else { (f32::INFINITY, f32::NEG_INFINITY) };
            *lo = if low < *lo { low } else { *lo };
            *hi = if high > *hi { high } else { *hi };
        }
    }
    (lo.into_iter().fold(f32::INFINITY, f32::min), hi.into_iter().fold(f32::NEG_INFINITY, f32::max))
}

/// Cluster centres in ascending order, at most `n`, from evenly spaced starts; a single centre at 0 without a histogram.
pub fn centres(histogram: Option<&Histogram>, n: usize) -> Vec<f64> {
    let Some(h) = histogram else { return vec![0.0] };
    let means: Vec<Option<f64>> = (0..h.weight.len()).map(|i| h.mean(i..i + 1)).collect();
    let (Some(first), Some(last)) = (means.iter().flatten().next(), means.iter().flatten().next_back()) else { return vec![0.0] };
    let mut c: Vec<f64> = (0..n).map(|i| first + (last - first) * (i as f64 + 0.5) / n as f64).collect();
    for _ in 0..ROUNDS {
        let (mut w, mut m) = (vec![0.0; c.len()], vec![0.0; c.len()]);
        let mut at = 0;
        for (i, mean) in means.iter().enumerate() {
            let Some(mean) = mean else { continue };
            while at + 1 < c.len() && mean - c[at] > c[at + 1] - mean {
                at += 1;
            }
            w[at] += h.weight[i];
            m[at] += h.moment[i];
        }
        let next: Vec<f64> = w.iter().zip(&m).filter(|(w, _)| **w > 0.0).map(|(w, m)| h.lo + m / w).collect();
        if next == c {
            break;
        }
        c = next;
    }
    c
}
