//! Touch-up: strokes that a person draws where a depth network is wrong, and their effect on the disparity map.
//!
//! Strokes are stored in coordinates of the photo, and each says how its region changes (nearer, or as near as another place), so that
//! they mean the same on the map of another network. The region of a stroke is found from the photo, see [`Outlines`].

mod original_map;
mod read;
mod region;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};
use tmpi_core::{DisparityMap, Photo};

pub use original_map::{HEAD, before, keep, to_keep};
pub use read::{StrokeError, patch, read, write};
pub use region::{Outlines, Region};

/// Version of the file of strokes that this program writes and reads.
pub const VERSION: u32 = 1;
/// Most strokes of a photo.
pub const STROKES: usize = 100;
/// Most points of all strokes of a photo.
pub const POINTS: usize = 8192;
/// Most bytes of strokes as JSON: all points at full precision, and as much again.
pub const BYTES: usize = 1 << 19;
/// Radii of brushes, as shares of the photo's longer side.
pub const RADII: std::ops::RangeInclusive<f64> = 0.002..=0.25;
/// Radius around the place of [`Effect::Like`] whose median disparity is used, as a share of the longer side: a single pixel may be an
/// outlier.
const PROBE: f64 = 0.005;

/// A stroke of a brush over the photo.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Stroke {
    /// Its centre line: x and y as shares of the photo's width and height, each 0 to 1. A single point is a dab.
    #[schema(min_items = 1, example = json!([[0.4, 0.5], [0.45, 0.62]]))]
    pub points: Vec<[f64; 2]>,
    /// Radius of the brush as a share of the photo's longer side, .002 to .25. The outline follows edges of the photo up to twice as far
    /// away.
    #[schema(minimum = 0.002, maximum = 0.25, example = 0.03)]
    pub radius: f64,
    /// How its region changes.
    #[serde(flatten)]
    pub effect: Effect,
}

/// How a stroke changes its region; exactly one of these.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Effect {
    /// Nearer by this much disparity, −1 to 1; negative values are farther. Relief within the region stays.
    By(f64),
    /// As near as this place of the photo, x and y of 0 to 1; the region becomes flat.
    Like([f64; 2]),
    /// This disparity, 0 (infinitely far) to 1 (the nearest surface); the region becomes flat.
    To(f64),
}

impl Stroke {
    /// Checks that every number is finite and in its range.
    ///
    /// # Errors
    /// [`StrokeError`] that names the field, without the stroke's own index in a list.
    pub fn check(&self) -> Result<(), StrokeError> {
        if self.points.is_empty() {
            return Err(StrokeError::at("points", "must hold at least one point"));
        }
        for (i, p) in self.points.iter().enumerate() {
            place(p).map_err(|e| e.within(&format!("points[{i}]")))?;
        }
        if !RADII.contains(&self.radius) {
            return Err(StrokeError::at("radius", format!("must be {} to {}, not {}", RADII.start(), RADII.end(), self.radius)));
        }
        match self.effect {
            Effect::By(v) if !(-1.0..=1.0).contains(&v) => Err(StrokeError::at("by", format!("must be -1 to 1, not {v}"))),
            Effect::To(v) if !(0.0..=1.0).contains(&v) => Err(StrokeError::at("to", format!("must be 0 to 1, not {v}"))),
            Effect::Like(p) => place(&p).map_err(|e| e.within("like")),
            _ => Ok(()),
        }
    }
}

fn place(p: &[f64; 2]) -> Result<(), StrokeError> {
    let inside = p.iter().all(|v| (0.0..=1.0).contains(v));
    if inside { Ok(()) } else { Err(StrokeError::at("", format!("must be x and y of 0 to 1, not {}, {}", p[0], p[1]))) }
}

/// Checks a photo's strokes: their numbers, their count, and the count of their points.
///
/// # Errors
/// [`StrokeError`] that names the field.
pub fn check(strokes: &[Stroke]) -> Result<(), StrokeError> {
    if strokes.len() > STROKES {
        return Err(StrokeError::at("strokes", format!("must be at most {STROKES}, not {}", strokes.len())));
    }
    let points: usize = strokes.iter().map(|s| s.points.len()).sum();
    if points > POINTS {
        return Err(StrokeError::at("strokes", format!("must have at most {POINTS} points together, not {points}")));
    }
    strokes.iter().enumerate().try_for_each(|(i, s)| s.check().map_err(|e| e.within(&format!("strokes[{i}]"))))
}

/// Applies strokes to a map one after another. Their regions follow from the photo and from `map` as given, so that an earlier stroke
/// does not move the outline of a later one, but [`Effect::Like`] reads the map that the earlier strokes left. `photo` and `map` (finite, 0
/// to 1) have the same size, which the map keeps. Touched pixels get confidence 1 if there is a `confidence`.
pub fn apply(photo: &Photo, map: &mut DisparityMap, mut confidence: Option<&mut Vec<f32>>, strokes: &[Stroke]) {
    let outlines = Outlines::new(photo, map);
    for stroke in strokes {
        let region = outlines.region(stroke);
        let flat = match stroke.effect {
            Effect::By(_) => None,
            Effect::Like(at) => Some(around(map, at)),
            Effect::To(value) => Some(value as f32),
        };
        region.each(map.width, map.height, |i| {
            map.delta[i] = match (flat, stroke.effect) {
                (Some(value), _) => value,
                (None, Effect::By(v)) => (map.delta[i] + v as f32).clamp(0.0, 1.0),
                (None, _) => map.delta[i],
            };
            if let Some(c) = confidence.as_mut().and_then(|c| c.get_mut(i)) {
                *c = 1.0;
            }
        });
    }
}

/// The median disparity around a place, x and y of 0 to 1.
fn around(map: &DisparityMap, [x, y]: [f64; 2]) -> f32 {
    let (w, h) = (map.width as usize, map.height as usize);
    let reach = (PROBE * w.max(h) as f64) as usize;
    let at = |v: f64, n: usize| ((v * n as f64) as usize).min(n - 1);
    let span = |c: usize, n: usize| c.saturating_sub(reach)..(c + reach + 1).min(n);
    let (cx, cy) = (at(x, w), at(y, h));
    let mut all: Vec<f32> = span(cy, h).flat_map(|y| span(cx, w).map(move |x| y * w + x)).map(|i| map.delta[i]).collect();
    let middle = all.len() / 2;
    *all.select_nth_unstable_by(middle, f32::total_cmp).1
}
