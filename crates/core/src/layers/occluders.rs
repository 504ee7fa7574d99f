//! Pixels in front of the remembered surface whose labels do not show it.
//!
//! The labels of a moving object come late, and its textureless parts get the labels of the wall behind it. Colours reveal such parts: they
//! differ from those seen there before. A side view opens a gap between such a part and the rest of the object; this gap must not show the
//! background behind both.

use super::dilation::{Dilation, dilate};
use crate::scene::Rect;

/// Margin, in pixels, around such a part in which nothing is recalled.
pub(super) const GAP: u32 = 3;
/// Radius, in pixels, of the opening that removes thin parts: at an object's edge these are only mixed colours.
const THIN: u32 = 1;

/// Mask of the pixels at which nothing is recalled.
#[derive(Clone, Debug, Default)]
pub(super) struct Occluders {
    mask: Vec<u8>,
    dilation: Dilation,
}

impl Occluders {
    /// Clears the mask, as before the first frame.
    pub fn clear(&mut self) {
        self.dilation.out.clear();
    }

    /// The mask of `count` pixels from index `from` on: 1 where nothing is recalled, otherwise 0. `None` before the first frame.
    pub fn row(&self, from: usize, count: usize) -> Option<&[u8]> {
        self.dilation.out.get(from..from + count)
    }

    /// The mask of `count` pixels, which the caller fills before [`Occluders::update`]: 0 if the pixel is not nearer than the remembered
    /// surface, is not mixed with a nearer one, and has another colour; otherwise 1.
    pub fn pixels(&mut self, count: usize) -> &mut [u8] {
        self.mask.resize(count, 1);
        &mut self.mask
    }

    /// Updates the mask from these pixels, `width` to a row.
    pub fn update(&mut self, width: u32) {
        let Self { mask, dilation } = self;
        let mut grow = |mask: &mut Vec<u8>, by: u32| {
            let all = Rect { x: 0, y: 0, w: width, h: mask.len() as u32 / width.max(1) };
            dilate(mask, width, all, (by, by), dilation);
            mask.copy_from_slice(&dilation.out);
        };
        // an opening removes seams: unchanged pixels grow over them
        grow(mask, THIN);
        for open in mask.iter_mut() {
            *open = 1 - *open;
        }
        grow(mask, THIN + GAP);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const W: usize = 24;

    fn at(front: &Occluders, pixel: usize) -> bool {
        front.row(pixel, 1).is_some_and(|v| v != [0])
    }

    /// The middle row of the result for a picture of `W` columns whose pixels have changed at `o`.
    fn in_front(row: &str) -> String {
        let mut front = Occluders::default();
        let others = (0..W).flat_map(|_| row.chars().map(|c| c == 'o'));
        front.pixels(W * W).iter_mut().zip(others).for_each(|(p, other)| *p = u8::from(!other));
        front.update(W as u32);
        (0..W).map(|x| if at(&front, W / 2 * W + x) { 'x' } else { '.' }).collect()
    }

    #[test]
    fn a_changed_part_is_in_front_with_a_margin_around_it() {
        assert_eq!(in_front("........................"), "........................");
        assert_eq!(in_front("........oooo............"), ".....xxxxxxxxxx.........");
        assert_eq!(in_front("oooo...................."), "xxxxxxx.................");
        // a seam is too thin to count
        assert_eq!(in_front("......oo......o........."), "........................");
    }

    #[test]
    fn nothing_is_in_front_before_the_first_frame() {
        let mut front = Occluders::default();
        assert!(!at(&front, 0));
        front.pixels(9).fill(0);
        front.update(3);
        assert!(at(&front, 8) && !at(&front, 9));
        front.clear();
        assert!(!at(&front, 8));
    }
}
