//! What stands in front of what is remembered, though its labels do not say so.
//!
//! Labels follow a thing that moves late, and parts of one without texture get those of the wall behind it. Its colours tell: they are not those
//! that were seen there. What opens between such a part and the rest, seen from beside, must not show what lies behind both.

use super::dilation::{Dilation, dilate};
use crate::scene::Rect;

/// Pixels about such a part in which nothing is recalled.
pub(super) const GAP: u32 = 3;
/// Pixels from its border up to which a part at the edge of a thing is no more than mixed colours.
const THIN: u32 = 1;

/// Pixels at which nothing is recalled.
#[derive(Clone, Debug, Default)]
pub(super) struct Occluders {
    mask: Vec<u8>,
    dilation: Dilation,
}

impl Occluders {
    /// Nothing is in front, before the first frame.
    pub fn clear(&mut self) {
        self.dilation.out.clear();
    }

    /// Of `count` pixels from one on: 1 where nothing is to be recalled, else 0; none before the first frame.
    pub fn row(&self, from: usize, count: usize) -> Option<&[u8]> {
        self.dilation.out.get(from..from + count)
    }

    /// Room for what is known of as many pixels: 0 for one that lies no nearer than what is remembered there, is not mixed with anything nearer,
    /// and looks otherwise; else 1. [`Occluders::look`] follows.
    pub fn pixels(&mut self, count: usize) -> &mut [u8] {
        self.mask.resize(count, 1);
        &mut self.mask
    }

    /// Looks at these pixels, `width` to a row.
    pub fn look(&mut self, width: u32) {
        let Self { mask, dilation } = self;
        let mut grow = |mask: &mut Vec<u8>, by: u32| {
            let all = Rect { x: 0, y: 0, w: width, h: mask.len() as u32 / width.max(1) };
            dilate(mask, width, all, (by, by), dilation);
            mask.copy_from_slice(&dilation.out);
        };
        // opened, that seams go: what looks as it did grows over them
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

    /// Of a picture of `W` columns, others at `o`: what is in front in its middle row.
    fn in_front(row: &str) -> String {
        let mut front = Occluders::default();
        let others = (0..W).flat_map(|_| row.chars().map(|c| c == 'o'));
        front.pixels(W * W).iter_mut().zip(others).for_each(|(p, other)| *p = u8::from(!other));
        front.look(W as u32);
        (0..W).map(|x| if at(&front, W / 2 * W + x) { 'x' } else { '.' }).collect()
    }

    #[test]
    fn a_part_that_looks_otherwise_is_in_front_with_what_is_about_it() {
        assert_eq!(in_front("........................"), "........................");
        assert_eq!(in_front("........oooo............"), ".....xxxxxxxxxx.........");
        assert_eq!(in_front("oooo...................."), "xxxxxxx.................");
        // a seam is no part
        assert_eq!(in_front("......oo......o........."), "........................");
    }

    #[test]
    fn nothing_is_in_front_before_the_first_frame() {
        let mut front = Occluders::default();
        assert!(!at(&front, 0));
        front.pixels(9).fill(0);
        front.look(3);
        assert!(at(&front, 8) && !at(&front, 9));
        front.clear();
        assert!(!at(&front, 8));
    }
}
