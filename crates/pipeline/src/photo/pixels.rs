//! Pixels of any decoder as upright sRGB of 8 bits.

use image::ColorType;
use rayon::prelude::*;

use super::PhotoError;
use tmpi_core::Photo;

/// RGB of 8 bits, alpha blended over white, and whether any pixel was not opaque.
pub(super) fn to_rgb(samples: &[u8], colour: ColorType) -> Result<(Vec<[u8; 3]>, bool), PhotoError> {
    let grey = |v: u8| [v; 3];
    let wide = |b: &[u8]| u16::from_ne_bytes([b[0], b[1]]);
    // 65 535 = 255 · 257, so this rounds to nearest
    let narrow = |v: u16| ((u32::from(v) + 128) / 257) as u8;
    // what is see-through is paper more often than night
    let over = |c: [u8; 3], a: u8| c.map(|v| ((u16::from(v) * u16::from(a) + 255 * (255 - u16::from(a)) + 127) / 255) as u8);
    let clear = |n: usize| samples.par_chunks_exact(n).any(|p| p[n - 1] != u8::MAX);
    let map = |n: usize, f: &(dyn Fn(&[u8]) -> [u8; 3] + Sync)| -> Vec<[u8; 3]> { samples.par_chunks_exact(n).map(f).collect() };
    Ok(match colour {
        ColorType::L8 => (map(1, &|p| grey(p[0])), false),
        ColorType::La8 => (map(2, &|p| over(grey(p[0]), p[1])), clear(2)),
        ColorType::Rgb8 => (map(3, &|p| [p[0], p[1], p[2]]), false),
        ColorType::Rgba8 => (map(4, &|p| over([p[0], p[1], p[2]], p[3])), clear(4)),
        ColorType::L16 => (map(2, &|p| grey(narrow(wide(p)))), false),
        ColorType::La16 => (map(4, &|p| over(grey(narrow(wide(p))), narrow(wide(&p[2..])))), true),
        ColorType::Rgb16 => (map(6, &|p| [0, 2, 4].map(|i| narrow(wide(&p[i..])))), false),
        ColorType::Rgba16 => (map(8, &|p| over([0, 2, 4].map(|i| narrow(wide(&p[i..]))), narrow(wide(&p[6..])))), true),
        other => return Err(PhotoError::Broken(format!("pixels of kind {other:?} are not read"))),
    })
}

/// Turns a photo upright, as its EXIF orientation (1 to 8) says.
pub(super) fn upright(photo: Photo, orientation: u8) -> Photo {
    let (rgb, (width, height)) = turned(photo.rgb, (photo.width, photo.height), orientation);
    Photo { width, height, rgb }
}

/// Turns pixels of a picture of `size` (width, height) upright, and gives its size then; any `orientation` but 2 to 8 leaves them.
pub(crate) fn turned<P: Copy + Default + Send + Sync>(pixels: Vec<P>, size: (u32, u32), orientation: u8) -> (Vec<P>, (u32, u32)) {
    let (w, h) = (size.0 as usize, size.1 as usize);
    // Source pixel of an upright pixel
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
