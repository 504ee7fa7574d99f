//! Per-tile planes: weighted clustering of disparity into the fewest planes that meet an error target (paper, section 3.2).

mod kernel;
mod linear;
mod lloyd;
mod optimal;
mod regular;
mod sample;
mod slanted;

use rayon::prelude::*;

use crate::tmpi::{DisparityMap, Grid, Plane, Tile};
use lloyd::Histogram;
use optimal::Table;
pub use sample::Samples;
pub(crate) use slanted::fit_points;

/// Most planes a tile can have; labels are bytes and renderers sort few layers a tile.
pub const MAX_PLANES: u32 = 64;

/// Most planes that the automatic count gives a tile.
pub const MAX_AUTO_PLANES: u32 = 6;

/// How planes are placed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Placement rule.
    pub method: Method,
    /// Upper bound of planes a tile, 1 to [`MAX_PLANES`].
    pub most: u32,
    /// Where given, the fewest planes (up to `most`) whose 99th percentile of |δ error| is at most this; else always `most`.
    pub target: Option<f64>,
}

/// Placement rule of the planes of a tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// Evenly between the extremes of the tile.
    Linear,
    /// Weighted k-means.
    Lloyd,
    /// Exact one-dimensional k-means.
    Optimal,
    /// Weighted k-planes.
    Slanted,
}

/// Places the planes of all tiles of `grid`, in the order of the tiles.
///
/// `confidence` is a weight per pixel in (0, 1] where there is one. Values of either map that are not finite weigh nothing.
#[must_use]
pub fn place(delta: &DisparityMap, confidence: Option<&[f32]>, grid: &Grid, placement: &Placement) -> Vec<Tile> {
    (0..grid.tiles())
        .into_par_iter()
        .map_init(Samples::default, |samples, tile| {
            samples.gather(delta, confidence, grid, tile);
            place_tile(samples, placement)
        })
        .collect()
}

/// Share of tiles, 0 to 1, whose best single slanted plane misses `target` (99th percentile of |δ error|).
#[must_use]
pub fn busy_share(delta: &DisparityMap, grid: &Grid, target: f64) -> f64 {
    let busy = (0..grid.tiles()).into_par_iter().map_init(Samples::default, |samples, tile| {
        samples.gather(delta, None, grid, tile);
        let one = slanted::fit(samples, 1, None);
        usize::from(samples.error_p99(&one) > target)
    });
    busy.sum::<usize>() as f64 / f64::from(grid.tiles().max(1))
}

/// Places the planes of one tile.
#[must_use]
pub fn place_tile(samples: &Samples, placement: &Placement) -> Tile {
    let most = placement.most.clamp(1, MAX_PLANES) as usize;
    if placement.method == Method::Slanted {
        return finish(samples, slanted::fit(samples, most, placement.target), placement.target);
    }
    let histogram = Histogram::new(samples.deltas(), samples.weights(), lloyd::BINS);
    let mut table = None;
    let mut run = |n: usize| -> Vec<Plane> {
        let centres = match placement.method {
            Method::Linear => linear::centres(samples, n),
            Method::Optimal => table.get_or_insert_with(|| Table::new(samples, most)).centres(n),
            Method::Lloyd | Method::Slanted => lloyd::centres(histogram.as_ref(), n),
        };
        centres.into_iter().map(Plane::fronto_parallel).collect()
    };
    let Some(target) = placement.target else { return finish(samples, run(most), None) };
    let mut best = run(1);
    for n in 1..=most {
        if n > 1 {
            best = run(n);
        }
        if samples.error_p99(&best) <= target {
            break;
        }
    }
    finish(samples, best, placement.target)
}

/// Puts planes on the container's grid, drops those that no pixel lies on, orders the rest and labels the pixels.
fn finish(samples: &Samples, planes: Vec<Plane>, target: Option<f64>) -> Tile {
    let mut planes: Vec<Plane> = planes.into_iter().map(|p| p.quantised()).collect();
    planes.sort_by(|p, q| p.a.total_cmp(&q.a).then(p.b.total_cmp(&q.b)).then(p.c.total_cmp(&q.c)));
    planes.dedup();
    let (mut nearest, mut error) = (Vec::new(), Vec::new());
    samples.assign(&planes, &mut nearest, &mut error);
    let mut labels: Vec<u8> = nearest.iter().map(|&l| l as u8).collect();
    if let Some(target) = target {
        regular::calm(samples, &planes, &mut labels, target);
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
    Tile { planes, labels, backstop: None }
}

/// Error of all tiles' planes against the map they were fitted to: mean absolute, mean squared, lower quartile of absolute.
///
/// Overlapping tiles count every pixel that they hold.
#[must_use]
pub fn discretisation_error(delta: &DisparityMap, grid: &Grid, tiles: &[Tile]) -> (f64, f64, f64) {
    let each: Vec<(Vec<f32>, f64, f64)> = tiles
        .par_iter()
        .enumerate()
        .map_init(Samples::default, |s, (i, t)| {
            s.gather(delta, None, grid, i as u32);
            let errors = s.errors(&t.planes, &t.labels);
            // a row at a time: `f32` keeps a few dozen terms, and adds them side by side
            let sum = |f: fn(f32) -> f32| errors.chunks(64).map(|row| f64::from(row.iter().map(|&e| f(e)).sum::<f32>())).sum();
            let (absolute, squared) = (sum(|e| e), sum(|e| e * e));
            (errors, absolute, squared)
        })
        .collect();
    let n: usize = each.iter().map(|e| e.0.len()).sum();
    if n == 0 {
        return (0.0, 0.0, 0.0);
    }
    let mae = each.iter().map(|e| e.1).sum::<f64>() / n as f64;
    let mse = each.iter().map(|e| e.2).sum::<f64>() / n as f64;
    let mut errors = Vec::with_capacity(n);
    for (more, _, _) in each {
        errors.extend(more);
    }
    let q = errors.len() / 4;
    let (_, q25, _) = errors.select_nth_unstable_by(q, f32::total_cmp);
    (mae, mse, f64::from(*q25))
}

#[cfg(test)]
mod tests;
