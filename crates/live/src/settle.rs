//! Blocks whose estimated depth is looked at once more after what moved there has gone.
//!
//! What is estimated beside a thing that moves has some of the thing's depth: networks see few pixels, and blur. Where depth is carried on
//! unchanged it would keep that for ever, and the thing's outline would stay behind as steps in what lay beside it.

use crate::change::Change;

/// Frames after the last change near a block.
const FRAMES: u8 = 12;
/// Blocks about one that changed that count as near. With one instead, `tmpi live bench --only still` finds 3 % fewer bytes of geometry and more flicker.
const ABOUT: usize = 2;

/// What waits to be looked at.
#[derive(Clone, Debug)]
pub struct Settle {
    /// Frames until it is; 0: it is not.
    left: Vec<u8>,
}

impl Settle {
    /// Nothing waits, of so many blocks.
    #[must_use]
    pub fn new(blocks: usize) -> Self {
        Self { left: vec![0; blocks] }
    }

    /// Takes what changed in a frame; gives the blocks that are to be looked at with it, as if these had changed by 1.
    pub fn next(&mut self, change: &Change) -> Change {
        let mut due = vec![0; self.left.len()];
        for (left, due) in self.left.iter_mut().zip(&mut due) {
            *due = u32::from(*left == 1);
            *left = left.saturating_sub(1);
        }
        let (across, down) = (change.across, change.blocks.len() / change.across.max(1));
        for (i, _) in change.blocks.iter().enumerate().filter(|(_, by)| **by > 0) {
            let (x, y) = (i % across, i / across);
            let columns = x.saturating_sub(ABOUT)..(x + ABOUT + 1).min(across);
            for row in y.saturating_sub(ABOUT)..(y + ABOUT + 1).min(down) {
                let blocks = row * across + columns.start..row * across + columns.end;
                self.left[blocks.clone()].fill(FRAMES);
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
        let mut settle = Settle::new(ACROSS * 7);
        let at = 3 * ACROSS + 4;
        assert!(due(&mut settle, &[at]).is_empty());
        for _ in 1..FRAMES {
            assert!(due(&mut settle, &[]).is_empty());
        }
        let near: Vec<usize> = (1..=5).flat_map(|y| (2..=6).map(move |x| y * ACROSS + x)).collect();
        assert_eq!(due(&mut settle, &[]), near);
        assert!(due(&mut settle, &[]).is_empty(), "and no more");
    }

    #[test]
    fn what_changes_again_waits_again_and_borders_hold() {
        let mut settle = Settle::new(ACROSS * 7);
        let corner = ACROSS * 7 - 1;
        for _ in 0..3 * FRAMES {
            assert!(due(&mut settle, &[0, corner]).is_empty());
        }
        for _ in 1..FRAMES {
            assert!(due(&mut settle, &[0]).is_empty());
        }
        // the one corner still changes
        let near: Vec<usize> = (4..7).flat_map(|y| (6..9).map(move |x| y * ACROSS + x)).collect();
        assert_eq!(due(&mut settle, &[0]), near);
    }

    #[test]
    fn no_picture_has_no_blocks() {
        assert!(Settle::new(0).next(&Change { blocks: Vec::new(), across: 0, cut: true }).blocks.is_empty());
    }
}
