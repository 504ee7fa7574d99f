//! Cleans a disparity map without a network: 5×5 median, then a guided filter by the photo. The baseline that Θ has to beat.

use rayon::prelude::*;

use crate::denoise::guided_filter;
use tmpi_core::{DisparityMap, Photo};

/// Radius of the median's window.
const MEDIAN: usize = 2;
/// Radius of the guided filter's window.
const RADIUS: u32 = 3;
/// Variance of luminance (in 0..=1) below which the guided filter smooths.
const EPSILON: f32 = 1e-4;

/// Runs the median, then the guided filter. The result is finite for any map.
pub fn denoise(photo: &Photo, delta: &DisparityMap) -> DisparityMap {
    guided_filter::filter(photo, &median(delta), RADIUS, EPSILON)
}

/// Median of the finite values among 5 × 5 pixels, the upper one of an even number; 0, which is infinitely far, if none is finite.
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
                    n += usize::from(v.is_finite());
                }
            }
            *o = if n == 0 { 0.0 } else { *values[..n].select_nth_unstable_by(n / 2, f32::total_cmp).1 };
        }
    });
    DisparityMap { width: delta.width, height: delta.height, delta: out }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A value of a map, sometimes not finite.
    fn value() -> impl Strategy<Value = f32> {
        prop_oneof![6 => 0f32..=1.0, 1 => prop::sample::select(vec![f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY])]
    }

    fn any_map() -> impl Strategy<Value = DisparityMap> {
        (1u32..16, 1u32..16, prop::collection::vec(value(), 15 * 15)).prop_map(|(width, height, values)| {
            let delta = values[..(width * height) as usize].to_vec();
            DisparityMap { width, height, delta }
        })
    }

    proptest! {
        #[test]
        fn the_median_is_the_middle_of_the_sorted_window(map in any_map()) {
            let (w, h) = (map.width as usize, map.height as usize);
            let got = median(&map);
            for (i, got) in got.delta.iter().enumerate() {
                let (x, y) = (i % w, i / w);
                let near = |j: &usize| (j % w).abs_diff(x) <= 2 && (j / w).abs_diff(y) <= 2;
                let mut window: Vec<f32> = (0..w * h).filter(near).map(|j| map.delta[j]).filter(|v| v.is_finite()).collect();
                window.sort_by(f32::total_cmp);
                let want = window.get(window.len() / 2).copied().unwrap_or(0.0);
                prop_assert_eq!(got.to_bits(), want.to_bits(), "at {}, {}", x, y);
            }
        }

        #[test]
        fn results_are_always_finite(map in any_map()) {
            let photo = Photo { width: map.width, height: map.height, rgb: vec![[9, 90, 200]; map.delta.len()] };
            prop_assert!(denoise(&photo, &map).delta.iter().all(|v| v.is_finite()));
        }
    }
}
