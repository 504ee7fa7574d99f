//! Measures what a photo loses when it is reduced.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use tmpi_core::Photo;
use tmpi_render::difference::psnr_of;

/// A photo that was made smaller.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Reduction {
    /// Longest side of the scene divided by that of the file.
    pub scale: f64,
    /// PSNR in dB of the reduced photo, enlarged again, against the original, over every seventeenth row; `None` if the decoder reduced the
    /// photo, which leaves nothing to compare.
    pub psnr: Option<f64>,
}

/// Distance of compared rows; comparing all would take longer than reducing. A multiple of the height of JPEG blocks would always compare the
/// same row of a block.
const STEP: usize = 17;

/// PSNR in dB of a reduced photo, enlarged again by linear interpolation, against the original; over every seventeenth row.
pub(super) fn psnr(small: &Photo, whole: &Photo) -> f64 {
    let (width, height) = (whole.width as usize, whole.height as usize);
    let columns: Vec<(usize, usize, f32)> = (0..width).map(|x| between(x, width, small.width as usize)).collect();
    let line = |y: usize| &small.rgb[y * small.width as usize..][..small.width as usize];
    let row = |y: usize| {
        let (upper, lower, down) = between(y, height, small.height as usize);
        let (upper, lower) = (line(upper), line(lower));
        let pixels = whole.rgb[y * width..][..width].iter().zip(&columns);
        let squares = pixels.map(|(want, &(left, right, across))| {
            (0..3).map(move |c| {
                let mix = |row: &[[u8; 3]]| f32::from(row[left][c]) * (1.0 - across) + f32::from(row[right][c]) * across;
                let is = (mix(upper) * (1.0 - down) + mix(lower) * down).round();
                f64::from((is - f32::from(want[c])).powi(2))
            })
        });
        squares.flatten().sum::<f64>()
    };
    let rows: Vec<usize> = (0..height).skip(STEP.min(height) / 2).step_by(STEP).collect();
    // added in the order of the rows, so that the sum does not depend on the number of threads
    let sum: f64 = rows.par_iter().map(|y| row(*y)).collect::<Vec<f64>>().into_iter().sum();
    psnr_of(sum / (rows.len() * width * 3).max(1) as f64)
}

/// The samples of `small` before and after sample `i` of `n`, and the share of the latter.
fn between(i: usize, n: usize, small: usize) -> (usize, usize, f32) {
    let at = ((i as f64 + 0.5) * small as f64 / n as f64 - 0.5).clamp(0.0, (small - 1) as f64);
    (at as usize, (at as usize + 1).min(small - 1), at.fract() as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_render::difference::MAX_PSNR;

    fn photo(width: u32, height: u32, value: impl Fn(u32, u32) -> u8) -> Photo {
        Photo::from_fn(width, height, |x, y| [value(x, y); 3])
    }

    #[test]
    fn a_flat_photo_loses_nothing_and_stripes_lose_their_deviation() {
        let flat = |w, h| photo(w, h, |_, _| 77);
        assert!((psnr(&flat(20, 10), &flat(40, 20)) - MAX_PSNR).abs() < 1e-12);
        // stripes of one pixel, 100 and 140: their mean is 20 levels away from both
        let stripes = photo(64, 64, |x, _| if x % 2 == 0 { 100 } else { 140 });
        let got = psnr(&photo(32, 32, |_, _| 120), &stripes);
        assert!((got - 20.0 * (255.0f64 / 20.0).log10()).abs() < 1e-9, "{got}");
        for (w, h) in [(1, 1), (1, 40), (300, 1)] {
            assert!(psnr(&flat(1, 1), &flat(w, h)) >= MAX_PSNR);
        }
    }
}
