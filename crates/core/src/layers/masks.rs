//! Texels of each layer, derived from planes and labels alone, so that a container need not carry them.
//!
//! Writer and readers compute in `f64` and round to `f32` at the same places, so their texels match bit for bit.

use std::ops::Range;

use super::Surface;
use super::prune::{Behind, Pruning, extent};
use super::visibility_kernels::{self, Columns};
use crate::parallel;
use crate::scene::{Class, Grid, Intrinsics, Plane, Rect, ViewBox};

/// A layer whose edge lies in front of its neighbour by at most this many pixels of parallax over [`SEAM_BOX`] is one surface with it,
/// however large the scene's view box is.
const SEAM: f64 = 1.0;
/// The view box over which [`SEAM`] counts. All containers are read with it.
const SEAM_BOX: ViewBox = ViewBox::cube(0.03);

/// The planes of one tile, and the label of each pixel.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tile {
    /// Planes, quantised as in the container, from far to near at the tile's centre; 1 to 64.
    pub planes: Vec<Plane>,
    /// Index of the plane of each pixel in the tile's rectangle, row-major.
    pub labels: Vec<u8>,
    /// A plane behind everything that the tile shows, known from its neighbourhood. It has hidden texels only.
    pub background: Option<Plane>,
}

impl Tile {
    /// The smallest δ that this tile shows; `index` is its index in the grid.
    pub fn min_disparity(&self, grid: &Grid, index: u32) -> f32 {
        let (r, place) = (grid.rect(index), TileFrame::of(grid, index));
        let mut least = f32::INFINITY;
        for (y, labels) in (r.y..r.y + r.h).zip(self.labels.chunks(r.w as usize)) {
            let (v, mut x) = (place.v(y), r.x);
            for run in labels.chunk_by(|a, b| a == b) {
                let plane = &self.planes[usize::from(run[0])];
                let next = x + run.len() as u32;
                // an affine plane is farthest at an end of the run, and rounding keeps the order
                for end in [x, next - 1] {
                    let d = plane.disparity(place.u(end), v) as f32;
                    least = if d < least { d } else { least };
                }
                x = next;
            }
        }
        least
    }

    /// δ of each pixel, row-major; `index` is the tile's index in the grid.
    pub fn disparities(&self, grid: &Grid, index: u32) -> Vec<f32> {
        let (r, place) = (grid.rect(index), TileFrame::of(grid, index));
        let (mut us, mut planes, mut out) = (Vec::new(), Vec::new(), vec![0f32; r.area()]);
        place.columns(r.x, r.w, &mut us);
        let columns = Columns { us: &us, labels: &self.labels, planes: &self.planes };
        for (y, row) in out.chunks_mut(r.w as usize).enumerate() {
            columns.visible(y, place.v(r.y + y as u32), &mut planes, row);
        }
        out
    }
}

/// Everything that determines the texels of a scene, except for colours.
#[derive(Clone, Debug, PartialEq)]
pub struct Geometry {
    /// The grid of tiles.
    pub grid: Grid,
    /// The reference camera.
    pub intrinsics: Intrinsics,
    /// Camera positions that the scene is made for.
    pub view_box: ViewBox,
    /// One entry for each tile of the grid.
    pub tiles: Vec<Tile>,
    /// Width, in pixels, of the band on the far side of depth borders whose colours are decomposed into foreground and background; 0 for
    /// none. Containers have [`super::MATTE_BAND`] or 0.
    pub matte_band: usize,
}

/// Classes and alphas of one layer.
#[derive(Clone, Debug, PartialEq)]
pub struct LayerMask {
    /// Plane of the layer.
    pub plane: Plane,
    /// Label of the layer; `None` for a background plane.
    pub label: Option<u8>,
    /// Pixels of the photo that the texels cover.
    pub rect: Rect,
    /// The [`Class`] of each texel, as a byte.
    pub class: Vec<u8>,
    /// Straight alpha of each texel.
    pub alpha: Vec<u8>,
}

/// Masks of the layers of a tile, from far to near at the tile's centre.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LayerMasks {
    /// The layers that have any texels.
    pub layers: Vec<LayerMask>,
    /// Number of hidden texels left out because no camera of the view box can see them.
    pub never_seen: usize,
}

/// Maps photo pixels to the `(u, v)` of a tile.
#[derive(Clone, Copy, Debug)]
pub struct TileFrame {
    /// Centre of the tile in pixels.
    pub centre: (f64, f64),
    /// Half the tile's size in pixels.
    pub half: f64,
}

impl TileFrame {
    /// The frame of tile `index`.
    pub fn of(grid: &Grid, index: u32) -> Self {
        Self { centre: grid.centre(index), half: grid.half() }
    }

    /// `v` of the centre of pixel row `y`.
    pub fn v(&self, y: u32) -> f64 {
        (f64::from(y) + 0.5 - self.centre.1) / self.half
    }

    /// `u` of the centre of pixel column `x`.
    fn u(&self, x: u32) -> f64 {
        (f64::from(x) + 0.5 - self.centre.0) / self.half
    }

    /// Writes `u` of the centres of `count` pixel columns from `x` on into `us`.
    pub fn columns(&self, x: u32, count: u32, us: &mut Vec<f64>) {
        us.clear();
        us.extend((x..x + count).map(|x| self.u(x)));
    }

    /// The least δ of a plane at the pixels of a rectangle, which has at least one.
    pub(super) fn least(&self, plane: &Plane, r: Rect) -> f64 {
        let (right, lower) = (r.x + r.w - 1, r.y + r.h - 1);
        // an affine plane is farthest at a corner
        let corners = [(r.x, r.y), (right, r.y), (r.x, lower), (right, lower)].map(|(x, y)| f64::from(self.disparity(plane, x, y)));
        corners.into_iter().fold(f64::INFINITY, f64::min)
    }

    /// δ of a plane at the centre of pixel `(x, y)`.
    pub fn disparity(&self, plane: &Plane, x: u32, y: u32) -> f32 {
        plane.disparity(self.u(x), self.v(y)) as f32
    }
}

/// The rectangle enlarged by `x` and `y` pixels on each side and clipped to the photo.
pub fn grown(r: Rect, x: u32, y: u32, grid: &Grid) -> Rect {
    let (x0, y0) = (r.x.saturating_sub(x), r.y.saturating_sub(y));
    Rect { x: x0, y: y0, w: (r.x + r.w + x).min(grid.width) - x0, h: (r.y + r.h + y).min(grid.height) - y0 }
}

impl Geometry {
    /// Number of planes in all tiles, including background planes.
    pub fn planes(&self) -> usize {
        self.tiles.iter().map(|t| t.planes.len() + usize::from(t.background.is_some())).sum()
    }

    /// Masks of all layers, tile by tile.
    pub fn masks(&self) -> Vec<LayerMasks> {
        self.extract(false)
    }

    /// Like [`Geometry::masks`], but with all hidden texels, including those that no camera can see. A baseline to evaluate pruning.
    pub fn masks_unpruned(&self) -> Vec<LayerMasks> {
        self.extract(true)
    }

    fn extract(&self, all: bool) -> Vec<LayerMasks> {
        self.masks_of(0..self.tiles.len() as u32, &self.surface(), all)
    }

    /// Masks of some tiles. The surface must cover at least their [`pixel_rows`](super::pixel_rows). With `all`, keeps hidden texels that no
    /// camera can see.
    pub(crate) fn masks_of(&self, tiles: Range<u32>, surface: &Surface, all: bool) -> Vec<LayerMasks> {
        let scratch = || Scratch { all, ..Scratch::default() };
        parallel::map_init(tiles.len(), scratch, |s, i| self.masks_of_tile(tiles.start + i as u32, surface, s))
    }

    /// δ of the visible surface of the whole photo.
    pub fn surface(&self) -> Surface {
        Surface::of(self, 0..self.grid.height)
    }

    /// δ of the visible surface of some rows of pixels.
    pub(crate) fn surface_of(&self, rows: Range<u32>) -> Surface {
        Surface::of(self, rows)
    }

    #[inline(never)]
    fn masks_of_tile(&self, index: u32, surface: &Surface, s: &mut Scratch) -> LayerMasks {
        let (tile, r, place) = (&self.tiles[index as usize], self.grid.rect(index), TileFrame::of(&self.grid, index));
        if let ([plane], None) = (tile.planes.as_slice(), tile.background) {
            // a tile with a single plane is all visible
            let (class, alpha) = (vec![Class::Photo as u8; r.area()], vec![u8::MAX; r.area()]);
            return LayerMasks { layers: vec![LayerMask { plane: *plane, label: Some(0), rect: r, class, alpha }], never_seen: 0 };
        }
        let w = r.w as usize;
        s.visible.resize(r.area(), 0.0);
        s.own.resize(r.area(), 0.0);
        for mask in [&mut s.hidden, &mut s.class, &mut s.alpha] {
            mask.resize(r.area(), 0);
        }
        let mut us = std::mem::take(&mut s.us);
        place.columns(r.x, r.w, &mut us);
        let columns = Columns { us: &us, labels: &tile.labels, planes: &tile.planes };
        for (y, out) in s.visible.chunks_mut(w).enumerate() {
            columns.visible(y, place.v(r.y + y as u32), &mut s.planes, out);
        }
        let parallax = |view_box: ViewBox| {
            let (x, y) = view_box.parallax(&self.intrinsics, r);
            x.max(y)
        };
        let (parallax, usual) = (parallax(self.view_box), parallax(SEAM_BOX));
        // found only if a layer needs it
        let mut nearest = None;
        let mut out = LayerMasks::default();
        let labelled = tile.planes.iter().enumerate().map(|(j, q)| (Some(j as u8), *q));
        for (label, plane) in labelled.chain(tile.background.map(|q| (None, q))) {
            for (y, own) in s.own.chunks_mut(w).enumerate() {
                visibility_kernels::disparities(&us, place.v(r.y + y as u32), &plane, own);
            }
            let behind = visibility_kernels::behind(&s.own, &s.visible, &tile.labels, label, &mut s.hidden);
            if behind > 0 && !s.all {
                let near = *nearest.get_or_insert_with(|| self.nearest_around(index, surface));
                let layer = Behind { r, place, plane: &plane, near };
                out.never_seen += behind - self.keep_seen(&layer, surface, &mut s.hidden, &mut s.pruning);
            }
            let Some(layer) = mask(r, place, tile, label, plane, [parallax, usual], s) else { continue };
            // a background plane is usually the farthest, but the order is by δ at the tile's centre; inserting is enough for so few
            // layers, and a sort would be a twentieth of the wasm
            let farther = out.layers.partition_point(|l| l.plane.a.total_cmp(&layer.plane.a).is_le());
            out.layers.insert(farther, layer);
        }
        s.us = us;
        out
    }
}

#[derive(Default)]
struct Scratch {
    /// Skips pruning.
    all: bool,
    /// `u` of the tile's columns.
    us: Vec<f64>,
    /// Coefficients of each plane in the current row: `b`, and `c · v`.
    planes: Vec<[f64; 2]>,
    /// δ of the visible surface and of the current layer.
    visible: Vec<f32>,
    own: Vec<f32>,
    /// 1 for the hidden texels of the current layer, otherwise 0.
    hidden: Vec<u8>,
    /// Classes and alphas of the current layer over the whole tile.
    class: Vec<u8>,
    alpha: Vec<u8>,
    pruning: Pruning,
    /// For each texel, the number of opaque ones among it and its neighbours in the row.
    sums: Vec<u8>,
    /// For each empty texel of a row, the number of opaque texels around it.
    ring: Vec<u8>,
}

/// Joins visible, hidden and soft texels into a layer cropped to its bounds; `None` if it has no texels.
#[inline(never)]
fn mask(r: Rect, place: TileFrame, tile: &Tile, label: Option<u8>, plane: Plane, parallax: [f64; 2], s: &mut Scratch) -> Option<LayerMask> {
    visibility_kernels::classify(&tile.labels, label, &s.hidden, &mut s.class, &mut s.alpha);
    if let Some(label) = label {
        soften(&SoftEdge { r, place, tile, label, parallax }, s);
    }
    let b = bounds(&s.class, r.w, r.h)?;
    let cut = |texels: &[u8]| {
        let mut out = Vec::with_capacity(b.area());
        for row in texels.chunks(r.w as usize).skip(b.y as usize).take(b.h as usize) {
            out.extend_from_slice(&row[b.x as usize..][..b.w as usize]);
        }
        out
    };
    Some(LayerMask { plane, label, rect: Rect { x: r.x + b.x, y: r.y + b.y, w: b.w, h: b.h }, class: cut(&s.class), alpha: cut(&s.alpha) })
}

/// A layer whose edge is softened.
struct SoftEdge<'a> {
    r: Rect,
    place: TileFrame,
    tile: &'a Tile,
    label: u8,
    /// Parallax, in pixels, of one unit of disparity over the scene's view box, and over [`SEAM_BOX`].
    parallax: [f64; 2],
}

impl SoftEdge<'_> {
    /// True if the surface is creased so that each side lies in front of the other's extension: the layer visible at pixel `(x, y)` of the
    /// ring has no texel behind one of this layer's adjacent pixels. `own` is δ of this layer.
    fn folds(&self, x: usize, y: usize, own: &[f32]) -> bool {
        let (w, h) = (self.r.w as usize, self.r.h as usize);
        let other = &self.tile.planes[self.tile.labels[y * w + x] as usize];
        let beside = (y.saturating_sub(1)..(y + 2).min(h)).flat_map(|y| (x.saturating_sub(1)..(x + 2).min(w)).map(move |x| (x, y)));
        beside.filter(|(x, y)| self.tile.labels[y * w + x] == self.label).any(|(x, y)| {
            let delta = self.place.disparity(other, self.r.x + x as u32, self.r.y + y as u32);
            delta >= own[y * w + x] || delta < 0.0
        })
    }
}

/// Adds a ring of soft texels around the layer. Alpha is the 3×3 box filter of the opaque mask and the colour is the photo's, so the
/// reference view stays exact. The ring exists only where the layer lies in front: elsewhere, the photo's colour belongs to another
/// surface. Where the layer lies only slightly in front and the surface has a crease, the ring is opaque; otherwise a hairline gap would
/// open along the crease.
#[inline(never)]
fn soften(edge: &SoftEdge, s: &mut Scratch) {
    let (w, h) = (edge.r.w as usize, edge.r.h as usize);
    let Scratch { class, alpha, own, visible, sums, ring, .. } = s;
    sums.resize(w * h, 0);
    for (alpha, sums) in alpha.chunks(w).zip(sums.chunks_mut(w)) {
        visibility_kernels::sums_of_three(alpha, sums);
    }
    ring.resize(w, 0);
    for y in 0..h {
        let row = |y: usize| &sums[y * w..][..w];
        let above = if y > 0 { row(y - 1) } else { &[] };
        let below = if y + 1 < h { row(y + 1) } else { &[] };
        if !visibility_kernels::ring(&class[y * w..][..w], [above, row(y), below], ring) {
            continue;
        }
        let lines = 1 + usize::from(y > 0) + usize::from(y + 1 < h);
        for x in 0..w {
            let (at, set) = (y * w + x, u32::from(ring[x]));
            if set == 0 {
                continue;
            }
            let [front, step] = edge.parallax.map(|p| (f64::from(own[at]) - f64::from(visible[at])) * p);
            if front > 0.0 {
                let all = (lines * (1 + usize::from(x > 0) + usize::from(x + 1 < w))) as u32;
                class[at] = Class::Photo as u8;
                let soft = ((255 * set + all / 2) / all) as u8;
                alpha[at] = if step <= SEAM && edge.folds(x, y, own) { 255 } else { soft };
            }
        }
    }
}

/// Bounds of the non-empty texels, plus one empty texel on each side if the tile has it, so that bilinear samples fade out; `None` if all
/// texels are empty.
fn bounds(class: &[u8], w: u32, h: u32) -> Option<Rect> {
    let b = extent(class, w as usize)?;
    let (x, y) = (b.x.saturating_sub(1), b.y.saturating_sub(1));
    Some(Rect { x, y, w: (b.x + b.w + 1).min(w) - x, h: (b.y + b.h + 1).min(h) - y })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Intrinsics, ViewBox};

    #[test]
    fn the_smallest_disparity_is_that_of_a_pixel() {
        let grid = Grid::new(70, 50, 64);
        let planes = vec![Plane { a: 0.3, b: 0.1, c: -0.2 }, Plane { a: 0.31, b: -0.15, c: 0.01 }];
        for (index, patch) in (0..grid.tiles()).flat_map(|index| [1, 3, 17, 64].map(|patch| (index, patch))) {
            let r = grid.rect(index);
            let labels = (0..r.area() as u32).map(|i| ((i % r.w / patch + i / r.w / patch) % 2) as u8).collect();
            let tile = Tile { planes: planes.clone(), labels, background: None };
            let want = tile.disparities(&grid, index).into_iter().fold(f32::INFINITY, f32::min);
            assert_eq!(tile.min_disparity(&grid, index).to_bits(), want.to_bits(), "tile {index}, patches of {patch}");
        }
    }

    #[test]
    fn edges_are_opaque_at_a_crease_and_soft_at_a_small_step() {
        let grid = Grid::new(64, 64, 64);
        let rims = |left: Plane, right: Plane| {
            let mut planes = vec![left, right];
            let order = left.a > right.a;
            planes.sort_by(|p, q| p.a.total_cmp(&q.a));
            let labels = (0..4096u32).map(|i| u8::from((i % 64 < 32) == order)).collect();
            let b = Geometry {
                grid,
                intrinsics: Intrinsics::centred(64, 64, 100.0),
                view_box: ViewBox { x: 0.04, y: 0.0, z: 0.0 },
                tiles: vec![Tile { planes, labels, background: None }],
                matte_band: 0,
            };
            let shapes = b.masks().remove(0);
            let row = |s: &LayerMask| {
                s.alpha[32 * s.rect.w as usize..][..s.rect.w as usize].iter().map(|&a| usize::from(a == 255)).sum::<usize>()
            };
            let soft = |s: &LayerMask| s.alpha.iter().any(|a| (1..255).contains(a));
            (shapes.layers.iter().map(row).sum::<usize>(), shapes.layers.iter().any(soft))
        };
        // both sides rise towards the middle, and their extensions rise further: neither has a texel below the other
        let valley = rims(Plane { a: 0.52, b: 0.3, c: 0.0 }, Plane { a: 0.521, b: -0.3, c: 0.0 });
        assert_eq!(valley, (64 + 2, false));
        // a step of half a pixel: the far side continues below the near one
        let (_, soft) = rims(Plane::fronto_parallel(0.4), Plane::fronto_parallel(0.5));
        assert!(soft);
    }
}
