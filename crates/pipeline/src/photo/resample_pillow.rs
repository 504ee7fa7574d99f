//! Separable resampling of 8-bit pictures with Pillow's rounding: fixed-point weights, and bytes between the two passes.
//!
//! Networks published with this preprocessing get exactly the same bytes here.

use rayon::prelude::*;

use super::Filter;

/// Fractional bits of a weight. With 8 bits for a value and 2 for a kernel's overshoot, sums fit in 32 bits.
const BITS: u32 = 22;

/// For each sample of the result, its first source sample and the weights from there on, in units of 2^-[`BITS`].
struct Weights(Vec<(usize, Vec<i32>)>);

impl Weights {
    /// If the size stays the same, each sample is its own: Pillow skips such an axis.
    fn new(from: usize, to: usize, filter: Filter) -> Self {
        let ratio = from as f64 / to as f64;
        let stretch = ratio.max(1.0);
        let reach = filter.support() * stretch;
        let tap = |i: usize| {
            let centre = (i as f64 + 0.5) * ratio;
            // `as` turns negative values into 0
            let first = ((centre - reach + 0.5) as usize).min(from - 1);
            let end = ((centre + reach + 0.5) as usize).clamp(first + 1, from);
            let weights: Vec<f64> = (first..end).map(|s| filter.at((s as f64 - centre + 0.5) * (1.0 / stretch))).collect();
            let sum: f64 = weights.iter().sum();
            let norm = if sum == 0.0 { 1.0 } else { sum };
            // `round` rounds halves away from 0
            (first, weights.into_iter().map(|w| (w / norm * f64::from(1 << BITS)).round() as i32).collect())
        };
        Self((0..to).map(tap).collect())
    }
}

/// The byte nearest to a sum that already includes a half.
fn byte(sum: i32) -> u8 {
    (sum >> BITS).clamp(0, 255) as u8
}

const HALF: i32 = 1 << (BITS - 1);

/// Resamples a row-major picture from size `from` to size `to` (width, height) as Pillow's `Image.resize` does: horizontally first,
/// rounded to bytes, then vertically, rounded to bytes.
///
/// Both sizes are at least 1×1 and `source` has `from.0 · from.1` pixels. The function works on bands of rows: beside the result it holds
/// only the source rows of a band, at the result's width.
pub fn resample_bytes(source: &[[u8; 3]], from: (u32, u32), to: (u32, u32), filter: Filter) -> Vec<[u8; 3]> {
    const BAND: usize = 32;
    let (from_w, from_h, to_w, to_h) = (from.0 as usize, from.1 as usize, to.0 as usize, to.1 as usize);
    let across = Weights::new(from_w, to_w, filter);
    let down = Weights::new(from_h, to_h, filter);
    let mut out = vec![[0; 3]; to_w * to_h];
    out.par_chunks_mut(BAND * to_w).enumerate().for_each(|(band, out)| {
        let taps = &down.0[band * BAND..band * BAND + out.len() / to_w];
        let (first, end) = (taps.iter().map(|t| t.0).min().unwrap_or(0), taps.iter().map(|t| t.0 + t.1.len()).max().unwrap_or(0));
        let mut narrow = vec![[0; 3]; (end - first) * to_w];
        for (narrow, y) in narrow.chunks_exact_mut(to_w).zip(first..end) {
            row(&source[y * from_w..(y + 1) * from_w], &across, narrow);
        }
        let mut sums = vec![0i32; 3 * to_w];
        for (out, (at, weights)) in out.chunks_exact_mut(to_w).zip(taps) {
            sums.fill(HALF);
            for (&w, line) in weights.iter().zip(narrow[(at - first) * to_w..].chunks_exact(to_w)) {
                for (s, &v) in sums.iter_mut().zip(line.as_flattened()) {
                    *s += w * i32::from(v);
                }
            }
            for (o, &s) in out.as_flattened_mut().iter_mut().zip(&sums) {
                *o = byte(s);
            }
        }
    });
    out
}

/// Resamples one row horizontally.
fn row(source: &[[u8; 3]], across: &Weights, out: &mut [[u8; 3]]) {
    for (o, (at, weights)) in out.iter_mut().zip(&across.0) {
        let mut sums = [HALF; 3];
        for (&w, p) in weights.iter().zip(&source[*at..]) {
            for (s, &v) in sums.iter_mut().zip(p) {
                *s += w * i32::from(v);
            }
        }
        *o = sums.map(byte);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn noise(w: u32, h: u32, seed: u32) -> Vec<[u8; 3]> {
        let hash = |i: u32| (i ^ seed.wrapping_mul(0x9e37_79b9)).wrapping_mul(0x85eb_ca6b).rotate_left(13).wrapping_mul(0xc2b2_ae35);
        (0..w * h).map(|i| std::array::from_fn(|c| (hash(3 * i + c as u32) >> 24) as u8)).collect()
    }

    /// Resamples one axis with 64-bit sums over every source sample; with `exact`, in `f64` and unrounded.
    fn axis(line: &[u8], to: usize, filter: Filter, exact: bool) -> Vec<f64> {
        if line.len() == to {
            return line.iter().map(|&v| f64::from(v)).collect();
        }
        let ratio = line.len() as f64 / to as f64;
        let value = |i: usize| {
            let kernel = |s: usize| filter.at((s as f64 - (i as f64 + 0.5) * ratio + 0.5) * (1.0 / ratio.max(1.0)));
            let weights: Vec<f64> = (0..line.len()).map(kernel).collect();
            let sum = weights.iter().sum::<f64>();
            if exact {
                return line.iter().zip(&weights).map(|(&v, w)| f64::from(v) * w / sum).sum::<f64>().clamp(0.0, 255.0);
            }
            let fixed = |w: f64| (w / sum * 4_194_304.0).round() as i64;
            let sum: i64 = line.iter().zip(&weights).map(|(&v, &w)| i64::from(v) * fixed(w)).sum();
            (((sum + 2_097_152) >> 22).clamp(0, 255)) as f64
        };
        (0..to).map(value).collect()
    }

    /// Both passes of [`axis`].
    fn reference(source: &[[u8; 3]], (w, h): (u32, u32), to: (u32, u32), filter: Filter) -> Vec<[u8; 3]> {
        let mut want = vec![[0; 3]; (to.0 * to.1) as usize];
        for c in 0..3 {
            let rows: Vec<Vec<f64>> = source
                .chunks_exact(w as usize)
                .map(|r| axis(&r.iter().map(|p| p[c]).collect::<Vec<_>>(), to.0 as usize, filter, false))
                .collect();
            for x in 0..to.0 as usize {
                let column: Vec<u8> = (0..h as usize).map(|y| rows[y][x] as u8).collect();
                for (y, v) in axis(&column, to.1 as usize, filter, false).into_iter().enumerate() {
                    want[y * to.0 as usize + x][c] = v as u8;
                }
            }
        }
        want
    }

    #[test]
    fn a_pass_differs_from_double_precision_only_by_rounding() {
        let source = noise(3001, 1, 3);
        let line: Vec<u8> = source.iter().map(|p| p[1]).collect();
        for to in [1, 2, 37, 500, 2999, 4001] {
            let got = resample_bytes(&source, (3001, 1), (to, 1), Filter::Cubic);
            for (got, want) in got.iter().zip(axis(&line, to as usize, Filter::Cubic, true)) {
                assert!((f64::from(got[1]) - want).abs() < 0.501, "{to}: {got:?} for {want}");
            }
        }
    }

    const PILLOW_CUBIC: [u8; 45] = [
        93, 122, 134, 125, 157, 131, 135, 133, 138, 104, 120, 142, 112, 117, 128, 121, 136, 142, 108, 121, 130, 119, 148, 127, 131, 139,
        143, 118, 122, 142, 127, 154, 129, 135, 141, 138, 104, 112, 127, 114, 151, 131, 146, 146, 143,
    ];
    /// Sum of every byte times its position, counted from 1.
    const PILLOW_TRIANGLE: u32 = 29_056_511;

    #[test]
    fn bytes_equal_those_of_pillow() {
        // Image.fromarray(a).resize((5, 3), Image.Resampling.BICUBIC), where a[y, x, c] = (x * 37 + y * 91 + c * 53) % 256 of 11 × 8
        let source: Vec<[u8; 3]> =
            (0..88u32).map(|i| std::array::from_fn(|c| ((i % 11 * 37 + i / 11 * 91 + c as u32 * 53) % 256) as u8)).collect();
        let got = resample_bytes(&source, (11, 8), (5, 3), Filter::Cubic);
        assert_eq!(got.as_flattened(), PILLOW_CUBIC);
        let got = resample_bytes(&source, (11, 8), (13, 17), Filter::Triangle);
        let sum: u32 = got.as_flattened().iter().zip(1..).map(|(&v, k)| u32::from(v) * k).sum();
        assert_eq!(sum, PILLOW_TRIANGLE);
    }

    proptest! {
        #[test]
        fn constant_pictures_stay_constant(w in 1u32..40, h in 1u32..40, to_w in 1u32..40, to_h in 1u32..40, v in any::<[u8; 3]>()) {
            for filter in [Filter::Cubic, Filter::Triangle, Filter::Lanczos3] {
                let got = resample_bytes(&vec![v; (w * h) as usize], (w, h), (to_w, to_h), filter);
                prop_assert_eq!(got.len(), (to_w * to_h) as usize);
                prop_assert!(got.iter().all(|p| *p == v));
            }
        }

        #[test]
        fn any_sizes_agree_with_64_bit_sums_over_the_whole_line(
            w in 1u32..50, h in 1u32..50, to_w in prop::option::of(1u32..50), to_h in prop::option::of(1u32..50), seed in any::<u32>(),
        ) {
            let (source, to_w, to_h) = (noise(w, h, seed), to_w.unwrap_or(w), to_h.unwrap_or(h));
            for filter in [Filter::Cubic, Filter::Triangle, Filter::Lanczos3] {
                prop_assert_eq!(resample_bytes(&source, (w, h), (to_w, to_h), filter), reference(&source, (w, h), (to_w, to_h), filter));
            }
        }
    }
}
