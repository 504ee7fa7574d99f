//! Measured depth: a second view of the scene, from beside the first, gives the distance of each point that both show.
//!
//! The second picture is [rectified](rectify) to the rows of the first and matched with it [semi-globally](sgm) by [census](census).
//! Disparities that both directions agree on are [fused](fuse) with the network's estimate.

pub mod census;
pub mod fuse;
mod halves;
#[cfg(test)]
mod malformed_files;
pub mod rectify;
pub mod sgm;
#[cfg(test)]
mod tests;

use tmpi_core::{DisparityMap, Photo};

use self::census::{Grey, census};
pub use self::halves::{Halves, Stereo};
use self::rectify::Rectified;
use self::sgm::{Range, Views};
use crate::depth;
use crate::photo::{Filter, resample, working_size};
use crate::usage::Clock;

/// Most pixels at which pictures are matched.
const WORK: f64 = 700_000.0;
/// Most disparities that are searched.
const MOST: usize = 192;
/// Longest side at which the range of disparity is determined.
const COARSE: usize = 240;
/// Share of the width that is searched for it to either side.
const SIDES: f64 = 0.35;
/// Share of the pixels measured there that the range may leave out at either end.
const TAIL: f64 = 0.002;
/// Share of the range that is added at either end.
const MARGIN: f64 = 0.1;
/// Share of the pixels below which a connected piece counts as chance.
const SPECK: f64 = 1e-3;
/// The same at the small size, where the range must not follow such pieces.
const SMALL_SPECK: f64 = 4e-3;
/// Fewest pixels of a connected piece, however small the picture.
const MIN_SPECK: usize = 32;
/// Least share of the pixels that must be measured.
const ENOUGH: f64 = 0.25;
/// Least range of disparity, in pixels of the matched size.
const PARALLAX: f32 = 1.5;

/// Shortest side, in pixels, of a picture that is matched. In smaller ones, chance measures enough: of 40 pairs of unrelated noise, 13
/// passed for one scene at 48 × 48 pixels, and none at 64 × 64.
const LEAST: u32 = 64;

/// Why a second view gives no depth.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StereoError {
    /// The second picture has another aspect.
    #[error("the second picture has another shape ({second}) than the first ({first})")]
    Shape {
        /// Width × height of the first.
        first: String,
        /// Width × height of the second.
        second: String,
    },
    /// The pictures are too small to match.
    #[error("the pictures are {size}, too small to measure depth: both sides need at least {LEAST} pixels")]
    Small {
        /// Width × height.
        size: String,
    },
    /// The pictures do not match, or have too little texture.
    #[error("the two pictures agree in {:.0} % of their pixels, too few to measure depth: they are evenly coloured or do not belong together", share * 100.0)]
    Few {
        /// Share of the pixels that was measured.
        share: f64,
    },
    /// Both pictures were taken from one place.
    #[error("the two pictures show no parallax: they were taken from one place, or everything is far away")]
    NoParallax,
}

/// Figures of a stereo measurement.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct StereoFigures {
    /// Share of the pixels, 0 to 1, whose depth was measured.
    pub measured: f64,
    /// Share of the pixels, 0 to 1, filled from the network's estimate. The other unmeasured pixels are hidden from the second eye and take the
    /// depth behind the edge.
    pub estimated: f64,
    /// Median vertical offset of matches before rectification, in pixels of the photo.
    pub rows_before_px: f64,
    /// Median vertical offset of matches after rectification, in pixels of the photo.
    pub rows_px: f64,
    /// Disparity of the nearest point between the two pictures, in pixels of the photo.
    pub nearest_px: f64,
    /// Disparity of the farthest point, in pixels of the photo.
    pub farthest_px: f64,
    /// Disparity taken as infinity, in pixels of the photo.
    pub infinity_px: f64,
    /// Whether the second picture is the left eye's.
    pub crossed: bool,
    /// Width at which the pictures were matched, in pixels.
    pub width: u32,
    /// Milliseconds for rectification.
    pub rectify_ms: f64,
    /// Milliseconds for matching.
    pub match_ms: f64,
    /// Milliseconds for fusing with the network's estimate.
    pub fuse_ms: f64,
}

/// Disparities of a pair.
#[derive(Clone, Debug)]
pub struct Measured {
    width: u32,
    height: u32,
    /// In pixels at this size; NaN where unmeasured.
    disparity: Vec<f32>,
    /// The cameras stood side by side and looked in the same direction, as far as rows show.
    parallel: bool,
    figures: StereoFigures,
}

/// Measured disparity, filled from the network's estimate.
#[derive(Clone, Debug)]
pub struct FusedDisparity {
    /// Disparity δ at the photo's size: 1 at the nearest point, 0 at infinity.
    pub map: DisparityMap,
    /// The same at the size of matching, if it differs.
    pub own: Option<DisparityMap>,
    /// Figures for the report.
    pub figures: StereoFigures,
}

/// Measures the disparity of the first picture of a pair against the second.
///
/// # Errors
/// [`StereoError`] if the pictures do not suffice.
pub fn measure(first: &Photo, second: &Photo) -> Result<Measured, StereoError> {
    let text = |p: &Photo| format!("{}×{}", p.width, p.height);
    if !depth::fits((second.width, second.height), (first.width, first.height)) {
        return Err(StereoError::Shape { first: text(first), second: text(second) });
    }
    if first.width.min(first.height) < LEAST {
        return Err(StereoError::Small { size: text(first) });
    }
    let clock = Clock::start();
    let mut size = working_size((first.width, first.height), WORK);
    let mut pair = [grey(first, size), grey(second, size)];
    // rows that cannot be determined stay as they are
    let rectified = rectify::rectify(&pair[0], &pair[1]);
    let Rectified { model, before_px, after_px } = rectified.unwrap_or_default();
    pair[1] = model.rectified(&pair[1]);
    let rectify_ms = clock.ms();
    let mut range = range(&pair).ok_or(StereoError::Few { share: 0.0 })?;
    let count = (range.1 - range.0) * f64::from(size.0);
    if count > MOST as f64 {
        size = working_size(size, f64::from(size.0) * f64::from(size.1) * (MOST as f64 / count).powi(2));
        pair = [grey(first, size), grey(second, size)];
        pair[1] = model.rectified(&pair[1]);
    }
    range = (range.0 * f64::from(size.0), range.1 * f64::from(size.0));
    let range = Range::holding(range.0.floor() as i32, range.1.ceil() as i32);
    let disparity = matched(&pair, range, SPECK);
    let share = share(&disparity);
    if share < ENOUGH {
        return Err(StereoError::Few { share });
    }
    if percentile(&disparity, 0.99) - percentile(&disparity, 0.01) < PARALLAX {
        return Err(StereoError::NoParallax);
    }
    let scale = f64::from(first.width) / f64::from(size.0);
    let figures = StereoFigures {
        measured: share,
        rows_before_px: before_px * scale,
        rows_px: after_px * scale,
        width: size.0,
        rectify_ms,
        match_ms: clock.ms() - rectify_ms,
        ..StereoFigures::default()
    };
    let parallel = rectified.is_some() && model == rectify::Model::default();
    Ok(Measured { width: size.0, height: size.1, disparity, parallel, figures })
}

impl Measured {
    /// Disparity at the size of `photo`. `estimate`, at the photo's size, fills what was not measured.
    pub fn fuse(self, photo: &Photo, estimate: &DisparityMap) -> FusedDisparity {
        let Self { width, height, mut disparity, parallel, mut figures } = self;
        let clock = Clock::start();
        let from = (estimate.width, estimate.height);
        // a non-finite estimate lies at infinity, as everywhere
        let finite = |v: f32| [if v.is_finite() { v } else { 0.0 }];
        let estimate = resample(&estimate.delta, from, (width, height), Filter::Triangle, finite, |[v]| v);
        figures.crossed = fuse::is_crossed(&disparity, &estimate);
        if figures.crossed {
            for d in &mut disparity {
                *d = -*d;
            }
        }
        let low = percentile(&disparity, 0.002);
        // for parallel cameras, infinity has disparity 0; for others it is no nearer than the farthest point
        let infinity = if parallel { low.min(0.0) } else { low };
        figures.estimated = fuse::fill(&mut disparity, &estimate, width as usize);
        let near = percentile(&disparity, 0.999).max(infinity + PARALLAX);
        let scale = f64::from(photo.width) / f64::from(width);
        let [nearest, farthest, at_infinity] = [near, low, infinity].map(|d| f64::from(d) * scale);
        (figures.nearest_px, figures.farthest_px, figures.infinity_px) = (nearest, farthest, at_infinity);
        let delta = disparity.iter().map(|d| ((d - infinity) / (near - infinity)).clamp(0.0, 1.0)).collect();
        let small = DisparityMap { width, height, delta };
        let own = (width, height) == (photo.width, photo.height);
        let map = if own { small.clone() } else { depth::resized(&small, photo.width, photo.height) };
        figures.fuse_ms = clock.ms();
        FusedDisparity { map, own: (!own).then_some(small), figures }
    }
}

/// Brightness of a picture at a size.
fn grey(photo: &Photo, size: (u32, u32)) -> Grey {
    let luma = |p: [u8; 3]| [0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2])];
    let values = resample(&photo.rgb, (photo.width, photo.height), size, Filter::Triangle, luma, |[v]| v.round().clamp(0.0, 255.0) as u8);
    Grey { width: size.0 as usize, height: size.1 as usize, values }
}

/// Disparity of the first of a pair, without specks.
fn matched(pair: &[Grey; 2], range: Range, speck: f64) -> Vec<f32> {
    let (width, height) = (pair[0].width, pair[0].height);
    let [own, other] = [census(&pair[0]), census(&pair[1])];
    let mut disparity = sgm::disparity(&Views { width, height, grey: &pair[0].values, own: &own, other: &other }, range);
    let least = ((width * height) as f64 * speck).ceil() as usize;
    fuse::drop_specks(&mut disparity, width, least.max(MIN_SPECK));
    disparity
}

/// Least and greatest disparity, in widths of the picture, from a match at a small size; `None` if almost nothing matches.
fn range(pair: &[Grey; 2]) -> Option<(f64, f64)> {
    let by = pair[0].width.max(pair[0].height).div_ceil(COARSE).max(1);
    let small = [rectify::reduced(&pair[0], by), rectify::reduced(&pair[1], by)];
    let width = small[0].width as f64;
    let side = (width * SIDES).ceil() as i32;
    let disparity = matched(&small, Range::holding(-side, side), SMALL_SPECK);
    if share(&disparity) < ENOUGH / 2.0 {
        return None;
    }
    let (low, high) = (f64::from(percentile(&disparity, TAIL)), f64::from(percentile(&disparity, 1.0 - TAIL)));
    let margin = 1.0 + (high - low) * MARGIN;
    Some(((low - margin) / width, (high + margin) / width))
}

fn share(disparity: &[f32]) -> f64 {
    disparity.iter().filter(|d| d.is_finite()).count() as f64 / disparity.len().max(1) as f64
}

/// The value below which this share of the finite values lies; 0 if there are none.
fn percentile(disparity: &[f32], share: f64) -> f32 {
    let mut known: Vec<f32> = disparity.iter().copied().filter(|d| d.is_finite()).collect();
    if known.is_empty() {
        return 0.0;
    }
    let at = ((known.len() - 1) as f64 * share).round() as usize;
    *known.select_nth_unstable_by(at, f32::total_cmp).1
}
