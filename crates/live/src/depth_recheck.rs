//! Schedules a second depth estimate for blocks near past motion.
//!
//! Networks see few pixels and blur, so the depth estimated beside a moving object contains some of the object's depth. Because unchanged
//! blocks keep their depth, the object's outline would otherwise remain forever as steps in the background.

use crate::change::Change;

/// Frames between the last change near a block and its recheck. With 6 frames, views lose 0.04 dB and 1 % more of the unchanged tiles are
/// sent (`tmpi-lab live-bench --only still`); with 24, geometry has 6 % fewer bytes but outlines remain twice as long; without rechecks,
/// outlines stay.
const FRAMES: u8 = 12;
/// Radius around a changed block, in blocks, that counts as near. Fewer save 9 % of the bytes and lose 0.02 dB.
const RADIUS: usize = 2;

/// Countdowns of all blocks.
#[derive(Clone, Debug)]
pub struct Rechecks {
    /// Frames until each block's recheck; 0: none is due.
    countdown: Vec<u8>,
}

impl Rechecks {
    /// Starts with no recheck due, for this many blocks.
    pub fn new(blocks: usize) -> Self {
        Self { countdown: vec![0; blocks] }
    }

    /// Records a frame's changes. Returns the blocks to recheck with this frame as changes.
    pub fn next(&mut self, change: &Change) -> Change {
        let mut due = vec![false; self.countdown.len()];
        for (left, due) in self.countdown.iter_mut().zip(&mut due) {
            *due = *left == 1;
            *left = left.saturating_sub(1);
        }
        let (across, down) = (change.across, change.blocks.len() / change.across.max(1));
        for (i, _) in change.blocks.iter().enumerate().filter(|(_, is_changed)| **is_changed) {
            let (x, y) = (i % across, i / across);
            let columns = x.saturating_sub(RADIUS)..(x + RADIUS + 1).min(across);
            for row in y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(down) {
                let blocks = row * across + columns.start..row * across + columns.end;
                self.countdown[blocks.clone()].fill(FRAMES);
                due[blocks].fill(false);
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
        let mut all = vec![false; ACROSS * 7];
        for i in blocks {
            all[*i] = true;
        }
        Change { blocks: all, across: ACROSS, cut: false }
    }

    fn due(rechecks: &mut Rechecks, blocks: &[usize]) -> Vec<usize> {
        rechecks.next(&changed(blocks)).blocks.iter().enumerate().filter(|(_, is_due)| **is_due).map(|(i, _)| i).collect()
    }

    #[test]
    fn blocks_near_a_change_are_rechecked_once() {
        let mut rechecks = Rechecks::new(ACROSS * 7);
        let at = 3 * ACROSS + 4;
        assert!(due(&mut rechecks, &[at]).is_empty());
        for _ in 1..FRAMES {
            assert!(due(&mut rechecks, &[]).is_empty());
        }
        let near: Vec<usize> = (1..=5).flat_map(|y| (2..=6).map(move |x| y * ACROSS + x)).collect();
        assert_eq!(due(&mut rechecks, &[]), near);
        assert!(due(&mut rechecks, &[]).is_empty(), "only once");
    }

    #[test]
    fn another_change_restarts_the_countdown() {
        let mut rechecks = Rechecks::new(ACROSS * 7);
        let corner = ACROSS * 7 - 1;
        for _ in 0..3 * FRAMES {
            assert!(due(&mut rechecks, &[0, corner]).is_empty());
        }
        for _ in 1..FRAMES {
            assert!(due(&mut rechecks, &[0]).is_empty());
        }
        // the first corner still changes
        let near: Vec<usize> = (4..7).flat_map(|y| (6..9).map(move |x| y * ACROSS + x)).collect();
        assert_eq!(due(&mut rechecks, &[0]), near);
    }

    #[test]
    fn an_empty_picture_has_no_blocks() {
        assert!(Rechecks::new(0).next(&Change { blocks: Vec::new(), across: 0, cut: true }).blocks.is_empty());
    }
}
