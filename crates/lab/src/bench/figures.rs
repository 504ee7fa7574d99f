//! Measured values by name.

use super::Point;

/// Median; 0 if there are no values.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    match n {
        0 => 0.0,
        _ if n % 2 == 1 => values[n / 2],
        _ => f64::midpoint(values[n / 2 - 1], values[n / 2]),
    }
}

/// All values of each figure; figures are in the order in which they first appeared.
#[derive(Clone, Debug, Default)]
pub(crate) struct Figures(Vec<(String, Vec<f64>)>);

impl Figures {
    fn named(&mut self, name: &str) -> &mut Vec<f64> {
        let i = self.0.iter().position(|(n, _)| n == name).unwrap_or_else(|| {
            self.0.push((name.into(), Vec::new()));
            self.0.len() - 1
        });
        &mut self.0[i].1
    }

    pub fn add(&mut self, name: &str, value: f64) {
        self.named(name).push(value);
    }

    /// Keeps only the largest value of a figure.
    pub fn most(&mut self, name: &str, value: f64) {
        let all = self.named(name);
        *all = vec![all.iter().copied().fold(value, f64::max)];
    }

    fn all(&self, name: &str) -> &[f64] {
        self.0.iter().find(|f| f.0 == name).map_or(&[], |f| &f.1)
    }

    /// Mean; 0 if there are no values.
    pub fn mean(&self, name: &str) -> f64 {
        let all = self.all(name);
        all.iter().sum::<f64>() / all.len().max(1) as f64
    }

    /// The value that this share of the values does not exceed; 0 if there are none.
    pub fn percentile(&self, name: &str, share: f64) -> f64 {
        let mut all = self.all(name).to_vec();
        all.sort_by(f64::total_cmp);
        all.get(((all.len() as f64 * share) as usize).min(all.len().saturating_sub(1))).copied().unwrap_or_default()
    }

    /// The mean of each figure.
    pub fn means(&self) -> Vec<(String, f64)> {
        self.0.iter().map(|(name, _)| (name.clone(), self.mean(name))).collect()
    }

    /// The means, with two of them as the place of a point, and the standard deviation of the second.
    pub fn point(&self, setting: String, axes: (&str, &str)) -> Point {
        let (x, y, all) = (self.mean(axes.0), self.mean(axes.1), self.all(axes.1));
        let spread = (all.iter().map(|v| (v - y).powi(2)).sum::<f64>() / all.len().max(1) as f64).sqrt();
        Point { setting, x, y, spread, figures: self.means(), ..Point::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_of_odd_even_and_empty_lists() {
        assert!((median(vec![3.0, 1.0, 9.0]) - 3.0).abs() < 1e-12);
        assert!((median(vec![4.0, 1.0, 9.0, 2.0]) - 3.0).abs() < 1e-12);
        assert!(median(Vec::new()).abs() < 1e-12);
    }

    #[test]
    fn figures_have_means_spreads_and_percentiles() {
        let mut f = Figures::default();
        for v in 1..=20 {
            f.add("y", f64::from(v));
        }
        f.add("x", 7.0);
        for v in [3.0, 9.0, 4.0] {
            f.most("most", v);
        }
        assert_eq!(f.means(), [("y".into(), 10.5), ("x".into(), 7.0), ("most".into(), 9.0)]);
        assert!((f.percentile("y", 0.95) - 20.0).abs() < 1e-12 && (f.percentile("y", 0.5) - 11.0).abs() < 1e-12);
        assert!(f.mean("none").abs() < 1e-12 && f.percentile("none", 1.0).abs() < 1e-12);
        let p = f.point("s".into(), ("x", "y"));
        assert!((p.x - 7.0).abs() < 1e-12 && (p.spread - 33.25f64.sqrt()).abs() < 1e-9, "{p:?}");
    }
}
