//! Finds where a frame differs from the previous one.

use crate::Rect;

/// Side of a block in pixels.
const SIDE: usize = 8;

/// The blocks of pixels in which any value differs.
pub(super) struct Blocks {
    across: usize,
    down: usize,
    /// Summed-area table, row by row: for each corner of a block, the number of differing blocks above and to the left.
    sums: Vec<u32>,
}

impl Blocks {
    /// Compares the values of two frames with `width` pixels to a row. All blocks differ if the old frame has another size.
    #[allow(clippy::needless_bitwise_bool, reason = "without a branch")]
    pub fn differing<T: PartialEq>(width: u32, old: &[T], new: &[T]) -> Self {
        let width = (width as usize).max(1);
        let (across, down) = (width.div_ceil(SIDE), new.len().div_ceil(width).div_ceil(SIDE));
        let mut sums = vec![0; (across + 1) * (down + 1)];
        let mut differs = vec![false; across];
        for j in 0..down {
            differs.fill(old.len() != new.len());
            let rows = j * SIDE * width..((j + 1) * SIDE * width).min(new.len());
            if let Some(old) = old.get(rows.clone()) {
                for (old, new) in old.chunks(width).zip(new[rows].chunks(width)) {
                    let blocks = old.chunks(SIDE).zip(new.chunks(SIDE));
                    for (differs, (old, new)) in differs.iter_mut().zip(blocks) {
                        // no early exit: stopping at the first difference takes longer
                        *differs |= old.iter().zip(new).fold(false, |differs, (old, new)| differs | (old != new));
                    }
                }
            }
            let mut row = 0;
            for (i, differs) in differs.iter().enumerate() {
                row += u32::from(*differs);
                sums[(j + 1) * (across + 1) + i + 1] = sums[j * (across + 1) + i + 1] + row;
            }
        }
        Self { across, down, sums }
    }

    /// True if a differing block overlaps a rectangle within the frame.
    pub fn any(&self, r: &Rect) -> bool {
        if r.area() == 0 {
            return false;
        }
        let first = |from: u32, most: usize| (from as usize / SIDE).min(most);
        let end = |end: u32, most: usize| (end as usize).div_ceil(SIDE).min(most);
        let (x0, x1) = (first(r.x, self.across), end(r.x + r.w, self.across));
        let (y0, y1) = (first(r.y, self.down), end(r.y + r.h, self.down));
        let at = |x: usize, y: usize| self.sums[y * (self.across + 1) + x];
        at(x1, y1) + at(x0, y0) > at(x1, y0) + at(x0, y1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn differing_pixels_are_found_anywhere(
            width in 1u32..40, height in 1u32..40, at in prop::collection::vec(any::<prop::sample::Index>(), 0..4),
            x in 0u32..40, y in 0u32..40, w in 0u32..30, h in 0u32..30,
        ) {
            let old = vec![0u8; (width * height) as usize];
            let mut new = old.clone();
            for i in &at {
                new[i.index(old.len())] = 1;
            }
            let blocks = Blocks::differing(width, &old, &new);
            let (x, y) = (x.min(width), y.min(height));
            let r = Rect { x, y, w: w.min(width - x), h: h.min(height - y) };
            // the rectangle, extended to whole blocks
            let about = |from: u32, len: u32, i: u32| len > 0 && (from / 8..(from + len).div_ceil(8)).contains(&(i / 8));
            let want = (0..).zip(&new).any(|(i, v)| *v == 1 && about(r.x, r.w, i % width) && about(r.y, r.h, i / width));
            prop_assert_eq!(blocks.any(&r), want);
            prop_assert_eq!(Blocks::differing(width, &old[1..], &new).any(&r), r.w > 0 && r.h > 0);
        }
    }
}
