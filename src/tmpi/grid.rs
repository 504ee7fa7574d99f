//! The grid of tiles over a photo (paper, section 3.1).

use serde::{Deserialize, Serialize};

/// Rectangle in photo pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rect {
    /// Left border.
    pub x: u32,
    /// Upper border.
    pub y: u32,
    /// Width.
    pub w: u32,
    /// Height.
    pub h: u32,
}

impl Rect {
    /// Count of pixels.
    #[must_use]
    pub fn area(&self) -> usize {
        self.w as usize * self.h as usize
    }

    /// True where `other` lies within this rectangle.
    #[must_use]
    pub fn contains(&self, other: &Rect) -> bool {
        let end = |a: u32, b: u32| u64::from(a) + u64::from(b);
        other.x >= self.x
            && other.y >= self.y
            && end(other.x, other.w) <= end(self.x, self.w)
            && end(other.y, other.h) <= end(self.y, self.h)
    }
}

/// Square tiles of `size` pixels every `stride` pixels; edge tiles are clipped to the photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Grid {
    /// Photo width, at least 1.
    pub width: u32,
    /// Photo height, at least 1.
    pub height: u32,
    /// Tile size `h`, at least 1.
    pub size: u32,
    /// Distance of neighbouring tiles `r ≤ h`, at least 1.
    pub stride: u32,
}

impl Grid {
    /// Tile size of the paper.
    pub const DEFAULT_SIZE: u32 = 64;

    /// Tiles of `size` pixels with the paper's stride `r = h − h/8`.
    #[must_use]
    pub fn new(width: u32, height: u32, size: u32) -> Self {
        Self { width, height, size, stride: (size - size / 8).max(1) }
    }

    /// One tile as large as the photo: a regular MPI.
    #[must_use]
    pub fn full(width: u32, height: u32) -> Self {
        let size = width.max(height);
        Self { width, height, size, stride: size }
    }

    /// Tiles in a row.
    #[must_use]
    pub fn columns(&self) -> u32 {
        Self::count(self.width, self.size, self.stride)
    }

    /// Tiles in a column.
    #[must_use]
    pub fn rows(&self) -> u32 {
        Self::count(self.height, self.size, self.stride)
    }

    /// Count of all tiles.
    #[must_use]
    pub fn tiles(&self) -> u32 {
        self.columns() * self.rows()
    }

    fn count(length: u32, size: u32, stride: u32) -> u32 {
        if length <= size { 1 } else { (length - size).div_ceil(stride) + 1 }
    }

    /// Pixels of tile `index` (row-major), clipped to the photo.
    #[must_use]
    pub fn rect(&self, index: u32) -> Rect {
        let (x, y) = self.origin(index);
        Rect { x, y, w: self.size.min(self.width - x), h: self.size.min(self.height - y) }
    }

    /// Upper left pixel of tile `index`.
    #[must_use]
    pub fn origin(&self, index: u32) -> (u32, u32) {
        let columns = self.columns();
        ((index % columns) * self.stride, (index / columns) * self.stride)
    }

    /// Centre of tile `index` before clipping, in photo pixels; the origin of `(u, v)` of its planes.
    #[must_use]
    pub fn centre(&self, index: u32) -> (f64, f64) {
        let (x, y) = self.origin(index);
        (f64::from(x) + self.half(), f64::from(y) + self.half())
    }

    /// Half the tile size in pixels: the unit of `(u, v)`.
    #[must_use]
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
        fn every_pixel_is_covered(w in 1u32..400, h in 1u32..400, size in 1u32..100) {
            let g = Grid::new(w, h, size);
            let mut seen = vec![false; (w * h) as usize];
            for i in 0..g.tiles() {
                let r = g.rect(i);
                prop_assert!(r.w > 0 && r.h > 0 && r.x + r.w <= w && r.y + r.h <= h);
                for y in r.y..r.y + r.h { for x in r.x..r.x + r.w { seen[(y * w + x) as usize] = true; } }
            }
            prop_assert!(seen.into_iter().all(|s| s));
        }
    }
}
