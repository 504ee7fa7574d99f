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

/// Fraction bits of the conversion.
const BITS: u32 = 14;

/// BT.709, limited range, in whole numbers, each chroma value for its four pixels. Server and page convert by this, so that hidden
/// colours that a reader derives agree with what the server saw. None where a plane is too short.
#[must_use]
pub fn to_rgb(i: &I420) -> Option<Photo> {
    let (w, h) = (i.width as usize, i.height as usize);
    let across = w.div_ceil(2);
    let chroma = across * h.div_ceil(2);
    let (luma, u, v) = (i.y.get(..w * h)?, i.u.get(..chroma)?, i.v.get(..chroma)?);
    let mut rgb = vec![[0; 3]; w * h];
    for (y, (row, out)) in luma.chunks(w.max(1)).zip(rgb.chunks_mut(w.max(1))).enumerate() {
        let (u, v) = (&u[y / 2 * across..][..across], &v[y / 2 * across..][..across]);
        for (((pair, out), u), v) in row.chunks(2).zip(out.chunks_mut(2)).zip(u).zip(v) {
            let (u, v) = (i32::from(*u) - 128, i32::from(*v) - 128);
            let (red, green, blue) = (29_372 * v, -3_494 * u - 8_731 * v, 34_610 * u);
            for (y, out) in pair.iter().zip(out) {
                let luma = 19_077 * (i32::from(*y) - 16) + (1 << (BITS - 1));
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

    /// BT.709 of a grey ramp and of full-range corners, against the definition in `f64`.
    #[test]
    fn the_conversion_is_that_of_the_standard_to_a_level() {
        for (y, u, v) in (16..=235).step_by(3).flat_map(|y| [(y, 128, 128), (y, 100, 150), (y, 160, 90), (y, 16, 240)]) {
            let rgb = to_rgb(&I420 { width: 1, height: 1, y: &[y], u: &[u], v: &[v] }).unwrap().rgb[0];
            let (y, u, v) = ((f64::from(y) - 16.0) / 219.0, (f64::from(u) - 128.0) / 224.0, (f64::from(v) - 128.0) / 224.0);
            let (kr, kb) = (0.2126, 0.0722);
            let (r, b) = (y + 2.0 * (1.0 - kr) * v, y + 2.0 * (1.0 - kb) * u);
            let g = (y - kr * r - kb * b) / (1.0 - kr - kb);
            for (is, should) in rgb.into_iter().zip([r, g, b]) {
                assert!((f64::from(is) - (should * 255.0).clamp(0.0, 255.0)).abs() <= 1.0, "{rgb:?}: {should}");
            }
        }
    }

    #[test]
    fn planes_that_are_too_short_are_no_picture() {
        let y = [0; 15];
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y, u: &[0; 6], v: &[0; 6] }).is_some());
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y, u: &[0; 6], v: &[0; 5] }).is_none());
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y[1..], u: &[0; 6], v: &[0; 6] }).is_none());
    }
}
