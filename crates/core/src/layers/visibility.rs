//! Which texels each layer has: derived from planes and labels alone, so that a container need not carry it.
//!
//! Writer and readers run the same steps in `f64` on values rounded to `f32` at the same places, and so come to the same texels bit
//! for bit.

use std::ops::Range;

use super::Surface;
use super::rows::{self, Columns, Dilation, dilate};
use crate::parallel;
use crate::scene::{Class, Grid, Intrinsics, Plane, Rect, ViewBox};

/// Widest search for the edge that uncovers a hidden texel, in pixels.
const MAX_REACH: f64 = 96.0;
/// Pixels added to the parallax: bilinear footprint and rounding.
const MARGIN: f64 = 1.5;
/// A surface counts as open for a layer that lies at most this far in front of it, in δ.
const UNOCCLUDED: f64 = 0.004;

/// A layer whose rim lies in front of its neighbour by at most this many pixels of parallax is one surface with it.
const SEAM: f64 = 1.0;

/// The planes of one tile and which of them each pixel lies on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tile {
    /// Planes on the container's grid, from far to near at the tile's centre; 1 to 64.
    pub planes: Vec<Plane>,
    /// Plane that each pixel of the tile's rectangle lies on, row-major.
    pub labels: Vec<u8>,
    /// A plane behind all that the tile shows, known from its neighbourhood: hidden texels only.
    pub background: Option<Plane>,
}

impl Tile {
    /// The least δ that it shows, of tile `index` of the grid.
    #[must_use]
    pub fn farthest(&self, grid: &Grid, index: u32) -> f32 {
        self.shown(grid, index).iter().fold(f32::INFINITY, |least, &d| if d < least { d } else { least })
    }

    /// δ of each of its pixels, row-major, of tile `index` of the grid.
    #[must_use]
    pub fn shown(&self, grid: &Grid, index: u32) -> Vec<f32> {
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

/// Everything that the texels of a scene follow from, but their colours.
#[derive(Clone, Debug, PartialEq)]
pub struct Geometry {
    /// The tiles.
    pub grid: Grid,
    /// The reference camera.
    pub intrinsics: Intrinsics,
    /// Camera positions that the scene is made for.
    pub view_box: ViewBox,
    /// One entry a tile of the grid.
    pub tiles: Vec<Tile>,
}

/// Which texels one layer has, and how opaque they are.
#[derive(Clone, Debug, PartialEq)]
pub struct LayerMask {
    /// Its plane.
    pub plane: Plane,
    /// Its label, none for a background.
    pub label: Option<u8>,
    /// Photo pixels that its texels stand for.
    pub rect: Rect,
    /// [`Class`] per texel.
    pub class: Vec<u8>,
    /// Straight alpha per texel.
    pub alpha: Vec<u8>,
}

/// Masks of the layers of a tile, from far to near at its centre.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LayerMasks {
    /// The layers that have any texel.
    pub layers: Vec<LayerMask>,
    /// Texels behind something that no camera of the view box looks past, and that were therefore left out.
    pub never_seen: usize,
}

impl ViewBox {
    /// Parallax in pixels, right and down, that a unit of disparity has within `rect` between the photo and the farthest
    /// camera of the box.
    #[must_use]
    pub fn parallax(&self, k: &Intrinsics, rect: Rect) -> (f64, f64) {
        // forward motion moves a pixel by its distance from the principal point
        let reach = |from: u32, len: u32, c: f64| (f64::from(from) - c).abs().max((f64::from(from + len) - c).abs());
        (k.fx * self.x + reach(rect.x, rect.w, k.cx) * self.z, k.fy * self.y + reach(rect.y, rect.h, k.cy) * self.z)
    }
}

/// Where `(u, v)` of a tile lies in the photo.
#[derive(Clone, Copy, Debug)]
pub struct TileFrame {
    /// Tile centre in pixels.
    pub centre: (f64, f64),
    /// Half a tile in pixels.
    pub half: f64,
}

impl TileFrame {
    /// Of tile `index`.
    #[must_use]
    pub fn of(grid: &Grid, index: u32) -> Self {
        Self { centre: grid.centre(index), half: grid.half() }
    }

    /// Vertical place of a row of pixels, in units of half a tile.
    #[must_use]
    pub fn v(&self, y: u32) -> f64 {
        (f64::from(y) + 0.5 - self.centre.1) / self.half
    }

    /// Horizontal places of `count` columns of pixels from `x` on, into `us`.
    pub fn columns(&self, x: u32, count: u32, us: &mut Vec<f64>) {
        us.clear();
        us.extend((x..x + count).map(|x| (f64::from(x) + 0.5 - self.centre.0) / self.half));
    }

    /// δ of a plane at the centre of pixel `(x, y)`.
    #[must_use]
    pub fn disparity(&self, plane: &Plane, x: u32, y: u32) -> f32 {
        plane.disparity((f64::from(x) + 0.5 - self.centre.0) / self.half, (f64::from(y) + 0.5 - self.centre.1) / self.half) as f32
    }
}

/// The rectangle grown by `x`, `y` pixels and clipped to the photo.
#[must_use]
pub fn grown(r: Rect, x: u32, y: u32, grid: &Grid) -> Rect {
    let (x0, y0) = (r.x.saturating_sub(x), r.y.saturating_sub(y));
    Rect { x: x0, y: y0, w: (r.x + r.w + x).min(grid.width) - x0, h: (r.y + r.h + y).min(grid.height) - y0 }
}

/// Pixels that [`Geometry::masks`] looks at, at most, where the tiles of a grid have so many planes: a reader's bound on its work.
pub fn work_of(grid: &Grid, planes: impl Iterator<Item = u64>) -> u64 {
    let reach = MAX_REACH as u32;
    let window = |i: u32| grown(grid.rect(i), reach, reach, grid).area() as u64;
    (0..grid.tiles()).zip(planes).map(|(i, n)| window(i) * (n + 1)).sum()
}

impl Geometry {
    /// Count of all planes, backgrounds included.
    #[must_use]
    pub fn planes(&self) -> usize {
        self.tiles.iter().map(|t| t.planes.len() + usize::from(t.background.is_some())).sum()
    }

    /// Masks of all layers, tile by tile.
    #[must_use]
    pub fn masks(&self) -> Vec<LayerMasks> {
        self.extract(false)
    }

    /// The same with every texel behind something, seen or not: what leaving them out is measured against.
    #[must_use]
    pub fn masks_unpruned(&self) -> Vec<LayerMasks> {
        self.extract(true)
    }

    fn extract(&self, all: bool) -> Vec<LayerMasks> {
        self.masks_of(0..self.tiles.len() as u32, &self.surface(), all)
    }

    /// Masks of some tiles; the surface has at least the [`Geometry::reach`] of them. `all`: with every texel behind something.
    pub(crate) fn masks_of(&self, tiles: Range<u32>, surface: &Surface, all: bool) -> Vec<LayerMasks> {
        let scratch = || Scratch { all, ..Scratch::default() };
        parallel::map_init(tiles.len(), scratch, |s, i| self.masks_of_tile(tiles.start + i as u32, surface, s))
    }

    /// δ of the visible surface of the whole photo.
    #[must_use]
    pub fn surface(&self) -> Surface {
        Surface::of(self, 0..self.grid.height)
    }

    /// The same of some rows of pixels alone.
    pub(crate) fn surface_of(&self, rows: Range<u32>) -> Surface {
        Surface::of(self, rows)
    }

    /// Rows of pixels that the texels of some rows of tiles, and their colours, follow from.
    pub(crate) fn reach(grid: &Grid, rows: &Range<u32>) -> Range<u32> {
        let last = grid.rect((rows.end - 1) * grid.columns());
        let reach = MAX_REACH as u32;
        (rows.start * grid.stride).saturating_sub(reach)..(last.y + last.h + reach).min(grid.height)
    }

    #[inline(never)]
    fn masks_of_tile(&self, index: u32, surface: &Surface, s: &mut Scratch) -> LayerMasks {
        let (tile, r, place) = (&self.tiles[index as usize], self.grid.rect(index), TileFrame::of(&self.grid, index));
        if let ([plane], None) = (tile.planes.as_slice(), tile.background) {
            // the one plane of a tile is all visible
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
        let parallax = self.view_box.parallax(&self.intrinsics, r);
        let parallax = parallax.0.max(parallax.1);
        let mut out = LayerMasks::default();
        let labelled = tile.planes.iter().enumerate().map(|(j, q)| (Some(j as u8), *q));
        for (label, plane) in labelled.chain(tile.background.map(|q| (None, q))) {
            for (y, own) in s.own.chunks_mut(w).enumerate() {
                rows::disparities(&us, place.v(r.y + y as u32), &plane, own);
            }
            out.never_seen += self.mark_hidden(r, place, tile, label, &plane, surface, s);
            let Some(layer) = mask(r, place, tile, label, plane, parallax, s) else { continue };
            // a background is the farthest at most places, but the order is by the tile's centre for all alike; a sort of so few would
            // be a twentieth of the wasm
            let farther = out.layers.partition_point(|l| l.plane.a.total_cmp(&layer.plane.a).is_le());
            out.layers.insert(farther, layer);
        }
        s.us = us;
        out
    }

    /// Marks the texels of a layer that lie behind the visible surface and that a camera in the view box can look at; gives
    /// the count of those that lie behind it but are never seen.
    #[allow(clippy::too_many_arguments, reason = "the parts of one tile")]
    #[inline(never)]
    fn mark_hidden(
        &self,
        r: Rect,
        place: TileFrame,
        tile: &Tile,
        label: Option<u8>,
        plane: &Plane,
        surface: &Surface,
        s: &mut Scratch,
    ) -> usize {
        let (behind, step) = rows::behind(&s.own, &s.visible, &tile.labels, label, &mut s.hidden);
        let Some(hidden) = extent(&s.hidden, r.w as usize).filter(|_| !s.all) else { return 0 };
        let parallax = self.view_box.parallax(&self.intrinsics, r);
        let reach = |parallax: f64, step: f64| (step * parallax + MARGIN).min(MAX_REACH).ceil() as u32;
        let win = grown(r, reach(parallax.0, step), reach(parallax.1, step), &self.grid);
        // an occluder of the neighbourhood may be nearer still, and its edge uncovers more
        let nearest = (win.y..win.y + win.h).map(|y| rows::nearest(surface.row(win.x, y, win.w))).fold(0.0, f32::max);
        // the plane is nowhere farther than at a corner
        let corner = |x: u32, y: u32| place.disparity(plane, x, y);
        let (right, lower) = (win.x + win.w - 1, win.y + win.h - 1);
        let least = corner(win.x, win.y).min(corner(right, win.y)).min(corner(win.x, lower)).min(corner(right, lower));
        let step = (f64::from(nearest) - f64::from(least).max(0.0)).max(step);
        let radius = (reach(parallax.0, step), reach(parallax.1, step));
        // what lies farther from every hidden texel uncovers none
        let inner = Rect { x: r.x + hidden.x, y: r.y + hidden.y, ..hidden };
        let near = common(win, grown(inner, radius.0, radius.1, &self.grid));
        place.columns(near.x, near.w, &mut s.window);
        s.open.resize(near.area(), 0);
        for (y, open) in (near.y..).zip(s.open.chunks_mut(near.w as usize)) {
            rows::open(&s.window, place.v(y), plane, surface.row(near.x, y, near.w), UNOCCLUDED, open);
        }
        dilate(&s.open, near.w, Rect { x: inner.x - near.x, y: inner.y - near.y, ..inner }, radius, &mut s.reach);
        let mut seen = 0;
        for (y, reach) in (hidden.y as usize..).zip(s.reach.out.chunks(hidden.w as usize)) {
            for (h, reach) in s.hidden[y * r.w as usize + hidden.x as usize..].iter_mut().zip(reach) {
                *h &= reach;
                seen += usize::from(*h);
            }
        }
        behind - seen
    }
}

/// The rectangle that both have in common, where they overlap.
fn common(a: Rect, b: Rect) -> Rect {
    let (x, y) = (a.x.max(b.x), a.y.max(b.y));
    Rect { x, y, w: (a.x + a.w).min(b.x + b.w) - x, h: (a.y + a.h).min(b.y + b.h) - y }
}

#[derive(Default)]
struct Scratch {
    /// Nothing is left out.
    all: bool,
    /// Horizontal places of the tile's columns, and of the window's.
    us: Vec<f64>,
    window: Vec<f64>,
    /// δ of each plane in the row at hand but for its share in `u`.
    planes: Vec<[f64; 2]>,
    /// δ of the visible surface and of the layer at hand.
    visible: Vec<f32>,
    own: Vec<f32>,
    /// Masks of 0 and 1: hidden texels of the tile, pixels of the window that nothing covers.
    hidden: Vec<u8>,
    open: Vec<u8>,
    /// The layer at hand: classes and alpha over the whole tile.
    class: Vec<u8>,
    alpha: Vec<u8>,
    /// What the open pixels reach within the tile.
    reach: Dilation,
    /// Opaque texels among three of a row.
    sums: Vec<u8>,
    /// Empty texels of a row that touch an opaque one.
    ring: Vec<u8>,
}

/// Joins visible, hidden and soft texels into a layer cut to its bounds; none where nothing is left.
#[inline(never)]
fn mask(r: Rect, place: TileFrame, tile: &Tile, label: Option<u8>, plane: Plane, parallax: f64, s: &mut Scratch) -> Option<LayerMask> {
    rows::classify(&tile.labels, label, &s.hidden, &mut s.class, &mut s.alpha);
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

/// A layer whose rim is softened.
struct SoftEdge<'a> {
    r: Rect,
    place: TileFrame,
    tile: &'a Tile,
    label: u8,
    parallax: f64,
}

impl SoftEdge<'_> {
    /// True where the surface is bent so that each side lies in front of the other's continuation: the layer that shows at pixel
    /// `(x, y)` of the ring has no texel under one of this layer's own pixels beside it. `own`: δ of this layer.
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

/// One ring of soft texels outside: alpha is the 3×3 box of the opaque mask, colour the photo's, so that the identity view
/// stays exact. Only where the layer lies in front: elsewhere the photo's colour belongs to something else. Where it lies
/// hardly in front and the surface is bent by a crease, the ring is opaque, or a hairline would open along the crease.
#[inline(never)]
fn soften(edge: &SoftEdge, s: &mut Scratch) {
    let (w, h) = (edge.r.w as usize, edge.r.h as usize);
    let Scratch { class, alpha, own, visible, sums, ring, .. } = s;
    sums.resize(w * h, 0);
    for (alpha, sums) in alpha.chunks(w).zip(sums.chunks_mut(w)) {
        rows::sums_of_three(alpha, sums);
    }
    ring.resize(w, 0);
    for y in 0..h {
        let row = |y: usize| &sums[y * w..][..w];
        let above = if y > 0 { row(y - 1) } else { &[] };
        let below = if y + 1 < h { row(y + 1) } else { &[] };
        if !rows::ring(&class[y * w..][..w], [above, row(y), below], ring) {
            continue;
        }
        let lines = 1 + usize::from(y > 0) + usize::from(y + 1 < h);
        for x in 0..w {
            let (at, set) = (y * w + x, u32::from(ring[x]));
            if set == 0 {
                continue;
            }
            let front = (f64::from(own[at]) - f64::from(visible[at])) * edge.parallax;
            if front > 0.0 {
                let all = (lines * (1 + usize::from(x > 0) + usize::from(x + 1 < w))) as u32;
                class[at] = Class::Photo as u8;
                let soft = ((255 * set + all / 2) / all) as u8;
                alpha[at] = if front <= SEAM && edge.folds(x, y, own) { 255 } else { soft };
            }
        }
    }
}

/// Bounds of what is not 0 in a mask `w` pixels wide; none where all is.
pub(super) fn extent(mask: &[u8], w: usize) -> Option<Rect> {
    let full = |c: &u8| *c != 0;
    let y0 = mask.iter().position(full)? / w;
    let y1 = mask.iter().rposition(full)? / w + 1;
    let (mut x0, mut x1) = (w, 0);
    for row in mask[y0 * w..y1 * w].chunks(w) {
        // only what lies outside of the bounds so far can widen them
        x0 = row[..x0].iter().position(full).unwrap_or(x0);
        x1 = row[x1..].iter().rposition(full).map_or(x1, |x| x1 + x + 1);
    }
    Some(Rect { x: x0 as u32, y: y0 as u32, w: (x1 - x0) as u32, h: (y1 - y0) as u32 })
}

/// Bounds of what is not empty, with one empty pixel around where the tile has it, so that bilinear samples fade out; none where
/// all is empty.
fn bounds(class: &[u8], w: u32, h: u32) -> Option<Rect> {
    let b = extent(class, w as usize)?;
    let (x, y) = (b.x.saturating_sub(1), b.y.saturating_sub(1));
    Some(Rect { x, y, w: (b.x + b.w + 1).min(w) - x, h: (b.y + b.h + 1).min(h) - y })
}

#[cfg(test)]
mod tests {
    use super::*;
    #[test]
    fn background_is_hidden_only_near_the_edge_that_uncovers_it() {
        // a near square in the middle of a far wall
        let grid = Grid::new(64, 64, 64);
        let labels = (0..4096u32).map(|i| u8::from((16..48).contains(&(i % 64)) && (16..48).contains(&(i / 64)))).collect();
        let tile = Tile { planes: vec![Plane::fronto_parallel(0.25), Plane::fronto_parallel(1.0)], labels, background: None };
        let b = Geometry {
            grid,
            intrinsics: Intrinsics::centred(64, 64, 100.0),
            view_box: ViewBox { x: 0.04, y: 0.0, z: 0.0 },
            tiles: vec![tile],
        };
        let shapes = &b.masks()[0];
        let far = &shapes.layers[0];
        let hidden = |x: u32, y: u32| far.class[((y - far.rect.y) * far.rect.w + x - far.rect.x) as usize] == Class::Hidden as u8;
        // parallax 4 px times a step of 0.75, and the margin: 5 px from the left and right edges, 2 from the others
        assert!(hidden(20, 32) && !hidden(21, 32) && hidden(43, 32) && !hidden(42, 32));
        assert!(hidden(32, 17) && !hidden(32, 18));
        assert_eq!(shapes.never_seen, 22 * 28);
        let near = &shapes.layers[1];
        assert!(near.alpha.iter().any(|a| (1..255).contains(a)), "the near layer has a soft rim");
    }

    #[test]
    fn rims_are_opaque_where_the_surface_is_bent_and_soft_at_a_small_step() {
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
            };
            let shapes = b.masks().remove(0);
            let row = |s: &LayerMask| {
                s.alpha[32 * s.rect.w as usize..][..s.rect.w as usize].iter().map(|&a| usize::from(a == 255)).sum::<usize>()
            };
            let soft = |s: &LayerMask| s.alpha.iter().any(|a| (1..255).contains(a));
            (shapes.layers.iter().map(row).sum::<usize>(), shapes.layers.iter().any(soft))
        };
        // both sides rise towards the middle and go on rising beyond it: neither has a texel under the other
        let valley = rims(Plane { a: 0.52, b: 0.3, c: 0.0 }, Plane { a: 0.521, b: -0.3, c: 0.0 });
        assert_eq!(valley, (64 + 2, false));
        // a step of half a pixel: the far side goes on under the near one
        let (_, soft) = rims(Plane::fronto_parallel(0.4), Plane::fronto_parallel(0.5));
        assert!(soft);
    }
}
