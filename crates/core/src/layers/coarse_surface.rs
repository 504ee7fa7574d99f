//! The visible surface in blocks of pixels, in which pruning searches far. A block counts as open if any of its pixels may be, so that a
//! search in blocks keeps all texels that a search in pixels keeps.

use std::ops::Range;

use super::visibility_kernels::nearest;
use crate::scene::{Plane, Rect};

/// Side of a block in pixels. Blocks start at multiples of it.
pub const BLOCK: u32 = 32;
/// As above, as an index.
const SIDE: usize = BLOCK as usize;
/// More than surfaces are rounded by, in δ: half a step of `f32` at the border of the farthest search.
const ROUNDING: f64 = 2e-5;

/// Least and greatest δ of blocks of pixels.
#[derive(Clone)]
pub struct CoarseSurface {
    columns: usize,
    /// Index of the first row of blocks.
    top: usize,
    least: Vec<f32>,
    most: Vec<f32>,
}

/// Where a search in blocks looks for edges.
pub struct BlockSearch<'a> {
    /// Pixels that are searched: `inner` and `radius` around it, within the photo.
    pub win: Rect,
    /// Bounds of the texels that are searched for.
    pub inner: Rect,
    /// Largest distance, horizontal and vertical.
    pub radius: (u32, u32),
    /// Plane of the texels.
    pub plane: &'a Plane,
    /// Centre of its tile, in pixels, and half the tile's size.
    pub frame: ((f64, f64), f64),
    /// A surface at most this far in front of the plane, in δ, is open.
    pub slack: f64,
}

impl CoarseSurface {
    /// Blocks of a surface whose rows are `width` pixels long and start at row `top` of the photo, the first row of a block.
    pub fn of(width: usize, top: u32, delta: &[f32]) -> Self {
        let columns = width.div_ceil(SIDE);
        let mut out = Self { columns, top: top as usize / SIDE, least: Vec::new(), most: Vec::new() };
        for rows in delta.chunks(width * SIDE) {
            let first = out.least.len();
            out.least.resize(first + columns, f32::INFINITY);
            out.most.resize(first + columns, f32::NEG_INFINITY);
            for row in rows.chunks(width) {
                for ((part, least), most) in row.chunks(SIDE).zip(&mut out.least[first..]).zip(&mut out.most[first..]) {
                    for &d in part {
                        *least = if d < *least { d } else { *least };
                        *most = if d > *most { d } else { *most };
                    }
                }
            }
        }
        out
    }

    /// Index of a block, by its column and row in the photo.
    fn at(&self, column: usize, row: usize) -> usize {
        (row - self.top) * self.columns + column
    }

    /// The greatest δ of all blocks that overlap a rectangle, at least 0.
    pub fn nearest(&self, win: Rect) -> f32 {
        let (columns, rows) = (blocks(win.x, win.w), blocks(win.y, win.h));
        nearest(&self.most[self.at(columns.start, rows.start)..], self.columns, columns.len(), rows.len())
    }

    /// True if any pixel of a block may be open.
    fn is_open(&self, column: usize, row: usize, search: &BlockSearch) -> bool {
        let BlockSearch { plane, frame: (centre, half), slack, .. } = search;
        let middle = |block: usize| (block as f64 + 0.5) * f64::from(BLOCK);
        let (u, v) = ((middle(column) - centre.0) / half, (middle(row) - centre.1) / half);
        // pixel centres are up to half a block less half a pixel from the middle
        let nearest = plane.disparity(u, v) + (plane.b.abs() + plane.c.abs()) * f64::from(BLOCK - 1) / 2.0 / half;
        f64::from(self.least[self.at(column, row)]) <= nearest + slack + ROUNDING
    }

    /// Clears in `hidden`, a mask of 0 and 1 over the tile `r`, the texels without an open block within the distance. Returns the number of
    /// remaining texels. `sums` is scratch memory.
    pub fn keep_seen(&self, search: &BlockSearch, r: Rect, hidden: &mut [u8], sums: &mut Vec<u32>) -> usize {
        let BlockSearch { win, inner, radius, .. } = *search;
        let (columns, rows) = (blocks(win.x, win.w), blocks(win.y, win.h));
        // numbers of open blocks above and left of each corner (summed-area table)
        let width = columns.len() + 1;
        sums.clear();
        sums.resize(width * (rows.len() + 1), 0);
        for (j, row) in rows.clone().enumerate() {
            let mut line = 0;
            for (i, column) in columns.clone().enumerate() {
                line += u32::from(self.is_open(column, row, search));
                sums[(j + 1) * width + i + 1] = sums[j * width + i + 1] + line;
            }
        }
        // blocks within the distance of a pixel, from the first of the search
        let within = |at: u32, radius: u32, from: u32, length: u32, first: usize| {
            let last = (at + radius).min(from + length - 1);
            (at.saturating_sub(radius) / BLOCK) as usize - first..(last / BLOCK) as usize + 1 - first
        };
        let mut seen = 0;
        for y in inner.y..inner.y + inner.h {
            let ys = within(y, radius.1, win.y, win.h, rows.start);
            for x in inner.x..inner.x + inner.w {
                let at = ((y - r.y) * r.w + x - r.x) as usize;
                if hidden[at] == 0 {
                    continue;
                }
                let xs = within(x, radius.0, win.x, win.w, columns.start);
                let sum = |x: usize, y: usize| sums[y * width + x];
                let open = sum(xs.end, ys.end) + sum(xs.start, ys.start) > sum(xs.start, ys.end) + sum(xs.end, ys.start);
                hidden[at] = u8::from(open);
                seen += usize::from(open);
            }
        }
        seen
    }
}

/// Blocks that overlap `length` pixels from `from` on.
fn blocks(from: u32, length: u32) -> Range<usize> {
    (from / BLOCK) as usize..(from + length).div_ceil(BLOCK) as usize
}
