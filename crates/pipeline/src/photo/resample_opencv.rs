//! Resampling of 8-bit pictures with the kernels and the rounding of `OpenCV`'s `resize`.
//!
//! Networks published with this preprocessing get the same bytes here.

use super::{Taps, resample_by};

/// Resamples a row-major picture from size `from` to size `to` (width, height): the mean over the area of a result's pixel if no side grows
/// (`INTER_AREA`), else a cubic over four pixels (`INTER_CUBIC`). Both sizes are at least 1×1 and `source` has `from.0 · from.1` pixels.
pub fn resize_opencv(source: &[[u8; 3]], from: (u32, u32), to: (u32, u32)) -> Vec<[u8; 3]> {
    let (from_w, from_h, to_w, to_h) = (from.0 as usize, from.1 as usize, to.0 as usize, to.1 as usize);
    let taps = |across: &Taps, down: &Taps, round: fn(f32) -> f32| {
        // `as` saturates
        resample_by(source, from_w, across, down, |p| p.map(f32::from), |p| p.map(|v| round(v) as u8))
    };
    if to_w > from_w || to_h > from_h {
        return taps(&Taps::four(from_w, to_w), &Taps::four(from_h, to_h), f32::round_ties_even);
    }
    // OpenCV rounds halves up only when it halves both sides
    let halved = (from_w, from_h) == (2 * to_w, 2 * to_h);
    let round: fn(f32) -> f32 = if halved { |v: f32| (v + 0.5).floor() } else { f32::round_ties_even };
    taps(&Taps::covered(from_w, to_w), &Taps::covered(from_h, to_h), round)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn noise(w: u32, h: u32) -> Vec<[u8; 3]> {
        (0..w * h).map(|i| std::array::from_fn(|c| ((i % w * 37 + i / w * 91 + c as u32 * 53) % 256) as u8)).collect()
    }

    /// Sum of every byte times its position, counted from 1.
    fn sum(picture: &[[u8; 3]]) -> u64 {
        picture.as_flattened().iter().zip(1..).map(|(&v, k)| u64::from(v) * k).sum()
    }

    /// From, to, and the [`sum`] of `OpenCV`'s result.
    type Row = ((u32, u32), (u32, u32), u64);
    const OPENCV: [Row; 5] = [
        ((97, 61), (40, 50), 2_296_324_442),
        ((97, 61), (200, 130), 388_043_613_777),
        ((100, 60), (50, 30), 1_291_694_948),
        ((90, 60), (30, 20), 206_708_429),
        ((90, 60), (90, 41), 7_811_845_399),
    ];

    #[test]
    fn bytes_equal_those_of_opencv() {
        // cv2.resize(a, to, interpolation=…), where a[y, x, c] = (x * 37 + y * 91 + c * 53) % 256
        for (from, to, want) in OPENCV {
            let got = sum(&resize_opencv(&noise(from.0, from.1), from, to));
            // OpenCV's cubic also sums in single precision, but in another order: halves may round to either side
            let cubic = to.0 > from.0;
            assert!(got == want || cubic && got.abs_diff(want) < want / 1_000_000, "{from:?} to {to:?}: {got} for {want}");
        }
    }

    /// One sample of an axis in `f64`: the mean over the area that it covers.
    fn exact(line: &[f64], to: usize, i: usize) -> f64 {
        let ratio = line.len() as f64 / to as f64;
        let (begin, end) = (i as f64 * ratio, (i + 1) as f64 * ratio);
        let overlap = |s: usize| (((s + 1) as f64).min(end) - (s as f64).max(begin)).max(0.0);
        line.iter().enumerate().map(|(s, v)| v * overlap(s)).sum::<f64>() / ratio
    }

    proptest! {
        #[test]
        fn means_differ_from_double_precision_by_one_level_at_most(w in 1u32..40, h in 1u32..40, to_w in 1u32..40, to_h in 1u32..40) {
            let (source, to) = (noise(w, h), (to_w.min(w), to_h.min(h)));
            let got = resize_opencv(&source, (w, h), to);
            prop_assert_eq!(got.len(), (to.0 * to.1) as usize);
            for (k, got) in got.iter().enumerate() {
                let (x, y) = (k % to.0 as usize, k / to.0 as usize);
                let column: Vec<f64> = source
                    .chunks_exact(w as usize)
                    .map(|row| exact(&row.iter().map(|p| f64::from(p[1])).collect::<Vec<_>>(), to.0 as usize, x))
                    .collect();
                let want = exact(&column, to.1 as usize, y);
                prop_assert!((f64::from(got[1]) - want).abs() <= 1.0, "{} for {want}", got[1]);
            }
        }

        #[test]
        fn constant_pictures_stay_constant(w in 1u32..40, h in 1u32..40, to_w in 1u32..40, to_h in 1u32..40, v in any::<[u8; 3]>()) {
            let got = resize_opencv(&vec![v; (w * h) as usize], (w, h), (to_w, to_h));
            prop_assert!(got.iter().all(|p| *p == v), "{:?}", got[0]);
        }
    }
}
