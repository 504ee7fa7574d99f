//! Guided filter of a disparity map by the photo's luminance (He, Sun and Tang 2010), by box sums, so that its cost does not depend on
//! the radius.

use rayon::prelude::*;

use tmpi_core::{DisparityMap, Photo};

/// Rows over which one task slides its window; starting a window costs `2r + 1` rows.
const BAND: usize = 64;

/// Filters `delta` with windows of `(2·radius + 1)²` pixels. `epsilon` is the variance of luminance (in 0..=1) below which it smooths
/// instead of following the photo. The map must be finite, and so is the result.
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

/// Mean over a `(2r + 1)²` window clipped to the map. Sums are in `f64`, so that sliding does not drift.
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

    /// Mean of a value over the window of each pixel, clipped to the map.
    fn window_mean(w: usize, h: usize, r: usize, value: impl Fn(usize) -> f64) -> Vec<f64> {
        let window = |i: usize| {
            let (x, y) = (i % w, i / w);
            let rows = y.saturating_sub(r)..(y + r + 1).min(h);
            rows.flat_map(move |yy| (x.saturating_sub(r)..(x + r + 1).min(w)).map(move |xx| yy * w + xx))
        };
        (0..w * h).map(|i| window(i).map(&value).sum::<f64>() / window(i).count() as f64).collect()
    }

    /// The filter by equations 5, 6 and 8 of He, Sun and Tang, in `f64`.
    fn by_formula(photo: &Photo, delta: &DisparityMap, r: usize, epsilon: f64) -> Vec<f64> {
        let (w, h) = (delta.width as usize, delta.height as usize);
        let mean = |value: &dyn Fn(usize) -> f64| window_mean(w, h, r, value);
        let guide: Vec<f64> =
            photo.rgb.iter().map(|[r, g, b]| (0.299 * f64::from(*r) + 0.587 * f64::from(*g) + 0.114 * f64::from(*b)) / 255.0).collect();
        let map: Vec<f64> = delta.delta.iter().copied().map(f64::from).collect();
        let (mean_i, mean_d) = (mean(&|i| guide[i]), mean(&|i| map[i]));
        let (square, product) = (mean(&|i| guide[i] * guide[i]), mean(&|i| guide[i] * map[i]));
        let slope = |i: usize| (product[i] - mean_i[i] * mean_d[i]) / (square[i] - mean_i[i] * mean_i[i] + epsilon);
        let (slopes, offsets) = (mean(&slope), mean(&|i| mean_d[i] - slope(i) * mean_i[i]));
        (0..guide.len()).map(|i| slopes[i] * guide[i] + offsets[i]).collect()
    }

    /// A photo of patches with some noise, so that windows have edges, texture and flat parts.
    fn patches(w: u32, h: u32, patch: u32, seed: u32) -> Photo {
        let value = |x: u32, y: u32| {
            let flat = (x / patch * 7 + y / patch * 13).wrapping_mul(2_654_435_761).wrapping_add(seed) >> 24;
            let rough = (y * w + x).wrapping_mul(0x85EB_CA77).wrapping_add(seed) >> 27;
            (flat + if (x / patch).is_multiple_of(2) { rough } else { 0 }).min(255) as u8
        };
        Photo::from_fn(w, h, |x, y| [value(x, y), value(y, x), 200])
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        #[test]
        fn box_mean_is_the_mean(w in 1usize..40, h in 1usize..150, r in 0usize..90, seed in any::<u32>()) {
            let src: Vec<f32> = (0..w * h).map(|i| ((i as u32).wrapping_mul(2_654_435_761).wrapping_add(seed) >> 8) as f32 / 1e6).collect();
            for (a, b) in box_mean(&src, w, h, r).iter().zip(window_mean(w, h, r, |i| f64::from(src[i]))) {
                prop_assert!((f64::from(*a) - b).abs() < 1e-5 * b.abs().max(1.0));
            }
        }

        /// Variances of values 0 to 1 have an error of 2⁻²³ in `f32`, and slopes have that over epsilon. A pixel differs from its
        /// window's mean by about the deviation, so its result has an error of 2⁻²³ over the root of epsilon, here times 8 for the sums.
        #[test]
        fn the_filter_agrees_with_its_formula_in_f64(
            w in 1u32..32, h in 1u32..32, r in 0usize..9, patch in 2u32..9, seed in any::<u32>(), exponent in -4f64..0.0,
            values in prop::collection::vec(0f32..=1.0, 32 * 32),
        ) {
            let photo = patches(w, h, patch, seed);
            let delta = DisparityMap { width: w, height: h, delta: values[..(w * h) as usize].to_vec() };
            let epsilon = 10f64.powf(exponent);
            let got = filter(&photo, &delta, r as u32, epsilon as f32);
            let tolerance = 8.0 * f64::from(f32::EPSILON) / epsilon.sqrt();
            for (got, want) in got.delta.iter().zip(by_formula(&photo, &delta, r, epsilon)) {
                prop_assert!((f64::from(*got) - want).abs() < tolerance, "{got}, not {want}");
            }
        }

        /// With the extremes that a finite map may hold.
        #[test]
        fn a_finite_map_stays_finite(
            w in 1u32..20, h in 1u32..20, r in 0u32..30, seed in any::<u32>(), epsilon in prop::sample::select(vec![0.0f32, 1e-30, 1e-4, 1e6]),
            values in prop::collection::vec(prop::sample::select(vec![0.0f32, 1.0, 1e-30, -1e9, 1e9]), 20 * 20),
        ) {
            let delta = DisparityMap { width: w, height: h, delta: values[..(w * h) as usize].to_vec() };
            prop_assert!(filter(&patches(w, h, 3, seed), &delta, r, epsilon).delta.iter().all(|v| v.is_finite()));
        }
    }
}
