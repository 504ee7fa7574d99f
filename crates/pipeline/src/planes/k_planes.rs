//! Weighted k-planes: clusters pixels on planes whose disparity is affine in the image.

use super::k_means::{self, Histogram};
use super::kernel::{self, Sums};
use super::{Samples, sample::percentile_99};
use tmpi_core::Plane;

const ROUNDS: usize = 20;
/// The search for planes uses every fourth pixel of every fourth row; planes are then fitted to every second pixel of every second row,
/// then to all pixels. The views of seven stereo scenes lose 0.03 dB against a search on every second pixel, which took half as long again.
const THIN: [usize; 2] = [4, 2];
/// A start is abandoned if this many more rounds, each as good as its last one, would leave it worse than the best start.
const PATIENCE: f64 = 6.0;
/// Ridge on the slopes, so that thin clusters stay fronto-parallel: as a share of the cluster's weight, and as a second moment (weight in
/// pixels times half tiles squared).
const RIDGE: (f64, f64) = (1e-4, 0.02);
/// Steepest slope in δ per half tile (0.008 δ per pixel in 64-pixel tiles).
const MAX_SLOPE: f64 = 0.256;

/// The fewest planes (up to `most`) whose 99th percentile of |δ error| is at most `target`; `most` planes without a target.
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
    let [thin, half] = THIN.map(|step| s.thinned(step));
    let mut search = Search::new(&thin, &one[0]);
    let (mut best, mut last) = (one.clone(), one);
    for k in 2..=most {
        last = search.run(&last, k);
        let mut full = last.clone();
        for s in [&half, &half, s] {
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

/// Weighted moments of a cluster, or of other points; coordinates are of order 1, so they need no shift before summation.
#[derive(Clone, Copy, Default)]
pub(crate) struct Moments {
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
    /// Adds a point at `(u, v)` with the disparity `d` and the weight `w`.
    pub(crate) fn add(&mut self, u: f64, v: f64, d: f64, w: f64) {
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

    /// Sum of the weights.
    pub(crate) fn weight(&self) -> f64 {
        self.w
    }

    /// Mean disparity.
    pub(crate) fn mean(&self) -> f64 {
        self.d / self.w
    }

    /// Plane by ridge least squares, with slopes clamped to [`MAX_SLOPE`]; `None` without weight.
    pub(crate) fn plane(&self) -> Option<Plane> {
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

fn fit_all(s: &Samples) -> Plane {
    Moments::from(kernel::sums(s.columns(), &vec![0; s.len()], 0)).plane().unwrap_or_default()
}

/// Refits each plane to its pixels; a plane without pixels stays unchanged.
pub fn refit(s: &Samples, labels: &[u32], planes: &mut [Plane]) {
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
    one: Plane,
    residual: Vec<f32>,
    /// Histograms of δ and of the residuals of a single plane.
    histograms: [Option<Histogram>; 2],
    labels: Vec<u32>,
    error: Vec<f32>,
    moved: Vec<(u32, u32)>,
    /// Moments of each cluster, and the number of its pixels with weight.
    clusters: Vec<(Moments, u32)>,
    /// Labels and errors of the whole tile.
    full: Scratch,
    random: u64,
}

impl<'a> Search<'a> {
    fn new(s: &'a Samples, one: &Plane) -> Self {
        let [a, b, c] = [one.a as f32, one.b as f32, one.c as f32];
        let residual: Vec<f32> = s.delta.iter().zip(&s.u).zip(&s.v).map(|((d, u), v)| d - (a + b * u + c * v)).collect();
        let histograms = [&s.delta, &residual].map(|values| Histogram::new(values, &s.weight, k_means::BINS));
        Self {
            s,
            one: *one,
            residual,
            histograms,
            labels: vec![0; s.len()],
            error: Vec::new(),
            moved: Vec::new(),
            clusters: Vec::new(),
            full: Scratch::default(),
            random: 0x9e37_79b9_7f4a_7c15,
        }
    }

    /// Fits `k` planes from several starts and returns the best; `last` is the result for `k − 1`.
    fn run(&mut self, last: &[Plane], k: usize) -> Vec<Plane> {
        let s = self.s;
        let mut best = (f64::INFINITY, last.to_vec());
        for start in 0..5 {
            match start {
                0 => label_nearest(&s.delta, &k_means::centres(self.histograms[0].as_ref(), k), &mut self.labels),
                1 => label_nearest(&self.residual, &k_means::centres(self.histograms[1].as_ref(), k), &mut self.labels),
                2 => self.split_worst(last),
                _ => self.voronoi(k),
            }
            let mut planes = vec![self.one; k];
            self.sum_up(k);
            let mut cost = f64::INFINITY;
            for _ in 0..ROUNDS {
                for (p, (moments, pixels)) in planes.iter_mut().zip(&self.clusters) {
                    // a plane without pixels stays unchanged
                    *p = (*pixels > 0).then(|| moments.plane()).flatten().unwrap_or(*p);
                }
                let c = s.assign_moved(&planes, &mut self.labels, &mut self.error, &mut self.moved);
                let gain = cost - c;
                cost = cost.min(c);
                // gains shrink from round to round: a start too many of its last gains behind will not catch up
                if gain <= cost * 0.001 || cost - PATIENCE * gain > best.0 {
                    break;
                }
                self.update_moments();
            }
            if cost < best.0 {
                best = (cost, planes);
            }
        }
        best.1
    }

    /// Computes the moments of `k` clusters from the labels.
    fn sum_up(&mut self, k: usize) {
        let s = self.s;
        self.clusters.clear();
        self.clusters.extend((0..k as u32).map(|j| (Moments::from(kernel::sums(s.columns(), &self.labels, j)), 0)));
        for (&l, &w) in self.labels.iter().zip(&s.weight) {
            self.clusters[l as usize].1 += u32::from(w > 0.0);
        }
    }

    /// Moves pixels whose label changed from one cluster's moments to the other's; after the first rounds, there are few.
    fn update_moments(&mut self) {
        let s = self.s;
        for &(i, old) in &self.moved {
            let i = i as usize;
            let (u, v, d, w) = (f64::from(s.u[i]), f64::from(s.v[i]), f64::from(s.delta[i]), f64::from(s.weight[i]));
            if w <= 0.0 {
                continue;
            }
            let (from, count) = &mut self.clusters[old as usize];
            from.add(u, v, d, -w);
            *count -= 1;
            if *count == 0 {
                // drops the rounding error
                *from = Moments::default();
            }
            let (to, count) = &mut self.clusters[self.labels[i] as usize];
            to.add(u, v, d, w);
            *count += 1;
        }
    }

    /// Sets the labels of the last result, with the costliest cluster split by the sign of its residual.
    fn split_worst(&mut self, last: &[Plane]) {
        let s = self.s;
        s.assign(last, &mut self.labels, &mut self.error);
        let mut cost = vec![0f32; last.len()];
        for ((&l, e), w) in self.labels.iter().zip(&self.error).zip(&s.weight) {
            cost[l as usize] += w * e * e;
        }
        let worst = (0..last.len()).max_by(|&a, &b| cost[a].total_cmp(&cost[b])).unwrap_or(0);
        let [a, b, c] = [last[worst].a as f32, last[worst].b as f32, last[worst].c as f32];
        let pixels = s.delta.iter().zip(&s.u).zip(&s.v);
        for (l, ((d, u), v)) in self.labels.iter_mut().zip(pixels) {
            if *l == worst as u32 && *d > a + b * u + c * v {
                *l = last.len() as u32;
            }
        }
    }

    /// Labels each pixel with the nearest of `k` random positions.
    fn voronoi(&mut self, k: usize) {
        let places: Vec<(f32, f32)> = (0..k).map(|_| (self.uniform(), self.uniform())).collect();
        self.error.clear();
        self.error.resize(self.labels.len(), f32::INFINITY);
        for (j, (x, y)) in (0..).zip(places) {
            let pixels = self.s.u.iter().zip(&self.s.v);
            for ((l, e), (u, v)) in self.labels.iter_mut().zip(&mut self.error).zip(pixels) {
                let new = (x - u) * (x - u) + (y - v) * (y - v);
                let better = new < *e;
                *e = if better { new } else { *e };
                *l = if better { j } else { *l };
            }
        }
    }

    /// Random number, uniform in [−1, 1). Each tile uses the same sequence, so that results do not depend on the order of tiles.
    fn uniform(&mut self) -> f32 {
        self.random = self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.random >> 40) as f32 / (1u64 << 23) as f32) - 1.0
    }
}

/// Labels each value with the nearest of ascending centres: the number of midpoints between centres that lie below it.
fn label_nearest(values: &[f32], centres: &[f64], labels: &mut [u32]) {
    labels.fill(0);
    for pair in centres.windows(2) {
        let between = f64::midpoint(pair[0], pair[1]) as f32;
        for (l, &d) in labels.iter_mut().zip(values) {
            *l += u32::from(d > between);
        }
    }
}
