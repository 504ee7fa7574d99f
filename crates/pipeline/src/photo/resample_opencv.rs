//! Resampling of 8-bit pictures with the kernels and the rounding of `OpenCV`'s `resize`.
//!
//! Networks published with this preprocessing get the same bytes here.

use rayon::prelude::*;

use super::{Taps, resample_by};

/// Kernel of [`resize_opencv`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interpolation {
    /// Linear between the two nearest pixels, whatever the ratio: `INTER_LINEAR`.
    Linear,
    /// The mean over the area of a result's pixel if no side grows (`INTER_AREA`), else a cubic over four pixels (`INTER_CUBIC`).
    AreaOrCubic,
}

/// Fractional bits of a weight of [`Interpolation::Linear`].
const BITS: u32 = 11;

/// Resamples a row-major picture from size `from` to size `to` (width, height). Both sizes are at least 1×1 and `source` has
/// `from.0 · from.1` pixels.
pub fn resize_opencv(source: &[[u8; 3]], from: (u32, u32), to: (u32, u32), by: Interpolation) -> Vec<[u8; 3]> {
    if from == to {
        return source.to_vec();
    }
    let (from_w, from_h, to_w, to_h) = (from.0 as usize, from.1 as usize, to.0 as usize, to.1 as usize);
    let taps = |across: &Taps, down: &Taps, round: fn(f32) -> f32| {
        // `as` saturates
        resample_by(source, from_w, across, down, |p| p.map(f32::from), |p| p.map(|v| round(v) as u8))
    };
    let halved = (from_w, from_h) == (2 * to_w, 2 * to_h);
    let grows = to_w > from_w || to_h > from_h;
    match by {
        // OpenCV rounds halves up only when it halves both sides
        _ if halved => taps(&Taps::covered(from_w, to_w), &Taps::covered(from_h, to_h), |v| (v + 0.5).floor()),
        Interpolation::AreaOrCubic if grows => taps(&Taps::four(from_w, to_w), &Taps::four(from_h, to_h), f32::round_ties_even),
        Interpolation::AreaOrCubic => taps(&Taps::covered(from_w, to_w), &Taps::covered(from_h, to_h), f32::round_ties_even),
        Interpolation::Linear => linear(source, (from_w, from_h), (to_w, to_h)),
    }
}

/// The lower of the two source samples around sample `i` of `to`, not yet clamped to the border, and the weights of both in units of
/// 2^-[`BITS`].
fn between(from: usize, to: usize, i: usize) -> (i64, [i32; 2]) {
    // in single precision, as in OpenCV
    let at = ((i as f64 + 0.5) * (from as f64 / to as f64) - 0.5) as f32;
    let low = at.floor();
    let share = at - low;
    let fixed = |w: f32| (w * f32::from(1u16 << BITS)).round_ties_even() as i32;
    (low as i64, [fixed(1.0 - share), fixed(share)])
}

fn linear(source: &[[u8; 3]], (from_w, from_h): (usize, usize), (to_w, to_h): (usize, usize)) -> Vec<[u8; 3]> {
    let within = |at: i64, size: usize| at.clamp(0, size as i64 - 1) as usize;
    let across: Vec<_> = (0..to_w)
        .map(|i| {
            let (low, weights) = between(from_w, to_w, i);
            // horizontally, a sample beyond the border is the border's with the whole weight; vertically, it keeps both weights
            if low < 0 || low >= from_w as i64 - 1 {
                ([within(low, from_w); 2], [1 << BITS, 0])
            } else {
                ([low as usize, low as usize + 1], weights)
            }
        })
        .collect();
    let mut out = vec![[0; 3]; to_w * to_h];
    out.par_chunks_exact_mut(to_w).enumerate().for_each(|(j, out)| {
        let (low, weights) = between(from_h, to_h, j);
        let rows = [low, low + 1].map(|y| &source[within(y, from_h) * from_w..][..from_w]);
        for (out, (at, v)) in out.iter_mut().zip(&across) {
            *out = std::array::from_fn(|c| {
                let sums = rows.map(|row| i32::from(row[at[0]][c]) * v[0] + i32::from(row[at[1]][c]) * v[1]);
                // OpenCV cuts each product to 8 + 2 bits before it adds them
                let sum: i32 = sums.iter().zip(weights).map(|(s, w)| ((s >> 4) * w) >> 16).sum();
                ((sum + 2) >> 2).clamp(0, 255) as u8
            });
        }
    });
    out
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

    /// From, to, interpolation, and the [`sum`] of `OpenCV`'s result.
    type Row = ((u32, u32), (u32, u32), Interpolation, u64);
    const OPENCV: [Row; 11] = [
        ((97, 61), (40, 50), Interpolation::Linear, 2_294_284_890),
        ((97, 61), (200, 130), Interpolation::Linear, 387_628_078_912),
        ((100, 60), (50, 30), Interpolation::Linear, 1_291_694_948),
        ((90, 60), (30, 20), Interpolation::Linear, 204_447_374),
        ((90, 60), (90, 41), Interpolation::Linear, 7_808_826_390),
        ((5, 3), (4, 20), Interpolation::Linear, 3_563_550),
        ((97, 61), (40, 50), Interpolation::AreaOrCubic, 2_296_324_442),
        ((97, 61), (200, 130), Interpolation::AreaOrCubic, 388_043_613_777),
        ((100, 60), (50, 30), Interpolation::AreaOrCubic, 1_291_694_948),
        ((90, 60), (30, 20), Interpolation::AreaOrCubic, 206_708_429),
        ((90, 60), (90, 41), Interpolation::AreaOrCubic, 7_811_845_399),
    ];

    #[test]
    fn bytes_equal_those_of_opencv() {
        // cv2.resize(a, to, interpolation=…), where a[y, x, c] = (x * 37 + y * 91 + c * 53) % 256
        for (from, to, by, want) in OPENCV {
            let got = sum(&resize_opencv(&noise(from.0, from.1), from, to, by));
            // OpenCV's cubic also sums in single precision, but in another order: halves may round to either side
            let cubic = by == Interpolation::AreaOrCubic && to.0 > from.0;
            assert!(got == want || cubic && got.abs_diff(want) < want / 1_000_000, "{from:?} to {to:?}, {by:?}: {got} for {want}");
        }
    }

    /// One sample of an axis in `f64`: the mean over the area that it covers, or linear between two samples.
    fn exact(line: &[f64], to: usize, i: usize, by: Interpolation) -> f64 {
        let ratio = line.len() as f64 / to as f64;
        let last = line.len() - 1;
        if by == Interpolation::Linear {
            let at = ((i as f64 + 0.5) * ratio - 0.5).clamp(0.0, last as f64);
            let low = at as usize;
            return line[low] * (1.0 - at.fract()) + line[(low + 1).min(last)] * at.fract();
        }
        let (begin, end) = (i as f64 * ratio, (i + 1) as f64 * ratio);
        let overlap = |s: usize| (((s + 1) as f64).min(end) - (s as f64).max(begin)).max(0.0);
        line.iter().enumerate().map(|(s, v)| v * overlap(s)).sum::<f64>() / ratio
    }

    proptest! {
        #[test]
        fn results_differ_from_double_precision_by_one_level_at_most(w in 1u32..40, h in 1u32..40, to_w in 1u32..40, to_h in 1u32..40) {
            let source = noise(w, h);
            for (by, to) in [(Interpolation::Linear, (to_w, to_h)), (Interpolation::AreaOrCubic, (to_w.min(w), to_h.min(h)))] {
                let got = resize_opencv(&source, (w, h), to, by);
                prop_assert_eq!(got.len(), (to.0 * to.1) as usize);
                for (k, got) in got.iter().enumerate() {
                    let (x, y) = (k % to.0 as usize, k / to.0 as usize);
                    let column: Vec<f64> = source
                        .chunks_exact(w as usize)
                        .map(|row| exact(&row.iter().map(|p| f64::from(p[1])).collect::<Vec<_>>(), to.0 as usize, x, by))
                        .collect();
                    let want = exact(&column, to.1 as usize, y, by);
                    prop_assert!((f64::from(got[1]) - want).abs() <= 1.0, "{} for {want}", got[1]);
                }
            }
        }

        #[test]
        fn constant_pictures_stay_constant(w in 1u32..40, h in 1u32..40, to_w in 1u32..40, to_h in 1u32..40, v in any::<[u8; 3]>()) {
            for by in [Interpolation::Linear, Interpolation::AreaOrCubic] {
                let got = resize_opencv(&vec![v; (w * h) as usize], (w, h), (to_w, to_h), by);
                prop_assert!(got.iter().all(|p| *p == v), "{by:?}: {:?}", got[0]);
            }
        }
    }
}
