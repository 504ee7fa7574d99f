//! Rows of a photo and its disparity map, laid out so that windows are read eight columns at a time.

use std::ops::Range;

use fearless_simd::{Simd, f32x8, prelude::*};
use tmpi_core::{DisparityMap, Photo};

/// Columns that are read at once; a window has at most one less.
pub(super) const LANES: usize = 8;
/// One value per column.
pub(super) type Lanes = [f32; LANES];
/// Radius of the widest window.
pub(super) const REACH: usize = 3;

/// A band of rows with columns beyond both ends, where δ is NaN and so neither above nor below anything.
#[derive(Default)]
pub(super) struct Band {
    rows: Range<usize>,
    stride: usize,
    colour: [Vec<f32>; 3],
    delta: Vec<f32>,
}

/// Eight columns of a row, starting [`REACH`] before a pixel.
pub(super) struct Strip {
    /// Red, green and blue, 0 to 255.
    pub colour: [Lanes; 3],
    /// δ.
    pub delta: Lanes,
}

impl Band {
    /// Loads `rows` and the rows within [`REACH`] of them.
    pub fn load(&mut self, photo: &Photo, delta: &DisparityMap, rows: Range<usize>) {
        let (w, h) = (photo.width as usize, photo.height as usize);
        self.rows = rows.start.saturating_sub(REACH)..(rows.end + REACH).min(h);
        self.stride = REACH + w + LANES - REACH;
        let size = self.stride * self.rows.len();
        self.delta.clear();
        self.delta.resize(size, f32::NAN);
        for plane in &mut self.colour {
            plane.resize(size, 0.0);
        }
        let [red, green, blue] = &mut self.colour;
        for (i, y) in self.rows.clone().enumerate() {
            let (own, from) = (i * self.stride + REACH..i * self.stride + REACH + w, y * w..(y + 1) * w);
            self.delta[own.clone()].copy_from_slice(&delta.delta[from.clone()]);
            let planes = red[own.clone()].iter_mut().zip(&mut green[own.clone()]).zip(&mut blue[own]);
            for (((r, g), b), p) in planes.zip(&photo.rgb[from]) {
                (*r, *g, *b) = (f32::from(p[0]), f32::from(p[1]), f32::from(p[2]));
            }
        }
    }

    /// Rows of the photo within `radius` of row `y`.
    pub fn near(&self, y: usize, radius: usize) -> Range<usize> {
        y.saturating_sub(radius).max(self.rows.start)..(y + radius + 1).min(self.rows.end)
    }

    /// The columns around `x` in row `y`, which both lie in the photo.
    #[inline(always)]
    pub fn strip(&self, x: usize, y: usize) -> Strip {
        let at = (y - self.rows.start) * self.stride + x;
        let lanes = |plane: &[f32]| {
            let own = &plane[at..at + LANES];
            std::array::from_fn(|k| own[k])
        };
        Strip { colour: std::array::from_fn(|c| lanes(&self.colour[c])), delta: lanes(&self.delta) }
    }

    /// Colour of a pixel.
    #[inline(always)]
    pub fn colour(&self, x: usize, y: usize) -> [f32; 3] {
        let at = (y - self.rows.start) * self.stride + REACH + x;
        std::array::from_fn(|c| self.colour[c][at])
    }

    /// δ of a pixel.
    #[inline(always)]
    pub fn delta(&self, x: usize, y: usize) -> f32 {
        self.delta[(y - self.rows.start) * self.stride + REACH + x]
    }
}

/// Added to a small number, it leaves the whole part in the lowest bits.
const ROUND: f32 = 12_582_912.0;
/// Coefficients of the series of `2^f`, the highest power first.
const SERIES: [f32; 7] = [1.540_353e-4, 1.333_355_8e-3, 9.618_129e-3, 5.550_411e-2, 0.240_226_5, std::f32::consts::LN_2, 1.0];

/// `2^x` for `x` in −126 to 0, with a relative error of at most 2e-7; about `2^−126` for `x` below that, down to −1e6.
///
/// The polynomial is the Taylor series of `2^f` about 0, with `f` in −½ to ½.
#[inline(always)]
pub(super) fn exp2<S: Simd>(x: f32x8<S>) -> f32x8<S> {
    const LEAST: u32 = (ROUND - 126.0).to_bits();
    let whole = x + ROUND;
    let f = x - (whole - ROUND);
    let p = SERIES[2..].iter().fold(f * SERIES[0] + SERIES[1], |p, &c| p * f + c);
    // positive floats are ordered like their bits
    f32x8::from_bits(p.to_bits() + (whole.to_bits().max(LEAST) << 23))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// [`exp2`] of one number.
    pub(crate) fn exp2_of(x: f32) -> f32 {
        let whole = x + ROUND;
        let f = x - (whole - ROUND);
        let p = SERIES[1..].iter().fold(SERIES[0], |p, c| p * f + c);
        f32::from_bits(p.to_bits().wrapping_add(whole.to_bits().max((ROUND - 126.0).to_bits()) << 23))
    }

    #[test]
    fn powers_of_two_agree_with_the_standard_library() {
        for i in 0..=126_000 {
            let x = -f64::from(i) / 1000.0;
            let (got, want) = (f64::from(exp2_of(x as f32)), (f64::from(x as f32)).exp2());
            assert!((got / want - 1.0).abs() < 3e-7, "{x}: {got} {want}");
        }
        for x in [-126.6f32, -217.0, -1e6] {
            assert!((0.7..1.5).contains(&(f64::from(exp2_of(x)) / (-126f64).exp2())), "{x}");
        }
    }

    #[test]
    fn a_strip_at_a_border_has_no_disparity_beyond_it() {
        let photo = Photo { width: 2, height: 2, rgb: vec![[1, 2, 3], [4, 5, 6], [7, 8, 9], [10, 11, 12]] };
        let delta = DisparityMap { width: 2, height: 2, delta: vec![0.1, 0.2, 0.3, 0.4] };
        let mut band = Band::default();
        for _ in 0..2 {
            band.load(&photo, &delta, 1..2);
            let s = band.strip(1, 1);
            assert_eq!(s.delta.map(f32::is_finite), [false, false, true, true, false, false, false, false]);
            assert!((s.delta[2] - 0.3).abs() < 1e-9 && (s.colour[2][3] - 12.0).abs() < 1e-9);
            assert_eq!(band.near(1, 3), 0..2);
            assert!((band.delta(0, 0) - 0.1).abs() < 1e-9 && (band.colour(0, 1)[1] - 8.0).abs() < 1e-9);
        }
    }
}
