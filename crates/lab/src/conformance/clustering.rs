//! Clustering: planes of stiff tiles against plain `f64` clustering of the same pixels.

use super::Checked;
use tmpi_core::{DisparityMap, Grid, Plane, Tile};
use tmpi_pipeline::planes::{Method, Placement, place};
use tmpi_testing::pictures::noise;

const FAMILY: &str = "clustering";
pub(super) const METHODS: [(Method, &str); 4] =
    [(Method::Linear, "linear"), (Method::Lloyd, "lloyd"), (Method::Optimal, "optimal"), (Method::Slanted, "slanted")];
/// Planes lie on the container's grid: half a step each of three coefficients.
pub(super) const GRID: f64 = 1.5 * Plane::STEP;

/// Steepest slope of a plane in δ per half tile.
const MAX_SLOPE: f64 = 0.256;

/// A tile's pixels.
pub(super) struct Tiles {
    name: &'static str,
    width: u32,
    delta: Vec<f32>,
    weight: Option<Vec<f32>>,
}

/// A pixel in `f64`: place in half tiles, disparity, weight.
type Pixel = [f64; 4];

fn cases() -> Vec<Tiles> {
    let n = 4096;
    let tile = |name, width: u32, delta: Vec<f32>| Tiles { name, width, delta, weight: None };
    let full = |name, f: &dyn Fn(usize) -> f32| tile(name, 64, (0..n).map(f).collect());
    // the exact reference takes the square of the count of distinct values
    let wave = |i: usize| ((0.5 + 0.3 * ((i % 64) as f32 / 9.0).sin() * ((i / 64) as f32 / 7.0).cos()) * 400.0).round() / 400.0;
    vec![
        full("constant", &|_| 0.25),
        full("two values 1e-7 apart", &|i| if i % 2 == 0 { 0.5 } else { 0.5 + 1e-7 }),
        full("1e-8 and 1 together", &|i| if i % 2 == 0 { 1e-8 } else { 1.0 }),
        full("one outlier in 4 096", &|i| if i == 99 { 1.0 } else { 0.1 }),
        Tiles { weight: Some(vec![0.0; n]), ..full("all confidence 0", &|i| (i % 7) as f32 / 7.0) },
        Tiles { weight: Some(vec![f32::NAN; n]), ..full("all confidence NaN", &|i| (i % 3) as f32 / 3.0) },
        full("NaN, infinite and negative", &|i| [0.3, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -0.5][i % 5]),
        full("all NaN", &|_| f32::NAN),
        full("3 distinct values", &|i| [0.2, 0.4, 0.9][i % 3]),
        Tiles {
            weight: Some((0..n).map(|i| if i % 2 == 0 { 1.0 } else { 1e4 }).collect()),
            ..full("weights 1 to 10 000", &|i| (i % 9) as f32 / 9.0)
        },
        full("smooth", &wave),
        full("one value of 3e38", &|i| if i == 3 { f32::MAX } else { 0.5 }),
        full("steep ramp", &|i| (i % 64) as f32 / 64.0),
        full("step on a ramp", &|i| if i % 64 < 20 { 0.8 } else { 0.1 + 0.002 * (i / 64) as f32 }),
        tile("3 values, two of them in one bin", 3, vec![0.778_965_83, 0.0, 0.776_459_34]),
        tile("11 values of noise", 11, (0..11).map(|i| noise(i, 0)).collect()),
        tile("256 values of noise", 16, (0..256).map(|i| noise(i, 1)).collect()),
        tile("1×1", 1, vec![0.7]),
        tile("1×64", 1, (0..64).map(|i| i as f32 / 64.0).collect()),
        tile("64×1", 64, (0..64).map(|i| i as f32 / 64.0).collect()),
    ]
}

impl Tiles {
    pub(super) fn place(&self, method: Method, n: u32) -> Tile {
        let height = self.delta.len() as u32 / self.width;
        let map = DisparityMap { width: self.width, height, delta: self.delta.clone() };
        let grid = Grid::new(self.width, height, 64);
        place(&map, self.weight.as_deref(), &grid, &Placement::fixed(method, n)).into_iter().next().unwrap_or_default()
    }

    /// All pixels, and the weights as they are documented: 0 where a value is not finite, all 1 where no weight is left.
    fn pixels(&self) -> Vec<Pixel> {
        let mut all: Vec<Pixel> = (0..self.delta.len())
            .map(|i| {
                let at = |v: usize| (v as f64 + 0.5 - 32.0) / 32.0;
                let (d, w) = (self.delta[i], self.weight.as_ref().map_or(1.0, |w| w[i]));
                let known = d.is_finite();
                let w = if known && w.is_finite() && w > 0.0 { f64::from(w) } else { 0.0 };
                [at(i % self.width as usize), at(i / self.width as usize), if known { d.into() } else { 0.0 }, w]
            })
            .collect();
        if all.iter().all(|p| p[3] == 0.0) {
            for p in &mut all {
                p[3] = 1.0;
            }
        }
        all
    }
}

fn distance(p: &Pixel, q: &Plane) -> f64 {
    (q.disparity(p[0], p[1]) - p[2]).abs()
}

/// Weighted root mean square distance to the nearest plane, without the farthest `spared` share of the pixels.
fn rms(pixels: &[Pixel], planes: &[Plane], spared: f64) -> f64 {
    let nearest = |p: &Pixel| planes.iter().map(|q| distance(p, q)).fold(f64::INFINITY, f64::min);
    let mut all: Vec<(f64, f64)> = pixels.iter().map(|p| (nearest(p), p[3])).collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    all.truncate(all.len() - (all.len() as f64 * spared) as usize);
    let (sum, weight) = all.iter().fold((0.0, 0.0), |(s, w), (e, pw)| (s + pw * e * e, w + pw));
    if weight > 0.0 { (sum / weight).sqrt() } else { 0.0 }
}

/// Distinct values, ascending, with their weights.
fn distinct(pixels: &[Pixel]) -> Vec<(f64, f64)> {
    let mut all: Vec<(f64, f64)> = pixels.iter().filter(|p| p[3] > 0.0).map(|p| (p[2], p[3])).collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    all.dedup_by(|b, a| {
        // the very same value, bit for bit
        let same = a.0.total_cmp(&b.0).is_eq();
        a.1 += if same { b.1 } else { 0.0 };
        same
    });
    all
}

fn flat(centres: impl IntoIterator<Item = f64>) -> Vec<Plane> {
    centres.into_iter().map(Plane::fronto_parallel).collect()
}

/// Centres evenly spaced between the extremes, both included.
fn linear(points: &[(f64, f64)], n: usize) -> Vec<Plane> {
    let (lo, hi) = (points[0].0, points[points.len() - 1].0);
    if n == 1 || lo >= hi {
        return flat([f64::midpoint(lo, hi)]);
    }
    flat((0..n).map(|i| lo + (hi - lo) * i as f64 / (n - 1) as f64))
}

/// Weighted k-means from evenly spaced starts.
fn lloyd(points: &[(f64, f64)], n: usize) -> Vec<Plane> {
    let (lo, hi) = (points[0].0, points[points.len() - 1].0);
    let mut centres: Vec<f64> = (0..n).map(|i| lo + (hi - lo) * (i as f64 + 0.5) / n as f64).collect();
    for _ in 0..200 {
        let mut sums = vec![(0.0, 0.0); centres.len()];
        for &(d, w) in points {
            let near = (0..centres.len()).min_by(|&a, &b| (centres[a] - d).abs().total_cmp(&(centres[b] - d).abs())).unwrap_or(0);
            sums[near] = (sums[near].0 + w, sums[near].1 + w * d);
        }
        let next: Vec<f64> = sums.iter().filter(|s| s.0 > 0.0).map(|s| s.1 / s.0).collect();
        if next == centres {
            break;
        }
        centres = next;
    }
    flat(centres)
}

/// The values of each bin of the histogram as one, their mean: 256 bins, or 16 a plane where those are more.
fn binned(points: &[(f64, f64)], n: usize) -> Vec<(f64, f64)> {
    let (lo, hi, bins) = (points[0].0, points[points.len() - 1].0, 256.max(16 * n));
    let scale = if hi > lo { bins as f64 / (hi - lo) } else { 0.0 };
    let bin = |p: &(f64, f64)| (((p.0 - lo) * scale) as usize).min(bins - 1);
    let mean = |some: &[(f64, f64)]| {
        let (sum, weight) = some.iter().fold((0.0, 0.0), |(s, w), p| (s + p.0 * p.1, w + p.1));
        (sum / weight, weight)
    };
    points.chunk_by(|a, b| bin(a) == bin(b)).map(mean).collect()
}

/// Least weighted sum of squares of `n` runs: every split tried, sums taken about each run's own mean.
fn exact(points: &[(f64, f64)], n: usize) -> Vec<Plane> {
    let len = points.len();
    let n = n.min(len);
    // cost[a][b - a]: of points a to b, grown one by one with a running mean
    let cost: Vec<Vec<(f64, f64)>> = (0..len)
        .map(|a| {
            let (mut w, mut mean, mut q) = (0.0, 0.0, 0.0);
            points[a..]
                .iter()
                .map(|&(d, pw)| {
                    w += pw;
                    let off = d - mean;
                    mean += off * pw / w;
                    q += pw * off * (d - mean);
                    (q, mean)
                })
                .collect()
        })
        .collect();
    // best[k][b]: cost of the first b points in k runs, and where the last one starts
    let mut best = vec![vec![(f64::INFINITY, 0); len + 1]; n + 1];
    best[0][0] = (0.0, 0);
    for k in 1..=n {
        for b in 1..=len {
            for a in 0..b {
                let c = best[k - 1][a].0 + cost[a][b - a - 1].0;
                if c < best[k][b].0 {
                    best[k][b] = (c, a);
                }
            }
        }
    }
    let (mut end, mut centres) = (len, Vec::new());
    for k in (1..=n).rev() {
        let start = best[k][end].1;
        centres.push(cost[start][end - start - 1].1);
        end = start;
    }
    flat(centres)
}

/// Weighted least squares, centred, with the library's bound on slopes; fronto-parallel where pixels lie on a line or a point.
fn fit(pixels: &[Pixel]) -> Option<Plane> {
    let sum = |f: &dyn Fn(&Pixel) -> f64| pixels.iter().map(|p| p[3] * f(p)).sum::<f64>();
    let w = sum(&|_| 1.0);
    if w <= 0.0 {
        return None;
    }
    let (u, v, d) = (sum(&|p| p[0]) / w, sum(&|p| p[1]) / w, sum(&|p| p[2]) / w);
    // the same ridge as in the library, so that the same planes are compared
    let ridge = 1e-4 * w + 0.02;
    let (uu, vv) = (sum(&|p| (p[0] - u).powi(2)) + ridge, sum(&|p| (p[1] - v).powi(2)) + ridge);
    let uv = sum(&|p| (p[0] - u) * (p[1] - v));
    let (ud, vd) = (sum(&|p| (p[0] - u) * (p[2] - d)), sum(&|p| (p[1] - v) * (p[2] - d)));
    let det = uu * vv - uv * uv;
    let limit = |s: f64| s.clamp(-MAX_SLOPE, MAX_SLOPE);
    let (b, c) = (limit((ud * vv - vd * uv) / det), limit((vd * uu - ud * uv) / det));
    Some(Plane { a: d - b * u - c * v, b, c })
}

/// k-planes on all pixels from the labels of one-dimensional k-means.
fn planes(pixels: &[Pixel], n: usize) -> Vec<Plane> {
    let mut planes = lloyd(&distinct(pixels), n);
    for _ in 0..60 {
        let mut sets = vec![Vec::new(); planes.len()];
        for p in pixels {
            let near = (0..planes.len()).min_by(|&a, &b| distance(p, &planes[a]).total_cmp(&distance(p, &planes[b]))).unwrap_or(0);
            sets[near].push(*p);
        }
        let next: Vec<Plane> = sets.iter().zip(&planes).map(|(s, old)| fit(s).unwrap_or(*old)).collect();
        if next == planes {
            break;
        }
        planes = next;
    }
    planes
}

/// Errors that the case's planes have beyond those of the reference, in δ; infinite where they are not planes and labels at all.
fn excess(tile: &Tile, pixels: &[Pixel], method: Method, n: u32) -> f64 {
    let sound = !tile.planes.is_empty()
        && tile.planes.len() <= n as usize
        && tile.planes.iter().all(Plane::is_finite)
        && tile.labels.len() == pixels.len()
        && tile.labels.iter().all(|&l| usize::from(l) < tile.planes.len());
    // slopes are bounded, or planes would run out of their range within the tile
    let steep = |p: &Plane| p.b.abs().max(p.c.abs()) > MAX_SLOPE + Plane::STEP;
    if !sound || tile.planes.iter().any(steep) {
        return f64::INFINITY;
    }
    // every label must be the nearest plane's
    let label = pixels.iter().zip(&tile.labels).map(|(p, &l)| {
        distance(p, &tile.planes[usize::from(l)]) - tile.planes.iter().map(|q| distance(p, q)).fold(f64::INFINITY, f64::min)
    });
    let points = distinct(pixels);
    let want = match method {
        Method::Linear => linear(&points, n as usize),
        Method::Lloyd => lloyd(&binned(&points, 1), n as usize),
        Method::Optimal => exact(&binned(&points, n as usize), n as usize),
        Method::Slanted if n == 1 => fit(pixels).into_iter().collect(),
        Method::Slanted => planes(pixels, n as usize),
    };
    // slanted planes are placed by the 99th percentile: one pixel in a hundred may lie anywhere
    let spared = if method == Method::Slanted && n > 1 { 0.01 } else { 0.0 };
    let more = rms(pixels, &tile.planes, spared) - rms(pixels, &want, spared);
    more.max(label.fold(0.0, f64::max))
}

pub(super) fn run(checked: &mut Checked) {
    clustering(checked, Tiles::place);
}

/// `kernel` places so many planes on a tile by a method.
pub(super) fn clustering(checked: &mut Checked, kernel: impl Fn(&Tiles, Method, u32) -> Tile) {
    for case in cases() {
        let pixels = case.pixels();
        let points = distinct(&pixels);
        let range = points.last().map_or(0.0, |p| p.0) - points.first().map_or(0.0, |p| p.0);
        for (method, name) in METHODS {
            let bound = GRID
                + match method {
                    // planes hold −2 to 2: beyond, it is enough that they are planes at all
                    _ if range > 4.0 => range,
                    // a boundary between clusters is off by one bin of the histogram at most
                    Method::Lloyd | Method::Optimal => range / 4096.0,
                    // searched on a quarter of the pixels, from several starts: at times another optimum, hardly ever a worse one
                    Method::Slanted => range / 1000.0,
                    Method::Linear => 0.0,
                };
            checked.case(FAMILY, case.name, name, "δ, rms", bound, || {
                // as many planes as a tile can have is more than most of these have distinct values
                [1, 2, 4, 64].map(|n| excess(&kernel(&case, method, n), &pixels, method, n)).into_iter().fold(0.0, f64::max)
            });
        }
    }
}
