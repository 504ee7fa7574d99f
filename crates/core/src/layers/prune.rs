//! Pruning: keeps only the hidden texels that a camera in the view box can see.
//!
//! A camera looks past an edge by the parallax between the two sides of the edge, in pixels. A hidden texel can therefore be seen only if,
//! within that distance, there is a pixel where the visible surface does not cover the layer's plane. The test is a box dilation of such
//! open pixels.

use std::ops::Range;

use super::dilation::{Dilation, dilate};
use super::{Geometry, Surface, TileFrame, grown, visibility_kernels};
use crate::scene::{Grid, Intrinsics, Plane, Rect, ViewBox};

/// Maximum search distance for an edge that uncovers a hidden texel, in pixels.
const MAX_REACH: f64 = 96.0;
/// Pixels added to the parallax, for the bilinear footprint and rounding.
const MARGIN: f64 = 1.5;
/// A visible surface at most this far in front of a layer, in δ, does not cover it.
const UNOCCLUDED: f64 = 0.004;

impl ViewBox {
    /// Parallax in pixels (horizontal, vertical) of one unit of disparity within `rect`, between the reference view and the farthest camera
    /// of the box.
    pub fn parallax(&self, k: &Intrinsics, rect: Rect) -> (f64, f64) {
        // forward motion moves a pixel in proportion to its distance from the principal point
        let reach = |from: u32, len: u32, c: f64| (f64::from(from) - c).abs().max((f64::from(from + len) - c).abs());
        (k.fx * self.x + reach(rect.x, rect.w, k.cx) * self.z, k.fy * self.y + reach(rect.y, rect.h, k.cy) * self.z)
    }
}

/// A layer of a tile with texels behind the visible surface.
pub(super) struct Behind<'a> {
    /// Pixels of the tile.
    pub r: Rect,
    pub place: TileFrame,
    pub plane: &'a Plane,
    /// Maximum distance of its texels behind the surface, in δ.
    pub depth: f64,
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
}

/// Maximum number of pixels that [`Geometry::masks`] reads for a grid whose tiles have these numbers of `planes`. Readers use it to bound
/// their work.
pub fn work_of(grid: &Grid, planes: impl Iterator<Item = u64>) -> u64 {
    let reach = MAX_REACH as u32;
    let window = |i: u32| grown(grid.rect(i), reach, reach, grid).area() as u64;
    (0..grid.tiles()).zip(planes).map(|(i, n)| window(i) * (n + 1)).sum()
}

impl Geometry {
    /// Rows of pixels that determine the texels, and their colours, in some rows of tiles.
    pub(crate) fn pixel_rows(grid: &Grid, rows: &Range<u32>) -> Range<u32> {
        let last = grid.rect((rows.end - 1) * grid.columns());
        let reach = MAX_REACH as u32;
        (rows.start * grid.stride).saturating_sub(reach)..(last.y + last.h + reach).min(grid.height)
    }

    /// Pixels whose surface determines the masks of a tile.
    pub(crate) fn window(&self, index: u32) -> Rect {
        let (tile, r, place) = (&self.tiles[index as usize], self.grid.rect(index), TileFrame::of(&self.grid, index));
        let (right, lower) = (r.x + r.w - 1, r.y + r.h - 1);
        let corners = [(r.x, r.y), (right, r.y), (r.x, lower), (right, lower)];
        let all = tile.planes.iter().chain(&tile.background).flat_map(|p| corners.map(|(x, y)| f64::from(place.disparity(p, x, y))));
        let (least, most) = all.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, m), d| (l.min(d), m.max(d)));
        let parallax = self.view_box.parallax(&self.intrinsics, r);
        // one more pixel, because rounding between the corners can differ
        let reach = |parallax: f64| ((most - least) * parallax + MARGIN).min(MAX_REACH).ceil() as u32 + 1;
        grown(r, reach(parallax.0), reach(parallax.1), &self.grid)
    }

    /// Clears the texels of a layer in `hidden`, a mask of 0 and 1 over the tile, that no camera of the view box can see. Returns the
    /// number of remaining texels.
    #[inline(never)]
    pub(super) fn keep_seen(&self, layer: &Behind, surface: &Surface, hidden: &mut [u8], scratch: &mut Pruning) -> usize {
        let (Behind { r, place, plane, depth }, Pruning { us, open, reach: dilation }) = (layer, scratch);
        let Some(bounds) = extent(hidden, r.w as usize) else { return 0 };
        let parallax = self.view_box.parallax(&self.intrinsics, *r);
        let reach = |parallax: f64, step: f64| (step * parallax + MARGIN).min(MAX_REACH).ceil() as u32;
        let win = grown(*r, reach(parallax.0, *depth), reach(parallax.1, *depth), &self.grid);
        // an occluder in the neighbourhood can be nearer still, and its edge uncovers more
        let nearest = (win.y..win.y + win.h).map(|y| visibility_kernels::nearest(surface.row(win.x, y, win.w))).fold(0.0, f32::max);
        // an affine plane is farthest at a corner
        let corner = |x: u32, y: u32| place.disparity(plane, x, y);
        let (right, lower) = (win.x + win.w - 1, win.y + win.h - 1);
        let least = corner(win.x, win.y).min(corner(right, win.y)).min(corner(win.x, lower)).min(corner(right, lower));
        let step = (f64::from(nearest) - f64::from(least).max(0.0)).max(*depth);
        let radius = (reach(parallax.0, step), reach(parallax.1, step));
        // pixels farther than that from all hidden texels cannot uncover any
        let inner = Rect { x: r.x + bounds.x, y: r.y + bounds.y, ..bounds };
        let near = common(win, grown(inner, radius.0, radius.1, &self.grid));
        place.columns(near.x, near.w, us);
        open.resize(near.area(), 0);
        for (y, open) in (near.y..).zip(open.chunks_mut(near.w as usize)) {
            visibility_kernels::open(us, place.v(y), plane, surface.row(near.x, y, near.w), UNOCCLUDED, open);
        }
        dilate(open, near.w, Rect { x: inner.x - near.x, y: inner.y - near.y, ..inner }, radius, dilation);
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

/// The intersection of two overlapping rectangles.
fn common(a: Rect, b: Rect) -> Rect {
    let (x, y) = (a.x.max(b.x), a.y.max(b.y));
    Rect { x, y, w: (a.x + a.w).min(b.x + b.w) - x, h: (a.y + a.h).min(b.y + b.h) - y }
}

/// Bounds of the non-zero entries in a mask that is `w` pixels wide; `None` if there are none.
pub(super) fn extent(mask: &[u8], w: usize) -> Option<Rect> {
    let full = |c: &u8| *c != 0;
    let y0 = mask.iter().position(full)? / w;
    let y1 = mask.iter().rposition(full)? / w + 1;
    let (mut x0, mut x1) = (w, 0);
    for row in mask[y0 * w..y1 * w].chunks(w) {
        // only entries outside the current bounds can widen them
        x0 = row[..x0].iter().position(full).unwrap_or(x0);
        x1 = row[x1..].iter().rposition(full).map_or(x1, |x| x1 + x + 1);
    }
    Some(Rect { x: x0 as u32, y: y0 as u32, w: (x1 - x0) as u32, h: (y1 - y0) as u32 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Class, Tile};

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
            matted: false,
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

    #[test]
    fn rows_of_tiles_depend_on_pixels_within_the_maximum_reach() {
        let grid = Grid { width: 100, height: 3000, size: 64, stride: 56 };
        let reach = MAX_REACH as u32;
        assert_eq!(Geometry::pixel_rows(&grid, &(20..22)), 20 * 56 - reach..21 * 56 + 64 + reach);
        assert_eq!(Geometry::pixel_rows(&grid, &(0..1)), 0..64 + reach);
        let rows = grid.tiles() / grid.columns();
        assert_eq!(Geometry::pixel_rows(&grid, &(rows - 1..rows)), (rows - 1) * 56 - reach..3000);
    }

    #[test]
    fn work_counts_every_plane_and_the_window_once_more() {
        let grid = Grid { width: 300, height: 64, size: 64, stride: 64 };
        let reach = MAX_REACH as u32;
        let window = |i: u32| u64::from((i * 64 + 64 + reach).min(300) - (i * 64).saturating_sub(reach)) * 64;
        let want: u64 = [3u64, 0, 1, 2, 5].iter().zip(0..).map(|(n, i)| window(i).min(300 * 64) * (n + 1)).sum();
        assert_eq!(work_of(&grid, [3, 0, 1, 2, 5].into_iter()), want);
    }
}
