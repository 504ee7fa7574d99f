//! Layers of all tiles: shapes from planes and labels, hidden texels coloured (paper, section 3.2).

use rayon::prelude::*;

use super::planes::fit_points;
use crate::tmpi::{Blueprint, DisparityMap, Filler, Grid, Layer, Photo, Place, Plane, Rect, Scene, Shape, Shapes, Texels, grown};

/// Pixels around a tile that a backstop plane is fitted to (RECIPE, step 4).
const BACKSTOP_REACH: u32 = 32;
/// Fewest pixels that a backstop is fitted to.
const BACKSTOP_PIXELS: usize = 32;
/// How much farther than the whole tile they must be, in δ.
const BACKSTOP_STEP: f32 = 0.05;

/// A layer with the colours of its hidden texels, in the order of its classes.
#[derive(Clone, Debug)]
pub struct Coloured {
    /// Plane, rectangle, class and alpha.
    pub shape: Shape,
    /// A colour for every hidden texel.
    pub hidden: Vec<[u8; 3]>,
}

/// Adds a backstop to every tile whose neighbourhood shows background that the tile does not.
pub fn add_backstops(blueprint: &mut Blueprint, delta: &DisparityMap) {
    let grid = blueprint.grid;
    blueprint.tiles.par_iter_mut().enumerate().for_each_init(Vec::new, |points, (i, t)| {
        let (r, place) = (grid.rect(i as u32), Place::of(&grid, i as u32));
        t.backstop = backstop(delta, &grid, r, place, t.farthest(&grid, i as u32), points);
    });
}

/// A plane for background that only the neighbourhood shows: without it, gaps wider than the tile's reach stay empty.
fn backstop(
    delta: &DisparityMap,
    grid: &Grid,
    r: Rect,
    place: Place,
    farthest: f32,
    points: &mut Vec<(f64, f64, f64, f64)>,
) -> Option<Plane> {
    let win = grown(r, BACKSTOP_REACH, BACKSTOP_REACH, grid);
    points.clear();
    let far = farthest - BACKSTOP_STEP;
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
    if points.len() < BACKSTOP_PIXELS {
        return None;
    }
    let plane = fit_points(points.iter().copied())?;
    // extrapolated into the tile it must stay behind everything there, else the slope is not to be trusted
    let mean = points.iter().map(|q| q.2).sum::<f64>() / points.len() as f64;
    let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|(u, v)| plane.disparity(u, v));
    let sane = corners.iter().all(|&d| d >= 0.0 && d < f64::from(farthest));
    Some(if sane { plane } else { Plane::fronto_parallel(mean) }.quantised())
}

/// Colours the hidden texels of all layers; sources are the photo's pixels at or behind each layer.
#[must_use]
pub fn colour(photo: &Photo, blueprint: &Blueprint, shapes: Vec<Shapes>) -> Vec<Vec<Coloured>> {
    let colours = Filler::new(photo, blueprint).fill_all(&shapes);
    let tile = |(s, c): (Shapes, Vec<_>)| s.layers.into_iter().zip(c).map(|(shape, hidden)| Coloured { shape, hidden }).collect();
    shapes.into_iter().zip(colours).map(tile).collect()
}

/// Joins coloured layers into a scene.
#[must_use]
pub fn compose(photo: Photo, blueprint: &Blueprint, tiles: Vec<Vec<Coloured>>) -> Scene {
    let mut texels = Texels::default();
    let mut layers = Vec::with_capacity(tiles.iter().map(Vec::len).sum());
    let total: usize = tiles.iter().flatten().map(|l| l.shape.class.len()).sum();
    texels.class.reserve_exact(total);
    texels.alpha.reserve_exact(total);
    for (tile, t) in tiles.into_iter().enumerate() {
        for Coloured { shape, hidden } in t {
            let (first_texel, first_hidden) = (texels.class.len(), texels.hidden.len());
            layers.push(Layer { tile: tile as u32, plane: shape.plane, rect: shape.rect, first_texel, first_hidden });
            texels.class.extend(shape.class);
            texels.alpha.extend(shape.alpha);
            texels.hidden.extend(hidden);
        }
    }
    Scene { grid: blueprint.grid, intrinsics: blueprint.intrinsics, view_box: blueprint.view_box, photo, layers, texels }
}
