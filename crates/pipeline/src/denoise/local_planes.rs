//! Cleans a noisy disparity map without a network, by planes fitted around each pixel, and measures how noisy a map is.
//!
//! A disparity map is flat or sloping between its edges, so the value of a plane fitted to hundreds of neighbours is far less noisy than
//! any of them. Neighbours are weighted by their similarity in the previous round's map, so that a plane ends at an edge. There are three
//! rounds, each with a larger window and a stricter similarity (adaptive weights as in Polzehl and Spokoiny 2000).
//! `training/eval_theta.py` compares this with the other methods.

use rayon::prelude::*;

use super::median_guided;
use tmpi_core::DisparityMap;

/// Per round: window radius in pixels, deviation of the distance weight in pixels, and the difference that still counts as similar, in
/// deviations of the noise.
const ROUNDS: [(i32, f32, f32); 3] = [(6, 3.0, 1.7), (10, 5.0, 0.9), (14, 7.0, 0.6)];
/// Added to the second moments: a window with few similar neighbours gives their mean instead of a plane through them.
const RIDGE: f32 = 2.0;
/// Deviation from which a map counts as noisy. 16-bit and 8-bit maps without noise stay below it, maps with noise of 1/300 of their range
/// above.
const NOISY: f32 = 1.5e-3;
/// Share of single outliers from which they are removed.
const SPOTTED: f64 = 1e-3;
/// How far beyond all its neighbours an outlier lies, in δ.
const BEYOND: f32 = 0.05;
/// Noise below which the similarity does not become stricter.
const LEAST: f32 = 0.01;

/// How degraded a map is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Degradation {
    /// Standard deviation of the noise that differs from pixel to pixel, in δ; 0 if the map does not count as noisy.
    pub noise: f32,
    /// Share of pixels, 0 to 1, that lie far beyond all eight neighbours.
    pub outliers: f64,
}

impl Degradation {
    /// Measures a finite map. Noise is the median of mixed second differences (Immerkær 1996), which edges and slopes hardly change.
    pub fn of(map: &DisparityMap) -> Self {
        let (w, h) = (map.width as usize, map.height as usize);
        if w < 3 || h < 3 {
            return Self { noise: 0.0, outliers: 0.0 };
        }
        // the mixed second difference at each pixel of a row, and whether the pixel is an outlier
        let second = |y: usize| {
            let row = |y: usize| &map.delta[y * w..(y + 1) * w];
            let (a, b, c) = (row(y - 1), row(y), row(y + 1));
            (1..w - 1).map(move |x| {
                let corners = [a[x - 1], a[x + 1], c[x - 1], c[x + 1]];
                let sides = [a[x], b[x - 1], b[x + 1], c[x]];
                let around = corners.iter().chain(&sides);
                let (low, high) = around.fold((f32::INFINITY, f32::NEG_INFINITY), |(l, u), &v| (l.min(v), u.max(v)));
                let is_beyond = b[x] > high + BEYOND || b[x] < low - BEYOND;
                ((corners.iter().sum::<f32>() - 2.0 * sides.iter().sum::<f32>() + 4.0 * b[x]).abs(), is_beyond)
            })
        };
        // the root of the weights' sum of squares is 6; a normal deviate is below .6745 half of the time
        let deviation = |second: f32| second / 0.6745 / 6.0;
        let counted = |y: usize| {
            second(y).fold([0, 0], |[calm, beyond], (second, is_beyond)| {
                [calm + usize::from(deviation(second) < NOISY), beyond + usize::from(is_beyond)]
            })
        };
        let [calm, beyond] = (1..h - 1).into_par_iter().map(counted).reduce(|| [0, 0], |a, b| [a[0] + b[0], a[1] + b[1]]);
        let middle = (w - 2) * (h - 2) / 2;
        // the median takes long, and is not noisy if more than half of the values are not
        let noise = if calm > middle {
            0.0
        } else {
            let mut all: Vec<f32> = (1..h - 1).into_par_iter().flat_map_iter(|y| second(y).map(|s| s.0)).collect();
            deviation(*all.select_nth_unstable_by(middle, f32::total_cmp).1)
        };
        Self { noise, outliers: beyond as f64 / (w * h) as f64 }
    }

    /// Whether cleaning helps.
    pub fn found(self) -> bool {
        self.noisy() || self.outliers >= SPOTTED
    }

    fn noisy(self) -> bool {
        self.noise >= NOISY
    }
}

/// Cleans a map; the result is within 0..=1. Returns the same map if [`Degradation::found`] is false.
pub fn denoise(map: &DisparityMap) -> DisparityMap {
    let damage = Degradation::of(map);
    if !damage.found() {
        return map.clone();
    }
    let middle = median_guided::median(map);
    if !damage.noisy() {
        let delta = map.delta.iter().zip(&middle.delta).map(|(&d, &m)| if (d - m).abs() > BEYOND { m } else { d }).collect();
        return DisparityMap { delta, ..*map };
    }
    let size = (map.width as usize, map.height as usize);
    let mut guide = blurred(&middle.delta, size);
    for (radius, spread, alike) in ROUNDS {
        guide = fitted(&map.delta, &guide, size, radius, spread, alike * damage.noise.max(LEAST));
    }
    DisparityMap { delta: guide, ..*map }
}

/// Gaussian blur with a deviation of 1 pixel.
fn blurred(values: &[f32], (w, h): (usize, usize)) -> Vec<f32> {
    const KERNEL: [f32; 7] = [0.004_433, 0.054_006, 0.242_036, 0.399_05, 0.242_036, 0.054_006, 0.004_433];
    let at = |i: usize, k: usize, n: usize| (i + k).saturating_sub(3).min(n - 1);
    let across: Vec<f32> =
        (0..w * h).into_par_iter().map(|i| (0..7).map(|k| KERNEL[k] * values[i - i % w + at(i % w, k, w)]).sum()).collect();
    (0..w * h).into_par_iter().map(|i| (0..7).map(|k| KERNEL[k] * across[at(i / w, k, h) * w + i % w]).sum()).collect()
}

/// Value at each pixel of the plane fitted to `values` in a disc around it, weighted by distance and by similarity in `guide`.
fn fitted(values: &[f32], guide: &[f32], (w, h): (usize, usize), radius: i32, spread: f32, tolerance: f32) -> Vec<f32> {
    let r = radius as usize;
    // padded by repeating the border, so that inner loops have no bounds to check
    let wide = w + 2 * r;
    let padded = |source: &[f32]| -> Vec<f32> {
        let row = |y: usize| &source[y.saturating_sub(r).min(h - 1) * w..][..w];
        (0..h + 2 * r).flat_map(|y| (0..wide).map(move |x| row(y)[x.saturating_sub(r).min(w - 1)])).collect()
    };
    let (values, around) = (padded(values), padded(guide));
    let sharp = 1.0 / (8.0 * tolerance * tolerance);
    let mut out = vec![0f32; w * h];
    out.par_chunks_mut(w).enumerate().for_each(|(y, out)| {
        let own = &guide[y * w..(y + 1) * w];
        let mut sums: [Vec<f32>; 9] = std::array::from_fn(|_| vec![0f32; w]);
        for dy in -radius..=radius {
            let line = (y as i32 + radius + dy) as usize * wide;
            for dx in -radius..=radius {
                let square = dx * dx + dy * dy;
                if square > radius * radius {
                    continue;
                }
                let near = (-(square as f32) / (2.0 * spread * spread)).exp();
                let from = line + (radius + dx) as usize;
                let (fx, fy) = (dx as f32, dy as f32);
                let [s, sx, sy, sxx, sxy, syy, t, tx, ty] = sums.each_mut().map(|v| &mut v[..w]);
                let (v, g) = (&values[from..from + w], &around[from..from + w]);
                for x in 0..w {
                    let difference = g[x] - own[x];
                    // close to exp(−d²/2), without an exponential
                    let like = (1.0 - difference * difference * sharp).max(0.0);
                    let like = like * like;
                    let weight = near * like * like;
                    let value = weight * v[x];
                    s[x] += weight;
                    sx[x] += weight * fx;
                    sy[x] += weight * fy;
                    sxx[x] += weight * fx * fx;
                    sxy[x] += weight * fx * fy;
                    syy[x] += weight * fy * fy;
                    t[x] += value;
                    tx[x] += value * fx;
                    ty[x] += value * fy;
                }
            }
        }
        for (x, o) in out.iter_mut().enumerate() {
            *o = centre(&std::array::from_fn(|k| f64::from(sums[k][x]))).clamp(0.0, 1.0) as f32;
        }
    });
    out
}

/// Value of the fitted plane in the middle of its window, by Cramer's rule, from the sums of 1, x, y, xx, xy, yy, v, vx, vy.
fn centre(&[s, x, y, xx, xy, yy, t, tx, ty]: &[f64; 9]) -> f64 {
    let (xx, yy) = (xx + f64::from(RIDGE), yy + f64::from(RIDGE));
    let minor = xx * yy - xy * xy;
    let (p, q) = (x * yy - y * xy, y * xx - x * xy);
    // positive, because the pixel itself has weight 1 and the ridge is positive
    let whole = s * minor - x * p - y * q;
    if whole <= 0.0 {
        return t / s.max(1e-12);
    }
    (t * minor - tx * p - ty * q) / whole
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two slopes that meet at a step.
    fn clean(w: u32, h: u32) -> DisparityMap {
        let delta = (0..w * h).map(|i| (i % w, i / w)).map(|(x, y)| {
            let far = 0.2 + 0.1 * y as f32 / h as f32;
            if x < w / 2 { far } else { 0.6 + 0.2 * x as f32 / w as f32 }
        });
        DisparityMap { width: w, height: h, delta: delta.collect() }
    }

    /// Normal deviates as sums of twelve uniform ones.
    fn noise(i: usize) -> f32 {
        (0..12).map(|k| tmpi_testing::pictures::noise(i as u32, k)).sum::<f32>() - 6.0
    }

    fn with_noise(map: &DisparityMap, deviation: f32) -> DisparityMap {
        DisparityMap { delta: map.delta.iter().enumerate().map(|(i, d)| (d + deviation * noise(i)).clamp(0.0, 1.0)).collect(), ..*map }
    }

    #[test]
    fn noise_is_measured_and_a_clean_map_keeps_every_bit() {
        let map = clean(120, 90);
        assert_eq!(denoise(&map), map);
        let coarse = DisparityMap { delta: map.delta.iter().map(|d| (d * 255.0).round() / 255.0).collect(), ..map };
        assert_eq!(denoise(&coarse), coarse, "rounding to 8 bits is not noise");
        assert!(Degradation::of(&with_noise(&map, 0.001)).noise.abs() < 1e-12, "too little to count");
        for deviation in [0.002, 0.003, 0.01, 0.0316] {
            let got = Degradation::of(&with_noise(&map, deviation)).noise;
            assert!((got / deviation - 1.0).abs() < 0.15, "{deviation}: {got}");
        }
    }

    #[test]
    fn fitted_values_agree_with_least_squares() {
        let (w, h) = (21, 17);
        let values: Vec<f32> = (0..w * h).map(|i| 0.5 + 0.1 * noise(i)).collect();
        let guide: Vec<f32> = (0..w * h).map(|i| 0.5 + 0.05 * noise(i + 999)).collect();
        let got = fitted(&values, &guide, (w, h), 4, 2.0, 0.05);
        for (x, y) in [(10usize, 8usize), (0, 0), (20, 3)] {
            // normal equations by elimination, in f64
            let mut a = [[0f64; 4]; 3];
            for dy in -4i32..=4 {
                for dx in -4i32..=4 {
                    if dx * dx + dy * dy > 16 {
                        continue;
                    }
                    let i = (y as i32 + dy).clamp(0, h as i32 - 1) as usize * w + (x as i32 + dx).clamp(0, w as i32 - 1) as usize;
                    let d = f64::from(guide[i] - guide[y * w + x]);
                    let weight = (1.0 - d * d / (8.0 * 0.0025)).max(0.0).powi(4) * (-f64::from(dx * dx + dy * dy) / 8.0).exp();
                    let basis = [1.0, f64::from(dx), f64::from(dy)];
                    for (row, b) in a.iter_mut().zip(basis) {
                        for k in 0..3 {
                            row[k] += weight * b * basis[k];
                        }
                        row[3] += weight * b * f64::from(values[i]);
                    }
                }
            }
            a[1][1] += 2.0;
            a[2][2] += 2.0;
            for p in 0..3 {
                let pivot = a[p];
                for (q, row) in a.iter_mut().enumerate() {
                    if q != p {
                        let f = row[p] / pivot[p];
                        row.iter_mut().zip(pivot).for_each(|(v, p)| *v -= f * p);
                    }
                }
            }
            let want = (a[0][3] / a[0][0]).clamp(0.0, 1.0);
            assert!((f64::from(got[y * w + x]) - want).abs() < 1e-4, "({x}, {y}): {} {want}", got[y * w + x]);
        }
    }
}
