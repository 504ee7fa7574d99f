//! The grid of tiles over a photo (paper, section 3.1).

use std::ops::Range;
use std::str::FromStr;

/// Rectangle in photo pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Rect {
    /// Left edge.
    pub x: u32,
    /// Upper edge.
    pub y: u32,
    /// Width.
    pub w: u32,
    /// Height.
    pub h: u32,
}

impl Rect {
    /// Number of pixels.
    pub fn area(&self) -> usize {
        self.w as usize * self.h as usize
    }

    /// True if `other` lies within this rectangle.
    pub fn contains(&self, other: &Rect) -> bool {
        let end = |a: u32, b: u32| u64::from(a) + u64::from(b);
        other.x >= self.x
            && other.y >= self.y
            && end(other.x, other.w) <= end(self.x, self.w)
            && end(other.y, other.h) <= end(self.y, self.h)
    }
}

/// The text is not four whole numbers.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("must be four whole numbers X,Y,W,H, not {0:?}")]
pub struct InvalidRect(String);

impl FromStr for Rect {
    type Err = InvalidRect;

    /// Parses `x,y,w,h`.
    ///
    /// # Errors
    /// [`InvalidRect`] unless the text is four whole numbers separated by commas.
    fn from_str(text: &str) -> Result<Self, InvalidRect> {
        let all: Result<Vec<u32>, std::num::ParseIntError> = text.split(',').map(|part| part.trim().parse()).collect();
        let Ok(&[x, y, w, h]) = all.as_deref() else { return Err(InvalidRect(text.to_owned())) };
        Ok(Self { x, y, w, h })
    }
}

/// Square tiles of `size` pixels every `stride` pixels; edge tiles are clipped to the photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Grid {
    /// Photo width, at least 1.
    pub width: u32,
    /// Photo height, at least 1.
    pub height: u32,
    /// Tile size `h`, at least 1.
    pub size: u32,
    /// Distance between neighbouring tiles `r ≤ h`, at least 1.
    pub stride: u32,
}

impl Grid {
    /// Tiles of `size` pixels with the paper's stride `r = h − h/8`.
    pub fn new(width: u32, height: u32, size: u32) -> Self {
        Self { width, height, size, stride: (size - size / 8).max(1) }
    }

    /// One tile as large as the photo: a regular MPI.
    pub fn full(width: u32, height: u32) -> Self {
        let size = width.max(height);
        Self { width, height, size, stride: size }
    }

    /// Number of tiles in a row.
    pub fn columns(&self) -> u32 {
        Self::count(self.width, self.size, self.stride)
    }

    /// Number of tiles in a column.
    pub fn rows(&self) -> u32 {
        Self::count(self.height, self.size, self.stride)
    }

    /// Number of all tiles.
    pub fn tiles(&self) -> u32 {
        self.columns() * self.rows()
    }

    /// The grid of some columns and rows of tiles, and the rectangle of the photo that it covers. Neither range may be empty or extend past
    /// the last tile.
    pub fn part(&self, columns: Range<u32>, rows: Range<u32>) -> (Rect, Self) {
        let side = |tiles: &Range<u32>, length: u32| {
            let from = tiles.start * self.stride;
            // in 64 bits: the last tile may extend past the photo
            let most = u64::from(tiles.end - tiles.start - 1) * u64::from(self.stride) + u64::from(self.size);
            (from, most.min(u64::from(length - from)) as u32)
        };
        let ((x, w), (y, h)) = (side(&columns, self.width), side(&rows, self.height));
        (Rect { x, y, w, h }, Self { width: w, height: h, ..*self })
    }

    fn count(length: u32, size: u32, stride: u32) -> u32 {
        if length <= size { 1 } else { (length - size).div_ceil(stride) + 1 }
    }

    /// Pixels of tile `index` (row-major), clipped to the photo.
    pub fn rect(&self, index: u32) -> Rect {
        let (x, y) = self.origin(index);
        Rect { x, y, w: self.size.min(self.width - x), h: self.size.min(self.height - y) }
    }

    /// Number of pixels of all tiles. Where tiles overlap, pixels count several times.
    pub fn tile_pixels(&self) -> usize {
        let side = |count: u32, length: u32| ((count - 1) * self.size + self.size.min(length - (count - 1) * self.stride)) as usize;
        side(self.columns(), self.width) * side(self.rows(), self.height)
    }

    /// Upper left pixel of tile `index`.
    pub fn origin(&self, index: u32) -> (u32, u32) {
        let columns = self.columns();
        ((index % columns) * self.stride, (index / columns) * self.stride)
    }

    /// Centre of tile `index` before clipping, in photo pixels: the origin of `(u, v)` for its planes.
    pub fn centre(&self, index: u32) -> (f64, f64) {
        let (x, y) = self.origin(index);
        (f64::from(x) + self.half(), f64::from(y) + self.half())
    }

    /// Width, in pixels, of the margin along a shared border of a tile in which its layers are sampled but not drawn, because the next tile
    /// has the same pixels.
    ///
    /// Beyond a tile's last half texel, sampling could only repeat it, which shows as a displaced column. Where two tiles overlap, the
    /// nearer one would hide the more accurate one, and soft edges would be blended twice. The rest of the overlap prevents gaps between
    /// neighbours.
    pub fn inset(&self) -> f64 {
        // an odd number of halves, so that the drawn area starts and ends at texel centres
        match self.size.saturating_sub(self.stride) {
            0 | 1 => 0.0,
            2..8 => 0.5,
            8.. => 1.5,
        }
    }

    /// The drawn part of a layer of tile `index` with texels in `rect`: `[[left, right], [top, bottom]]` in pixels from the rectangle's
    /// upper left corner. Nothing is drawn if an end lies before its start.
    pub fn drawn(&self, index: u32, rect: Rect) -> [[f64; 2]; 2] {
        let (tile, by) = (self.rect(index), self.inset());
        let side = |from: u32, size: u32, tile: u32, length: u32, all: u32| {
            let (from, end) = (f64::from(from), f64::from(tile + length));
            let first = if tile > 0 { f64::from(tile) + by } else { 0.0 };
            let last = if tile + length < all { end - by } else { end };
            [(first - from).max(0.0), (last - from).min(f64::from(size))]
        };
        [side(rect.x, rect.w, tile.x, tile.w, self.width), side(rect.y, rect.h, tile.y, tile.h, self.height)]
    }

    /// Half the tile size in pixels: the unit of `(u, v)`.
    pub fn half(&self) -> f64 {
        f64::from(self.size) / 2.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_papers_picture_has_84_tiles() {
        assert_eq!(Grid::new(630, 350, 64).tiles(), 84);
    }

    proptest! {
        #[test]
        fn a_part_has_the_same_tiles(w in 1u32..400, h in 1u32..400, size in 1u32..100, at in any::<[u16; 4]>()) {
            let g = Grid::new(w, h, size);
            let range = |a: u16, b: u16, n: u32| {
                let (a, b) = (u32::from(a) % n, u32::from(b) % n);
                a.min(b)..a.max(b) + 1
            };
            let (columns, rows) = (range(at[0], at[1], g.columns()), range(at[2], at[3], g.rows()));
            let (rect, part) = g.part(columns.clone(), rows.clone());
            prop_assert_eq!((part.columns(), part.rows()), (columns.end - columns.start, rows.end - rows.start));
            for i in 0..part.tiles() {
                let (column, row) = (columns.start + i % part.columns(), rows.start + i / part.columns());
                let (was, is) = (g.rect(row * g.columns() + column), part.rect(i));
                prop_assert_eq!(was, Rect { x: is.x + rect.x, y: is.y + rect.y, ..is });
            }
        }

        #[test]
        fn every_pixel_is_covered(w in 1u32..400, h in 1u32..400, size in 1u32..100) {
            let g = Grid::new(w, h, size);
            let (mut seen, mut drawn) = (vec![false; (w * h) as usize], vec![false; (w * h) as usize]);
            for i in 0..g.tiles() {
                let r = g.rect(i);
                prop_assert!(r.w > 0 && r.h > 0 && r.x + r.w <= w && r.y + r.h <= h);
                let [[left, right], [upper, lower]] = g.drawn(i, r);
                for y in 0..r.h { for x in 0..r.w {
                    let at = ((r.y + y) * w + r.x + x) as usize;
                    seen[at] = true;
                    // the pixel is drawn completely
                    let (x, y) = (f64::from(x), f64::from(y));
                    drawn[at] |= left <= x && x + 1.0 <= right && upper <= y && y + 1.0 <= lower;
                } }
            }
            prop_assert!(seen.into_iter().all(|s| s));
            prop_assert_eq!(g.tile_pixels(), (0..g.tiles()).map(|t| g.rect(t).area()).sum::<usize>());
            prop_assert!(drawn.into_iter().all(|s| s));
        }
    }
}
