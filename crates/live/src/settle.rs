//! Blocks whose estimated depth is looked at once more after what moved there has gone.
//!
//! What is estimated beside a thing that moves has some of the thing's depth: networks see few pixels, and blur. Where depth is carried on
//! unchanged it would keep that for ever, and the thing's outline would stay behind as steps in what lay beside it.

use crate::change::Change;

/// After how many frames, and how near a change, where nothing else is said. `tmpi-lab live-bench --only still --settle N --settle-blocks M` compares: views
/// lose .04 dB after 6 frames and send a hundredth of the unchanged tiles more; 24 save 6 % of geometry's bytes and leave outlines twice as long, fewer blocks
/// save 9 % and lose .02 dB; without any of it outlines stay.
pub const SETTLES: Settling = Settling { frames: 12, blocks: 2 };

/// When blocks are looked at once more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settling {
    /// Frames after the last change near a block; 0: never.
    pub frames: u8,
    /// Blocks about one that changed that count as near.
    pub blocks: u8,
}

/// What waits to be looked at.
#[derive(Clone, Debug)]
pub struct Settle {
    when: Settling,
    /// Frames until it is; 0: it is not.
    left: Vec<u8>,
}

impl Settle {
    /// Nothing waits, of so many blocks.
    #[must_use]
    pub fn new(blocks: usize, when: Settling) -> Self {
        Self { when, left: vec![0; blocks] }
    }

    /// Takes what changed in a frame; gives the blocks that are to be looked at with it, as if these had changed by 1.
    pub fn next(&mut self, change: &Change) -> Change {
        let mut due = vec![0; self.left.len()];
        for (left, due) in self.left.iter_mut().zip(&mut due) {
            *due = u32::from(*left == 1);
            *left = left.saturating_sub(1);
        }
        let (across, down) = (change.across, change.blocks.len() / change.across.max(1));
        let about = usize::from(self.when.blocks);
        for (i, _) in change.blocks.iter().enumerate().filter(|(_, by)| **by > 0) {
            let (x, y) = (i % across, i / across);
            let columns = x.saturating_sub(about)..(x + about + 1).min(across);
            for row in y.saturating_sub(about)..(y + about + 1).min(down) {
                let blocks = row * across + columns.start..row * across + columns.end;
                self.left[blocks.clone()].fill(self.when.frames);
                due[blocks].fill(0);
            }
        }
        Change { blocks: due, across, cut: false }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ACROSS: usize = 9;

    fn changed(blocks: &[usize]) -> Change {
        let mut all = vec![0; ACROSS * 7];
        for i in blocks {
            all[*i] = 5;
        }
        Change { blocks: all, across: ACROSS, cut: false }
    }

    fn due(settle: &mut Settle, blocks: &[usize]) -> Vec<usize> {
        settle.next(&changed(blocks)).blocks.iter().enumerate().filter(|(_, by)| **by > 0).map(|(i, _)| i).collect()
    }

    #[test]
    fn what_is_near_a_change_is_looked_at_once_some_frames_after_it() {
        let mut settle = Settle::new(ACROSS * 7, SETTLES);
        let at = 3 * ACROSS + 4;
        assert!(due(&mut settle, &[at]).is_empty());
        for _ in 1..SETTLES.frames {
            assert!(due(&mut settle, &[]).is_empty());
        }
        let near: Vec<usize> = (1..=5).flat_map(|y| (2..=6).map(move |x| y * ACROSS + x)).collect();
        assert_eq!(due(&mut settle, &[]), near);
        assert!(due(&mut settle, &[]).is_empty(), "and no more");
    }

    #[test]
    fn what_changes_again_waits_again_and_borders_hold() {
        let mut settle = Settle::new(ACROSS * 7, SETTLES);
        let corner = ACROSS * 7 - 1;
        for _ in 0..3 * SETTLES.frames {
            assert!(due(&mut settle, &[0, corner]).is_empty());
        }
        for _ in 1..SETTLES.frames {
            assert!(due(&mut settle, &[0]).is_empty());
        }
        // the one corner still changes
        let near: Vec<usize> = (4..7).flat_map(|y| (6..9).map(move |x| y * ACROSS + x)).collect();
        assert_eq!(due(&mut settle, &[0]), near);
    }

    #[test]
    fn nothing_is_looked_at_where_nothing_is_to_settle() {
        let mut settle = Settle::new(ACROSS * 7, Settling { frames: 0, ..SETTLES });
        assert!((0..40).all(|n| due(&mut settle, if n == 0 { &[30] } else { &[] }).is_empty()));
    }

    #[test]
    fn no_picture_has_no_blocks() {
        assert!(Settle::new(0, SETTLES).next(&Change { blocks: Vec::new(), across: 0, cut: true }).blocks.is_empty());
    }
}
