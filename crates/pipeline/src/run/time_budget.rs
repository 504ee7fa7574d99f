//! Run time under a budget: what settings will take on this machine, and which of them fits.
//!
//! The choice falls twice: before decoding, the size that the cheapest setting can do in time; after the disparity is there, the
//! largest parallax error that fits what is left. What a photo has taken so far is known by then, so only the rest is predicted.

use std::sync::OnceLock;

use serde::{Deserialize, Serialize};

/// Milliseconds on a machine, fitted by `tmpi-lab bench` (`costs.json`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Costs {
    /// From the file to the disparity that planes are placed on, a megapixel; without the depth network.
    pub before: f64,
    /// Depth network, a photo; it works at a size of its own.
    pub depth: f64,
    /// What else it takes where depth is estimated, a megapixel: enlarging, and snapping blurred edges.
    pub depth_megapixel: f64,
    /// Planes and all that follows where one plane does for every tile, a megapixel: the same at any error.
    pub plain: f64,
    /// What other tiles take beyond that, by operating point, from the best to the cheapest.
    pub points: Vec<Rate>,
}

/// Cost of an operating point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rate {
    /// Times the parallax error that was asked for.
    pub factor: f64,
    /// Milliseconds a megapixel more where one plane does not do for the error that was asked for.
    pub busy: f64,
}

/// Environment variable that names the file of [`Costs`].
pub const COSTS: &str = "TMPI_COSTS";
/// Share of busy tiles that is assumed before the disparity is known.
const BUSY: f64 = 0.4;
/// Predictions are taken for so much more than they say: late is worse than plain.
const CAUTION: f64 = 1.1;
/// Smallest size that a photo is reduced to, longest side in pixels.
const LEAST_SIDE: f64 = 64.0;
/// A photo is reduced to this share of its sides at most: to bring it nearer to its own size would save less than reducing takes.
const WORTH_REDUCING: f64 = 0.85;
/// What takes its time at any size is joined by at least this share of it: to reduce a photo further would cost much of the picture
/// and save little of the time.
const WORTH_IT: f64 = 0.25;

impl Default for Costs {
    /// Two cores of a server processor, between what `tmpi-lab bench --only budget` found in a slow hour and in a
    /// quick one. That writes those of any machine.
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
    /// Those of the file that [`COSTS`] names, read once; the default where it names none or it cannot be read.
    #[must_use]
    pub fn of_this_machine() -> &'static Self {
        static READ: OnceLock<Costs> = OnceLock::new();
        READ.get_or_init(|| {
            let Some(path) = std::env::var_os(COSTS) else { return Self::default() };
            let read = std::fs::read(&path).map_err(|e| e.to_string());
            let parsed = read.and_then(|bytes| serde_json::from_slice::<Self>(&bytes).map_err(|e| e.to_string()));
            parsed.and_then(|c| if c.points.is_empty() { Err("it has no operating point".into()) } else { Ok(c) }).unwrap_or_else(
                |reason| {
                    tracing::warn!(path = %std::path::Path::new(&path).display(), reason, "costs of this machine cannot be read");
                    Self::default()
                },
            )
        })
    }

    /// The longest side that the cheapest operating point does within `budget` milliseconds; none where the whole photo fits.
    #[must_use]
    pub fn side(&self, budget: f64, (width, height): (u32, u32), estimated: bool) -> Option<u32> {
        let cheapest = self.cheapest(BUSY)?;
        let megapixels = f64::from(width) * f64::from(height) / 1e6;
        let (fixed, more) = if estimated { (self.depth, self.depth_megapixel) } else { (0.0, 0.0) };
        let rate = (self.before + more + self.plain + cheapest.busy * BUSY) * CAUTION;
        let room = (budget - fixed).max(fixed * WORTH_IT) / rate;
        if room >= megapixels {
            return None;
        }
        let longest = f64::from(width.max(height));
        let side = (longest * (room / megapixels).sqrt().min(WORTH_REDUCING)).max(LEAST_SIDE).min(longest);
        Some(side as u32)
    }

    /// The best operating point of which `left` milliseconds are enough, else the cheapest; with the milliseconds that it will
    /// take and whether they are enough.
    #[must_use]
    pub fn choose(&self, left: f64, megapixels: f64, busy: f64) -> (Rate, f64, bool) {
        let takes = |r: &Rate| megapixels * (self.plain + r.busy * busy);
        let fits = self.points.iter().find(|r| takes(r) * CAUTION <= left);
        let rate = fits.or_else(|| self.cheapest(busy)).copied().unwrap_or(Rate { factor: 1.0, busy: 0.0 });
        (rate, takes(&rate), fits.is_some())
    }

    /// The operating point that takes the least time at this share of busy tiles; the best of equals.
    fn cheapest(&self, busy: f64) -> Option<&Rate> {
        self.points.iter().min_by(|a, b| (a.busy * busy).total_cmp(&(b.busy * busy)))
    }
}

/// A photo that was made at one of the operating points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// Times the parallax error that was asked for.
    pub factor: f64,
    /// Share of tiles, 0 to 1, that one plane does not do for at the error that was asked for.
    pub busy: f64,
    /// Milliseconds a megapixel that planes and all that follows took.
    pub ms: f64,
}

/// Fits `plain + busy · share` by least squares, `plain` the same for all points; gives it and the points in the order of `factors`. Nothing is
/// below 0, and no point takes more than the one before: with a larger error there is less to do.
#[must_use]
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
    // each point's own slope eliminated from the normal equation of the common part
    let slope_of_x = |s: &Sums| if s.xx > 0.0 { s.x / s.xx } else { 0.0 };
    let (above, below) = sums.iter().fold((0.0, 0.0), |(a, b), s| (a + s.y - s.xy * slope_of_x(s), b + s.n - s.x * slope_of_x(s)));
    // where all are equally busy, nothing tells the common part from the rest: half of the least is as good a guess as any
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
    fn a_common_part_and_slopes_are_found_again_and_never_rise() {
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
    fn no_budget_costs_more_than_none() {
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
                assert!(fits == (predicted * CAUTION <= budget));
            }
        }
        // one plane does for every tile of a flat photo, whatever the error: the best point is the quickest
        assert!((c.choose(0.0, 0.5, 0.0).0.factor - 1.0).abs() < 1e-9);
        assert!((c.choose(0.0, 0.5, 0.9).0.factor - 8.0).abs() < 1e-9);
    }

    #[test]
    fn a_photo_is_never_reduced_by_so_little_that_reducing_takes_longer() {
        let c = Costs::default();
        for budget in 1..2000 {
            if let Some(side) = c.side(f64::from(budget), (1280, 720), false) {
                assert!(f64::from(side) <= 1280.0 * WORTH_REDUCING, "{budget} ms: {side}");
            }
        }
    }

    #[test]
    fn more_time_buys_a_smaller_error_and_a_larger_photo() {
        let c = Costs::default();
        let factor = |left: f64| c.choose(left, 0.5, 0.5).0.factor;
        assert!((factor(1e6) - 1.0).abs() < 1e-9 && (factor(0.0) - 8.0).abs() < 1e-9);
        assert!(c.choose(1e6, 0.5, 0.5).2 && !c.choose(0.0, 0.5, 0.5).2);
        assert_eq!(c.side(1e6, (4000, 3000), false), None);
        let (small, large) = (c.side(50.0, (4000, 3000), false).unwrap(), c.side(500.0, (4000, 3000), false).unwrap());
        assert!((64..large).contains(&small) && large < 4000, "{small} {large}");
        assert!(c.side(500.0, (4000, 3000), true).unwrap() < large);
        assert_eq!(c.side(f64::NAN, (100, 50), false), Some(64));
        // no time is left beside the depth network: a smaller photo would not bring it back
        let hopeless = c.side(1.0, (4000, 3000), true).unwrap();
        assert_eq!(c.side(c.depth, (4000, 3000), true), Some(hopeless));
        assert!(hopeless > 2 * c.side(1.0, (4000, 3000), false).unwrap(), "{hopeless}");
    }
}
