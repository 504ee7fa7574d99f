//! Background planes: what only the neighbourhood of a tile shows (RECIPE, step 4).

use rayon::prelude::*;

use tmpi_core::{DisparityMap, Geometry, Grid, Plane, Rect, Tile, TileFrame, grown};

use crate::planes::fit_points;

/// Pixels around a tile that a background plane is fitted to (RECIPE, step 4).
const BACKGROUND_REACH: u32 = 32;
/// And where there is no background so near, at most: what hidden texels reach (`tmpi_core`).
const WIDEST_REACH: u32 = 96;
/// Fewest pixels that a background is fitted to.
const BACKGROUND_PIXELS: usize = 32;
/// How much farther than the whole tile they must be, in δ.
const BACKGROUND_STEP: f32 = 0.05;

/// Adds a background to every tile whose neighbourhood shows background that the tile does not.
pub fn add_backgrounds(geometry: &mut Geometry, delta: &DisparityMap) {
    add_backgrounds_to(geometry, delta, |_| true);
}

/// The same for the tiles that are `wanted` alone; others stay as they are.
pub fn add_backgrounds_to(geometry: &mut Geometry, delta: &DisparityMap, wanted: impl Fn(u32) -> bool + Sync) {
    let grid = geometry.grid;
    let (x, y) = geometry.view_box.parallax(&geometry.intrinsics, Rect { x: 0, y: 0, w: grid.width, h: grid.height });
    // what the farthest camera uncovers, and no more than readers look for
    let wide = x.max(y).clamp(f64::from(BACKGROUND_REACH), f64::from(WIDEST_REACH)).ceil() as u32;
    // of a room's first frames some tiles may have no planes yet, and show nothing that could be uncovered
    let of = |(i, t): (usize, &Tile)| if t.planes.is_empty() { f32::INFINITY } else { t.farthest(&grid, i as u32) };
    let farthest: Vec<f32> = geometry.tiles.par_iter().enumerate().map(of).collect();
    geometry.tiles.par_iter_mut().enumerate().filter(|(i, _)| wanted(*i as u32)).for_each_init(Vec::new, |points, (i, t)| {
        let (r, place) = (grid.rect(i as u32), TileFrame::of(&grid, i as u32));
        let within = |reach: u32, points: &mut _| background(delta, grown(r, reach, reach, &grid), (r, place), farthest[i], points);
        t.background = within(BACKGROUND_REACH, points);
        if t.background.is_none() && wide > BACKGROUND_REACH && may_uncover(&grid, i as u32, &farthest, wide) {
            t.background = within(wide, points);
        }
    });
}

/// Whether a tile within `reach` pixels of tile `index` shows something so much farther that it may be uncovered there.
fn may_uncover(grid: &Grid, index: u32, farthest: &[f32], reach: u32) -> bool {
    let (columns, tiles) = (grid.columns(), reach.div_ceil(grid.stride));
    let around = |at: u32, count: u32| at.saturating_sub(tiles)..(at + tiles + 1).min(count);
    let (x, y) = (index % columns, index / columns);
    let far = farthest[index as usize] - BACKGROUND_STEP;
    around(y, grid.rows()).any(|row| around(x, columns).any(|column| farthest[(row * columns + column) as usize] < far))
}

/// A plane for background that only the neighbourhood shows: without it, gaps wider than the tile's reach stay empty.
fn background(
    delta: &DisparityMap,
    win: Rect,
    (r, place): (Rect, TileFrame),
    farthest: f32,
    points: &mut Vec<(f64, f64, f64, f64)>,
) -> Option<Plane> {
    points.clear();
    let far = farthest - BACKGROUND_STEP;
    for y in win.y..win.y + win.h {
        let (row, v) = (&delta.delta[y as usize * delta.width as usize..], place.v(y));
        // left and right of the tile in its own rows
        let beside = if (r.y..r.y + r.h).contains(&y) { [win.x..r.x, r.x + r.w..win.x + win.w] } else { [win.x..win.x + win.w, 0..0] };
        for part in beside {
            for (x, &d) in (part.start..).zip(&row[part.start as usize..part.end as usize]) {
                if d < far {
                    points.push(((f64::from(x) + 0.5 - place.centre.0) / place.half, v, f64::from(d), 1.0));
                }
            }
        }
    }
    if points.len() < BACKGROUND_PIXELS {
        return None;
    }
    let plane = fit_points(points.iter().copied())?;
    // extrapolated into the tile it must stay behind everything there, else the slope is not to be trusted
    let mean = points.iter().map(|q| q.2).sum::<f64>() / points.len() as f64;
    let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|(u, v)| plane.disparity(u, v));
    let sane = corners.iter().all(|&d| d >= 0.0 && d < f64::from(farthest));
    Some(if sane { plane } else { Plane::fronto_parallel(mean) }.quantised())
}
