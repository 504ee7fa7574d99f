//! Converts decoded video frames to RGB, in the same way for every viewer of a room.

use crate::Photo;

/// Planes of a 4:2:0 picture: chroma has half the width and half the height, rounded up. 8 bits, rows without padding.
#[derive(Clone, Copy, Debug)]
pub struct I420<'a> {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Luma.
    pub y: &'a [u8],
    /// Blue-difference chroma.
    pub u: &'a [u8],
    /// Red-difference chroma.
    pub v: &'a [u8],
}

/// Weights of red, green and blue in the luma of a video.
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
    /// The matrix of a code point in ITU-T H.273, table 4; `None` if it is unspecified or unsupported.
    pub const fn from_code(code: u8) -> Option<Self> {
        match code {
            1 => Some(Self::Bt709),
            // FCC's weights differ from these by less than a level
            4..=6 => Some(Self::Bt601),
            7 => Some(Self::Smpte240),
            9 | 10 => Some(Self::Bt2020),
            _ => None,
        }
    }

    /// Its code point in ITU-T H.273, table 4.
    pub const fn code(self) -> u8 {
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

/// How to interpret the samples of a video.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Colour {
    /// Luma weights.
    pub matrix: Matrix,
    /// True if luma ranges from 0 to 255 instead of 16 to 235.
    pub full_range: bool,
}

impl Colour {
    /// The colours that a stream signals. Without a matrix, full-range video uses JPEG's matrix, and other video BT.709, as in browsers.
    pub fn signalled(matrix: Option<Matrix>, full_range: bool) -> Self {
        let silent = if full_range { Matrix::Bt601 } else { Matrix::Bt709 };
        Self { matrix: matrix.unwrap_or(silent), full_range }
    }

    /// Scale and zero of luma; then the factors of `v` for red, of `u` and `v` for green, and of `u` for blue. Integers with [`BITS`]
    /// fraction bits.
    fn factors(self) -> (i32, i32, [i32; 4]) {
        let (red, blue) = self.matrix.weights();
        let green = 1.0 - red - blue;
        let (zero, luma, chroma) = if self.full_range { (0, 1.0, 1.0) } else { (16, 255.0 / 219.0, 255.0 / 224.0) };
        let whole = |factor: f64| (factor * f64::from(1 << BITS)).round() as i32;
        let [v, u] = [2.0 * (1.0 - red) * chroma, 2.0 * (1.0 - blue) * chroma];
        (whole(luma), zero, [whole(v), -whole(u * blue / green), -whole(v * red / green), whole(u)])
    }
}

/// Number of fraction bits in the conversion.
const BITS: u32 = 14;

/// Converts a picture to RGB in integer arithmetic; each chroma value applies to its four pixels. Server and pages share this conversion,
/// so hidden colours that a viewer derives match what the server saw. `None` if a plane is too short.
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

    /// Compares a grey ramp and extreme colours of each matrix and range with the definition in `f64`.
    #[test]
    fn the_conversion_matches_the_standard_to_one_level() {
        let samples = || (0..=255).step_by(3).flat_map(|y| [(y, 128, 128), (y, 100, 150), (y, 160, 90), (y, 16, 240)]);
        for matrix in [Matrix::Bt601, Matrix::Bt709, Matrix::Smpte240, Matrix::Bt2020] {
            assert_eq!(Matrix::from_code(matrix.code()), Some(matrix));
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
    fn short_planes_are_rejected() {
        let y = [0; 15];
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y, u: &[0; 6], v: &[0; 6] }, Colour::default()).is_some());
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y, u: &[0; 6], v: &[0; 5] }, Colour::default()).is_none());
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y[1..], u: &[0; 6], v: &[0; 6] }, Colour::default()).is_none());
    }
}
