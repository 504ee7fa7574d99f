//! Colours of hidden texels: a push-pull pyramid over the neighbourhood, whose sources lie at or behind the layer (RECIPE, step 5).
//!
//! The colours follow from the photo and the [`Geometry`], so a container need not carry them. Writer and readers compute in `f64` and
//! round to `f32` at the same places, so the same photo gives the same colours.

use std::ops::Range;

use super::inpaint_kernels::{self, Sources};
use super::{Geometry, LayerMasks, Surface, TileFrame};
use crate::parallel;
use crate::scene::{Class, Grid, Photo, Plane, Rect};

/// Context around the hidden texels of a layer, in pixels.
pub(crate) const CONTEXT: u32 = 32;

/// Finds the colours of hidden texels. Create one per photo.
pub struct Inpainter<'a> {
    /// Pixels of the rows that the surface covers.
    rgb: &'a [[u8; 3]],
    grid: Grid,
    /// δ of the visible surface, infinite where a pixel touches a nearer surface.
    sources: Surface,
}

/// Scratch memory for the pyramid of one layer, reusable for the next. Does not store the finest level, the photo's own pixels, because it
/// can be recomputed.
#[derive(Default)]
pub struct Pyramid {
    /// `u` of the window's columns.
    us: Vec<f64>,
    /// The levels, starting at half the window's size.
    levels: Vec<Level>,
    /// Number of levels for the current layer; there may be more from earlier layers.
    used: usize,
}

/// Columns and rows of a level.
type Region = (Range<usize>, Range<usize>);

impl<'a> Inpainter<'a> {
    /// Computes the visible surface, and excludes pixels that touch a nearer surface.
    pub fn new(photo: &'a Photo, geometry: &Geometry) -> Self {
        let mut sources = geometry.surface();
        sources.exclude_mixed();
        Self::with_sources(geometry.grid, sources, &photo.rgb)
    }

    /// Like [`Inpainter::new`] for some rows of the photo. `sources` is their visible surface, from which mixed pixels are already excluded;
    /// `rgb` has the pixels of the same rows.
    pub(crate) const fn with_sources(grid: Grid, sources: Surface, rgb: &'a [[u8; 3]]) -> Self {
        Self { rgb, grid, sources }
    }

    /// Colours of the hidden texels of a layer on `plane`, in their order. `class` has the [`Class`] of each texel in `rect`.
    pub fn fill(&self, tile: u32, plane: &Plane, rect: Rect, class: &[u8], pyramid: &mut Pyramid) -> Vec<[u8; 3]> {
        self.fill_some(tile, plane, rect, (class, class), pyramid)
    }

    /// Like [`Inpainter::fill`], but returns only colours of texels that are also hidden in `wanted`.
    #[inline(never)]
    pub(crate) fn fill_some(
        &self,
        tile: u32,
        plane: &Plane,
        rect: Rect,
        (class, wanted): (&[u8], &[u8]),
        pyramid: &mut Pyramid,
    ) -> Vec<[u8; 3]> {
        let Some(all) = hidden_bounds(rect, class) else { return Vec::new() };
        let hidden = if std::ptr::eq(class, wanted) { Some(all) } else { hidden_bounds(rect, wanted) };
        let Some(hidden) = hidden else { return Vec::new() };
        let place = TileFrame::of(&self.grid, tile);
        let win = super::grown(all, CONTEXT, CONTEXT, &self.grid);
        place.columns(win.x, win.w, &mut pyramid.us);
        self.gather(place, plane, win, pyramid);
        let count = wanted.iter().filter(|&&c| c == Class::Hidden as u8).count();
        if !pyramid.pull() {
            // nothing nearby lies behind the layer, so use the mean of its own surroundings
            return vec![self.mean(rect); count];
        }
        let (x, y) = ((hidden.x - win.x) as usize, (hidden.y - win.y) as usize);
        pyramid.push((x..x + hidden.w as usize, y..y + hidden.h as usize));
        let mut out = Vec::with_capacity(count);
        let rows = (rect.y..).zip(wanted.chunks(rect.w as usize)).skip((hidden.y - rect.y) as usize).take(hidden.h as usize);
        for (y, class) in rows {
            let class = &class[(hidden.x - rect.x) as usize..][..hidden.w as usize];
            let row = self.row(place, y, hidden);
            inpaint_kernels::colours(&pyramid.us[x..], plane, row, pyramid.levels[0].about((y - win.y) as usize), x, class, &mut out);
        }
        out
    }

    /// Colours of the hidden texels of all layers, tile by tile and layer by layer.
    pub fn fill_all(&self, masks: &[LayerMasks]) -> Vec<Vec<Vec<[u8; 3]>>> {
        self.fill_tiles(0, masks)
    }

    /// Like [`Inpainter::fill_all`] for tiles from index `first` on.
    pub(crate) fn fill_tiles(&self, first: u32, masks: &[LayerMasks]) -> Vec<Vec<Vec<[u8; 3]>>> {
        parallel::map_init(masks.len(), Pyramid::default, |pyramid, i| {
            masks[i].layers.iter().map(|l| self.fill(first + i as u32, &l.plane, l.rect, &l.class, pyramid)).collect()
        })
    }

    /// Pixels of row `y` in the columns of `win`.
    fn row(&self, place: TileFrame, y: u32, win: Rect) -> Sources<'_> {
        let at = self.sources.at(win.x, y);
        let surface = self.sources.row(win.x, y, win.w);
        Sources { v: place.v(y), surface, rgb: &self.rgb[at..at + surface.len()] }
    }

    /// Sums 2×2 sources in `win` into the finest stored level.
    fn gather(&self, place: TileFrame, plane: &Plane, win: Rect, pyramid: &mut Pyramid) {
        pyramid.resize(win.w as usize, win.h as usize);
        let Pyramid { us, levels, .. } = pyramid;
        let width = levels[0].width;
        for (y, out) in (win.y..).step_by(2).zip(levels[0].texels.chunks_mut(width)) {
            let second = if y + 1 < win.y + win.h { self.row(place, y + 1, win) } else { Sources::NONE };
            inpaint_kernels::gather(us, plane, [self.row(place, y, win), second], out);
        }
    }

    fn mean(&self, r: Rect) -> [u8; 3] {
        let mut sum = [0u64; 3];
        for y in r.y..r.y + r.h {
            for p in &self.rgb[self.sources.at(r.x, y)..][..r.w as usize] {
                for (s, v) in sum.iter_mut().zip(p) {
                    *s += u64::from(*v);
                }
            }
        }
        sum.map(|s| (s / r.area().max(1) as u64) as u8)
    }
}

/// Bounds of the hidden texels in photo pixels; `None` if there are none.
fn hidden_bounds(rect: Rect, class: &[u8]) -> Option<Rect> {
    let width = rect.w as usize;
    let (mut columns, mut rows) = (vec![0u8; width], 0..0u32);
    for (y, row) in (0..).zip(class.chunks(width)) {
        // whole rows at a time, without an early exit, which would not vectorise
        let mut any = 0;
        for (column, c) in columns.iter_mut().zip(row) {
            let hidden = u8::from(*c == Class::Hidden as u8);
            *column |= hidden;
            any |= hidden;
        }
        if any != 0 {
            let first = if rows.is_empty() { y } else { rows.start };
            rows = first..y + 1;
        }
    }
    let full = |c: &u8| *c != 0;
    let (x0, right) = (columns.iter().position(full)? as u32, columns.iter().rposition(full)? as u32);
    Some(Rect { x: rect.x + x0, y: rect.y + rows.start, w: right + 1 - x0, h: rows.end - rows.start })
}

impl Pyramid {
    /// Sets the sizes of the levels over a window, from half its size down to 1×1; their contents are undefined until written.
    fn resize(&mut self, width: usize, height: usize) {
        let (mut w, mut h, mut n) = (width, height, 0);
        while n == 0 || w > 1 || h > 1 {
            (w, h) = (w.div_ceil(2), h.div_ceil(2));
            if self.levels.len() == n {
                self.levels.push(Level::default());
            }
            self.levels[n].resize(w, h);
            n += 1;
        }
        self.used = n;
    }

    /// Sums the sources from fine to coarse; returns false if there are none.
    fn pull(&mut self) -> bool {
        for n in 1..self.used {
            let (fine, coarse) = self.levels.split_at_mut(n);
            coarse[0].pull(&fine[n - 1]);
        }
        self.levels[self.used - 1].texels[0][3] > 0.0
    }

    /// Fills in full colours from coarse to fine, for the texels that a region of the window depends on.
    fn push(&mut self, region: Region) {
        self.push_level(0, region);
    }

    fn push_level(&mut self, n: usize, (xs, ys): Region) {
        // each texel is interpolated from the four nearest coarser ones
        let coarser = |r: Range<usize>, most: usize| (r.start / 2).saturating_sub(1)..((r.end - 1) / 2 + 2).min(most);
        let level = &self.levels[n];
        let (xs, ys) = (coarser(xs, level.width), coarser(ys, level.height));
        if n + 1 < self.used {
            self.push_level(n + 1, (xs.clone(), ys.clone()));
        }
        let (fine, coarse) = self.levels[..self.used].split_at_mut(n + 1);
        let Level { width, texels, .. } = &mut fine[n];
        for y in ys {
            let about = coarse.first().map_or(inpaint_kernels::Coarser { near: &[], other: &[] }, |up| up.about(y));
            inpaint_kernels::push(about, xs.start, &mut texels[y * *width..][xs.clone()]);
        }
    }
}

/// One level of the pyramid. A texel is colour times weight, and the weight in 0..=1.
#[derive(Default)]
struct Level {
    width: usize,
    height: usize,
    texels: Vec<[f32; 4]>,
}

impl Level {
    fn resize(&mut self, width: usize, height: usize) {
        (self.width, self.height) = (width, height);
        self.texels.resize(width * height, [0.0; 4]);
    }

    /// Sums 2×2 texels of the next finer level, and scales weights above 1 to 1.
    fn pull(&mut self, fine: &Self) {
        for (y, to) in self.texels.chunks_mut(self.width).enumerate() {
            let row = |y: usize| &fine.texels[y * fine.width..][..fine.width];
            inpaint_kernels::pull(row(2 * y), (2 * y + 1 < fine.height).then(|| row(2 * y + 1)), to);
        }
    }

    /// The rows of this level around row `y` of the next finer level.
    fn about(&self, y: usize) -> inpaint_kernels::Coarser<'_> {
        let last = self.height - 1;
        let beside = if y.is_multiple_of(2) { (y / 2).saturating_sub(1) } else { y / 2 + 1 };
        let row = |y: usize| &self.texels[y.min(last) * self.width..][..self.width];
        inpaint_kernels::Coarser { near: row(y / 2), other: row(beside) }
    }
}

#[cfg(test)]
mod tests;
