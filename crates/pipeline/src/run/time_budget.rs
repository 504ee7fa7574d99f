//! Time budgets: predicts how long settings take on this machine and chooses the ones that fit.
//!
//! The choice has two steps. Before decoding, [`Costs::side`] chooses the largest photo size that the cheapest operating point finishes in
//! time. Once the disparity is known, [`Costs::choose`] picks the smallest parallax error that fits into the remaining time. The elapsed
//! time is known by then, so only the rest is predicted.
//!
//! A tile is *busy* if one plane does not meet the requested parallax error.

use std::sync::OnceLock;

use serde::{Deserialize, Serialize};

/// Run times of a machine in milliseconds, fitted by `tmpi-lab bench` (`costs.json`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Costs {
    /// Per megapixel, from the file to the disparity that planes are fitted to, without the depth network.
    pub before: f64,
    /// Per photo, for the depth network, which runs at its own size.
    pub depth: f64,
    /// Per megapixel, in addition if depth is estimated: upsampling, snapping of blurred edges, and widening.
    pub depth_megapixel: f64,
    /// Per megapixel, for planes and all later stages of a photo without busy tiles; the same at any parallax error.
    pub plain: f64,
    /// Additional time of busy tiles, by operating point, from the best to the cheapest.
    pub points: Vec<Rate>,
}

/// Cost of an operating point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rate {
    /// Multiple of the requested parallax error.
    pub factor: f64,
    /// Additional milliseconds per megapixel of busy tiles.
    pub busy: f64,
}

/// Environment variable with the path of the JSON file of [`Costs`].
pub const COSTS: &str = "TMPI_COSTS";
/// Share of busy tiles that [`Costs::side`] assumes, before the disparity is known.
const ASSUMED_BUSY: f64 = 0.4;
/// Safety factor on predictions: a late result is worse than a plainer one.
const SAFETY: f64 = 1.1;
/// Shortest length, in pixels, that the longest side of a photo is reduced to.
const MIN_SIDE: f64 = 64.0;
/// Largest share of its sides that a photo is reduced to: a smaller reduction saves less time than it takes.
const MAX_REDUCED: f64 = 0.85;
/// Least time that a photo keeps for the stages that depend on its size, as a share of the time that does not: a smaller photo would lose
/// much of the picture and save little time.
const MIN_SCALED: f64 = 0.25;

impl Default for Costs {
    /// Costs of two cores of a server processor, between those that `tmpi-lab bench --only budget` measured in a slow and in a fast hour.
    /// Run it to measure your machine.
    fn default() -> Self {
        let rate = |factor, busy| Rate { factor, busy };
        Self {
            before: 40.0,
            depth: 25.0,
            depth_megapixel: 40.0,
            plain: 66.0,
            points: vec![rate(1.0, 182.0), rate(2.0, 138.0), rate(4.0, 100.0), rate(8.0, 80.0)],
        }
    }
}

impl Costs {
    /// Costs from the file that [`COSTS`] names, read once. Returns the defaults if the variable is unset, or, with a logged warning, if
    /// the file cannot be read or has no operating point.
    pub fn of_this_machine() -> &'static Self {
        static READ: OnceLock<Costs> = OnceLock::new();
        READ.get_or_init(|| {
            let Some(path) = std::env::var_os(COSTS) else { return Self::default() };
            let read = std::fs::read(&path).map_err(|e| e.to_string());
            let parsed = read.and_then(|bytes| serde_json::from_slice::<Self>(&bytes).map_err(|e| e.to_string()));
            parsed.and_then(|c| if c.points.is_empty() { Err("it has no operating point".into()) } else { Ok(c) }).unwrap_or_else(
                |reason| {
                    tracing::warn!(path = %std::path::Path::new(&path).display(), reason, "cannot read costs, using the defaults");
                    Self::default()
                },
            )
        })
    }

    /// The longest side, in pixels, at which the cheapest operating point finishes within `budget` milliseconds; `None` if the photo fits
    /// without reduction. `estimated` says whether the depth network runs.
    pub fn side(&self, budget: f64, (width, height): (u32, u32), estimated: bool) -> Option<u32> {
        let cheapest = self.cheapest(ASSUMED_BUSY)?;
        let megapixels = f64::from(width) * f64::from(height) / 1e6;
        let (fixed, more) = if estimated { (self.depth, self.depth_megapixel) } else { (0.0, 0.0) };
        let rate = (self.before + more + self.plain + cheapest.busy * ASSUMED_BUSY) * SAFETY;
        let room = (budget - fixed).max(fixed * MIN_SCALED) / rate;
        if room >= megapixels {
            return None;
        }
        let longest = f64::from(width.max(height));
        let side = (longest * (room / megapixels).sqrt().min(MAX_REDUCED)).max(MIN_SIDE).min(longest);
        Some(side as u32)
    }

    /// The best operating point that fits into `left` milliseconds, or the cheapest if none fits; with its predicted milliseconds and
    /// whether it fits. `busy` is the share of busy tiles, 0 to 1.
    pub fn choose(&self, left: f64, megapixels: f64, busy: f64) -> (Rate, f64, bool) {
        let takes = |r: &Rate| megapixels * (self.plain + r.busy * busy);
        let fits = self.points.iter().find(|r| takes(r) * SAFETY <= left);
        let rate = fits.or_else(|| self.cheapest(busy)).copied().unwrap_or(Rate { factor: 1.0, busy: 0.0 });
        (rate, takes(&rate), fits.is_some())
    }

    /// The fastest operating point at this share of busy tiles; the best one on ties.
    fn cheapest(&self, busy: f64) -> Option<&Rate> {
        self.points.iter().min_by(|a, b| (a.busy * busy).total_cmp(&(b.busy * busy)))
    }
}

/// Run time of a photo made at one of the operating points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// Multiple of the requested parallax error.
    pub factor: f64,
    /// Share of busy tiles, 0 to 1.
    pub busy: f64,
    /// Milliseconds per megapixel for planes and all later stages.
    pub ms: f64,
}

/// Fits `plain + busy · share` to the measurements by least squares, with one `plain` for all operating points. Returns `plain` and the
/// operating points in the order of `factors`. No value is negative, and no point is slower than the one before it: a larger parallax error
/// means less work.
pub fn fit(factors: &[f64], measured: &[Measured]) -> (f64, Vec<Rate>) {
    #[derive(Default)]
    struct Sums {
        n: f64,
        x: f64,
        y: f64,
        xx: f64,
        xy: f64,
    }
    let sums: Vec<Sums> = factors
        .iter()
        .map(|factor| {
            let own = measured.iter().filter(|m| m.factor.total_cmp(factor).is_eq());
            own.fold(Sums::default(), |s, m| Sums {
                n: s.n + 1.0,
                x: s.x + m.busy,
                y: s.y + m.ms,
                xx: s.xx + m.busy * m.busy,
                xy: s.xy + m.busy * m.ms,
            })
        })
        .collect();
    // eliminate the slope of each point from the normal equation of `plain`
    let slope_of_x = |s: &Sums| if s.xx > 0.0 { s.x / s.xx } else { 0.0 };
    let (above, below) = sums.iter().fold((0.0, 0.0), |(a, b), s| (a + s.y - s.xy * slope_of_x(s), b + s.n - s.x * slope_of_x(s)));
    // if all photos are equally busy, `plain` is undetermined: half of the least time is as good a guess as any
    let least = measured.iter().map(|m| m.ms).fold(f64::INFINITY, f64::min);
    let plain = if below > 1e-9 {
        (above / below).max(0.0)
    } else if least.is_finite() {
        least / 2.0
    } else {
        0.0
    };
    let plain = if least.is_finite() { plain.min(least.max(0.0)) } else { plain };
    let mut most = f64::INFINITY;
    let points = factors.iter().zip(&sums).map(|(&factor, s)| {
        most = most.min(if s.xx > 0.0 { ((s.xy - plain * s.x) / s.xx).max(0.0) } else { 0.0 });
        Rate { factor, busy: most }
    });
    (plain, points.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fit_recovers_plain_and_slopes_and_slopes_never_rise() {
        let factors = [1.0, 2.0, 8.0];
        let all = |busy: [f64; 3], slope: [f64; 3]| -> Vec<Measured> {
            let one = |(factor, slope): (f64, f64)| busy.map(|busy| Measured { factor, busy, ms: 60.0 + slope * busy });
            factors.into_iter().zip(slope).flat_map(one).collect()
        };
        let (plain, points) = fit(&factors, &all([0.1, 0.3, 0.8], [200.0, 150.0, 40.0]));
        assert!((plain - 60.0).abs() < 1e-6);
        assert!(points.iter().zip([200.0, 150.0, 40.0]).all(|(p, want)| (p.busy - want).abs() < 1e-6), "{points:?}");
        let (_, rising) = fit(&factors, &all([0.1, 0.3, 0.8], [100.0, 150.0, 40.0]));
        assert!(rising.windows(2).all(|p| p[0].busy >= p[1].busy), "{rising:?}");
        for measured in [Vec::new(), all([0.5; 3], [10.0; 3]), all([0.0; 3], [10.0; 3]), all([0.1, 0.5, 1.0], [-50.0, -90.0, -900.0])] {
            let (plain, points) = fit(&factors, &measured);
            assert!(plain >= 0.0 && points.len() == 3 && points.iter().all(|p| p.busy >= 0.0), "{plain} {points:?}");
        }
    }

    #[test]
    fn a_budget_never_predicts_more_time_than_no_budget() {
        let c = Costs::default();
        for busy in [0.0, 0.5, 0.9] {
            let takes = |r: &Rate| 0.5 * (c.plain + r.busy * busy);
            let without = takes(&c.points[0]);
            for budget in (0..400).map(f64::from) {
                let (rate, predicted, fits) = c.choose(budget, 0.5, busy);
                assert!(
                    predicted <= without && (predicted - takes(&rate)).abs() < 1e-9,
                    "{budget} ms at {busy}: {predicted}, without {without}"
                );
                assert!(fits || c.points.iter().all(|p| takes(p) >= predicted), "{budget} ms at {busy}: {rate:?} is not the cheapest");
                assert!(fits == (predicted * SAFETY <= budget));
            }
        }
        // one plane is enough for every tile of a flat photo at any error, so the best point is also the fastest
        assert!((c.choose(0.0, 0.5, 0.0).0.factor - 1.0).abs() < 1e-9);
        assert!((c.choose(0.0, 0.5, 0.9).0.factor - 8.0).abs() < 1e-9);
    }

    #[test]
    fn a_reduction_is_never_too_small_to_save_time() {
        let c = Costs::default();
        for budget in 1..2000 {
            if let Some(side) = c.side(f64::from(budget), (1280, 720), false) {
                assert!(f64::from(side) <= 1280.0 * MAX_REDUCED, "{budget} ms: {side}");
            }
        }
    }

    #[test]
    fn a_larger_budget_gives_a_smaller_error_and_a_larger_photo() {
        let c = Costs::default();
        let factor = |left: f64| c.choose(left, 0.5, 0.5).0.factor;
        assert!((factor(1e6) - 1.0).abs() < 1e-9 && (factor(0.0) - 8.0).abs() < 1e-9);
        assert!(c.choose(1e6, 0.5, 0.5).2 && !c.choose(0.0, 0.5, 0.5).2);
        assert_eq!(c.side(1e6, (4000, 3000), false), None);
        let (small, large) = (c.side(50.0, (4000, 3000), false).unwrap(), c.side(500.0, (4000, 3000), false).unwrap());
        assert!((64..large).contains(&small) && large < 4000, "{small} {large}");
        assert!(c.side(500.0, (4000, 3000), true).unwrap() < large);
        assert_eq!(c.side(f64::NAN, (100, 50), false), Some(64));
        // the depth network alone exceeds the budget: a smaller photo would hardly help
        let hopeless = c.side(1.0, (4000, 3000), true).unwrap();
        assert_eq!(c.side(c.depth, (4000, 3000), true), Some(hopeless));
        assert!(hopeless > 2 * c.side(1.0, (4000, 3000), false).unwrap(), "{hopeless}");
    }
}
