//! Colours that the second picture of a pair shows: also those of points that a nearer surface hides from the first.

use std::ops::RangeInclusive;

use tmpi_core::Photo;

use super::fuse::is_hidden;
use super::rectify::Model;

/// The second picture shows a point if its own disparity there differs from the point's by at most this many pixels at the matched size, plus
/// this share of the range of disparity, and by less than half the step to the surface that hides the point from the first picture.
const AGREES: (f64, f64) = (1.0, 0.06);
/// Pixels at the matched size by which the last of the [`STEPS`] towards the point's position in the second picture may still move it.
const SETTLED: f64 = 1.0;
const STEPS: usize = 3;
/// Radius of the window, in pixels at the matched size, that must be free of nearer surfaces, whose colours would mix in.
const CLEAR: usize = 2;
/// Most pixels beside a gap whose disparities tell what is behind it. Those at its border are off by up to 2 pixels: their windows reach
/// into the gap. On spots behind a square, the strip that only the second eye sees gains 17.6 dB with 11 pixels, 8.2 with one.
const BESIDE: usize = 11;
/// With this many levels added, another exposure multiplies sRGB levels by one factor, except for the darkest ones.
const TOE: f64 = 0.055 * 255.0;
/// Levels at which exposures are compared: others may be clipped.
const UNCLIPPED: RangeInclusive<f64> = 8.0..=247.0;
/// Most points at which exposures are compared, and fewest.
const POINTS: (usize, usize) = (20_000, 100);
/// Largest factor between two exposures.
const MOST_GAIN: f64 = 4.0;

/// Where the second picture of a pair shows points of the first.
#[derive(Clone, Debug)]
pub struct SecondEye {
    /// Width and height of the first picture in pixels.
    pub(super) first: (u32, u32),
    /// Width and height at which the pictures were matched, in pixels.
    pub(super) size: (usize, usize),
    /// Displacement of the second picture from the rows of the first.
    pub(super) model: Model,
    /// Disparity of each pixel of the rectified second picture at the matched size, in pixels: larger is nearer, NaN where unknown.
    pub(super) disparity: Vec<f32>,
    /// Disparity, in the same pixels, of δ = 0, and the difference between δ = 1 and δ = 0.
    pub(super) scale: (f64, f64),
    /// The second picture is the left eye's.
    pub(super) crossed: bool,
    /// Factor of each channel's levels, plus [`TOE`], from the second picture to the first.
    pub(super) gains: [f64; 3],
}

impl SecondEye {
    /// The colour in `picture`, the second one, of the point with disparity `delta` behind pixel `at` of the first, in the exposure of the
    /// first. `visible` is the δ that the first picture shows there. `None` if the second does not show the point, or if a value is not
    /// finite.
    pub fn colour(&self, picture: &Photo, at: (u32, u32), delta: f32, visible: f32) -> Option<[u8; 3]> {
        let place = self.model.place(self.find(at, delta, visible)?, self.size);
        let levels = sample(picture, scaled(place, self.size, size_of(picture)))?;
        // rounds to nearest; the cast clamps to 0..=255
        Some(std::array::from_fn(|c| ((levels[c] + TOE) * self.gains[c] - TOE + 0.5) as u8))
    }

    /// Position in the rectified second picture, in pixels at the matched size, at which it shows the point.
    fn find(&self, at: (u32, u32), delta: f32, visible: f32) -> Option<(f64, f64)> {
        let [own, front] = [delta, visible].map(|d| self.scale.0 + f64::from(d) * self.scale.1);
        let within = (AGREES.0 + AGREES.1 * self.scale.1).min((front - own) / 2.0);
        if !own.is_finite() || !front.is_finite() || within <= 0.0 {
            return None;
        }
        let (mut disparity, mut moved) = (own, 0.0);
        for _ in 0..STEPS {
            let found = self.disparity_at(self.rectified(at, disparity)).filter(|d| (d - own).abs() <= within)?;
            (disparity, moved) = (found, (found - disparity).abs());
        }
        let place = self.rectified(at, disparity);
        (moved <= SETTLED && self.is_clear(place, own + within)).then_some(place)
    }

    /// Position in the rectified second picture of the point with `disparity` at pixel `at` of the first, in pixels at the matched size.
    fn rectified(&self, at: (u32, u32), disparity: f64) -> (f64, f64) {
        let (x, y) = scaled((f64::from(at.0), f64::from(at.1)), (self.first.0 as usize, self.first.1 as usize), self.size);
        (if self.crossed { x + disparity } else { x - disparity }, y)
    }

    /// Index of the pixel at a position; `None` if it is outside.
    fn pixel(&self, (x, y): (f64, f64)) -> Option<(usize, usize)> {
        let (x, y) = (x.round(), y.round());
        let inside = x >= 0.0 && y >= 0.0 && x < self.size.0 as f64 && y < self.size.1 as f64;
        inside.then_some((x as usize, y as usize))
    }

    /// Disparity of the second picture's pixel at a position; `None` if it is outside or unknown.
    fn disparity_at(&self, place: (f64, f64)) -> Option<f64> {
        let (x, y) = self.pixel(place)?;
        Some(f64::from(self.disparity[y * self.size.0 + x])).filter(|d| d.is_finite())
    }

    /// Whether nothing around a position is nearer than `most`.
    fn is_clear(&self, place: (f64, f64), most: f64) -> bool {
        let Some((x, y)) = self.pixel(place) else { return false };
        let (w, h) = self.size;
        (y.saturating_sub(CLEAR)..(y + CLEAR + 1).min(h)).all(|y| {
            let row = &self.disparity[y * w + x.saturating_sub(CLEAR)..y * w + (x + CLEAR + 1).min(w)];
            row.iter().all(|d| d.is_nan() || f64::from(*d) <= most)
        })
    }
}

/// Fills gaps in the rows of the second picture, `w` pixels wide, that a nearer surface hides from the first, with the disparity behind it.
pub(super) fn fill_hidden(disparity: &mut [f32], w: usize) {
    for row in disparity.chunks_exact_mut(w) {
        let mut left: Option<usize> = None;
        for x in 0..w {
            if !row[x].is_finite() {
                continue;
            }
            if let Some(l) = left.filter(|l| x - l > 1) {
                let (before, after) = (median(row[..=l].iter().rev()), median(row[x..].iter()));
                if is_hidden(x - l - 1, after - before) {
                    row[l + 1..x].fill(before.min(after));
                }
            }
            left = Some(x);
        }
    }
}

/// Median of the values up to the first that is not finite, at most [`BESIDE`]; NaN if there are none.
fn median<'a>(values: impl Iterator<Item = &'a f32>) -> f32 {
    let mut known: Vec<f32> = values.copied().take_while(|v| v.is_finite()).take(BESIDE).collect();
    known.sort_unstable_by(f32::total_cmp);
    known.get(known.len() / 2).copied().unwrap_or(f32::NAN)
}

fn size_of(photo: &Photo) -> (usize, usize) {
    (photo.width as usize, photo.height as usize)
}

/// The position of a point in a picture of another size; pixel centres are whole numbers.
fn scaled((x, y): (f64, f64), from: (usize, usize), to: (usize, usize)) -> (f64, f64) {
    let one = |p: f64, from: usize, to: usize| (p + 0.5) * to as f64 / from as f64 - 0.5;
    (one(x, from.0, to.0), one(y, from.1, to.1))
}

/// Levels at a position between pixels, bilinear; `None` if it is outside.
fn sample(photo: &Photo, (x, y): (f64, f64)) -> Option<[f64; 3]> {
    let between = |p: f64, n: u32| {
        let last = f64::from(n) - 1.0;
        let inside = (-0.5..=last + 0.5).contains(&p);
        let p = p.clamp(0.0, last);
        inside.then_some((p as u32, (p as u32 + 1).min(n - 1), p.fract()))
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (between(x, photo.width)?, between(y, photo.height)?);
    let [a, b, c, d] = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)].map(|(x, y)| photo.at(x, y).map(f64::from));
    let mix = |a: f64, b: f64, share: f64| a + (b - a) * share;
    Some(std::array::from_fn(|i| mix(mix(a[i], b[i], fx), mix(c[i], d[i], fx), fy)))
}

/// For each channel, the factor that brings the second picture's levels, plus [`TOE`], to the first's: the median over matched points, 1 if
/// there are too few. `disparity` is that of the first picture at the matched `size`, in pixels to the left, NaN where unmeasured.
pub(super) fn gains(first: &Photo, second: &Photo, model: &Model, size: (usize, usize), disparity: &[f32]) -> [f64; 3] {
    let mut ratios = [const { Vec::new() }; 3];
    for i in (0..disparity.len()).step_by((disparity.len() / POINTS.0).max(1)) {
        let (x, y, d) = ((i % size.0) as f64, (i / size.0) as f64, f64::from(disparity[i]));
        // outside, if it is not a number
        let theirs = sample(second, scaled(model.place((x - d, y), size), size, size_of(second)));
        let Some((ours, theirs)) = sample(first, scaled((x, y), size, size_of(first))).zip(theirs) else { continue };
        for ((ratios, a), b) in ratios.iter_mut().zip(ours).zip(theirs) {
            if UNCLIPPED.contains(&a) && UNCLIPPED.contains(&b) {
                ratios.push((a + TOE) / (b + TOE));
            }
        }
    }
    ratios.map(|mut ratios| {
        if ratios.len() < POINTS.1 {
            return 1.0;
        }
        let middle = ratios.len() / 2;
        (*ratios.select_nth_unstable_by(middle, f64::total_cmp).1).clamp(MOST_GAIN.recip(), MOST_GAIN)
    })
}

#[cfg(test)]
mod tests;
