//! The last frames that were shown, for tiles that come after theirs.

use std::collections::VecDeque;
use std::time::Duration;

/// Frames that are kept: tiles that are later than that are taken for as late.
pub(super) const KEPT: usize = 6;

/// A frame as it comes to be shown, and the tiles that come with it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct When {
    /// Its number; those of one publisher grow.
    pub frame: u64,
    /// The newest frame that tiles which came since the frame before are of; none, or this one's number or more: they are this frame's.
    pub tiles: Option<u64>,
    /// How long after the frame before it was taken; none where it is that one once more.
    pub gone: Option<Duration>,
}

/// A frame that was shown.
#[derive(Clone, Debug, Default)]
pub(super) struct Shown {
    pub number: u64,
    /// When it was taken, by a clock that starts with the first one.
    pub at: Duration,
    /// Colours, as words.
    pub words: Vec<u32>,
}

/// The last frames, the newest first.
#[derive(Debug, Default)]
pub(super) struct History(VecDeque<Shown>);

impl History {
    pub fn clear(&mut self) {
        self.0.clear();
    }

    /// Takes a frame in; one of a number that is not above the last one's is another publisher's, and what was is forgotten.
    pub fn add(&mut self, frame: Shown) {
        if self.0.front().is_some_and(|last| last.number >= frame.number) {
            self.0.clear();
        }
        self.0.truncate(KEPT - 1);
        self.0.push_front(frame);
    }

    /// The frame of a number, or the first after it where it was never shown, and how many before the next one it was; none where nothing was shown
    /// since.
    pub fn since(&self, number: u64) -> Option<(&Shown, u32)> {
        let count = self.0.iter().take_while(|shown| shown.number >= number).count();
        Some((self.0.get(count.checked_sub(1)?)?, count as u32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_that_was_never_shown_has_the_first_after_it_in_its_place() {
        let mut history = History::default();
        assert!(history.since(0).is_none());
        for number in [3, 4, 6, 9] {
            history.add(Shown { number, ..Shown::default() });
        }
        let of = |history: &History, number| history.since(number).map(|(shown, late)| (shown.number, late));
        for (number, expected) in
            [(9, Some((9, 1))), (7, Some((9, 1))), (6, Some((6, 2))), (5, Some((6, 2))), (4, Some((4, 3))), (10, None)]
        {
            assert_eq!(of(&history, number), expected, "{number}");
        }
        // older than any: the oldest
        assert_eq!(of(&history, 1), Some((3, 4)));
        for number in 10..10 + KEPT as u64 {
            history.add(Shown { number, ..Shown::default() });
        }
        assert_eq!(of(&history, 9), Some((10, KEPT as u32)));
        // another publisher counts anew
        history.add(Shown { number: 2, ..Shown::default() });
        assert_eq!((of(&history, 1), of(&history, 9)), (Some((2, 1)), None));
    }
}
