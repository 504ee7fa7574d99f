//! Weighted k-planes: clusters of pixels on planes whose disparity is affine in the image.

use super::kernel::{self, Sums};
use super::lloyd;
use super::{Samples, sample::percentile_99};
use crate::tmpi::Plane;

const ROUNDS: usize = 20;
/// Ridge on the slopes, as a share of a cluster's weight and as pixels, so that thin clusters stay fronto-parallel.
const RIDGE: (f64, f64) = (1e-4, 0.02);
/// Steepest slope in δ per half tile (0.008 δ a pixel on 64-pixel tiles).
const MAX_SLOPE: f64 = 0.256;

/// The fewest planes (up to `most`) that meet `target`, or `most` planes where there is no target.
pub fn fit(s: &Samples, most: usize, target: Option<f64>) -> Vec<Plane> {
    if s.is_empty() {
        return vec![Plane::default()];
    }
    let one = vec![fit_all(s)];
    let mut best_error = s.error_p99(&one);
    let goal = target.unwrap_or(0.0);
    if most == 1 || best_error <= goal {
        return one;
    }
    let thin = s.thinned();
    let mut search = Search::new(&thin, &one[0]);
    let (mut best, mut last) = (one.clone(), one);
    for k in 2..=most {
        last = search.run(&last, k);
        let mut full = last.clone();
        for _ in 0..2 {
            s.assign(&full, &mut search.full.labels, &mut search.full.error);
            refit(s, &search.full.labels, &mut full);
        }
        s.assign(&full, &mut search.full.labels, &mut search.full.error);
        let e = percentile_99(&mut search.full.error);
        if e < best_error || target.is_none() {
            best_error = e;
            best = full;
        }
        if best_error <= goal {
            break;
        }
    }
    best
}

/// Moments of a cluster; coordinates are of order 1, so nothing need be shifted before it is summed.
#[derive(Clone, Copy, Default)]
struct Moments {
    w: f64,
    u: f64,
    v: f64,
    d: f64,
    uu: f64,
    uv: f64,
    vv: f64,
    ud: f64,
    vd: f64,
}

impl From<Sums> for Moments {
    fn from(s: Sums) -> Self {
        let [w, u, v, d, uu, uv, vv, ud, vd] = s.map(f64::from);
        Self { w, u, v, d, uu, uv, vv, ud, vd }
    }
}

impl Moments {
    fn add(&mut self, u: f64, v: f64, d: f64, w: f64) {
        self.w += w;
        self.u += w * u;
        self.v += w * v;
        self.d += w * d;
        self.uu += w * u * u;
        self.uv += w * u * v;
        self.vv += w * v * v;
        self.ud += w * u * d;
        self.vd += w * v * d;
    }

    /// Ridge least squares with slopes bounded; none where there is no weight.
    fn plane(&self) -> Option<Plane> {
        if self.w <= 0.0 {
            return None;
        }
        let (mu, mv, md) = (self.u / self.w, self.v / self.w, self.d / self.w);
        let ridge = RIDGE.0 * self.w + RIDGE.1;
        let (uu, vv, uv) = (self.uu - self.u * mu + ridge, self.vv - self.v * mv + ridge, self.uv - self.u * mv);
        let (ud, vd) = (self.ud - self.u * md, self.vd - self.v * md);
        let det = uu * vv - uv * uv;
        let (b, c) = if det > 1e-12 * uu * vv { ((ud * vv - vd * uv) / det, (vd * uu - ud * uv) / det) } else { (0.0, 0.0) };
        let (b, c) = (b.clamp(-MAX_SLOPE, MAX_SLOPE), c.clamp(-MAX_SLOPE, MAX_SLOPE));
        let p = Plane { a: md - b * mu - c * mv, b, c };
        Some(if p.is_finite() { p } else { Plane::fronto_parallel(md) })
    }
}

/// Plane of the points that `choose` takes, as `(u, v, δ, weight)`; none where they have no weight.
pub(crate) fn fit_points(points: impl Iterator<Item = (f64, f64, f64, f64)>) -> Option<Plane> {
    let mut m = Moments::default();
    for (u, v, d, w) in points {
        m.add(u, v, d, w);
    }
    m.plane()
}

fn fit_all(s: &Samples) -> Plane {
    let (u, v, d, w) = (s.us(), s.vs(), s.deltas(), s.weights());
    fit_points((0..s.len()).map(|i| (u[i].into(), v[i].into(), d[i].into(), w[i].into()))).unwrap_or_default()
}

/// Refits each plane to its pixels; a plane without pixels stays.
fn refit(s: &Samples, labels: &[u32], planes: &mut [Plane]) {
    for (j, p) in planes.iter_mut().enumerate() {
        if let Some(q) = Moments::from(kernel::sums(s.columns(), labels, j as u32)).plane() {
            *p = q;
        }
    }
}

#[derive(Default)]
struct Scratch {
    labels: Vec<u32>,
    error: Vec<f32>,
}

struct Search<'a> {
    s: &'a Samples,
    residual: Vec<f32>,
    labels: Vec<u32>,
    error: Vec<f32>,
    /// Labels and errors of the whole tile.
    full: Scratch,
    random: u64,
}

impl<'a> Search<'a> {
    fn new(s: &'a Samples, one: &Plane) -> Self {
        let residual = (0..s.len()).map(|i| s.deltas()[i] - one.disparity(s.us()[i].into(), s.vs()[i].into()) as f32).collect();
        Self { s, residual, labels: vec![0; s.len()], error: Vec::new(), full: Scratch::default(), random: 0x9e37_79b9_7f4a_7c15 }
    }

    /// Best of several starts of `k` planes; `last` is the result for `k − 1`.
    fn run(&mut self, last: &[Plane], k: usize) -> Vec<Plane> {
        let s = self.s;
        let mut best = (f64::INFINITY, last.to_vec());
        for start in 0..5 {
            match start {
                0 => label_nearest(s.deltas(), &lloyd::centres(s.deltas(), s.weights(), k), &mut self.labels),
                1 => label_nearest(&self.residual, &lloyd::centres(&self.residual, s.weights(), k), &mut self.labels),
                2 => self.split_worst(last),
                _ => self.voronoi(k),
            }
            let mut planes = vec![fit_all(s); k];
            let mut cost = f64::INFINITY;
            for _ in 0..ROUNDS {
                refit(s, &self.labels, &mut planes);
                let c = s.assign(&planes, &mut self.labels, &mut self.error);
                if c > cost * 0.999 {
                    cost = cost.min(c);
                    break;
                }
                cost = c;
            }
            if cost < best.0 {
                best = (cost, planes);
            }
        }
        best.1
    }

    /// Labels of the last result with the costliest cluster split by the sign of its error.
    fn split_worst(&mut self, last: &[Plane]) {
        let s = self.s;
        s.assign(last, &mut self.labels, &mut self.error);
        let error = |i: usize, l: u32| f64::from(s.deltas()[i]) - last[l as usize].disparity(s.us()[i].into(), s.vs()[i].into());
        let mut cost = vec![0.0; last.len()];
        for (i, &l) in self.labels.iter().enumerate() {
            cost[l as usize] += f64::from(s.weights()[i]) * error(i, l).powi(2);
        }
        let worst = (0..last.len()).max_by(|&a, &b| cost[a].total_cmp(&cost[b])).unwrap_or(0) as u32;
        for i in 0..self.labels.len() {
            if self.labels[i] == worst && error(i, worst) > 0.0 {
                self.labels[i] = last.len() as u32;
            }
        }
    }

    /// Labels by the nearest of `k` random places.
    fn voronoi(&mut self, k: usize) {
        let places: Vec<(f32, f32)> = (0..k).map(|_| (self.uniform(), self.uniform())).collect();
        for i in 0..self.labels.len() {
            let (u, v) = (self.s.us()[i], self.s.vs()[i]);
            let d = |p: &(f32, f32)| (p.0 - u).powi(2) + (p.1 - v).powi(2);
            self.labels[i] = (0..k).min_by(|&a, &b| d(&places[a]).total_cmp(&d(&places[b]))).unwrap_or(0) as u32;
        }
    }

    /// Uniform in [−1, 1); the same sequence for every tile, so that a result does not depend on the order of tiles.
    fn uniform(&mut self) -> f32 {
        self.random = self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.random >> 40) as f32 / (1u64 << 23) as f32) - 1.0
    }
}

fn label_nearest(values: &[f32], centres: &[f64], labels: &mut [u32]) {
    for (l, &d) in labels.iter_mut().zip(values) {
        let at = centres.partition_point(|&c| c < f64::from(d));
        *l =
            if at == 0 || (at < centres.len() && centres[at] - f64::from(d) < f64::from(d) - centres[at - 1]) { at } else { at - 1 } as u32;
    }
}
