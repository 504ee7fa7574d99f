//! The visible surface: δ at each pixel of the photo.

use std::ops::Range;

use super::coarse_surface::CoarseSurface;
use super::visibility_kernels::{Columns, nearest};
use super::{Geometry, TileFrame};
use crate::scene::Rect;

/// Difference in δ from which a pixel's colour is mixed with that of a nearer neighbour.
const TOUCH: f64 = 0.03;

/// δ of the visible surface for some rows of the photo, row-major. Where tiles overlap, the last tile counts.
#[derive(Clone)]
pub struct Surface {
    width: usize,
    /// Index of the first row.
    top: u32,
    delta: Vec<f32>,
    /// The same in blocks, mixed pixels included, if pruning searches them.
    coarse: Option<CoarseSurface>,
}

impl Surface {
    /// The surface of some rows. These must be whole blocks, or end with the photo, if pruning searches blocks.
    pub(super) fn of(geometry: &Geometry, rows: Range<u32>) -> Self {
        let (grid, width) = (&geometry.grid, geometry.grid.width as usize);
        let mut surface = Self { width, top: rows.start, delta: vec![0.0; width * rows.len()], coarse: None };
        let (mut us, mut planes) = (Vec::new(), Vec::new());
        for (i, t) in (0..).zip(&geometry.tiles) {
            let r = grid.rect(i);
            let own = r.y.max(rows.start)..(r.y + r.h).min(rows.end);
            if own.is_empty() {
                continue;
            }
            let place = TileFrame::of(grid, i);
            place.columns(r.x, r.w, &mut us);
            let columns = Columns { us: &us, labels: &t.labels, planes: &t.planes };
            for y in own {
                let at = surface.at(r.x, y);
                columns.visible((y - r.y) as usize, place.v(y), &mut planes, &mut surface.delta[at..at + r.w as usize]);
            }
        }
        surface.coarse = geometry.searches_blocks().then(|| CoarseSurface::of(width, surface.top, &surface.delta));
        surface
    }

    /// The surface in blocks, if pruning searches them.
    pub(super) const fn coarse(&self) -> Option<&CoarseSurface> {
        self.coarse.as_ref()
    }

    /// The greatest δ in a window, at least 0; with `in_blocks`, of all blocks that overlap it.
    pub(super) fn nearest(&self, win: Rect, in_blocks: bool) -> f64 {
        let of_pixels = || (win.y..win.y + win.h).map(|y| nearest(self.row(win.x, y, win.w))).fold(0.0, f32::max);
        f64::from(self.coarse().filter(|_| in_blocks).map_or_else(of_pixels, |coarse| coarse.nearest(win)))
    }

    /// Index of the first row.
    pub(super) const fn top(&self) -> u32 {
        self.top
    }

    /// Index of a pixel of the photo in this surface.
    pub(super) fn at(&self, x: u32, y: u32) -> usize {
        (y - self.top) as usize * self.width + x as usize
    }

    /// δ of `count` pixels of row `y` from column `x` on.
    pub(super) fn row(&self, x: u32, y: u32, count: u32) -> &[f32] {
        &self.delta[self.at(x, y)..][..count as usize]
    }

    /// δ of all pixels, row by row.
    pub fn all(&self) -> &[f32] {
        &self.delta
    }

    /// A copy that is infinite at mixed pixels: those that touch a surface nearer by more than [`TOUCH`].
    pub(crate) fn without_mixed(&self) -> Self {
        let mut surface = self.clone();
        surface.exclude_mixed();
        surface
    }

    /// Sets mixed pixels, those that touch a nearer surface, to infinity.
    pub(super) fn exclude_mixed(&mut self) {
        let width = self.width;
        let mut above = vec![f32::NEG_INFINITY; width];
        // padded by one pixel at both ends
        let (mut here, mut nearest) = (above.clone(), vec![f32::NEG_INFINITY; width + 2]);
        let rows = self.delta.len() / width;
        for y in 0..rows {
            let (row, below) = self.delta[y * width..].split_at_mut(width);
            here.copy_from_slice(row);
            nearest[1..=width].copy_from_slice(row);
            for other in [&above[..], below.get(..width).unwrap_or_default()] {
                for (n, &d) in nearest[1..].iter_mut().zip(other) {
                    *n = if d > *n { d } else { *n };
                }
            }
            let larger = |a: f32, b: f32| if b > a { b } else { a };
            let beside = nearest.iter().zip(&nearest[1..]).zip(&nearest[2..]);
            for (d, ((before, at), after)) in row.iter_mut().zip(beside) {
                let most = larger(larger(*at, *before), *after);
                *d = if f64::from(most) - f64::from(*d) > TOUCH { f32::INFINITY } else { *d };
            }
            std::mem::swap(&mut above, &mut here);
        }
    }
}
