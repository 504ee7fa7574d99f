//! Guided filter of a disparity map by the photo's luminance (He, Sun and Tang 2010), by box sums: cost independent of the radius.

use rayon::prelude::*;

use tmpi_core::{DisparityMap, Photo};

/// Rows that one task slides over; the window's start costs `2r + 1` rows each.
const BAND: usize = 64;

/// Filters `delta` with windows of `(2·radius + 1)²` pixels; `epsilon` is the variance of luminance (in 0..=1) below which
/// it smooths instead of following the photo. The map must be finite; the result is.
#[must_use]
pub fn filter(photo: &Photo, delta: &DisparityMap, radius: u32, epsilon: f32) -> DisparityMap {
    let (w, h, r) = (delta.width as usize, delta.height as usize, radius as usize);
    let guide: Vec<f32> = photo.rgb.par_iter().map(|p| luminance(*p)).collect();
    let product = |a: &[f32], b: &[f32]| -> Vec<f32> { a.par_iter().zip(b).map(|(a, b)| a * b).collect() };
    let mean_i = box_mean(&guide, w, h, r);
    let mean_d = box_mean(&delta.delta, w, h, r);
    let corr_ii = box_mean(&product(&guide, &guide), w, h, r);
    let corr_id = box_mean(&product(&guide, &delta.delta), w, h, r);
    let slope: Vec<f32> = (0..guide.len())
        .into_par_iter()
        .map(|i| {
            let variance = (corr_ii[i] - mean_i[i] * mean_i[i]).max(0.0);
            (corr_id[i] - mean_i[i] * mean_d[i]) / (variance + epsilon.max(1e-12))
        })
        .collect();
    drop((corr_ii, corr_id));
    let offset: Vec<f32> = (0..guide.len()).into_par_iter().map(|i| mean_d[i] - slope[i] * mean_i[i]).collect();
    drop((mean_i, mean_d));
    let (slope, offset) = (box_mean(&slope, w, h, r), box_mean(&offset, w, h, r));
    let delta = (0..guide.len()).into_par_iter().map(|i| slope[i] * guide[i] + offset[i]).collect();
    DisparityMap { width: w as u32, height: h as u32, delta }
}

/// Rec. 601 luma in 0..=1.
fn luminance(p: [u8; 3]) -> f32 {
    (0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2])) / 255.0
}

/// Mean over a `(2r + 1)²` window clipped to the map; sums in `f64`, so that sliding does not drift.
pub(crate) fn box_mean(src: &[f32], w: usize, h: usize, r: usize) -> Vec<f32> {
    let mut rows = vec![0f32; src.len()];
    rows.par_chunks_mut(w).zip(src.par_chunks(w)).for_each(|(out, line)| {
        let mut sum: f64 = line[..r.min(w)].iter().map(|v| f64::from(*v)).sum();
        for (x, o) in out.iter_mut().enumerate() {
            if x + r < w {
                sum += f64::from(line[x + r]);
            }
            if x > r {
                sum -= f64::from(line[x - r - 1]);
            }
            *o = (sum / ((x + r + 1).min(w) - x.saturating_sub(r)) as f64) as f32;
        }
    });
    let mut out = vec![0f32; src.len()];
    out.par_chunks_mut(w * BAND).enumerate().for_each(|(band, out)| {
        let first = band * BAND;
        let mut sums = vec![0f64; w];
        let slide = |y: usize, sign: f64, sums: &mut Vec<f64>| {
            for (s, v) in sums.iter_mut().zip(&rows[y * w..(y + 1) * w]) {
                *s += sign * f64::from(*v);
            }
        };
        for y in first.saturating_sub(r)..(first + r).min(h) {
            slide(y, 1.0, &mut sums);
        }
        for (i, line) in out.chunks_mut(w).enumerate() {
            let y = first + i;
            if y + r < h {
                slide(y + r, 1.0, &mut sums);
            }
            if y > r && i > 0 {
                slide(y - r - 1, -1.0, &mut sums);
            }
            let n = ((y + r + 1).min(h) - y.saturating_sub(r)) as f64;
            for (o, s) in line.iter_mut().zip(&sums) {
                *o = (s / n) as f32;
            }
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn reference(src: &[f32], w: usize, h: usize, r: usize) -> Vec<f64> {
        let mut out = Vec::new();
        for y in 0..h {
            for x in 0..w {
                let (mut sum, mut n) = (0.0, 0.0);
                for yy in y.saturating_sub(r)..(y + r + 1).min(h) {
                    for xx in x.saturating_sub(r)..(x + r + 1).min(w) {
                        sum += f64::from(src[yy * w + xx]);
                        n += 1.0;
                    }
                }
                out.push(sum / n);
            }
        }
        out
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        #[test]
        fn box_mean_is_the_mean(w in 1usize..40, h in 1usize..150, r in 0usize..90, seed in any::<u32>()) {
            let src: Vec<f32> = (0..w * h).map(|i| ((i as u32).wrapping_mul(2_654_435_761).wrapping_add(seed) >> 8) as f32 / 1e6).collect();
            for (a, b) in box_mean(&src, w, h, r).iter().zip(reference(&src, w, h, r)) {
                prop_assert!((f64::from(*a) - b).abs() < 1e-5 * b.abs().max(1.0));
            }
        }
    }

    #[test]
    fn it_follows_the_photos_edge() {
        let (w, h) = (64u32, 32u32);
        let photo = Photo { width: w, height: h, rgb: (0..w * h).map(|i| if i % w < 32 { [30; 3] } else { [200; 3] }).collect() };
        let ramp = (0..w * h).map(|i| 0.2 + 0.6 * (((i % w) as f32 - 27.5) / 8.0).clamp(0.0, 1.0)).collect();
        let d = filter(&photo, &DisparityMap { width: w, height: h, delta: ramp }, 8, 1e-4).delta;
        assert!(d[16 * 64 + 30] < 0.3 && d[16 * 64 + 33] > 0.7, "{} {}", d[16 * 64 + 30], d[16 * 64 + 33]);
    }
}
