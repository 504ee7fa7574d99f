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

/// Values of each figure: of each subject, all that its runs measured. Figures are in the order in which they first appeared.
#[derive(Clone, Debug, Default)]
pub(crate) struct Figures(Vec<(String, Vec<Vec<f64>>)>);

impl Figures {
    fn named(&mut self, name: &str) -> &mut Vec<Vec<f64>> {
        let i = self.0.iter().position(|(n, _)| n == name).unwrap_or_else(|| {
            self.0.push((name.into(), Vec::new()));
            self.0.len() - 1
        });
        &mut self.0[i].1
    }

    /// Adds the value of another subject.
    pub fn add(&mut self, name: &str, value: f64) {
        self.named(name).push(vec![value]);
    }

    /// Adds the value of another run of a subject. The median of its runs counts.
    pub fn add_run(&mut self, name: &str, subject: usize, value: f64) {
        let all = self.named(name);
        if all.len() <= subject {
            all.resize(subject + 1, Vec::new());
        }
        all[subject].push(value);
    }

    /// Adds all values of other subjects.
    pub fn append(&mut self, other: Self) {
        other.0.into_iter().for_each(|(name, values)| self.named(&name).extend(values));
    }

    /// Keeps only the largest value of a figure.
    pub fn most(&mut self, name: &str, value: f64) {
        let all = self.named(name);
        *all = vec![vec![all.iter().flatten().copied().fold(value, f64::max)]];
    }

    /// The value of each subject.
    fn all(&self, name: &str) -> Vec<f64> {
        let all: &[Vec<f64>] = self.0.iter().find(|f| f.0 == name).map_or(&[], |f| &f.1);
        all.iter().filter(|runs| !runs.is_empty()).map(|runs| median(runs.clone())).collect()
    }

    /// Mean; 0 if there are no values.
    pub fn mean(&self, name: &str) -> f64 {
        let all = self.all(name);
        all.iter().sum::<f64>() / all.len().max(1) as f64
    }

    /// The value that this share of the values does not exceed; 0 if there are none.
    pub fn percentile(&self, name: &str, share: f64) -> f64 {
        let mut all = self.all(name);
        all.sort_by(f64::total_cmp);
        all.get(((all.len() as f64 * share) as usize).min(all.len().saturating_sub(1))).copied().unwrap_or_default()
    }

    pub fn means(&self) -> Vec<(String, f64)> {
        self.0.iter().map(|(name, _)| (name.clone(), self.mean(name))).collect()
    }

    /// The means of the least and of the most that the runs of a subject measured, for each figure in which runs differ.
    fn ranges(&self) -> Vec<(String, [f64; 2])> {
        let range = |subjects: &Vec<Vec<f64>>| {
            let mean = |most: fn(f64, f64) -> f64| {
                let all: Vec<f64> = subjects.iter().filter_map(|runs| runs.iter().copied().reduce(most)).collect();
                all.iter().sum::<f64>() / all.len().max(1) as f64
            };
            Some([mean(f64::min), mean(f64::max)]).filter(|[least, most]| least < most)
        };
        self.0.iter().filter_map(|(name, subjects)| Some((name.clone(), range(subjects)?))).collect()
    }

    /// The means, with two of them as the place of a point, and the standard deviation of the second.
    pub fn point(&self, setting: String, axes: (&str, &str)) -> Point {
        let (x, y, all) = (self.mean(axes.0), self.mean(axes.1), self.all(axes.1));
        let spread = (all.iter().map(|v| (v - y).powi(2)).sum::<f64>() / all.len().max(1) as f64).sqrt();
        Point { setting, x, y, spread, figures: self.means(), ranges: self.ranges(), ..Point::default() }
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
        assert!((p.x - 7.0).abs() < 1e-12 && (p.spread - 33.25f64.sqrt()).abs() < 1e-9 && p.ranges.is_empty(), "{p:?}");
    }

    #[test]
    fn medians_of_runs_count_and_ranges_tell_how_far_runs_are_apart() {
        let mut f = Figures::default();
        for (subject, ms) in [(0, 30.0), (1, 100.0), (0, 20.0), (1, 140.0), (0, 70.0)] {
            f.add_run("ms", subject, ms);
        }
        f.add_run("dB", 0, 31.0);
        f.add_run("dB", 0, 31.0);
        let mut other = Figures::default();
        other.add("dB", 33.0);
        other.add_run("ms", 0, 150.0);
        f.append(other);
        let p = f.point("s".into(), ("ms", "dB"));
        // medians 30, 120, 150; least 20, 100, 150; most 70, 140, 150
        assert_eq!(p.figures, [("ms".into(), 100.0), ("dB".into(), 32.0)]);
        assert_eq!((p.ranges.clone(), p.range("dB")), (vec![("ms".into(), [90.0, 120.0])], None));
        assert!(p.range("ms").is_some_and(|[least, most]| least <= p.x && p.x <= most) && (p.spread - 1.0).abs() < 1e-12, "{p:?}");
    }
}
