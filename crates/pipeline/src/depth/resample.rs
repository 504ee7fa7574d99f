//! Resamples disparity to another size without mixing across edges.

use rayon::prelude::*;
use tmpi_core::DisparityMap;

/// Range of neighbouring disparities above which they belong to two surfaces and are not mixed.
const EDGE: f32 = 0.03;

/// Resamples to another size. Enlarging is linear within a surface, and reducing takes the mean of what a sample covers. Where the source
/// samples belong to two surfaces, takes the nearest one, or their median if there are more than two in a line.
fn resize(source: &[f32], (w, h): (usize, usize), (width, height): (u32, u32)) -> DisparityMap {
    let (ratio_x, ratio_y) = (w as f64 / f64::from(width), h as f64 / f64::from(height));
    let columns: Vec<Covered> = (0..width as usize).map(|x| Covered::new(x, ratio_x, w)).collect();
    let mut delta = vec![0f32; width as usize * height as usize];
    delta.par_chunks_exact_mut(width as usize).enumerate().for_each(|(y, row)| {
        let rows = Covered::new(y, ratio_y, h);
        let mut window = Vec::new();
        for ((x, out), columns) in row.iter_mut().enumerate().zip(&columns) {
            window.clear();
            let mut mean = 0.0;
            for (line, weight) in source.chunks_exact(w).skip(rows.first).zip(&rows.weights) {
                let line = &line[columns.first..][..columns.weights.len()];
                window.extend_from_slice(line);
                mean += weight * line.iter().zip(&columns.weights).map(|(v, weight)| weight * f64::from(*v)).sum::<f64>();
            }
            let (lo, hi) = window.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |m, &v| (m.0.min(v), m.1.max(v)));
            *out = if hi - lo <= EDGE {
                // weights sum to 1 up to rounding
                (mean as f32).max(lo).min(hi)
            } else if ratio_x.max(ratio_y) <= 2.0 {
                let near = |i: usize, ratio: f64, n: usize| (((i as f64 + 0.5) * ratio) as usize).min(n - 1);
                source[near(y, ratio_y, h) * w + near(x, ratio_x, w)]
            } else {
                let middle = window.len() / 2;
                *window.select_nth_unstable_by(middle, f32::total_cmp).1
            };
        }
    });
    DisparityMap { width, height, delta }
}

/// Resamples a map to another size without mixing across edges.
pub fn resized(map: &DisparityMap, width: u32, height: u32) -> DisparityMap {
    resize(&map.delta, (map.width as usize, map.height as usize), (width, height))
}

/// Source samples along one axis that make up a sample of the result.
struct Covered {
    first: usize,
    /// Weights of the samples from `first` on; they sum to 1.
    weights: Vec<f64>,
}

impl Covered {
    /// Those of sample `i`, where `n` source samples are `ratio` times as many as the result has.
    fn new(i: usize, ratio: f64, n: usize) -> Self {
        if ratio <= 1.0 {
            // between two
            let at = ((i as f64 + 0.5) * ratio - 0.5).clamp(0.0, (n - 1) as f64);
            let (first, share) = (at as usize, at.fract());
            return Self { first, weights: if share > 0.0 { vec![1.0 - share, share] } else { vec![1.0] } };
        }
        let begin = i as f64 * ratio;
        let end = (begin + ratio).min(n as f64);
        // no slivers, which are rounding
        let first = ((begin + 1e-9) as usize).min(n - 1);
        let last = ((end - 1e-9) as usize).clamp(first, n - 1);
        let share = |s: usize| (end.min((s + 1) as f64) - begin.max(s as f64)) / (end - begin);
        Self { first, weights: (first..=last).map(share).collect() }
    }
}
