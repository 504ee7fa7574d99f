//! Whether a default is what its curve speaks for.

use super::{Axis, Experiment, Point};

/// Gains below this share of a time or a size, and below this share of an error or a quality, are none: two runs differ by as much.
const NOISE: [f64; 2] = [0.03, 0.002];

/// What an experiment says of a default.
#[derive(Clone, Debug)]
pub(super) struct Verdict<'a> {
    /// Curve of the default, where there are several.
    pub curve: Option<&'a str>,
    /// The default.
    pub default: &'a Point,
    /// The setting that is better, if there is one.
    pub better: Option<&'a Point>,
}

impl Experiment {
    /// True where each curve is of something else and has a default of its own, so that points of two curves cannot be compared.
    pub(super) fn is_apart(&self) -> bool {
        self.curves.iter().filter(|c| c.points.iter().any(|p| p.default)).count() > 1
    }

    /// Each default against the other settings. Where both axes have a better side, a setting is better that gains on one and loses on none;
    /// where only the vertical one has, the best.
    pub(super) fn verdicts(&self) -> Vec<Verdict<'_>> {
        let apart = self.is_apart();
        let all = || self.curves.iter().flat_map(|c| &c.points);
        let found = self.curves.iter().filter_map(|c| {
            let default = c.points.iter().find(|p| p.default)?;
            let others: Vec<&Point> = if apart { c.points.iter().collect() } else { all().collect() };
            let others = others.into_iter().filter(|p| self.is_better(p, default));
            let better = others.max_by(|a, b| gain(&self.y, a.y, default.y).total_cmp(&gain(&self.y, b.y, default.y)));
            Some(Verdict { curve: apart.then_some(c.name.as_str()), default, better })
        });
        found.collect()
    }

    fn is_better(&self, point: &Point, default: &Point) -> bool {
        let up = gain(&self.y, point.y, default.y);
        let along = if self.x.up.is_some() { gain(&self.x, point.x, default.x) } else { 0.0 };
        self.y.up.is_some() && up > -NOISE[1] && along > -NOISE[0] && (up > NOISE[1] || along > NOISE[0])
    }
}

/// By which share a value is better than another on an axis; 0 where neither side of the axis is.
fn gain(axis: &Axis, value: f64, than: f64) -> f64 {
    let more = (value - than) / than.abs().max(f64::MIN_POSITIVE);
    match axis.up {
        Some(true) => more,
        Some(false) => -more,
        None => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::super::Curve;
    use super::*;

    fn experiment(x_up: Option<bool>, curves: &[&[(f64, f64, bool)]]) -> Experiment {
        let point = |&(x, y, default): &(f64, f64, bool)| Point { setting: format!("{x} {y}"), x, y, default, ..Point::default() };
        let curve = |points: &&[(f64, f64, bool)]| Curve { name: points.len().to_string(), points: points.iter().map(point).collect() };
        Experiment {
            id: "e",
            title: String::new(),
            about: String::new(),
            x: Axis { label: "ms", log: false, up: x_up },
            y: Axis { label: "dB", log: false, up: Some(true) },
            curves: curves.iter().map(curve).collect(),
        }
    }

    fn better(e: &Experiment) -> Vec<Option<String>> {
        e.verdicts().into_iter().map(|v| v.better.map(|p| p.setting.clone())).collect()
    }

    #[test]
    fn a_setting_that_gains_and_loses_nothing_is_better() {
        let one = |x, y| better(&experiment(Some(false), &[&[(100.0, 30.0, true), (x, y, false)]]));
        assert_eq!(one(100.0, 31.0), [Some("100 31".into())]);
        assert_eq!(one(50.0, 30.0), [Some("50 30".into())]);
        for (x, y) in [(200.0, 31.0), (50.0, 29.0), (101.0, 30.01), (99.0, 29.99)] {
            assert_eq!(one(x, y), [None], "{x} {y}");
        }
        // an axis of the setting itself has no better side
        assert_eq!(better(&experiment(None, &[&[(1.0, 30.0, true), (9.0, 30.5, false), (5.0, 31.0, false)]])), [Some("5 31".into())]);
    }

    #[test]
    fn curves_of_different_things_are_not_compared() {
        let (slow, quick): (&[_], &[_]) = (&[(100.0, 30.0, true), (100.0, 29.0, false)], &[(10.0, 40.0, true)]);
        assert_eq!(better(&experiment(Some(false), &[slow, quick])), [None, None]);
        assert_eq!(better(&experiment(Some(false), &[slow, &[(10.0, 40.0, false)]])), [Some("10 40".into())]);
        assert!(better(&experiment(Some(false), &[&[(1.0, 2.0, false)]])).is_empty());
    }
}
