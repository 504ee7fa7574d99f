//! Kernels by their definitions, in `f64`, without any cleverness.

use tmpi_core::{DisparityMap, Photo, Plane};
use tmpi_pipeline::planes::Samples;

/// Half the window of the guided filter, as a share of the root of the pixels, and what is added to a variance.
const RADIUS: f64 = 0.006;
const EPSILON: f64 = 1e-4;

/// Pixels at which the guided filter fits.
const WORK: f64 = 100_000.0;

/// The guided filter by colour (He, Sun and Tang 2010): `δ = a · rgb + b` fitted in each window of photo and map at the working size, the models of
/// all windows about a pixel in the mean, linear between the pixels of the working size, applied to the photo's own colours.
pub(super) fn guided(photo: &Photo, map: &DisparityMap) -> Vec<f64> {
    let own = [photo.width as usize, photo.height as usize];
    let scale = (WORK / (own[0] * own[1]) as f64).sqrt().min(1.0);
    let [w, h] = own.map(|n| (n as f64 * scale).round().max(1.0) as usize);
    let colours: Vec<[f64; 3]> = photo.rgb.iter().map(|p| p.map(|v| f64::from(v) / 255.0)).collect();
    let guide = triangle(&colours, own, [w, h]);
    let known: Vec<[f64; 1]> = map.delta.iter().map(|d| [f64::from(*d)]).collect();
    let delta = triangle(&known, [map.width as usize, map.height as usize], [w, h]);
    let radius = ((w as f64 * h as f64).sqrt() * RADIUS).round().max(1.0) as usize;
    let window = |i: usize| {
        let (x, y) = (i % w, i / w);
        let columns = x.saturating_sub(radius)..(x + radius + 1).min(w);
        (y.saturating_sub(radius)..(y + radius + 1).min(h)).flat_map(move |y| columns.clone().map(move |x| y * w + x))
    };
    let model = |i: usize| {
        let n = window(i).count() as f64;
        let mean = |f: &dyn Fn(usize) -> f64| window(i).map(f).sum::<f64>() / n;
        let (c, d): ([f64; 3], f64) = (std::array::from_fn(|k| mean(&|j| guide[j][k])), mean(&|j| delta[j][0]));
        let mut system = [[0.0; 4]; 3];
        for (row, line) in system.iter_mut().enumerate() {
            for (column, value) in line.iter_mut().enumerate() {
                *value = mean(&|j| {
                    let other = if column < 3 { guide[j][column] - c[column] } else { delta[j][0] - d };
                    (guide[j][row] - c[row]) * other
                });
            }
            line[row] += EPSILON;
        }
        let a = solved(system);
        [a[0], a[1], a[2], d - a.iter().zip(c).map(|(a, c)| a * c).sum::<f64>()]
    };
    let models: Vec<[f64; 4]> = (0..w * h).map(model).collect();
    let means: Vec<[f64; 4]> =
        (0..w * h).map(|i| std::array::from_fn(|k| window(i).map(|j| models[j][k]).sum::<f64>() / window(i).count() as f64)).collect();
    let applied = |(c, m): (&[f64; 3], [f64; 4])| (c.iter().zip(m).map(|(c, m)| c * m).sum::<f64>() + m[3]).clamp(0.0, 1.0);
    colours.iter().zip(triangle(&means, [w, h], own)).map(applied).collect()
}

/// Resampling by a triangle about each sample's place, as wide as the coarser of both sizes asks for.
fn triangle<const C: usize>(source: &[[f64; C]], from: [usize; 2], to: [usize; 2]) -> Vec<[f64; C]> {
    let taps = |axis: usize, i: usize| {
        let ratio = from[axis] as f64 / to[axis] as f64;
        let weight = move |j: usize| 1.0 - (j as f64 + 0.5 - (i as f64 + 0.5) * ratio).abs() / ratio.max(1.0);
        (0..from[axis]).map(move |j| (j, weight(j))).filter(|t| t.1 > 0.0).collect::<Vec<_>>()
    };
    let [across, down] = [0, 1].map(|axis| (0..to[axis]).map(|i| taps(axis, i)).collect::<Vec<_>>());
    let value = |i: usize| {
        let (mut sum, mut weight) = ([0.0; C], 0.0);
        for (y, v) in &down[i / to[0]] {
            for (x, u) in &across[i % to[0]] {
                sum = std::array::from_fn(|c| sum[c] + u * v * source[y * from[0] + x][c]);
                weight += u * v;
            }
        }
        sum.map(|s| s / weight)
    };
    (0..to[0] * to[1]).map(value).collect()
}

/// What a sample of a map at another size may be: so much, or any of these where they belong to two surfaces.
pub(super) struct Resized {
    pub mean: f64,
    pub samples: Vec<f64>,
}

/// A map at another size: linear between samples where a side grows, and the mean of what a sample covers where it shrinks.
pub(super) fn resized(map: &DisparityMap, to: (u32, u32)) -> Vec<Resized> {
    let taps = |n: u32, to: u32, i: u32| {
        let ratio = f64::from(n) / f64::from(to);
        let at = (f64::from(i) + 0.5) * ratio;
        let weight = move |j: u32| {
            let j = f64::from(j);
            let linear = |edge: f64| 1.0 - (j + 0.5 - edge.clamp(0.5, f64::from(n) - 0.5)).abs();
            if ratio > 1.0 { (j + 1.0).min(at + ratio / 2.0) - j.max(at - ratio / 2.0) } else { linear(at) }
        };
        (0..n).map(move |j| (j as usize, weight(j))).filter(|t| t.1 > 1e-9).collect::<Vec<_>>()
    };
    let value = |(y, x): (u32, u32)| {
        let (across, down) = (taps(map.width, to.0, x), taps(map.height, to.1, y));
        let all = down.iter().flat_map(|(y, v)| across.iter().map(move |(x, u)| (f64::from(map.delta[y * map.width as usize + x]), u * v)));
        let all: Vec<(f64, f64)> = all.collect();
        let weight: f64 = all.iter().map(|a| a.1).sum();
        Resized { mean: all.iter().map(|a| a.0 * a.1 / weight).sum(), samples: all.iter().map(|a| a.0).collect() }
    };
    (0..to.1).flat_map(|y| (0..to.0).map(move |x| (y, x))).map(value).collect()
}

/// Gauss's elimination with the largest pivot.
fn solved(mut system: [[f64; 4]; 3]) -> [f64; 3] {
    for k in 0..3 {
        let pivot = (k..3).max_by(|a, b| system[*a][k].abs().total_cmp(&system[*b][k].abs())).unwrap_or(k);
        system.swap(k, pivot);
        for row in 0..3 {
            if row != k {
                let share = system[row][k] / system[k][k];
                for column in 0..4 {
                    system[row][column] -= share * system[k][column];
                }
            }
        }
    }
    std::array::from_fn(|k| system[k][3] / system[k][k])
}

/// Iterated conditional modes (Besag 1986): pixel by pixel, four times over, each takes the label of itself or of one of its four neighbours that
/// costs the least. A label costs the square of its error in units of the target, and so much for each of the eight neighbours that has another;
/// another label than before may be off by the target at most.
pub(super) fn smoothed_labels(s: &Samples, planes: &[Plane], labels: &mut [u8], target: f64, neighbour: f64) {
    let (w, h) = (s.width, labels.len() / s.width);
    let error =
        |i: usize, l: u8| (planes[usize::from(l)].disparity(f64::from(s.u[i]), f64::from(s.v[i])) - f64::from(s.delta[i])).abs() / target;
    for i in (0..4).flat_map(|_| 0..w * h) {
        let (x, y) = (i % w, i / w);
        let around = (y.saturating_sub(1)..(y + 2).min(h)).flat_map(|y| (x.saturating_sub(1)..(x + 2).min(w)).map(move |x| y * w + x));
        let near: Vec<usize> = around.filter(|j| *j != i).collect();
        let cost = |l: u8, labels: &[u8]| error(i, l).powi(2) + neighbour * near.iter().filter(|j| labels[**j] != l).count() as f64;
        let sides = [(y > 0).then(|| i - w), (y + 1 < h).then(|| i + w), (x > 0).then(|| i - 1), (x + 1 < w).then(|| i + 1)];
        let mut best = labels[i];
        for l in sides.into_iter().flatten().map(|j| labels[j]) {
            if error(i, l) <= 1.0 && cost(l, labels) < cost(best, labels) {
                best = l;
            }
        }
        labels[i] = best;
    }
}
