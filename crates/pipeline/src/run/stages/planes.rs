//! Placement of the planes of all tiles.

use tmpi_core::{DisparityMap, Geometry, Grid, Intrinsics, Plane, Rect, Tile};

use super::{Prepared, WeightedDisparity};
use crate::planes::{Placement, Rounded, busy_share, discretisation_error, place_again, place_rounded};
use crate::run::time_budget::Costs;
use crate::run::{Budget, Context, MakeError, Parallax, PlaneCount, PlaneError, Sizes, TileError};
use tmpi_core::container::{most_planes, readable};

/// Tiles with their planes, still without background planes.
#[derive(Clone, Debug)]
pub struct Placed {
    /// The tiles.
    pub geometry: Geometry,
    /// How the planes were placed.
    pub placement: Placement,
}

/// Stage from disparity to planes and labels of every tile.
///
/// # Errors
/// [`MakeError`] if there is no time left.
pub fn place_planes(context: &mut Context, prepared: &Prepared, map: &WeightedDisparity) -> Result<Placed, MakeError> {
    let stage = context.begin("planes")?;
    let (options, delta) = (context.options, &map.delta);
    let (w, h) = (delta.width, delta.height);
    let grid = options.grid(w, h);
    let movement = Parallax::new(prepared.intrinsics, options.view_box);
    let most_px = movement.most(Rect { x: 0, y: 0, w, h });
    let mut max_error = options.max_error;
    if let Some(asked) = options.budget_ms {
        let budget = fit(context, asked, (delta, &grid), most_px, prepared.reduced, &mut max_error);
        context.report.budget = Some(budget);
    }
    let mut placement = options.placement(max_error, most_px);
    let confidence = map.confidence.as_deref();
    let (mut tiles, mut before) = split(place_rounded(delta, confidence, &grid, &placement));
    let most = most_planes(&grid);
    if most < placement.most && !readable(&grid, &tiles) {
        // small tiles on a large photo: use as few planes as readers accept in any photo of this grid
        placement.most = most;
        (tiles, before) = split(place_rounded(delta, confidence, &grid, &placement));
    }
    let (pixels, count) = (u64::from(w) * u64::from(h), tiles.len() as u64);
    let placed: usize = tiles.iter().map(|t| t.planes.len()).sum();
    let room = options.most_planes(pixels, count, context.limits.memory);
    if options.planes == PlaneCount::Auto && placed as u64 > count * u64::from(room) {
        // a large photo with almost only busy tiles: use fewer planes to stay within the memory limit
        placement.most = room;
        (tiles, before) = split(place_rounded(delta, confidence, &grid, &placement));
    }
    let input = &context.report.input;
    let sizes = context.sizes.unwrap_or(Sizes::of_photo((input.width, input.height)));
    let planes = tiles.iter().map(|t| t.planes.len()).sum::<usize>().div_ceil(tiles.len().max(1));
    context.report.memory_bound_bytes = options.memory_with(&sizes, Some(w.max(h)), planes as u32);
    let geometry = Geometry { grid, intrinsics: prepared.intrinsics, view_box: options.view_box, tiles, matte_band: 0 };
    let error = &mut context.report.error;
    (error.depth_mae, error.depth_mse, error.depth_q25) = discretisation_error(delta, &grid, &geometry.tiles);
    let tiles = movement.of_planes(delta, &geometry);
    error.tile_px = tiles.iter().map(|t| (t.mean * 1e3).round() / 1e3).collect();
    error.planes = PlaneError { most_planes: placement.most, ..plane_error(&tiles, placement.target.map(|_| max_error)) };
    error.planes.rounding_px = movement.of_rounding(&geometry, &before);
    context.end(stage);
    Ok(Placed { geometry, placement })
}

/// The planes of a room's tiles, from which those of the next frame start; all frames must have the same size.
#[derive(Debug, Default)]
pub struct WarmStart {
    tiles: Vec<Tile>,
    /// Which tiles change in the next frame, by number; all do if the length differs from the number of tiles.
    pub changed: Vec<bool>,
    /// Most planes of tiles that the next frame places anew; `None`: the limit of the options. Tiles may keep more planes.
    pub most: Option<u32>,
}

impl WarmStart {
    /// Makes the next frame start from `tile` at tile `index` of the grid.
    pub fn set_last_tile(&mut self, index: u32, tile: &Tile) {
        if let Some(held) = self.tiles.get_mut(index as usize) {
            *held = Tile { background: None, ..tile.clone() };
        }
    }

    /// Stage of the next frame, without background planes. Does not choose a time budget, check memory or measure errors, as
    /// [`place_planes`] does for a photo: the room does that itself.
    ///
    /// # Errors
    /// [`MakeError`] if there is no time left.
    pub fn place(&mut self, context: &mut Context, intrinsics: Intrinsics, delta: &DisparityMap) -> Result<Geometry, MakeError> {
        let stage = context.begin("planes")?;
        let (options, w, h) = (context.options, delta.width, delta.height);
        let (grid, count) = (options.grid(w, h), options.grid(w, h).tiles() as usize);
        let most_px = Parallax::new(intrinsics, options.view_box).most(Rect { x: 0, y: 0, w, h });
        let mut placement = options.placement(options.max_error, most_px);
        placement.most = placement.most.min(most_planes(&grid)).min(self.most.unwrap_or(u32::MAX));
        self.tiles.resize(count, Tile::default());
        let changed = Some(&self.changed).filter(|c| c.len() == count);
        let wanted = |i: u32| changed.is_none_or(|c| c[i as usize]);
        place_again(delta, None, &grid, &placement, &mut self.tiles, wanted);
        self.changed.clear();
        context.end(stage);
        Ok(Geometry { grid, intrinsics, view_box: options.view_box, tiles: self.tiles.clone(), matte_band: 0 })
    }
}

/// Tiles, and the planes of each before rounding.
fn split(all: Vec<Rounded>) -> (Vec<Tile>, Vec<Vec<Plane>>) {
    all.into_iter().map(|r| (r.tile, r.before)).unzip()
}

/// Errors over all tiles, against a bound if there is one.
fn plane_error(tiles: &[TileError], bound_px: Option<f64>) -> PlaneError {
    let pixels = tiles.iter().map(|t| t.pixels).sum::<usize>().max(1) as f64;
    let mean = |of: fn(&TileError) -> f64| tiles.iter().map(|t| of(t) * t.pixels as f64).sum::<f64>() / pixels;
    let over: Vec<f64> = tiles.iter().filter_map(|t| bound_px.map(|b| t.p99 - b)).filter(|o| *o > 0.0).collect();
    PlaneError {
        mean_px: mean(|t| t.mean),
        bound_px,
        missed_tiles: over.len(),
        // not `sum`, which gives -0 without terms
        missed_mean_px: over.iter().fold(0.0, |sum, o| sum + o) / over.len().max(1) as f64,
        missed_most_px: over.iter().copied().fold(0.0, f64::max),
        smoothing_px: mean(|t| t.smoothing),
        ..PlaneError::default()
    }
}

/// Chooses the parallax error for the rest of a time budget.
fn fit(
    context: &Context,
    asked_ms: f64,
    (delta, grid): (&DisparityMap, &Grid),
    most_px: f64,
    reduced: Option<u32>,
    max_error: &mut f64,
) -> Budget {
    let elapsed = context.elapsed_ms();
    let busy = busy_share(delta, grid, *max_error / most_px.max(1.0));
    let megapixels = f64::from(delta.width) * f64::from(delta.height) / 1e6;
    let (rate, ms, enough) = Costs::of_this_machine().choose(asked_ms - elapsed, megapixels, busy);
    *max_error *= rate.factor;
    let size = reduced.map_or(String::new(), |side| format!("--max-size {side} "));
    let reason = match (enough, rate.factor > 1.0 || reduced.is_some()) {
        (false, _) if elapsed >= asked_ms => "the photo and its depth alone took longer",
        (false, _) => "even the cheapest setting takes longer",
        (true, true) => "the best setting that fits",
        (true, false) => "the requested settings fit",
    };
    Budget {
        asked_ms,
        predicted_ms: elapsed + ms,
        outcome_ms: 0.0,
        chose: format!("{size}--max-error {max_error}"),
        reason: reason.into(),
        busy,
    }
}
