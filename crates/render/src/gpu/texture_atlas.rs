//! Packs layer rectangles on the pages of a texture array.

use crate::RenderError;

/// Maximum side of a page, unless a rectangle is larger.
const PAGE_SIDE: u32 = 4096;

/// Position of a rectangle's upper left texel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct AtlasPosition {
    pub page: u32,
    pub x: u32,
    pub y: u32,
}

/// Positions of all rectangles, and the size of the pages that hold them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Packing {
    pub width: u32,
    pub height: u32,
    pub pages: u32,
    /// In the order of the given sizes.
    pub positions: Vec<AtlasPosition>,
}

/// Packs rectangles of `sizes` (width, height) on shelves, tallest first. Uses at most `pages` pages with sides of at most `side` texels.
pub(super) fn pack(sizes: &[(u32, u32)], side: u32, pages: u32) -> Result<Packing, RenderError> {
    let area: u64 = sizes.iter().map(|&(w, h)| u64::from(w) * u64::from(h)).sum();
    let square = ((area as f64).sqrt().ceil() as u32).next_power_of_two().min(PAGE_SIDE.min(side));
    let largest = |f: fn(&(u32, u32)) -> u32| sizes.iter().map(f).max().unwrap_or(1);
    let (width, height) = (square.max(largest(|s| s.0)), square.max(largest(|s| s.1)));
    if width > side || height > side {
        return Err(RenderError::TooLarge(format!("a layer of {width}×{height} texels; textures hold at most {side} a side")));
    }
    let mut order: Vec<usize> = (0..sizes.len()).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(sizes[i].1), i));
    let mut positions = vec![AtlasPosition::default(); sizes.len()];
    // the next free position on the shelf, and the shelf's lower border
    let (mut at, mut lower) = (AtlasPosition::default(), 0);
    for i in order {
        let (w, h) = sizes[i];
        if at.x + w > width {
            (at.x, at.y) = (0, lower);
        }
        if at.y + h > height {
            at = AtlasPosition { page: at.page + 1, x: 0, y: 0 };
            lower = 0;
        }
        positions[i] = at;
        at.x += w;
        lower = lower.max(at.y + h);
    }
    let used = at.page + 1;
    if used > pages {
        return Err(RenderError::TooLarge(format!("{used} atlas pages of {width}×{height} texels; the adapter has at most {pages}")));
    }
    Ok(Packing { width, height: if used == 1 { lower.max(1) } else { height }, pages: used, positions })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn rectangles_lie_on_their_pages_without_overlap(sizes in prop::collection::vec((1u32..70, 1u32..70), 0..120), side in 70u32..200) {
            let p = pack(&sizes, side, 256).unwrap();
            prop_assert!(p.width <= side && p.height <= side);
            let mut taken = std::collections::HashSet::new();
            for (at, (w, h)) in p.positions.iter().zip(&sizes) {
                prop_assert!(at.page < p.pages && at.x + w <= p.width && at.y + h <= p.height);
                for y in at.y..at.y + h { for x in at.x..at.x + w { prop_assert!(taken.insert((at.page, x, y))); } }
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        assert!(pack(&[(100, 10)], 100, 1).is_ok());
        assert!(matches!(pack(&[(101, 10)], 100, 1), Err(RenderError::TooLarge(_))));
        assert!(pack(&[(100, 100), (100, 100)], 100, 2).is_ok());
        assert!(matches!(pack(&[(100, 100), (100, 100)], 100, 1), Err(RenderError::TooLarge(_))));
    }
}
