//! Splits disparity into a few bands, each with objects at a similar distance, by exact k-means on a histogram.

/// Bins of the histogram.
const BINS: usize = 256;
/// Range of the number of bands, unless the photo has fewer distances.
pub(super) const COUNT: std::ops::RangeInclusive<usize> = 3..=8;
/// RMS deviation of δ from its band's mean above which another band is added.
const SPREAD: f64 = 0.06;

/// Bounds between bands, ascending: one fewer than bands. Uses the fewest bands that keep to [`SPREAD`].
pub(super) fn bounds(delta: &[f32]) -> Vec<f32> {
    let (least, most) = delta.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), &d| (a.min(d), b.max(d)));
    let width = (most - least) / BINS as f32;
    // NaN without pixels
    if width.is_nan() || width <= 0.0 {
        return Vec::new();
    }
    let mut histogram = [0u64; BINS];
    for d in delta {
        histogram[(((d - least) / width) as usize).min(BINS - 1)] += 1;
    }
    let occupied = histogram.iter().filter(|&&n| n > 0).count();
    let costs = Costs::of(&histogram);
    let allowed = delta.len() as f64 * (SPREAD / f64::from(width)).powi(2);
    let table = table(&costs, *COUNT.end().min(&occupied));
    let count = (*COUNT.start()..=table.len()).find(|n| table[n - 1][BINS].0 <= allowed).unwrap_or(table.len());
    let mut ends = Vec::new();
    let mut end = BINS;
    for n in (1..count).rev() {
        end = table[n][end].1;
        ends.push(end);
    }
    ends.reverse();
    // in the middle of the gap between occupied bins
    let bound = |end: usize| {
        let below = (0..end).rev().find(|&i| histogram[i] > 0).unwrap_or(0) + 1;
        let above = (end..BINS).find(|&i| histogram[i] > 0).unwrap_or(end);
        least + (below + above) as f32 / 2.0 * width
    };
    ends.into_iter().map(bound).collect()
}

/// Prefix sums over the bins: count, sum, sum of squares.
struct Costs([[f64; 3]; BINS + 1]);

impl Costs {
    fn of(histogram: &[u64; BINS]) -> Self {
        let mut sums = [[0.0; 3]; BINS + 1];
        for (i, &n) in histogram.iter().enumerate() {
            let (n, at) = (n as f64, i as f64 + 0.5);
            sums[i + 1] = [sums[i][0] + n, sums[i][1] + n * at, sums[i][2] + n * at * at];
        }
        Self(sums)
    }

    /// Sum of squared deviations from the mean over the bins `from..to`, in bins².
    fn about_mean(&self, from: usize, to: usize) -> f64 {
        let [n, sum, squares] = std::array::from_fn(|i| self.0[to][i] - self.0[from][i]);
        if n > 0.0 { (squares - sum * sum / n).max(0.0) } else { 0.0 }
    }
}

/// `table[n - 1][end]`: minimum cost of `n` bands over the bins before `end`, and the first bin of the last band.
fn table(costs: &Costs, most: usize) -> Vec<Vec<(f64, usize)>> {
    let mut table = vec![(0..=BINS).map(|end| (costs.about_mean(0, end), 0)).collect::<Vec<_>>()];
    for n in 1..most {
        let row = (0..=BINS).map(|end| {
            let best = (n.min(end)..=end).map(|from| (table[n - 1][from].0 + costs.about_mean(from, end), from));
            best.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, 0))
        });
        let row = row.collect();
        table.push(row);
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn separate_distances_get_separate_bands() {
        let of = |at: &[f32]| bounds(&(0..4000).map(|i| at[i % at.len()] + (i % 7) as f32 * 1e-3).collect::<Vec<_>>());
        let got = of(&[0.0, 0.5, 1.0]);
        assert!(got.len() == 2 && (got[0] - 0.25).abs() < 0.02 && (got[1] - 0.75).abs() < 0.02, "{got:?}");
        assert_eq!(of(&[0.05, 0.3, 0.5, 0.7, 0.95]).len(), 4);
        assert!(bounds(&[0.4; 100]).is_empty() && bounds(&[]).is_empty());
    }

    #[test]
    fn a_slope_gets_at_most_eight_equal_bands() {
        let slope: Vec<f32> = (0..10_000).map(|i| i as f32 / 1e4).collect();
        let got = bounds(&slope);
        assert!(COUNT.contains(&(got.len() + 1)), "{got:?}");
        let step = 1.0 / (got.len() + 1) as f32;
        assert!(got.iter().enumerate().all(|(i, b)| (b - (i + 1) as f32 * step).abs() < 0.01), "{got:?}");
        // the smallest count that keeps to the spread
        let spread = |bands: f64| 1.0 / bands / 12f64.sqrt();
        assert!(spread((got.len() + 1) as f64) <= SPREAD && spread(got.len() as f64) > SPREAD);
        let steep: Vec<f32> = slope.iter().map(|d| d * 50.0).collect();
        assert_eq!(bounds(&steep).len() + 1, *COUNT.end());
    }
}
