//! Cleaning of a disparity map without a network: 5×5 median, then a guided filter by the photo. The bar that Θ has to beat.

use rayon::prelude::*;

use crate::denoise::guided_filter;
use tmpi_core::{DisparityMap, Photo};

/// Half the window of the median.
const MEDIAN: usize = 2;
/// Half the window of the guided filter, and the variance of luminance (in 0..=1) below which it smooths.
const RADIUS: u32 = 3;
const EPSILON: f32 = 1e-4;

/// Median and guided filter.
#[must_use]
pub fn denoise(photo: &Photo, delta: &DisparityMap) -> DisparityMap {
    guided_filter::filter(photo, &median(delta), RADIUS, EPSILON)
}

/// Median over 5 × 5 pixels.
pub(super) fn median(delta: &DisparityMap) -> DisparityMap {
    let (w, h) = (delta.width as usize, delta.height as usize);
    let mut out = vec![0.0; delta.delta.len()];
    out.par_chunks_mut(w).enumerate().for_each(|(y, row)| {
        let mut values = [0f32; (2 * MEDIAN + 1).pow(2)];
        for (x, o) in row.iter_mut().enumerate() {
            let mut n = 0;
            for yy in y.saturating_sub(MEDIAN)..(y + MEDIAN + 1).min(h) {
                for v in &delta.delta[yy * w + x.saturating_sub(MEDIAN)..yy * w + (x + MEDIAN + 1).min(w)] {
                    values[n] = *v;
                    n += 1;
                }
            }
            *o = *values[..n].select_nth_unstable_by(n / 2, f32::total_cmp).1;
        }
    });
    DisparityMap { width: delta.width, height: delta.height, delta: out }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outliers_go_and_edges_stay() {
        let (w, h) = (40u32, 30u32);
        let photo = Photo { width: w, height: h, rgb: (0..w * h).map(|i| if i % w < 20 { [20; 3] } else { [220; 3] }).collect() };
        let clean: Vec<f32> = (0..w * h).map(|i| if i % w < 20 { 0.2 } else { 0.8 }).collect();
        let mut dirty = clean.clone();
        for i in (0..dirty.len()).step_by(37) {
            dirty[i] = 1.0 - dirty[i];
        }
        let got = denoise(&photo, &DisparityMap { width: w, height: h, delta: dirty });
        let worst = got.delta.iter().zip(&clean).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 0.06, "{worst}");
    }
}
