//! The last frames, for tiles that arrive after their frame.

use std::collections::VecDeque;
use std::time::Duration;

/// Maximum number of frames kept, and of large frames. Tiles that are later count as this late.
pub(super) const KEPT: usize = 24;
const KEPT_LARGE: usize = 6;
/// Pixels of all kept frames, unless that is less than [`KEPT_LARGE`] frames: 32 MB.
const PIXELS: usize = 8_000_000;

/// Number and time of a frame that is to be shown, and the frame of its tiles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameTiming {
    /// Number of the frame; increases while the publisher is the same.
    pub frame: u64,
    /// Newest frame to which tiles belong that arrived since the previous frame. `None`, or a number not below `frame`, if they belong to
    /// this frame.
    pub tiles: Option<u64>,
    /// Time since the previous frame was captured; `None` if this is the same frame again.
    pub elapsed: Option<Duration>,
}

/// A frame, which was shown or skipped.
#[derive(Clone, Debug, Default)]
pub(super) struct Shown {
    pub number: u64,
    /// Capture time, by a clock that starts with the first frame.
    pub at: Duration,
    /// Colours, as words.
    pub words: Vec<u32>,
}

/// Number of frames of this many pixels that are kept.
pub(super) fn kept(pixels: usize) -> usize {
    (PIXELS / pixels.max(1)).clamp(KEPT_LARGE, KEPT)
}

/// The last frames, newest first.
#[derive(Debug, Default)]
pub(super) struct History(VecDeque<Shown>);

impl History {
    pub fn clear(&mut self) {
        self.0.clear();
    }

    /// Adds a frame. If its number is not above the last one's, the publisher is another one, and the earlier frames are dropped.
    pub fn add(&mut self, frame: Shown) {
        if self.0.front().is_some_and(|last| last.number >= frame.number) {
            self.0.clear();
        }
        self.0.truncate(kept(frame.words.len()) - 1);
        self.0.push_front(frame);
    }

    /// The frame with this number, or the first after it if it is not known, and its distance in known frames from the next frame to come.
    /// `None` if no frame is known since.
    pub fn since(&self, number: u64) -> Option<(&Shown, u32)> {
        let count = self.0.iter().take_while(|shown| shown.number >= number).count();
        Some((self.0.get(count.checked_sub(1)?)?, count as u32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_large_frames_are_kept() {
        let mut history = History::default();
        for number in 0..10 {
            history.add(Shown { number, words: vec![0; PIXELS / KEPT_LARGE + 1], ..Shown::default() });
        }
        assert_eq!(history.0.len(), KEPT_LARGE);
    }

    #[test]
    fn the_next_known_frame_replaces_an_unknown_one() {
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
        // older than all: the oldest frame
        assert_eq!(of(&history, 1), Some((3, 4)));
        for number in 10..10 + KEPT as u64 {
            history.add(Shown { number, ..Shown::default() });
        }
        assert_eq!(of(&history, 9), Some((10, KEPT as u32)));
        // another publisher starts its own numbering
        history.add(Shown { number: 2, ..Shown::default() });
        assert_eq!((of(&history, 1), of(&history, 9)), (Some((2, 1)), None));
    }
}
