//! How far from a hidden texel the edge can be that uncovers it.
//!
//! A camera moved by `(X, Y, Z)` shows a point of disparity δ, `p` pixels from the principal point, at `(p − f·(X, Y)·δ) / (1 − Z·δ)`: that
//! is the homography of its plane. The camera's ray through a texel of disparity `d` at `p` therefore crosses, at disparity `s`, the photo's
//! point `p + (s − d) · (f·(X, Y) − Z·p) / (1 − Z·d)`. It starts below a nearer surface, and is free only if it leaves that surface across an
//! edge, at an `s` of at most the disparity `n` of the nearest surface on its way. In front of the camera, `Z·s < 1`. Over the view box, with
//! half extents `x`, `y` and `z`, the edge is hence at most
//!
//! `(n − d) / (1 − z'·d) · (f·x + |p|·z')` pixels away, with `z' = min(z, 1/n)`,
//!
//! horizontally, and the same with `y` vertically. The camera at a corner of the box sees an edge exactly there. The bound grows with `n` and
//! shrinks as `d` grows; it is never more than `n·f·x + |p|`, even if the box reaches into the surface.

use std::ops::Range;

use super::coarse_surface::BLOCK;
use super::{Geometry, Surface, TileFrame, grown};
use crate::scene::{Grid, Intrinsics, Rect, ViewBox};

/// Largest distance at which pruning compares single pixels; farther edges are found in [blocks](super::coarse_surface).
pub(super) const FINE_REACH: u32 = 96;
/// Largest distance that pruning searches, in pixels: what the view box of the program's options uncovers in the widest photo that a
/// container holds. It bounds the work of readers.
const MAX_REACH: u32 = 52 * BLOCK;
/// Pixels added to the distance, for the bilinear footprint and rounding.
pub(super) const MARGIN: f64 = 1.5;
/// Rounds in which a search grows towards nearer surfaces. Most need three; a ramp that needs more is searched as far as the nearest surface
/// of a photo uncovers.
const ROUNDS: usize = 6;

impl ViewBox {
    /// Parallax in pixels (horizontal, vertical) of one unit of disparity within `rect`, between the reference view and the farthest camera
    /// of the box.
    pub fn parallax(&self, k: &Intrinsics, rect: Rect) -> (f64, f64) {
        // forward motion moves a pixel in proportion to its distance from the principal point
        let reach = |from: u32, len: u32, c: f64| (f64::from(from) - c).abs().max((f64::from(from + len) - c).abs());
        (k.fx * self.x + reach(rect.x, rect.w, k.cx) * self.z, k.fy * self.y + reach(rect.y, rect.h, k.cy) * self.z)
    }

    /// Largest distance in pixels (horizontal, vertical), in the photo, from a texel in `rect` with a disparity of at least `far` ≥ 0 to an
    /// edge of a surface with a disparity of at most `near` that uncovers the texel for a camera of the box. 0 unless `near > far`.
    pub fn uncovered(&self, k: &Intrinsics, rect: Rect, near: f64, far: f64) -> (f64, f64) {
        if far >= near {
            return (0.0, 0.0);
        }
        let z = if self.z * near > 1.0 { 1.0 / near } else { self.z };
        // `near` bounds the quotient, which is the limit of 0 / 0 where `z` is `1 / near`
        let step = ((near - far) / (1.0 - z * far)).min(near);
        let (x, y) = Self { z, ..*self }.parallax(k, rect);
        (step * x, step * y)
    }
}

/// Pixels that are read to prune a tile's layer, at most, and blocks.
fn window_work(grid: &Grid, index: u32) -> u64 {
    let area = |reach: u32| grown(grid.rect(index), reach, reach, grid).area() as u64;
    area(FINE_REACH) + area(MAX_REACH).div_ceil(u64::from(BLOCK * BLOCK))
}

/// Maximum number of pixels and blocks that [`Geometry::masks`] reads for a grid whose tiles have these numbers of `planes`, without the few
/// passes that find the nearest surface around a tile. Readers use it to bound their work.
pub fn work_of(grid: &Grid, planes: impl Iterator<Item = u64>) -> u64 {
    (0..grid.tiles()).zip(planes).map(|(i, n)| window_work(grid, i) * (n + 1)).sum()
}

/// Farthest that pruning searches for this camera and box, in pixels (horizontal, vertical), if surfaces have a δ of at most 1.
pub(crate) fn farthest(grid: &Grid, k: &Intrinsics, view_box: &ViewBox) -> (u32, u32) {
    let (x, y) = view_box.uncovered(k, Rect { x: 0, y: 0, w: grid.width, h: grid.height }, 1.0, 0.0);
    (pixels(x, MAX_REACH), pixels(y, MAX_REACH))
}

/// Rows of pixels that determine the texels, and their colours, in some rows of tiles, if pruning searches `reach` pixels up and down: whole
/// blocks.
pub(crate) fn pixel_rows(grid: &Grid, reach: u32, rows: &Range<u32>) -> Range<u32> {
    let last = grid.rect((rows.end - 1) * grid.columns());
    // colours and matting need fewer than these
    let reach = reach.max(FINE_REACH);
    let top = (rows.start * grid.stride).saturating_sub(reach) / BLOCK * BLOCK;
    top..(last.y + last.h + reach).next_multiple_of(BLOCK).min(grid.height)
}

/// A distance in whole pixels with its margin, at most `most`.
fn pixels(distance: f64, most: u32) -> u32 {
    ((distance + MARGIN).ceil() as u32).min(most)
}

impl Geometry {
    /// Farthest that pruning searches for an edge that uncovers a hidden texel, in pixels (horizontal, vertical). Background planes are
    /// wanted from as far.
    pub fn reach(&self) -> (u32, u32) {
        farthest(&self.grid, &self.intrinsics, &self.view_box)
    }

    /// True if pruning searches so far that it needs the surface in blocks.
    pub(super) fn searches_blocks(&self) -> bool {
        let (x, y) = self.reach();
        x.max(y) > FINE_REACH
    }

    /// Number of tiles with hidden texels that views from the box may uncover across more pixels than pruning searches. They may show gaps.
    pub fn tiles_beyond_reach(&self) -> usize {
        let most = MAX_REACH;
        let beyond = |index: u32| {
            let tile = &self.tiles[index as usize];
            let r = self.grid.rect(index);
            let (x, y) = self.view_box.uncovered(&self.intrinsics, r, 1.0, self.least(index));
            let win = grown(r, most, most, &self.grid);
            // where the search ends at the photo's borders, nothing is missed
            let cut = |distance: f64, within: u32, side: u32| distance + MARGIN > f64::from(most) && within < side;
            (tile.planes.len() > 1 || tile.background.is_some()) && (cut(x, win.w, self.grid.width) || cut(y, win.h, self.grid.height))
        };
        (0..self.tiles.len() as u32).filter(|t| beyond(*t)).count()
    }

    /// The least δ of the planes of a tile, within it, at least 0.
    fn least(&self, index: u32) -> f64 {
        let (tile, r, place) = (&self.tiles[index as usize], self.grid.rect(index), TileFrame::of(&self.grid, index));
        let planes = tile.planes.iter().chain(&tile.background);
        planes.map(|p| place.least(p, r)).fold(f64::INFINITY, f64::min).max(0.0)
    }

    /// Pixels whose surface determines the masks of a tile.
    pub(crate) fn window(&self, index: u32, surface: &Surface) -> Rect {
        let (win, radius) = self.search_window(self.grid.rect(index), self.nearest_around(index, surface), self.least(index));
        // one more pixel, because rounding between the corners can differ; blocks are read as a whole
        let more = if radius.0.max(radius.1) < FINE_REACH { 1 } else { BLOCK };
        grown(win, more, more, &self.grid)
    }

    /// δ of the nearest surface that can hide texels of a tile from a camera of the box: no nearer one is within the distance at which its
    /// edges would uncover any. At least 1 if it is not found within some rounds.
    pub(super) fn nearest_around(&self, index: u32, surface: &Surface) -> f64 {
        let (r, far) = (self.grid.rect(index), self.least(index));
        let mut near = far;
        for _ in 0..ROUNDS {
            let (win, radius) = self.search_window(r, near, far);
            // a nearer surface in the neighbourhood uncovers from farther away
            let nearest = surface.nearest(win, radius.0.max(radius.1) > FINE_REACH);
            if nearest <= near {
                return near;
            }
            near = nearest;
        }
        near.max(1.0)
    }

    /// Pixels in which an edge of a surface at `near` can uncover texels of `rect` with a disparity of at least `far`, and its largest
    /// distance from them (horizontal, vertical).
    pub(super) fn search_window(&self, rect: Rect, near: f64, far: f64) -> (Rect, (u32, u32)) {
        let (most, (x, y)) = (self.reach(), self.view_box.uncovered(&self.intrinsics, rect, near, far));
        let radius = (pixels(x, most.0), pixels(y, most.1));
        (grown(rect, radius.0, radius.1, &self.grid), radius)
    }
}

#[cfg(test)]
mod tests;
