//! The census transform (Zabih and Woodfill 1994): which neighbours of a pixel are darker than it. It does not change with exposure.

use rayon::prelude::*;

/// Radius of the window, x and y: 9 × 7 pixels, of which 62 are compared.
const RADIUS: (usize, usize) = (4, 3);

/// A grey picture, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Grey {
    /// Width in pixels, at least 1.
    pub width: usize,
    /// Height in pixels, at least 1.
    pub height: usize,
    /// Brightness, 0 to 255.
    pub values: Vec<u8>,
}

/// Census transform of a picture, one word per pixel. Beyond the border, the outermost pixels repeat.
pub fn census(picture: &Grey) -> Vec<u64> {
    let (w, h) = (picture.width, picture.height);
    let (rx, ry) = RADIUS;
    let mut out = vec![0u64; w * h];
    out.par_chunks_exact_mut(w).enumerate().for_each_init(Vec::new, |line: &mut Vec<u8>, (y, out)| {
        let own = &picture.values[y * w..(y + 1) * w];
        // eight comparisons per byte: sixteen pixels at once on any processor
        let mut bytes = [const { Vec::new() }; 8];
        let mut count = 0;
        for dy in 0..=2 * ry {
            let row = &picture.values[(y + dy).saturating_sub(ry).min(h - 1) * w..][..w];
            line.clear();
            line.extend(std::iter::repeat_n(row[0], rx));
            line.extend_from_slice(row);
            line.extend(std::iter::repeat_n(row[w - 1], rx));
            for dx in (0..=2 * rx).filter(|dx| (*dx, dy) != (rx, ry)) {
                let byte = &mut bytes[count / 8];
                byte.resize(w, 0u8);
                for ((byte, neighbour), own) in byte.iter_mut().zip(&line[dx..dx + w]).zip(own) {
                    *byte = *byte << 1 | u8::from(neighbour < own);
                }
                count += 1;
            }
        }
        for (x, out) in out.iter_mut().enumerate() {
            *out = u64::from_le_bytes(std::array::from_fn(|k| bytes[k][x]));
        }
    });
    out
}
