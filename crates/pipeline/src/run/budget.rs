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
    /// Planes and all that follows, by operating point, from the best to the cheapest.
    pub points: Vec<Rate>,
}

/// Cost of an operating point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rate {
    /// Times the parallax error that was asked for.
    pub factor: f64,
    /// Milliseconds a megapixel that one plane a tile does for.
    pub plain: f64,
    /// Milliseconds a megapixel more where it does not.
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
/// What takes its time at any size is joined by at least this share of it: to reduce a photo further would cost much of the picture
/// and save little of the time.
const WORTH_IT: f64 = 0.25;

impl Default for Costs {
    /// Two cores of a server processor, between what `tmpi-lab bench --only budget` found in a slow hour and in a
    /// quick one. That writes those of any machine.
    fn default() -> Self {
        let rate = |factor, plain, busy| Rate { factor, plain, busy };
        Self {
            before: 40.0,
            depth: 25.0,
            depth_megapixel: 40.0,
            points: vec![rate(1.0, 62.0, 190.0), rate(2.0, 65.0, 140.0), rate(4.0, 78.0, 78.0), rate(8.0, 88.0, 40.0)],
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
        let rate = (self.before + more + cheapest.plain + cheapest.busy * BUSY) * CAUTION;
        let room = (budget - fixed).max(fixed * WORTH_IT) / rate;
        if room >= megapixels {
            return None;
        }
        let longest = f64::from(width.max(height));
        let side = (longest * (room / megapixels).sqrt()).max(LEAST_SIDE).min(longest);
        Some(side as u32)
    }

    /// The best operating point of which `left` milliseconds are enough, else the cheapest; with the milliseconds that it will
    /// take and whether they are enough.
    #[must_use]
    pub fn choose(&self, left: f64, megapixels: f64, busy: f64) -> (Rate, f64, bool) {
        let takes = |r: &Rate| megapixels * (r.plain + r.busy * busy);
        let fits = self.points.iter().find(|r| takes(r) * CAUTION <= left);
        let rate = fits.or_else(|| self.cheapest(busy)).copied().unwrap_or(Rate { factor: 1.0, plain: 0.0, busy: 0.0 });
        (rate, takes(&rate), fits.is_some())
    }

    /// The operating point that takes the least time at this share of busy tiles; the best of equals.
    fn cheapest(&self, busy: f64) -> Option<&Rate> {
        let takes = |r: &Rate| r.plain + r.busy * busy;
        self.points.iter().min_by(|a, b| takes(a).total_cmp(&takes(b)))
    }
}

/// Fits `plain + busy · share` to `(share, milliseconds a megapixel)` by least squares, both at least 0.
#[must_use]
pub fn fit(factor: f64, measured: &[(f64, f64)]) -> Rate {
    let n = measured.len().max(1) as f64;
    let (mx, my) = (measured.iter().map(|m| m.0).sum::<f64>() / n, measured.iter().map(|m| m.1).sum::<f64>() / n);
    let var: f64 = measured.iter().map(|m| (m.0 - mx).powi(2)).sum();
    let cov: f64 = measured.iter().map(|m| (m.0 - mx) * (m.1 - my)).sum();
    let slope = if var > 1e-9 { (cov / var).max(0.0) } else { 0.0 };
    let plain = my - slope * mx;
    if plain >= 0.0 {
        return Rate { factor, plain, busy: slope };
    }
    // through the origin
    let (xx, xy) = measured.iter().fold((0.0, 0.0), |(a, b), m| (a + m.0 * m.0, b + m.0 * m.1));
    Rate { factor, plain: 0.0, busy: if xx > 0.0 { xy / xx } else { 0.0 } }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_found_again_and_never_below_0() {
        let line: Vec<(f64, f64)> = [0.1, 0.3, 0.8].map(|x| (x, 200.0 + 300.0 * x)).into();
        let r = fit(2.0, &line);
        assert!((r.plain - 200.0).abs() < 1e-6 && (r.busy - 300.0).abs() < 1e-6);
        let steep = fit(1.0, &[(0.5, 10.0), (1.0, 100.0)]);
        assert!(steep.plain >= 0.0 && steep.busy > 0.0);
        assert!((fit(1.0, &[(0.5, 40.0)]).plain - 40.0).abs() < 1e-9);
        assert!(fit(1.0, &[]).plain.abs() < 1e-9);
    }

    #[test]
    fn where_nothing_fits_no_point_would_take_less() {
        let c = Costs::default();
        for busy in (0..=100).map(|percent| f64::from(percent) / 100.0) {
            let (rate, takes, fits) = c.choose(0.0, 0.5, busy);
            let least = c.points.iter().map(|r| 0.5 * (r.plain + r.busy * busy)).fold(f64::INFINITY, f64::min);
            assert!(!fits && (takes - least).abs() < 1e-9, "at {busy}: {rate:?} takes {takes}, another {least}");
        }
        // one plane does for every tile of a flat photo, whatever the error: the best point is the quickest
        assert!((c.choose(0.0, 0.5, 0.0).0.factor - 1.0).abs() < 1e-9);
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
