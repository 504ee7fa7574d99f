//! Converts the pixels of any decoder to upright 8-bit sRGB.

use rayon::prelude::*;

use super::colour::{CHUNK, Conversion};
use tmpi_core::Photo;

/// A sample as a decoder returns it.
pub(super) trait Sample: Copy + Default + Send + Sync {
    /// The nearest 8-bit value.
    fn byte(self) -> u8;
}

impl Sample for u8 {
    fn byte(self) -> u8 {
        self
    }
}

impl Sample for u16 {
    fn byte(self) -> u8 {
        // 65 535 = 255 · 257, so this rounds to nearest
        ((u32::from(self) + 128) / 257) as u8
    }
}

/// Converts samples to 8-bit RGB: applies `conversion` if there is one, then blends over white if `blend` is set. Also returns whether
/// any pixel is not opaque. One channel is grey and three are RGB; two and four add alpha.
pub(super) fn to_rgb<S: Sample>(samples: &[S], channels: usize, conversion: Option<&Conversion<S>>, blend: bool) -> (Vec<[u8; 3]>, bool) {
    let colour = |p: &[S]| if channels < 3 { [p[0]; 3] } else { [p[0], p[1], p[2]] };
    let alpha = |p: &[S]| if channels.is_multiple_of(2) { p[channels - 1].byte() } else { u8::MAX };
    // white is a more likely background than black
    let over = |c: [u8; 3], a: u8| c.map(|v| ((u16::from(v) * u16::from(a) + 255 * (255 - u16::from(a)) + 127) / 255) as u8);
    let mut rgb = vec![[0; 3]; samples.len() / channels];
    let chunks = rgb.par_chunks_mut(CHUNK).zip(samples.par_chunks(CHUNK * channels));
    let see_through = chunks.map(|(out, samples)| {
        let mut colours: Vec<[S; 3]> = samples.chunks_exact(channels).map(colour).collect();
        if let Some(conversion) = conversion {
            conversion.chunk(&mut colours);
        }
        let mut clear = false;
        for ((out, colour), pixel) in out.iter_mut().zip(colours).zip(samples.chunks_exact(channels)) {
            let alpha = alpha(pixel);
            clear |= alpha != u8::MAX;
            *out = over(colour.map(S::byte), if blend { alpha } else { u8::MAX });
        }
        clear
    });
    let see_through = see_through.reduce(|| false, |a, b| a || b);
    (rgb, see_through)
}

/// Turns a photo upright by its EXIF orientation (1 to 8).
pub(super) fn upright(photo: Photo, orientation: u8) -> Photo {
    let (rgb, (width, height)) = turned(photo.rgb, (photo.width, photo.height), orientation);
    Photo { width, height, rgb }
}

/// Turns row-major pixels of a picture of `size` (width, height) upright, and returns the new size. An `orientation` outside 2 to 8
/// changes nothing.
pub(crate) fn turned<P: Copy + Default + Send + Sync>(pixels: Vec<P>, size: (u32, u32), orientation: u8) -> (Vec<P>, (u32, u32)) {
    let (w, h) = (size.0 as usize, size.1 as usize);
    // source pixel of an upright pixel
    let from = move |x: usize, y: usize| match orientation {
        2 => (w - 1 - x, y),
        3 => (w - 1 - x, h - 1 - y),
        4 => (x, h - 1 - y),
        5 => (y, x),
        6 => (y, h - 1 - x),
        7 => (w - 1 - y, h - 1 - x),
        8 => (w - 1 - y, x),
        _ => (x, y),
    };
    if !(2..=8).contains(&orientation) {
        return (pixels, size);
    }
    let (width, height) = if orientation >= 5 { (size.1, size.0) } else { size };
    let mut out = vec![P::default(); pixels.len()];
    out.par_chunks_exact_mut(width as usize).enumerate().for_each(|(y, row)| {
        for (x, p) in row.iter_mut().enumerate() {
            let (sx, sy) = from(x, y);
            *p = pixels[sy * w + sx];
        }
    });
    (out, (width, height))
}
