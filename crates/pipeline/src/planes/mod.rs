//! Per-tile planes: weighted clustering of disparity into the fewest planes that meet an error target (paper, section 3.2).

mod exact_k_means;
mod k_means;
mod k_planes;
mod kernel;
mod label_smoothing;
mod reader_bounds;
mod sample;
mod warm_start;

use rayon::prelude::*;

pub use exact_k_means::ClusterTable;
use k_means::Histogram;
pub(crate) use k_planes::Moments;
pub use label_smoothing::{NEIGHBOUR_COST, smooth_labels};
pub use sample::Samples;
pub(crate) use sample::percentile_99;
use tmpi_core::{DisparityMap, Grid, Plane, Tile};
pub use warm_start::{place_again, place_tile_from};

/// Most planes per tile: labels are bytes, and renderers sort only a few layers per tile.
pub const MAX_PLANES: u32 = 64;

/// Most planes per tile with an automatic number of planes.
pub const MAX_AUTO_PLANES: u32 = 6;

/// Method, number and error target of the planes to place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// How planes are placed.
    pub method: Method,
    /// Most planes per tile, 1 to [`MAX_PLANES`].
    pub most: u32,
    /// If given, a tile gets the fewest planes (up to `most`) for which the 99th percentile of |δ error| is at most this; else it gets
    /// `most`.
    pub target: Option<f64>,
    /// Cost in label smoothing of each neighbour on another plane, against the squared error in units of the target; unused without a
    /// target. The default is [`NEIGHBOUR_COST`]; 0 leaves every pixel on its nearest plane.
    pub neighbour: f32,
}

impl Placement {
    /// `n` planes in every tile.
    pub fn fixed(method: Method, n: u32) -> Self {
        Self { method, most: n, target: None, neighbour: NEIGHBOUR_COST }
    }

    /// The fewest planes, at most `most`, that meet the error `target` in δ.
    pub fn fewest(method: Method, most: u32, target: f64) -> Self {
        Self { method, most, target: Some(target), neighbour: NEIGHBOUR_COST }
    }
}

/// How the planes of a tile are placed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Evenly spaced in disparity between the tile's extremes.
    Linear,
    /// Confidence-weighted k-means (as in the paper).
    Lloyd,
    /// Exact one-dimensional k-means by dynamic programming.
    Optimal,
    /// Confidence-weighted k-planes with slanted planes.
    #[default]
    Slanted,
}

/// Places the planes of all tiles of `grid`. Returns the tiles in grid order.
///
/// `confidence`, if given, is a weight per pixel in (0, 1]. Pixels where either map is not finite have no weight.
pub fn place(delta: &DisparityMap, confidence: Option<&[f32]>, grid: &Grid, placement: &Placement) -> Vec<Tile> {
    place_rounded(delta, confidence, grid, placement).into_iter().map(|r| r.tile).collect()
}

/// [`place`], with the planes before rounding to the container's grid of coefficients.
pub fn place_rounded(delta: &DisparityMap, confidence: Option<&[f32]>, grid: &Grid, placement: &Placement) -> Vec<Rounded> {
    (0..grid.tiles())
        .into_par_iter()
        .map_init(Samples::default, |samples, tile| {
            samples.gather(delta, confidence, grid, tile);
            place_tile_rounded(samples, placement)
        })
        .collect()
}

/// A tile with planes rounded to the container's grid of coefficients.
#[derive(Clone, Debug)]
pub struct Rounded {
    /// The tile.
    pub tile: Tile,
    /// Its planes before rounding, in the same order. Of planes that are equal after rounding, the one that changed most.
    pub before: Vec<Plane>,
}

/// Share of tiles, 0 to 1, whose best single slanted plane misses `target` (99th percentile of |δ error|).
pub fn busy_share(delta: &DisparityMap, grid: &Grid, target: f64) -> f64 {
    let busy = (0..grid.tiles()).into_par_iter().map_init(Samples::default, |samples, tile| {
        samples.gather(delta, None, grid, tile);
        let one = k_planes::fit(samples, 1, None);
        usize::from(samples.error_p99(&one) > target)
    });
    busy.sum::<usize>() as f64 / f64::from(grid.tiles().max(1))
}

/// Places the planes of one tile.
pub fn place_tile(samples: &Samples, placement: &Placement) -> Tile {
    place_tile_rounded(samples, placement).tile
}

fn place_tile_rounded(samples: &Samples, placement: &Placement) -> Rounded {
    let most = placement.most.clamp(1, MAX_PLANES) as usize;
    if placement.method == Method::Slanted {
        return finish(samples, k_planes::fit(samples, most, placement.target), placement);
    }
    let histogram = Histogram::new(&samples.delta, &samples.weight, k_means::BINS);
    let mut table = None;
    let mut run = |n: usize| -> Vec<Plane> {
        let centres = match placement.method {
            Method::Linear => evenly_spaced(samples, n),
            Method::Optimal => table.get_or_insert_with(|| ClusterTable::new(&samples.delta, &samples.weight, most)).centres(n),
            Method::Lloyd | Method::Slanted => k_means::centres(histogram.as_ref(), n),
        };
        centres.into_iter().map(Plane::fronto_parallel).collect()
    };
    let Some(target) = placement.target else { return finish(samples, run(most), placement) };
    let mut best = Vec::new();
    for n in 1..=most {
        best = run(n);
        if samples.error_p99(&best) <= target {
            break;
        }
    }
    finish(samples, best, placement)
}

/// The usual baseline: `n` evenly spaced disparities from the tile's least to its greatest, both included. Their midpoint alone if both are
/// equal or `n` is below 2; 0 without samples.
fn evenly_spaced(s: &Samples, n: usize) -> Vec<f64> {
    let (lo, hi) = s.delta.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), &d| (lo.min(f64::from(d)), hi.max(f64::from(d))));
    if lo >= hi || n < 2 {
        return vec![if lo.is_finite() { f64::midpoint(lo, hi) } else { 0.0 }];
    }
    (0..n).map(|i| lo + (hi - lo) * i as f64 / (n - 1) as f64).collect()
}

/// Rounds planes to the container's grid of coefficients, sorts them, labels the pixels and drops planes without pixels.
fn finish(samples: &Samples, planes: Vec<Plane>, placement: &Placement) -> Rounded {
    // u and v run from -1 to 1, so the three differences add up in one of the tile's corners
    let change = |[q, p]: &[Plane; 2]| (p.a - q.a).abs() + (p.b - q.b).abs() + (p.c - q.c).abs();
    let mut both: Vec<[Plane; 2]> = planes.into_iter().map(|p| [p.quantised(), p]).collect();
    let order = |p: &Plane, q: &Plane| p.a.total_cmp(&q.a).then(p.b.total_cmp(&q.b)).then(p.c.total_cmp(&q.c));
    both.sort_by(|x, y| order(&x[0], &y[0]).then(change(y).total_cmp(&change(x))));
    both.dedup_by(|x, y| x[0] == y[0]);
    let planes: Vec<Plane> = both.iter().map(|[q, _]| *q).collect();
    let (mut nearest, mut error) = (Vec::new(), Vec::new());
    samples.assign(&planes, &mut nearest, &mut error);
    let tile = finish_labelled(samples, planes, nearest.iter().map(|&l| l as u8).collect(), placement);
    let before = both.iter().filter(|[q, _]| tile.planes.contains(q)).map(|[_, p]| *p).collect();
    Rounded { tile, before }
}

/// Smooths the labels of sorted and rounded planes, and drops planes without pixels.
fn finish_labelled(samples: &Samples, mut planes: Vec<Plane>, mut labels: Vec<u8>, placement: &Placement) -> Tile {
    if let Some(target) = placement.target {
        label_smoothing::smooth_labels(samples, &planes, &mut labels, target, placement.neighbour);
    }
    let mut used = vec![false; planes.len()];
    for &l in &labels {
        used[l as usize] = true;
    }
    let map: Vec<u8> = used
        .iter()
        .scan(0u8, |next, &u| {
            let at = *next;
            *next += u8::from(u);
            Some(at)
        })
        .collect();
    for l in &mut labels {
        *l = map[*l as usize];
    }
    let mut keep = used.iter();
    planes.retain(|_| *keep.next().unwrap_or(&false));
    Tile { planes, labels, background: None }
}

/// Low bits of an `f32` that the histogram of errors drops: it keeps the exponent and nine bits of the fraction.
const DROPPED_BITS: u32 = 14;

/// Error in δ of all planes against the map that they were fitted to: mean absolute error, mean squared error, and lower quartile of the
/// absolute error (to 0.2 %).
///
/// A pixel counts once for every tile that contains it.
pub fn discretisation_error(delta: &DisparityMap, grid: &Grid, tiles: &[Tile]) -> (f64, f64, f64) {
    let none = || vec![0u32; (1f32.to_bits() >> DROPPED_BITS) as usize + 1];
    let per_thread = tiles.len().div_ceil(rayon::current_num_threads()).max(1);
    // sum per tile and then in tile order, so that the number of threads does not change the result
    let mut sums = vec![[0f64; 2]; tiles.len()];
    let parts = tiles.par_chunks(per_thread).zip(sums.par_chunks_mut(per_thread)).enumerate().map(|(chunk, (tiles, sums))| {
        let (mut s, mut counts) = (Samples::default(), none());
        let last = counts.len() - 1;
        for (i, (t, to)) in tiles.iter().zip(sums).enumerate() {
            s.gather(delta, None, grid, (chunk * per_thread + i) as u32);
            let errors = s.errors(&t.planes, &t.labels);
            for e in &errors {
                counts[((e.to_bits() >> DROPPED_BITS) as usize).min(last)] += 1;
            }
            // row by row: `f32` is exact enough for a few dozen terms, and their sum vectorises
            let sum = |f: fn(f32) -> f32| errors.chunks(64).map(|row| f64::from(row.iter().map(|&e| f(e)).sum::<f32>())).sum::<f64>();
            *to = [sum(|e| e), sum(|e| e * e)];
        }
        counts
    });
    let counts = parts.reduce(none, |mut counts, more| {
        counts.iter_mut().zip(more).for_each(|(a, b)| *a += b);
        counts
    });
    let [absolute, squared] = sums.iter().fold([0.0; 2], |all, one| [all[0] + one[0], all[1] + one[1]]);
    let n: u64 = counts.iter().map(|&c| u64::from(c)).sum();
    if n == 0 {
        return (0.0, 0.0, 0.0);
    }
    let mut below = 0;
    let q25 = counts.iter().position(|&c| {
        below += u64::from(c);
        below > n / 4
    });
    (absolute / n as f64, squared / n as f64, f64::from(f32::from_bits((q25.unwrap_or(0) as u32) << DROPPED_BITS)))
}

/// Share of ghosts, 0 to 1: pixels whose plane differs by more than `apart` in δ from every value of `delta` in the surrounding 5×5 pixels.
/// In a novel view, such a pixel floats beside an edge.
///
/// A pixel counts once for every tile that contains it.
pub fn ghost_share(delta: &DisparityMap, grid: &Grid, tiles: &[Tile], apart: f32) -> f64 {
    let (w, h) = (delta.width as usize, delta.height as usize);
    let lone = |x: usize, y: usize, d: f32| {
        let (columns, mut rows) = (x.saturating_sub(2)..(x + 3).min(w), y.saturating_sub(2)..(y + 3).min(h));
        rows.all(|y| delta.delta[y * w + columns.start..y * w + columns.end].iter().all(|v| (v - d).abs() > apart))
    };
    let counts = tiles.par_iter().enumerate().map(|(i, t)| {
        let (r, shown) = (grid.rect(i as u32), t.disparities(grid, i as u32));
        let place = |k: usize| (r.x as usize + k % r.w as usize, r.y as usize + k / r.w as usize);
        (shown.iter().enumerate().filter(|&(k, &d)| lone(place(k).0, place(k).1, d)).count(), shown.len())
    });
    let (ghosts, all) = counts.reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
    ghosts as f64 / all.max(1) as f64
}

#[cfg(test)]
mod tests;
