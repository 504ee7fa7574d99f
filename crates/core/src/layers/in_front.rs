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
/// Half the width of a gap, in pixels, between nearer parts that is one of the same thing, however thin.
const INSIDE: u32 = 3;

/// What a pixel shows, beside what is remembered there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Shown {
    /// It lies nearer.
    pub nearer: bool,
    /// It does not, but looks otherwise.
    pub other: bool,
    /// It touches something nearer.
    pub mixed: bool,
}

/// Pixels at which nothing is recalled.
#[derive(Clone, Debug, Default)]
pub(super) struct InFront {
    nearer: Vec<u8>,
    others: Vec<u8>,
    /// Without those of the others that are mixed.
    whole: Vec<u8>,
    dilation: Dilation,
}

impl InFront {
    /// Nothing is in front, before the first frame.
    pub fn clear(&mut self) {
        self.dilation.out.clear();
    }

    /// Whether nothing is to be recalled at a pixel.
    pub fn at(&self, pixel: usize) -> bool {
        self.dilation.out.get(pixel).is_some_and(|v| *v != 0)
    }

    /// Looks at the pixels of a frame, `width` to a row.
    pub fn look(&mut self, width: u32, pixels: impl Iterator<Item = Shown>) {
        let Self { nearer, others, whole, dilation } = self;
        for mask in [&mut *nearer, others, whole] {
            mask.clear();
        }
        for shown in pixels {
            nearer.push(shown.nearer.into());
            others.push(shown.other.into());
            whole.push((shown.other && !shown.mixed).into());
        }
        let all = Rect { x: 0, y: 0, w: width, h: nearer.len() as u32 / width.max(1) };
        let mut grow = |mask: &mut Vec<u8>, by: u32| {
            dilate(mask, width, all, (by, by), dilation);
            mask.copy_from_slice(&dilation.out);
        };
        let turn = |mask: &mut Vec<u8>| mask.iter_mut().for_each(|v| *v = 1 - *v);
        // opened: seams go
        turn(whole);
        grow(whole, THIN);
        turn(whole);
        grow(whole, THIN);
        // closed: gaps within a thing fill
        grow(nearer, INSIDE);
        turn(nearer);
        grow(nearer, INSIDE);
        turn(nearer);
        for ((whole, other), nearer) in whole.iter_mut().zip(others).zip(nearer) {
            *whole |= *other & *nearer;
        }
        grow(whole, GAP);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const W: usize = 24;

    /// Of a picture of `W` columns, `n` nearer, `o` other, `m` other and mixed: what is in front in its middle row.
    fn in_front(row: &str) -> String {
        let shown = |c: char| Shown { nearer: c == 'n', other: c == 'o' || c == 'm', mixed: c == 'm' };
        let mut front = InFront::default();
        front.look(W as u32, (0..W).flat_map(|_| row.chars().map(shown)));
        (0..W).map(|x| if front.at(W / 2 * W + x) { 'x' } else { '.' }).collect()
    }

    #[test]
    fn a_part_that_looks_otherwise_is_in_front_with_what_is_about_it() {
        assert_eq!(in_front("........................"), "........................");
        assert_eq!(in_front("........oooo............"), ".....xxxxxxxxxx.........");
        // its seam of mixed pixels, and one without a part
        assert_eq!(in_front(".....mmooommm..........."), "....xxxxxxxxx...........");
        assert_eq!(in_front("......oo.....mm.....nnnn"), "........................");
    }

    #[test]
    fn a_gap_within_a_nearer_thing_is_in_front_however_thin() {
        assert_eq!(in_front("....nnnnn.mnnnnn........"), ".......xxxxxxx..........");
        assert_eq!(in_front("....nnnnnnnnm..........."), "........................");
        // what was seen there, and stays, is seen through it
        assert_eq!(in_front("....nnnnn..nnnnn........"), "........................");
    }

    #[test]
    fn nothing_is_in_front_before_the_first_frame() {
        let mut front = InFront::default();
        assert!(!front.at(0));
        front.look(1, std::iter::repeat_n(Shown { other: true, ..Shown::default() }, 3));
        assert!(front.at(2) && !front.at(3));
        front.clear();
        assert!(!front.at(2));
    }
}
