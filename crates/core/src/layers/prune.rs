//! Pruning: keeps only the hidden texels that a camera in the view box can see.
//!
//! A camera looks past an edge [so far](super::reach). A hidden texel can therefore be seen only if, within that distance, there is a pixel
//! where the visible surface does not cover the layer's plane. The test is a box dilation of such open pixels; far searches look for open
//! [blocks](super::coarse_surface).

use super::coarse_surface::BlockSearch;
use super::dilation::{Dilation, dilate};
use super::reach::FINE_REACH;
use super::{Geometry, Surface, TileFrame, visibility_kernels};
use crate::scene::{Plane, Rect};

/// A visible surface at most this far in front of a layer, in δ, does not cover it.
const UNOCCLUDED: f64 = 0.004;

/// A layer of a tile with texels behind the visible surface.
pub(super) struct Behind<'a> {
    /// Pixels of the tile.
    pub r: Rect,
    pub place: TileFrame,
    pub plane: &'a Plane,
    /// [`Geometry::nearest_around`] the tile.
    pub near: f64,
}

/// Scratch memory, reused from layer to layer.
#[derive(Default)]
pub(super) struct Pruning {
    /// `u` of the columns of the window around the texels.
    us: Vec<f64>,
    /// 1 for the pixels of the window that nothing covers, otherwise 0.
    open: Vec<u8>,
    /// Dilation of the open pixels within the tile.
    reach: Dilation,
    /// Sums of open blocks.
    sums: Vec<u32>,
}

impl Geometry {
    /// Clears the texels of a layer in `hidden`, a mask of 0 and 1 over the tile, that no camera of the view box can see. Returns the
    /// number of remaining texels.
    #[inline(never)]
    pub(super) fn keep_seen(&self, layer: &Behind, surface: &Surface, hidden: &mut [u8], scratch: &mut Pruning) -> usize {
        let (Behind { r, place, plane, near }, Pruning { us, open, reach: dilation, sums }) = (layer, scratch);
        let Some(bounds) = extent(hidden, r.w as usize) else { return 0 };
        // pixels farther than the radius from all hidden texels cannot uncover any
        let inner = Rect { x: r.x + bounds.x, y: r.y + bounds.y, ..bounds };
        let (win, radius) = self.search_window(inner, *near, place.least(plane, inner).max(0.0));
        if radius.0.max(radius.1) > FINE_REACH
            && let Some(coarse) = surface.coarse()
        {
            let search = BlockSearch { win, inner, radius, plane, frame: (place.centre, place.half), slack: UNOCCLUDED };
            return coarse.keep_seen(&search, *r, hidden, sums);
        }
        place.columns(win.x, win.w, us);
        open.resize(win.area(), 0);
        for (y, open) in (win.y..).zip(open.chunks_mut(win.w as usize)) {
            visibility_kernels::open(us, place.v(y), plane, surface.row(win.x, y, win.w), UNOCCLUDED, open);
        }
        dilate(open, win.w, Rect { x: inner.x - win.x, y: inner.y - win.y, ..inner }, radius, dilation);
        let mut seen = 0;
        for (y, reached) in (bounds.y as usize..).zip(dilation.out.chunks(bounds.w as usize)) {
            for (h, reached) in hidden[y * r.w as usize + bounds.x as usize..].iter_mut().zip(reached) {
                *h &= reached;
                seen += usize::from(*h);
            }
        }
        seen
    }
}

/// Bounds of the non-zero entries in a mask that is `w` pixels wide; `None` if there are none.
pub(super) fn extent(mask: &[u8], w: usize) -> Option<Rect> {
    let full = |c: &u8| *c != 0;
    // whole rows at a time, without an early exit, which would not vectorise
    let any = |row: &[u8]| row.iter().fold(0, |any, c| any | c) != 0;
    let (y0, last) = (mask.chunks(w).position(any)?, mask.chunks(w).rposition(any)?);
    let mut columns = vec![0u8; w];
    for row in mask.chunks(w).skip(y0).take(last + 1 - y0) {
        for (column, c) in columns.iter_mut().zip(row) {
            *column |= c;
        }
    }
    let (x0, right) = (columns.iter().position(full)?, columns.iter().rposition(full)?);
    Some(Rect { x: x0 as u32, y: y0 as u32, w: (right + 1 - x0) as u32, h: (last + 1 - y0) as u32 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Class, Grid, Intrinsics, Tile, ViewBox};

    #[test]
    fn background_has_hidden_texels_only_near_the_edge_that_uncovers_them() {
        // a near square in the middle of a far wall
        let grid = Grid::new(64, 64, 64);
        let labels = (0..4096u32).map(|i| u8::from((16..48).contains(&(i % 64)) && (16..48).contains(&(i / 64)))).collect();
        let tile = Tile { planes: vec![Plane::fronto_parallel(0.25), Plane::fronto_parallel(1.0)], labels, background: None };
        let b = Geometry {
            grid,
            intrinsics: Intrinsics::centred(64, 64, 100.0),
            view_box: ViewBox { x: 0.04, y: 0.0, z: 0.0 },
            tiles: vec![tile],
            matte_band: 0,
        };
        let shapes = &b.masks()[0];
        let far = &shapes.layers[0];
        let hidden = |x: u32, y: u32| far.class[((y - far.rect.y) * far.rect.w + x - far.rect.x) as usize] == Class::Hidden as u8;
        // a parallax of 4 px times a step of 0.75, plus the margin: 5 px from the left and right edges, 2 px from the others
        assert!(hidden(20, 32) && !hidden(21, 32) && hidden(43, 32) && !hidden(42, 32));
        assert!(hidden(32, 17) && !hidden(32, 18));
        assert_eq!(shapes.never_seen, 22 * 28);
        let near = &shapes.layers[1];
        assert!(near.alpha.iter().any(|a| (1..255).contains(a)), "the near layer has a soft rim");
    }
}
