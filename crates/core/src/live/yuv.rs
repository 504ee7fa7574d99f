//! From the planes of a decoded video frame to RGB, for every reader of a room alike.

use crate::Photo;

/// Planes of a picture whose chroma has half the width and half the height, rounded up; 8 bits, rows without gaps.
#[derive(Clone, Copy, Debug)]
pub struct I420<'a> {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Luma.
    pub y: &'a [u8],
    /// Blue less luma.
    pub u: &'a [u8],
    /// Red less luma.
    pub v: &'a [u8],
}

/// By which weights of red, green and blue the luma of a video is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Matrix {
    /// Standard definition, and JPEG.
    Bt601,
    /// High definition.
    #[default]
    Bt709,
    /// High definition before BT.709.
    Smpte240,
    /// Ultra-high definition, non-constant luminance.
    Bt2020,
}

impl Matrix {
    /// By its number in ITU-T H.273, table 4; none where it is not specified, or another one.
    #[must_use]
    pub const fn numbered(code: u8) -> Option<Self> {
        match code {
            1 => Some(Self::Bt709),
            // FCC's differ from these by less than a level
            4..=6 => Some(Self::Bt601),
            7 => Some(Self::Smpte240),
            9 | 10 => Some(Self::Bt2020),
            _ => None,
        }
    }

    /// Its number there.
    #[must_use]
    pub const fn number(self) -> u8 {
        match self {
            Self::Bt709 => 1,
            Self::Bt601 => 6,
            Self::Smpte240 => 7,
            Self::Bt2020 => 9,
        }
    }

    /// Weights of red and blue.
    const fn weights(self) -> (f64, f64) {
        match self {
            Self::Bt601 => (0.299, 0.114),
            Self::Bt709 => (0.2126, 0.0722),
            Self::Smpte240 => (0.212, 0.087),
            Self::Bt2020 => (0.2627, 0.0593),
        }
    }
}

/// How the samples of a video are to be read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Colour {
    /// The matrix.
    pub matrix: Matrix,
    /// Luma from 0 to 255 rather than from 16 to 235.
    pub full_range: bool,
}

impl Colour {
    /// As a stream says. Where it names no matrix it is BT.709, as browsers take it, but for full range, which is JPEG's with its matrix.
    #[must_use]
    pub fn said(matrix: Option<Matrix>, full_range: bool) -> Self {
        let silent = if full_range { Matrix::Bt601 } else { Matrix::Bt709 };
        Self { matrix: matrix.unwrap_or(silent), full_range }
    }

    /// Luma's factor and zero, then the factors of `v` for red, `u` and `v` for green, `u` for blue; in whole numbers of [`BITS`] bits.
    fn factors(self) -> (i32, i32, [i32; 4]) {
        let (red, blue) = self.matrix.weights();
        let green = 1.0 - red - blue;
        let (zero, luma, chroma) = if self.full_range { (0, 1.0, 1.0) } else { (16, 255.0 / 219.0, 255.0 / 224.0) };
        let whole = |factor: f64| (factor * f64::from(1 << BITS)).round() as i32;
        let [v, u] = [2.0 * (1.0 - red) * chroma, 2.0 * (1.0 - blue) * chroma];
        (whole(luma), zero, [whole(v), -whole(u * blue / green), -whole(v * red / green), whole(u)])
    }
}

/// Fraction bits of the conversion.
const BITS: u32 = 14;

/// Converts in whole numbers, each chroma value for its four pixels. Server and page convert by this, so that hidden
/// colours that a reader derives agree with what the server saw. None where a plane is too short.
#[must_use]
pub fn to_rgb(i: &I420, colour: Colour) -> Option<Photo> {
    let (w, h) = (i.width as usize, i.height as usize);
    let across = w.div_ceil(2);
    let chroma = across * h.div_ceil(2);
    let (luma, u, v) = (i.y.get(..w * h)?, i.u.get(..chroma)?, i.v.get(..chroma)?);
    let (scale, zero, [v_red, u_green, v_green, u_blue]) = colour.factors();
    let mut rgb = vec![[0; 3]; w * h];
    for (y, (row, out)) in luma.chunks(w.max(1)).zip(rgb.chunks_mut(w.max(1))).enumerate() {
        let (u, v) = (&u[y / 2 * across..][..across], &v[y / 2 * across..][..across]);
        for (((pair, out), u), v) in row.chunks(2).zip(out.chunks_mut(2)).zip(u).zip(v) {
            let (u, v) = (i32::from(*u) - 128, i32::from(*v) - 128);
            let (red, green, blue) = (v_red * v, u_green * u + v_green * v, u_blue * u);
            for (y, out) in pair.iter().zip(out) {
                let luma = scale * (i32::from(*y) - zero) + (1 << (BITS - 1));
                *out = [red, green, blue].map(|c| ((luma + c) >> BITS).clamp(0, 255) as u8);
            }
        }
    }
    Some(Photo { width: i.width, height: i.height, rgb })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "test")]

    use super::*;

    /// A grey ramp and corners of each matrix and range, against the definition in `f64`.
    #[test]
    fn the_conversion_is_that_of_the_standard_to_a_level() {
        let samples = || (0..=255).step_by(3).flat_map(|y| [(y, 128, 128), (y, 100, 150), (y, 160, 90), (y, 16, 240)]);
        for matrix in [Matrix::Bt601, Matrix::Bt709, Matrix::Smpte240, Matrix::Bt2020] {
            assert_eq!(Matrix::numbered(matrix.number()), Some(matrix));
            for ((y, u, v), full_range) in samples().flat_map(|s| [(s, false), (s, true)]) {
                let planes = I420 { width: 1, height: 1, y: &[y], u: &[u], v: &[v] };
                let rgb = to_rgb(&planes, Colour { matrix, full_range }).unwrap().rgb[0];
                let (zero, luma, chroma) = if full_range { (0.0, 255.0, 255.0) } else { (16.0, 219.0, 224.0) };
                let y = (f64::from(y) - zero) / luma;
                let [u, v] = [u, v].map(|c| (f64::from(c) - 128.0) / chroma);
                let (kr, kb) = matrix.weights();
                let (r, b) = (y + 2.0 * (1.0 - kr) * v, y + 2.0 * (1.0 - kb) * u);
                let g = (y - kr * r - kb * b) / (1.0 - kr - kb);
                for (is, should) in rgb.into_iter().zip([r, g, b]) {
                    assert!((f64::from(is) - (should * 255.0).clamp(0.0, 255.0)).abs() <= 1.0, "{matrix:?} {rgb:?}: {should}");
                }
            }
        }
    }

    #[test]
    fn planes_that_are_too_short_are_no_picture() {
        let y = [0; 15];
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y, u: &[0; 6], v: &[0; 6] }, Colour::default()).is_some());
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y, u: &[0; 6], v: &[0; 5] }, Colour::default()).is_none());
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y[1..], u: &[0; 6], v: &[0; 6] }, Colour::default()).is_none());
    }
}
