//! The visible surface: δ at each pixel of the photo.

use std::ops::Range;

use super::coarse_surface::CoarseSurface;
use super::visibility_kernels::{Columns, nearest};
use super::{Geometry, TileFrame};
use crate::parallel;
use crate::scene::Rect;
use crate::simd::dispatch;

/// Difference in δ from which a pixel's colour is mixed with that of a nearer neighbour.
const TOUCH: f64 = 0.03;
/// Rows of pixels that one thread computes at a time.
const BAND: usize = 32;

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
        let width = geometry.grid.width as usize;
        let mut surface = Self { width, top: rows.start, delta: vec![0.0; width * rows.len()], coarse: None };
        parallel::each_piece(&mut surface.delta, width * BAND, |i, band| visible(geometry, rows.start + (i * BAND) as u32, band));
        surface.coarse = geometry.searches_blocks().then(|| CoarseSurface::of(width, surface.top, &surface.delta));
        surface
    }

    /// The surface in blocks, if pruning searches them.
    pub(super) const fn coarse(&self) -> Option<&CoarseSurface> {
        self.coarse.as_ref()
    }

    /// The greatest δ in a window, at least 0; with `in_blocks`, of all blocks that overlap it.
    pub(super) fn nearest(&self, win: Rect, in_blocks: bool) -> f64 {
        let of_pixels = || nearest(&self.delta[self.at(win.x, win.y)..], self.width, win.w as usize, win.h as usize);
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
        // the rows beside a band, before any pixel is excluded
        let bands = self.delta.chunks(width * BAND);
        let above: Vec<Vec<f32>> = bands.clone().map(|band| band[band.len() - width..].to_vec()).collect();
        let below: Vec<Vec<f32>> = bands.map(|band| band[..width].to_vec()).collect();
        parallel::each_piece(&mut self.delta, width * BAND, |i, band| {
            let above = i.checked_sub(1).map_or(&[][..], |i| above[i].as_slice());
            let below = below.get(i + 1).map_or(&[][..], Vec::as_slice);
            exclude_mixed(band, width, above, below);
        });
    }
}

/// Writes δ of the visible surface into some rows of the photo, from row `top` on.
fn visible(geometry: &Geometry, top: u32, band: &mut [f32]) {
    let (grid, width) = (&geometry.grid, geometry.grid.width as usize);
    let rows = top..top + (band.len() / width) as u32;
    // rows of tiles that overlap these rows of pixels
    let first = if top < grid.size { 0 } else { (top - grid.size) / grid.stride + 1 };
    let last = (rows.end - 1) / grid.stride;
    let tiles = [first, last + 1].map(|row| (row * grid.columns()) as usize);
    let (mut us, mut planes) = (Vec::new(), Vec::new());
    for (i, t) in geometry.tiles.iter().enumerate().take(tiles[1]).skip(tiles[0]) {
        let r = grid.rect(i as u32);
        let place = TileFrame::of(grid, i as u32);
        place.columns(r.x, r.w, &mut us);
        let columns = Columns { us: &us, labels: &t.labels, planes: &t.planes };
        for y in r.y.max(rows.start)..(r.y + r.h).min(rows.end) {
            let at = (y - top) as usize * width + r.x as usize;
            columns.visible((y - r.y) as usize, place.v(y), &mut planes, &mut band[at..at + r.w as usize]);
        }
    }
}

/// Sets mixed pixels of some rows to infinity. The rows above and below them are empty at the ends of the surface.
fn exclude_mixed(band: &mut [f32], width: usize, above: &[f32], end: &[f32]) {
    // padded by one pixel at both ends
    let mut nearest = vec![f32::NEG_INFINITY; width + 2];
    let (mut here, mut above) = (Vec::with_capacity(width), above.to_vec());
    for y in 0..band.len() / width {
        let (row, below) = band[y * width..].split_at_mut(width);
        here.clear();
        here.extend_from_slice(row);
        exclude(row, &above, below.get(..width).unwrap_or(end), &mut nearest);
        std::mem::swap(&mut above, &mut here);
    }
}

dispatch!(
    /// Sets the mixed pixels of a row to infinity. `nearest` is scratch memory, longer by one pixel at both ends, which are infinitely far.
    exclude, exclude_body, (row: &mut [f32], above: &[f32], below: &[f32], nearest: &mut [f32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loops must be compiled with the caller's target features")]
fn exclude_body(row: &mut [f32], above: &[f32], below: &[f32], nearest: &mut [f32]) {
    nearest[1..=row.len()].copy_from_slice(row);
    let larger = |a: f32, b: f32| if b > a { b } else { a };
    for other in [above, below] {
        for (n, d) in nearest[1..].iter_mut().zip(other) {
            *n = larger(*n, *d);
        }
    }
    let beside = nearest.iter().zip(&nearest[1..]).zip(&nearest[2..]);
    for (d, ((before, at), after)) in row.iter_mut().zip(beside) {
        let most = larger(larger(*at, *before), *after);
        *d = if f64::from(most) - f64::from(*d) > TOUCH { f32::INFINITY } else { *d };
    }
}
