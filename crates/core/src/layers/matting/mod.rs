//! Matting at depth borders, so that no outline of an object stays on the background when the view moves.
//!
//! Colours of the photo beside a silhouette are mixtures, `C = α F + (1 − α) B`. On the far side of a border, the far layer gets B instead
//! of the photo's colour, and the near layer extends over it with F and α. The reference view still shows C. The same goes for a colour
//! that does not belong to a plain far side, such as the halo of a sharpened photo. Mattes follow from photo, planes and labels, so a
//! container does not carry them.

mod borders;
mod matte;
mod sides;
#[cfg(test)]
mod tests;

use std::ops::Range;

pub(crate) use self::borders::Rows;
use self::borders::{BorderPixel, Scratch};
use super::{Geometry, LayerMask, TexturedLayer};
use crate::parallel;
use crate::scene::{Class, Grid, Rect};

/// Width of the band in containers: `tmpi-lab ghosts` measures others.
pub const MATTE_BAND: usize = 2;

/// Mattes the layers of some tiles, starting with tile `first`. `photo` has the rows of pixels of these tiles, and those within their
/// reach.
pub(crate) fn matte(geometry: &Geometry, first: u32, tiles: &mut [Vec<TexturedLayer>], photo: Rows) {
    let (grid, count) = (&geometry.grid, tiles.len() as u32);
    if count == 0 {
        return;
    }
    let rects = [grid.rect(first), grid.rect(first + count - 1)];
    let wanted = rects[0].y..rects[1].y + rects[1].h;
    let around = around(grid, first..first + count);
    let neighbours = borders::neighbours(geometry.matte_band);
    let pixels = parallel::map_init(around.len(), Scratch::default, |s, i| {
        borders::of_tile(geometry, around.start + i as u32, &neighbours, &wanted, photo, s)
    });
    let near = Near { geometry, first: around.start, pixels: &pixels };
    parallel::each_piece(tiles, 1, |i, tile| near.apply(first + i as u32, &mut tile[0]));
}

/// Whole rows of tiles that contain all tiles overlapping the given ones.
fn around(grid: &Grid, tiles: Range<u32>) -> Range<u32> {
    let columns = grid.columns();
    let more = reach(grid);
    let rows = (tiles.start / columns).saturating_sub(more)..((tiles.end - 1) / columns + 1 + more).min(grid.rows());
    rows.start * columns..rows.end * columns
}

/// Number of tiles to either side that overlap a tile.
fn reach(grid: &Grid) -> u32 {
    (grid.size - 1) / grid.stride
}

/// Mattes of all pixels beside borders, by tile.
struct Near<'a> {
    geometry: &'a Geometry,
    /// Tile of the first entry in `pixels`.
    first: u32,
    pixels: &'a [Vec<BorderPixel>],
}

/// A pixel beside a border, in one tile.
#[derive(Clone, Copy)]
struct Mixed {
    /// Index among the tile's pixels.
    at: usize,
    pixel: BorderPixel,
    /// True if this tile owns the pixel.
    own: bool,
}

/// New contents of one texel of a layer.
struct Change {
    /// Index among the layer's texels.
    at: usize,
    class: Class,
    alpha: u8,
    colour: [u8; 3],
}

impl Near<'_> {
    /// Mattes the layers of tile `index`.
    fn apply(&self, index: u32, layers: &mut [TexturedLayer]) {
        let grid = &self.geometry.grid;
        let r = grid.rect(index);
        let mixed = self.within(index, r);
        if mixed.is_empty() {
            return;
        }
        let labels = &self.geometry.tiles[index as usize].labels;
        for layer in layers {
            let Some(label) = layer.shape.label else { continue };
            let in_front = |m: &Mixed| m.own && m.pixel.near == label;
            widen(&mut layer.shape, r, mixed.iter().filter(|m| in_front(m)).map(|m| m.at));
            let shape = &layer.shape;
            let change = |m: &Mixed| {
                let at = within(shape.rect, m.pixel.x, m.pixel.y)?;
                let matte = m.pixel.matte;
                let (class, alpha, colour) = if labels[m.at] == label {
                    (Class::Hidden, u8::MAX, matte.background)
                } else if in_front(m) {
                    // the whole pixel is foreground, so the photo's colour is right
                    let class = if matte.alpha == u8::MAX { Class::Photo } else { Class::Hidden };
                    (class, matte.alpha, matte.foreground)
                } else if shape.class[at] == Class::Photo as u8 {
                    (Class::Empty, 0, [0; 3])
                } else {
                    return None;
                };
                Some(Change { at, class, alpha, colour })
            };
            let changes: Vec<Change> = mixed.iter().filter_map(change).collect();
            alter(layer, &changes);
        }
    }

    /// Pixels of a tile beside a border, row by row, whichever tile owns them.
    fn within(&self, index: u32, r: Rect) -> Vec<Mixed> {
        let grid = &self.geometry.grid;
        let (columns, more) = (grid.columns(), reach(grid));
        let side = |at: u32, count: u32| at.saturating_sub(more)..(at + more + 1).min(count);
        let mut out = Vec::new();
        for row in side(index / columns, grid.rows()) {
            // the tiles of a row own the same rows of pixels, one beside the other, and those of the next row own the next rows
            let owners = side(index % columns, columns).map(|column| row * columns + column);
            let mut owners: Vec<Owner> = owners.filter_map(|owner| self.owner(owner, index, r)).collect();
            while let Some(y) = owners.iter().filter_map(|owner| owner.pixels.first()).map(|pixel| pixel.y).min() {
                for owner in &mut owners {
                    let (line, rest) = owner.pixels.split_at(owner.pixels.partition_point(|pixel| pixel.y <= y));
                    owner.pixels = rest;
                    let own = owner.own;
                    out.extend(line.iter().filter_map(|&pixel| Some(Mixed { at: within(r, pixel.x, pixel.y)?, pixel, own })));
                }
            }
        }
        out
    }

    /// Pixels that tile `owner` owns in the rows of pixels of tile `index`.
    // never inlined: the page's decoder would have it four times
    #[inline(never)]
    fn owner(&self, owner: u32, index: u32, r: Rect) -> Option<Owner<'_>> {
        let pixels = self.pixels.get(owner.checked_sub(self.first)? as usize)?;
        let before = |y: u32| pixels.partition_point(|pixel| pixel.y < y);
        Some(Owner { pixels: &pixels[before(r.y)..before(r.y + r.h)], own: owner == index })
    }
}

/// Pixels beside borders that one tile owns, row by row.
struct Owner<'a> {
    pixels: &'a [BorderPixel],
    /// True if it is the tile whose layers are matted.
    own: bool,
}

/// Index of a pixel in a rectangle; `None` if it is outside.
fn within(r: Rect, x: u32, y: u32) -> Option<usize> {
    let (x, y) = (x.checked_sub(r.x)?, y.checked_sub(r.y)?);
    (x < r.w && y < r.h).then(|| y as usize * r.w as usize + x as usize)
}

/// Enlarges a layer to include these pixels of its tile, with a border of one empty texel.
fn widen(shape: &mut LayerMask, tile: Rect, places: impl Iterator<Item = usize>) {
    let old = shape.rect;
    let (mut x0, mut y0, mut x1, mut y1) = (old.x, old.y, old.x + old.w, old.y + old.h);
    for at in places {
        let (x, y) = (tile.x + (at % tile.w as usize) as u32, tile.y + (at / tile.w as usize) as u32);
        x0 = x0.min(x.saturating_sub(1).max(tile.x));
        y0 = y0.min(y.saturating_sub(1).max(tile.y));
        x1 = x1.max((x + 2).min(tile.x + tile.w));
        y1 = y1.max((y + 2).min(tile.y + tile.h));
    }
    let new = Rect { x: x0, y: y0, w: x1 - x0, h: y1 - y0 };
    if new == old {
        return;
    }
    for texels in [&mut shape.class, &mut shape.alpha] {
        let mut wide = vec![0; new.area()];
        for (y, row) in (old.y - new.y..).zip(texels.chunks(old.w as usize)) {
            let first = y as usize * new.w as usize + (old.x - new.x) as usize;
            wide[first..first + row.len()].copy_from_slice(row);
        }
        *texels = wide;
    }
    shape.rect = new;
}

/// Applies changes to a layer; they are sorted by texel.
fn alter(TexturedLayer { shape, hidden }: &mut TexturedLayer, changes: &[Change]) {
    if changes.is_empty() {
        return;
    }
    let old = std::mem::take(hidden);
    hidden.reserve_exact(old.len() + changes.len());
    let is_hidden = |c: &&u8| **c == Class::Hidden as u8;
    // number of texels, and of old hidden colours, that are processed
    let (mut done, mut used) = (0, 0);
    for change in changes {
        let kept = used + shape.class[done..change.at].iter().filter(is_hidden).count();
        hidden.extend_from_slice(&old[used..kept]);
        used = kept + usize::from(is_hidden(&&shape.class[change.at]));
        if change.class == Class::Hidden {
            hidden.push(change.colour);
        }
        (shape.class[change.at], shape.alpha[change.at]) = (change.class as u8, change.alpha);
        done = change.at + 1;
    }
    hidden.extend_from_slice(&old[used..]);
}
