//! Refinement of the planes of all tiles together: planes of neighbouring tiles that show one surface meet where the tiles overlap.
//!
//! Each tile is fitted alone, to an error target, so neighbours may disagree about their common pixels by twice the target; side views show
//! that as a seam. Over all planes, the refinement lowers the sum of
//! - the squared change of δ at each pixel of each plane, and
//! - [`BORDER_WEIGHT`] times the squared disagreement of two matching planes at each common pixel,
//!
//! by Gauss-Seidel sweeps over a chequerboard of tiles. No tile moves beyond its error bound.

use std::ops::Range;

use rayon::prelude::*;
use tmpi_core::{DisparityMap, Grid, Plane, Rect, Tile, TileFrame};

use super::k_planes::RIDGE;
use super::sample::percentile_99;
use super::{Samples, far_to_near, largest_change};

/// Sweeps over all tiles; a third one changes almost nothing. 0 leaves every tile as it was fitted.
const SWEEPS: usize = 2;
/// Weight of a common pixel of two planes, against that of a plane's own pixel. In a prototype on four predicted maps, 4 lowers the share of
/// common pixels that are off by more than a quarter of the target from 11, 14, 24 and 43 % to 5, 6, 22 and 31 %, and raises the mean error
/// of planes by 17, 11, 1 and 11 %. 16 lowers the share by at most two points more.
const BORDER_WEIGHT: f64 = 4.0;
/// Planes match at pixels where they disagree by at most this multiple of the target. Two planes that meet the target at a pixel differ by
/// no more.
const MATCHING: f64 = 2.0;
/// Shares of a step to try until a tile stays within its bound.
const STEPS: [f64; 2] = [1.0, 0.5];
/// Smallest change of δ on a tile that counts. Rounding to the container's grid makes planes of one surface disagree by as much.
const NEGLIGIBLE: f64 = 3.0 * Plane::STEP;

/// Sums over pixels of 1, u, v, u², uv and v².
type Sums = [f64; 6];

/// Moves the planes of `tiles`, rounded to the container's grid and labelled, so that neighbours meet in their overlap. Labels, numbers and
/// orders of planes stay. The 99th percentile of each tile's |δ error| stays below `target`, or does not rise if it is above. `before`
/// has the planes of each tile before rounding; it follows them.
///
/// The result does not depend on the number of threads. Time is linear in the number of pixels.
pub fn meet_at_borders(delta: &DisparityMap, grid: &Grid, target: f64, tiles: &mut [Tile], before: &mut [Vec<Plane>]) {
    if tiles.len() < 2 || target <= 0.0 {
        return;
    }
    let refined = refine(delta, grid, target, tiles, SWEEPS);
    for ((tile, before), refined) in tiles.iter_mut().zip(before).zip(refined) {
        for ((plane, before), exact) in tile.planes.iter_mut().zip(before).zip(refined) {
            let rounded = exact.quantised();
            if rounded != *plane {
                (*plane, *before) = (rounded, exact);
            }
        }
    }
}

/// The refined planes of each tile, not rounded.
fn refine(delta: &DisparityMap, grid: &Grid, target: f64, tiles: &[Tile], sweeps: usize) -> Vec<Vec<Plane>> {
    let fitted = |samples: &mut Samples, t: usize| {
        samples.gather(delta, None, grid, t as u32);
        Fitted::new(samples, grid, target, tiles, t)
    };
    let all: Vec<Fitted> = (0..tiles.len()).into_par_iter().map_init(Samples::default, fitted).collect();
    let mut planes: Vec<Vec<Plane>> = tiles.iter().map(|t| t.planes.clone()).collect();
    let columns = grid.columns() as usize;
    for pass in 0..2 * sweeps {
        // tiles of one colour of the chequerboard have no common border, so their order does not matter
        let own_colour = |t: &usize| (t % columns + t / columns) % 2 == pass % 2;
        let step = |samples: &mut Samples, t: usize| {
            let goals = all[t].goals(&tiles[t].planes, &planes);
            if goals == planes[t] {
                return None;
            }
            samples.gather(delta, None, grid, t as u32);
            all[t].step(samples, &tiles[t].labels, &planes[t], &goals).map(|moved| (t, moved))
        };
        let moved: Vec<_> = (0..tiles.len()).into_par_iter().filter(own_colour).map_init(Samples::default, step).collect();
        for (t, moved) in moved.into_iter().flatten() {
            planes[t] = moved;
        }
    }
    planes
}

/// What stays of a tile while planes move.
struct Fitted {
    /// Of the pixels of each plane.
    sums: Vec<Sums>,
    links: Vec<Link>,
    /// Largest 99th percentile of |δ error|.
    bound: f64,
}

/// The common pixels of a plane and a matching plane of a neighbour.
struct Link {
    own: usize,
    tile: usize,
    plane: usize,
    sums: Sums,
    /// Centre of the neighbour in the tile's `(u, v)`.
    centre: (f64, f64),
}

impl Fitted {
    fn new(samples: &Samples, grid: &Grid, target: f64, tiles: &[Tile], t: usize) -> Self {
        let tile = &tiles[t];
        let mut sums = vec![Sums::default(); tile.planes.len()];
        for ((&label, &u), &v) in tile.labels.iter().zip(samples.us()).zip(samples.vs()) {
            add(&mut sums[usize::from(label)], f64::from(u), f64::from(v));
        }
        let mut errors = samples.errors(&tile.planes, &tile.labels);
        let bound = if exceeds(&errors, target) { percentile_99(&mut errors) } else { target };
        let mut links = Vec::new();
        for other in neighbours(grid, t as u32) {
            link(grid, MATCHING * target, tiles, (t, other as usize), &mut links);
        }
        Self { sums, links, bound }
    }

    /// Where each plane would move to if all planes of the neighbours stayed; `start` has the planes as they were fitted.
    fn goals(&self, start: &[Plane], planes: &[Vec<Plane>]) -> Vec<Plane> {
        let goal = |(i, (start, &own)): (usize, (&Plane, &Sums))| {
            let (mut sums, mut pull) = (own, [0.0; 3]);
            // keeps the slopes of planes that hardly have any pixels
            let ridge = RIDGE.0 * own[0] + RIDGE.1;
            sums[3] += ridge;
            sums[5] += ridge;
            for link in self.links.iter().filter(|link| link.own == i) {
                let other = &planes[link.tile][link.plane];
                let gap = [other.disparity(-link.centre.0, -link.centre.1) - start.a, other.b - start.b, other.c - start.c];
                let weighted = link.sums.map(|v| BORDER_WEIGHT * v);
                sums = std::array::from_fn(|k| sums[k] + weighted[k]);
                let [n, u, v, uu, uv, vv] = weighted;
                for (pull, row) in pull.iter_mut().zip([[n, u, v], [u, uu, uv], [v, uv, vv]]) {
                    *pull += row[0] * gap[0] + row[1] * gap[1] + row[2] * gap[2];
                }
            }
            let [a, b, c] = solved(sums, pull);
            let goal = Plane { a: start.a + a, b: start.b + b, c: start.c + c };
            if largest_change(start, &goal) > NEGLIGIBLE { goal } else { *start }
        };
        start.iter().zip(&self.sums).enumerate().map(goal).collect()
    }

    /// The planes after a step towards `goals` that keeps the bound and the order of planes; `None` if there is none.
    fn step(&self, samples: &Samples, labels: &[u8], planes: &[Plane], goals: &[Plane]) -> Option<Vec<Plane>> {
        let stepped = |share: f64| -> Vec<Plane> {
            let mix = |from: f64, to: f64| from + share * (to - from);
            planes.iter().zip(goals).map(|(p, q)| Plane { a: mix(p.a, q.a), b: mix(p.b, q.b), c: mix(p.c, q.c) }).collect()
        };
        STEPS.into_iter().map(stepped).find(|planes| {
            let rounded: Vec<Plane> = planes.iter().map(Plane::quantised).collect();
            let ordered = rounded.windows(2).all(|two| far_to_near(&two[0], &two[1]).is_lt());
            ordered && !exceeds(&samples.errors(&rounded, labels), self.bound)
        })
    }
}

/// Adds the links of the first tile of `pair` to the second one.
fn link(grid: &Grid, matching: f64, tiles: &[Tile], pair: (usize, usize), links: &mut Vec<Link>) {
    let of = |t: usize| (&tiles[t], grid.rect(t as u32), TileFrame::of(grid, t as u32));
    let ((own, rect, frame), (other, other_rect, other_frame)) = (of(pair.0), of(pair.1));
    let scaled = |v: f64, centre: f64| (v - centre) / frame.half;
    let centre = (scaled(other_frame.centre.0, frame.centre.0), scaled(other_frame.centre.1, frame.centre.1));
    let label = |tile: &Tile, r: &Rect, x: u32, y: u32| usize::from(tile.labels[((y - r.y) * r.w + x - r.x) as usize]);
    for y in common((rect.y, rect.h), (other_rect.y, other_rect.h)) {
        let v = frame.v(y);
        for x in common((rect.x, rect.w), (other_rect.x, other_rect.w)) {
            let (i, j) = (label(own, &rect, x, y), label(other, &other_rect, x, y));
            let apart = frame.disparity(&own.planes[i], x, y) - other_frame.disparity(&other.planes[j], x, y);
            if f64::from(apart.abs()) > matching {
                continue;
            }
            let known = links.iter().rposition(|link| (link.own, link.tile, link.plane) == (i, pair.1, j));
            let at = known.unwrap_or_else(|| {
                links.push(Link { own: i, tile: pair.1, plane: j, sums: Sums::default(), centre });
                links.len() - 1
            });
            add(&mut links[at].sums, scaled(f64::from(x) + 0.5, frame.centre.0), v);
        }
    }
}

/// The tiles to the left, to the right, above and below.
fn neighbours(grid: &Grid, t: u32) -> impl Iterator<Item = u32> {
    let columns = grid.columns();
    let (x, y) = (t % columns, t / columns);
    let left_right = [(x > 0).then(|| t - 1), (x + 1 < columns).then(|| t + 1)];
    let above_below = [(y > 0).then(|| t - columns), (y + 1 < grid.rows()).then(|| t + columns)];
    left_right.into_iter().chain(above_below).flatten()
}

/// What two ranges, given by start and length, have in common.
fn common(a: (u32, u32), b: (u32, u32)) -> Range<u32> {
    a.0.max(b.0)..(a.0 + a.1).min(b.0 + b.1)
}

fn add(sums: &mut Sums, u: f64, v: f64) {
    for (sum, term) in sums.iter_mut().zip([1.0, u, v, u * u, u * v, v * v]) {
        *sum += term;
    }
}

/// Whether the 99th percentile of errors is above `bound`.
fn exceeds(errors: &[f32], bound: f64) -> bool {
    let above = errors.iter().filter(|e| f64::from(**e) > bound).count();
    above + (errors.len() * 99 / 100) >= errors.len().max(1)
}

/// Solves the normal equations of three coefficients; the ridge keeps them regular.
fn solved([n, u, v, uu, uv, vv]: Sums, pull: [f64; 3]) -> [f64; 3] {
    let (mu, mv) = (u / n, v / n);
    let (uu, uv, vv) = (uu - u * mu, uv - u * mv, vv - v * mv);
    let (pu, pv) = (pull[1] - pull[0] * mu, pull[2] - pull[0] * mv);
    let det = uu * vv - uv * uv;
    let (b, c) = ((pu * vv - pv * uv) / det, (pv * uu - pu * uv) / det);
    [pull[0] / n - b * mu - c * mv, b, c]
}

#[cfg(test)]
mod tests;
