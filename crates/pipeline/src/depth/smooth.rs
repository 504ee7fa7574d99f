//! Smooths a network's map up to the photo's edges: weighted least squares, solved line by line (Min et al. 2014).
//!
//! A network that blurs edges leaves haloes many pixels wide. Each line in turn minimises `Σ (u − d)² + λ Σ w (u − u′)²` over neighbours,
//! with `w = exp(−|colour difference| / σ)`, so that disparity spreads within a surface and stops at its edge. `models/depth.md` has a
//! table of error by λ, and the commands for it. Every line is a tridiagonal system with a dominant diagonal: it is stable for any λ, and
//! no value leaves the input's range.

use rayon::prelude::*;

/// Colour distance (RGB in 0..=1) over which a weight falls to 1/e.
const SIGMA: f64 = 0.04;
/// Rounds along rows and columns; each round is four times weaker than the one before.
const ROUNDS: i32 = 3;

/// Smooths `delta`, of `width` columns, by a guide (RGB in 0..=1) of the same size. `lambda` is the strength; 0 changes nothing.
pub(super) fn smooth(guide: &[[f32; 3]], delta: &[f32], width: usize, lambda: f64) -> Vec<f32> {
    let height = delta.len() / width;
    let mut map = delta.to_vec();
    if lambda <= 0.0 {
        return map;
    }
    let across = weights(guide, width);
    let down = weights(&transposed(guide, width), height);
    for round in 1..=ROUNDS {
        let strength = 1.5 * lambda * 4f64.powi(ROUNDS - round) / (4f64.powi(ROUNDS) - 1.0);
        lines(&mut map, &across, width, strength);
        let mut turned = transposed(&map, width);
        lines(&mut turned, &down, height, strength);
        map = transposed(&turned, height);
    }
    map
}

/// Weight between each pixel and the next in its line; 0 at the end of a line.
fn weights(guide: &[[f32; 3]], width: usize) -> Vec<f64> {
    let weight = |a: &[f32; 3], b: &[f32; 3]| {
        let distance = (0..3).map(|c| f64::from(a[c] - b[c]).powi(2)).sum::<f64>().sqrt();
        (-distance / SIGMA).exp()
    };
    let mut out = vec![0.0; guide.len()];
    for (out, line) in out.chunks_exact_mut(width).zip(guide.chunks_exact(width)) {
        for (o, pair) in out.iter_mut().zip(line.windows(2)) {
            *o = weight(&pair[0], &pair[1]);
        }
    }
    out
}

fn transposed<T: Copy>(map: &[T], width: usize) -> Vec<T> {
    let height = map.len() / width;
    (0..width).flat_map(|x| (0..height).map(move |y| map[y * width + x])).collect()
}

/// Solves `(1 + λ L) u = d` for each line, where `L` is the line's weighted Laplacian.
fn lines(map: &mut [f32], weights: &[f64], width: usize, lambda: f64) {
    map.par_chunks_exact_mut(width).zip(weights.par_chunks_exact(width)).for_each(|(line, weights)| {
        // forward elimination, back substitution: `u[i] = value[i] + share[i] · u[i + 1]`
        let (mut share, mut value) = (vec![0f64; width], vec![0f64; width]);
        let (mut before, mut last_share, mut last_value) = (0.0, 0.0, 0.0);
        for i in 0..width {
            let after = lambda * weights[i];
            let pivot = 1.0 + after + before * (1.0 - last_share);
            (last_share, last_value) = (after / pivot, (f64::from(line[i]) + before * last_value) / pivot);
            (share[i], value[i], before) = (last_share, last_value, after);
        }
        let mut next = 0.0;
        for i in (0..width).rev() {
            next = value[i] + share[i] * next;
            line[i] = next as f32;
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Solves the same system by dense Gaussian elimination.
    fn by_elimination(line: &[f32], weights: &[f64], lambda: f64) -> Vec<f64> {
        let n = line.len();
        let mut a = vec![vec![0f64; n + 1]; n];
        for i in 0..n {
            a[i][i] += 1.0;
            a[i][n] = f64::from(line[i]);
            if i + 1 < n {
                let w = lambda * weights[i];
                a[i][i] += w;
                a[i + 1][i + 1] += w;
                a[i][i + 1] -= w;
                a[i + 1][i] -= w;
            }
        }
        for p in 0..n {
            for q in 0..n {
                if q != p {
                    let f = a[q][p] / a[p][p];
                    let pivot = a[p].clone();
                    a[q].iter_mut().zip(pivot).for_each(|(v, p)| *v -= f * p);
                }
            }
        }
        (0..n).map(|i| a[i][n] / a[i][i]).collect()
    }

    proptest! {
        #[test]
        fn lines_agree_with_elimination(line in prop::collection::vec(0f32..1.0, 1..40), seed in any::<u32>(), exponent in -3f64..7.0) {
            let lambda = 10f64.powf(exponent);
            let weights: Vec<f64> = (0..line.len()).map(|i| f64::from((i as u32 + 1).wrapping_mul(seed | 1) >> 8) / f64::from(1 << 24)).collect();
            let mut got = line.clone();
            let mut last = weights.clone();
            last[line.len() - 1] = 0.0;
            lines(&mut got, &last, line.len(), lambda);
            for (a, b) in got.iter().zip(by_elimination(&line, &last, lambda)) {
                prop_assert!((f64::from(*a) - b).abs() < 1e-5, "{a} {b}");
            }
            let (lo, hi) = line.iter().fold((1f32, 0f32), |m, &v| (m.0.min(v), m.1.max(v)));
            prop_assert!(got.iter().all(|&v| v >= lo - 1e-5 && v <= hi + 1e-5));
        }
    }

    #[test]
    fn disparity_spreads_within_a_surface_and_stops_at_its_edge() {
        let (w, h) = (60, 40);
        let guide: Vec<[f32; 3]> = (0..w * h).map(|i| if i % w < 30 { [0.2; 3] } else { [0.7; 3] }).collect();
        let halo: Vec<f32> = (0..w * h).map(|i| (((i % w) as f32 - 15.0) / 30.0).clamp(0.0, 1.0)).collect();
        let got = smooth(&guide, &halo, w, 3000.0);
        let row = &got[20 * w..21 * w];
        assert!(row[30] - row[29] > 0.5, "{} {}", row[29], row[30]);
        assert_eq!(smooth(&guide, &halo, w, 0.0), halo);
    }

    #[test]
    fn single_pixels_and_lines_stay_constant() {
        for (w, h) in [(1, 1), (1, 9), (9, 1)] {
            let guide = vec![[0.5; 3]; w * h];
            let got = smooth(&guide, &vec![0.25; w * h], w, 1e12);
            assert!(got.iter().all(|v| (v - 0.25).abs() < 1e-6));
        }
    }
}
