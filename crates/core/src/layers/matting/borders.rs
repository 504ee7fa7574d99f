//! Pixels beside depth borders, and their mattes.

use std::ops::Range;

use super::super::visibility_kernels::Columns;
use super::super::{Geometry, TileFrame};
use super::matte::{Matte, Mattes};
use super::sides::{self, COLUMNS, Pixels, Sides, WINDOW};
use crate::scene::packed_rgb::{of_word, words};
use crate::scene::{Grid, Plane, Rect};
use crate::simd::dispatch;

/// A border is matted if its sides differ by more than `MIN_STEP` in δ, and move against each other by more than `MIN_MOTION` pixels over
/// the view box. Smaller steps are part of one object, or uncover nothing.
const MIN_STEP: f64 = 0.05;
const MIN_MOTION: f64 = 1.0;

/// A pixel beside a border.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct BorderPixel {
    /// Position in the photo.
    pub x: u32,
    pub y: u32,
    /// Label of the foreground, in the tile that owns the pixel.
    pub near: u8,
    pub matte: Matte,
}

/// Some rows of the photo.
#[derive(Clone, Copy)]
pub(crate) struct Rows<'a> {
    /// Index of the first row.
    pub top: u32,
    /// Pixels of the rows.
    pub rgb: &'a [[u8; 3]],
}

/// Scratch memory, reused from tile to tile. All but `us` and `planes` have [`COLUMNS`] values more than the tile has pixels.
#[derive(Default)]
pub(super) struct Scratch {
    us: Vec<f64>,
    planes: Vec<[f64; 2]>,
    /// δ of the visible surface; its maximum within the band, and its minimum within one pixel.
    visible: Vec<f32>,
    most: Vec<f32>,
    least: Vec<f32>,
    column: Vec<f32>,
    /// Colours as words, and the sums of the squares of their channels.
    words: Vec<u32>,
    squares: Vec<u32>,
}

/// Pixels that a tile owns. Overlapping tiles divide the overlap in the middle, so each tile has the surroundings of its own pixels.
pub(super) fn owned(grid: &Grid, index: u32) -> Rect {
    let (tile, columns) = (grid.rect(index), grid.columns());
    let by = grid.size.saturating_sub(grid.stride) / 2;
    let side = |from: u32, length: u32, number: u32, count: u32| {
        let first = if number == 0 { 0 } else { (from + by).min(from + length) };
        let end = if number + 1 == count { from + length } else { (from + grid.stride + by).min(from + length) };
        first..end.max(first)
    };
    let (x, y) = (side(tile.x, tile.w, index % columns, columns), side(tile.y, tile.h, index / columns, grid.rows()));
    Rect { x: x.start, y: y.start, w: x.end - x.start, h: y.end - y.start }
}

/// A tile that is searched for borders.
struct Tile<'a> {
    geometry: &'a Geometry,
    r: Rect,
    frame: TileFrame,
    labels: &'a [u8],
    planes: &'a [Plane],
    index: u32,
    /// Pixels beside which a nearer one makes a border, as [`neighbours`] orders them.
    neighbours: &'a [[isize; 2]],
    /// Columns and rows of tiles.
    columns: u32,
    rows: u32,
}

/// Pixels beside a border that tile `index` owns in the rows `wanted`, row by row.
#[inline(never)]
pub(super) fn of_tile(
    geometry: &Geometry,
    index: u32,
    neighbours: &[[isize; 2]],
    wanted: &Range<u32>,
    photo: Rows,
    s: &mut Scratch,
) -> Vec<BorderPixel> {
    let tile = Tile::of(geometry, index, neighbours);
    let r = tile.r;
    let mut out = Vec::new();
    if tile.planes.len() < 2 || tile.labels.len() != r.area() {
        return out;
    }
    let (right, down) = geometry.view_box.parallax(&geometry.intrinsics, r);
    let step = (MIN_MOTION / right.max(down)).max(MIN_STEP) as f32;
    tile.compute_visible(s);
    // nothing beside a pixel is farther in front of it than the nearest pixel is in front of the farthest
    if spread(&s.visible[..r.area()]) <= step {
        return out;
    }
    tile.compute_most(s);
    let own = owned(&geometry.grid, index);
    let rows = own.y.max(wanted.start)..(own.y + own.h).min(wanted.end);
    let w = r.w as usize;
    let mut is_prepared = false;
    for y in rows.clone() {
        let row = (y - r.y) as usize * w + (own.x - r.x) as usize;
        let row = row..row + own.w as usize;
        if !steps(&s.visible[row.clone()], &s.most[row.clone()], step) {
            continue;
        }
        if !is_prepared {
            tile.prepare(&rows, photo, s);
            is_prepared = true;
        }
        for at in row {
            if s.most[at] - s.visible[at] > step
                && let Some(pixel) = tile.border_pixel(at % w, at / w, s)
            {
                out.push(pixel);
            }
        }
    }
    out
}

/// Pixels within `band` rows and columns of a pixel, by how far to the right and down they are: nearest first, and those as near row by row.
pub(super) fn neighbours(band: usize) -> Vec<[isize; 2]> {
    let band = band as isize;
    let mut all = Vec::new();
    // no sorting, whose code would be a twentieth of the page's decoder
    for square in 1..=2 * band * band {
        for v in -band..=band {
            for u in -band..=band {
                if u * u + v * v == square {
                    all.push([u, v]);
                }
            }
        }
    }
    all
}

/// Makes room for `count` pixels and [`COLUMNS`] more values.
// never inlined: the page's decoder would have it six times
#[inline(never)]
fn resize<T: Clone + Default>(values: &mut Vec<T>, count: usize) {
    values.resize(count + COLUMNS, T::default());
}

/// The nearest foreground pixel.
#[derive(Clone, Copy)]
struct Nearest {
    label: u8,
    /// Pixels to the right and down.
    off: [isize; 2],
}

impl<'a> Tile<'a> {
    fn of(geometry: &'a Geometry, index: u32, neighbours: &'a [[isize; 2]]) -> Self {
        let (grid, tile) = (&geometry.grid, &geometry.tiles[index as usize]);
        Self {
            geometry,
            r: grid.rect(index),
            frame: TileFrame::of(grid, index),
            labels: &tile.labels,
            planes: &tile.planes,
            index,
            neighbours,
            columns: grid.columns(),
            rows: grid.rows(),
        }
    }

    /// Computes δ of the visible surface.
    fn compute_visible(&self, s: &mut Scratch) {
        let (w, count) = (self.r.w as usize, self.r.area());
        for all in [&mut s.visible, &mut s.most, &mut s.least, &mut s.column] {
            resize(all, count);
        }
        self.frame.columns(self.r.x, self.r.w, &mut s.us);
        let columns = Columns { us: &s.us, labels: self.labels, planes: self.planes };
        for (y, row) in s.visible[..count].chunks_mut(w).enumerate() {
            columns.visible(y, self.frame.v(self.r.y + y as u32), &mut s.planes, row);
        }
    }

    /// Computes its maximum around each pixel.
    fn compute_most(&self, s: &mut Scratch) {
        let (w, count) = (self.r.w as usize, self.r.area());
        largest(&s.visible[..count], w, self.geometry.matte_band, &mut s.column[..count], &mut s.most[..count]);
    }

    /// Computes its minimum around each pixel, and copies the colours in windows around pixels of these rows of the photo, and around pixels
    /// between these and a border.
    fn prepare(&self, rows: &Range<u32>, photo: Rows, s: &mut Scratch) {
        let (w, width, count) = (self.r.w as usize, self.geometry.grid.width as usize, self.r.area());
        smallest(&s.visible[..count], w, &mut s.column[..count], &mut s.least[..count]);
        for all in [&mut s.words, &mut s.squares] {
            resize(all, count);
        }
        let around = (WINDOW + self.geometry.matte_band) as u32;
        for y in rows.start.saturating_sub(around).max(self.r.y)..(rows.end + around).min(self.r.y + self.r.h) {
            let from = (y - photo.top) as usize * width + self.r.x as usize;
            let to = (y - self.r.y) as usize * w;
            words(&photo.rgb[from..from + w], &mut s.words[to..to + w]);
            sides::squares(&s.words[to..to + w], &mut s.squares[to..to + w]);
        }
    }

    /// The matte of pixel `(x, y)` of the tile, which lies beside a nearer surface. `None` if the colours do not determine one, or if tiles
    /// disagree.
    fn border_pixel(&self, x: usize, y: usize, s: &Scratch) -> Option<BorderPixel> {
        let w = self.r.w as usize;
        let at = y * w + x;
        let (far, most) = (s.visible[at], s.most[at]);
        let middle = far + 0.5 * (most - far);
        let (px, py) = (self.r.x + x as u32, self.r.y + y as u32);
        let Nearest { label: near, off } = self.nearest(x, y, middle, s)?;
        if !self.others_agree(px, py, middle) {
            return None;
        }
        let Mattes { mixture, halo } = self.mattes(x, y, middle, s);
        let fades = |mixture: &Matte| {
            // between this pixel and the border, colours are mixed even more
            let between = |at: usize, off: isize| at.saturating_add_signed(off - off / 2);
            let (u, v) = (between(x, off[0]), between(y, off[1]));
            off == off.map(isize::signum)
                || s.visible[v * w + u] >= middle
                || self.mattes(u, v, middle, s).mixture.is_some_and(|m| m.alpha >= mixture.alpha)
        };
        let matte = halo.or_else(|| mixture.filter(fades))?;
        Some(BorderPixel { x: px, y: py, near, matte })
    }

    /// Mattes of pixel `(x, y)`, which lies behind `middle`.
    fn mattes(&self, x: usize, y: usize, middle: f32, s: &Scratch) -> Mattes {
        let at = y * self.r.w as usize + x;
        let Sides { front, back } = self.sides(x, y, [s.visible[at], middle], s);
        Mattes::of(of_word(s.words[at]), &front, &back)
    }

    /// The nearest pixel in front of `middle` whose plane is also in front at `(x, y)`.
    fn nearest(&self, x: usize, y: usize, middle: f32, s: &Scratch) -> Option<Nearest> {
        let (w, h) = (self.r.w as usize, self.r.h as usize);
        let (px, py) = (self.r.x + x as u32, self.r.y + y as u32);
        self.neighbours.iter().find_map(|&off| {
            let (u, v) = (x.checked_add_signed(off[0])?, y.checked_add_signed(off[1])?);
            if u >= w || v >= h || s.visible[v * w + u] < middle {
                return None;
            }
            let label = self.labels[v * w + u];
            let delta = self.frame.disparity(&self.planes[usize::from(label)], px, py);
            (delta > middle).then_some(Nearest { label, off })
        })
    }

    /// True if all other tiles with this pixel also show the far side there.
    fn others_agree(&self, x: u32, y: u32, middle: f32) -> bool {
        let (g, tiles) = (&self.geometry.grid, &self.geometry.tiles);
        let side = |at: u32, count: u32| {
            let first = if at < g.size { 0 } else { (at - g.size) / g.stride + 1 };
            first..(at / g.stride + 1).min(count)
        };
        let columns = side(x, self.columns);
        side(y, self.rows).all(|row| {
            columns.clone().all(|column| {
                let index = row * self.columns + column;
                if index == self.index {
                    return true;
                }
                let (r, tile) = (g.rect(index), &tiles[index as usize]);
                let label = tile.labels.get(((y - r.y) * r.w + x - r.x) as usize);
                let plane = label.and_then(|l| tile.planes.get(usize::from(*l)));
                plane.is_some_and(|p| TileFrame::of(g, index).disparity(p, x, y) < middle)
            })
        })
    }

    /// Unmixed colours around pixel `(x, y)`: those nearer than `middle`, and those of the surface at `far`.
    fn sides(&self, x: usize, y: usize, [far, middle]: [f32; 2], s: &Scratch) -> Sides {
        let Scratch { visible, most, words, squares, .. } = s;
        let pixels = Pixels { width: self.r.w as usize, visible, most, words, squares };
        let farthest = far - (middle - far);
        let sides = sides::around(pixels, &s.least, [x, y], farthest, middle);
        // a thin object has only pixels beside the border
        if sides.front.weight > 0 { sides } else { sides::around(pixels, visible, [x, y], farthest, middle) }
    }
}

dispatch!(
    /// True if anywhere in the row the maximum exceeds the visible δ by more than `step`.
    steps, steps_body, (visible: &[f32], most: &[f32], step: f32) -> bool
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn steps_body(visible: &[f32], most: &[f32], step: f32) -> bool {
    visible.iter().zip(most).fold(0, |any, (d, m)| any | u8::from(m - d > step)) != 0
}

/// Number of lanes in the reduction.
const LANES: usize = 8;

dispatch!(
    /// The difference between the largest and the smallest value.
    spread, spread_body, (values: &[f32]) -> f32
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn spread_body(values: &[f32]) -> f32 {
    let (mut most, mut least) = ([f32::NEG_INFINITY; LANES], [f32::INFINITY; LANES]);
    let (chunks, rest) = values.as_chunks::<LANES>();
    for chunk in chunks {
        for ((m, l), &d) in most.iter_mut().zip(&mut least).zip(chunk) {
            *m = larger(*m, d);
            *l = smaller(*l, d);
        }
    }
    let most = rest.iter().chain(&most).fold(f32::NEG_INFINITY, |m, &d| larger(m, d));
    let least = rest.iter().chain(&least).fold(f32::INFINITY, |l, &d| smaller(l, d));
    most - least
}

#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn larger(a: f32, b: f32) -> f32 {
    if b > a { b } else { a }
}

#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled with the caller's target features")]
fn smaller(a: f32, b: f32) -> f32 {
    if b < a { b } else { a }
}

dispatch!(
    /// The maximum of the values within `by` rows and columns of each, `w` values to a row; `column` is scratch memory.
    largest, largest_body, (values: &[f32], w: usize, by: usize, column: &mut [f32], out: &mut [f32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn largest_body(values: &[f32], w: usize, by: usize, column: &mut [f32], out: &mut [f32]) {
    extreme(values, w, (column, out), by, larger);
}

dispatch!(
    /// The minimum of the values within one row and column of each, `w` values to a row; `column` is scratch memory.
    smallest, smallest_body, (values: &[f32], w: usize, column: &mut [f32], out: &mut [f32])
);

#[inline(always)]
#[allow(clippy::inline_always, reason = "the loop must be compiled with the caller's target features")]
fn smallest_body(values: &[f32], w: usize, column: &mut [f32], out: &mut [f32]) {
    extreme(values, w, (column, out), 1, smaller);
}

/// The extreme of the values within `by` rows and columns of each, `w` values to a row.
#[inline(always)]
#[allow(clippy::inline_always, reason = "the loops must be compiled with the caller's target features")]
fn extreme(values: &[f32], w: usize, (column, out): (&mut [f32], &mut [f32]), by: usize, pick: impl Fn(f32, f32) -> f32 + Copy) {
    let all = values.len();
    column.copy_from_slice(values);
    for off in (1..=by).map(|n| (n * w).min(all)) {
        replace(&mut column[off..], &values[..all - off], pick);
        replace(&mut column[..all - off], &values[off..], pick);
    }
    out.copy_from_slice(column);
    for (out, row) in out.chunks_mut(w).zip(column.chunks(w)) {
        for off in (1..=by).map(|n| n.min(w)) {
            replace(&mut out[off..], &row[..w - off], pick);
            replace(&mut out[..w - off], &row[off..], pick);
        }
    }
}

/// Replaces each value by what `pick` returns for it and another.
// must be compiled with the caller's target features; the page's decoder has no others, and would have the loop eight times
#[cfg_attr(target_arch = "wasm32", inline(never))]
#[cfg_attr(not(target_arch = "wasm32"), inline(always))]
fn replace(values: &mut [f32], others: &[f32], pick: impl Fn(f32, f32) -> f32) {
    for (value, other) in values.iter_mut().zip(others) {
        *value = pick(*value, *other);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_are_nearest_first_and_row_by_row() {
        assert_eq!(neighbours(1), [[0, -1], [-1, 0], [1, 0], [0, 1], [-1, -1], [1, -1], [-1, 1], [1, 1]]);
        assert_eq!((neighbours(2).len(), neighbours(2)[8], neighbours(2)[23]), (24, [0, -2], [2, 2]));
    }
}
