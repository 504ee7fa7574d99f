//! Messages since the last key frame, and where in them a viewer is.
//!
//! Viewers hold no messages, only a place: what they have not read yet lies here once for all of them.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use bytes::Bytes;

/// Bytes that are kept, at most.
const KEPT_BYTES: usize = 8 << 20;
/// Messages that are kept, at most.
const KEPT: usize = 4096;
/// Bytes by which a viewer may be behind.
pub const BEHIND_BYTES: u64 = 1 << 20;
/// Time by which a viewer may be behind.
pub const BEHIND: Duration = Duration::from_secs(1);

/// Share of [`BEHIND_BYTES`] up to which a viewer that is behind gets the frames of a layer.
const KEEPS: [f64; 3] = [f64::INFINITY, 0.5, 0.25];

/// What a message holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum What {
    /// A frame that needs no other.
    Key,
    /// A frame of a temporal layer; those of layers above 0 can be left out.
    Frame {
        /// The layer.
        layer: u32,
    },
    /// Planes and labels.
    Geometry {
        /// The frame that they are as of.
        frame: u64,
    },
    /// Sound.
    Sound,
}

#[derive(Clone, Debug)]
struct Entry {
    bytes: Bytes,
    what: What,
    at: Instant,
    /// Bytes of all messages up to this one.
    passed: u64,
}

/// The messages.
#[derive(Debug, Default)]
pub struct Ring {
    entries: VecDeque<Entry>,
    /// Number of the first of them.
    first: u64,
    /// Number of the last key frame.
    key: Option<u64>,
    /// Bytes of all messages so far, and of those that are kept.
    passed: u64,
    kept: usize,
}

/// Whether somebody looks at what a viewer is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sight {
    /// As far as is known.
    Seen,
    /// Nobody does: sound alone is sent.
    Hidden,
    /// Somebody does again, and has not been given a frame yet.
    Back,
    /// Somebody does, and cannot decode what follows.
    Lost,
}

/// Where a viewer is.
#[derive(Clone, Debug)]
pub struct Place {
    /// Number of the next message.
    next: u64,
    /// Nothing can be decoded before the next key frame.
    waits: bool,
    /// Tiles came meanwhile, and were left out.
    stale: bool,
    /// The frame up to which all tiles reached the viewer; none: it has none.
    known: Option<u64>,
    sight: Sight,
    /// The lowest layer of which a frame was left out after the last frame of a lower one: those that follow may refer to it.
    lacks: Option<u32>,
    /// Number of the first message whose sound was not heard: who looks again may go back to a key frame.
    heard: u64,
    /// When the viewer came or skipped: it is not behind by what came before.
    since: Instant,
    /// Frames that it was not given.
    pub skipped: u64,
}

impl Place {
    /// The frame up to which all tiles reached the viewer; none: it has none.
    #[must_use]
    pub const fn known(&self) -> Option<u64> {
        self.known
    }

    /// Whether sound alone is sent.
    #[must_use]
    pub const fn is_paused(&self) -> bool {
        matches!(self.sight, Sight::Hidden)
    }

    /// Sends sound alone from now on, or all again: then with a key frame, and after the tiles that are newer than the viewer has.
    pub const fn pause(&mut self, paused: bool) {
        self.sight = match (paused, self.sight) {
            (true, _) => Sight::Hidden,
            (false, Sight::Hidden) => Sight::Back,
            (false, sight) => sight,
        };
    }

    /// Goes on with a key frame that the viewer was not sent yet; nothing changes for one that waits for a key frame, or does not look.
    pub const fn lose(&mut self) {
        if matches!(self.sight, Sight::Seen) && !self.waits {
            self.sight = Sight::Lost;
        }
    }

    /// Whether nothing can be sent before the next key frame to somebody who looks.
    #[must_use]
    pub const fn wants_key(&self) -> bool {
        self.waits && !self.is_paused()
    }

    /// Where one begins in another publisher's messages who had this place in the last one's.
    #[must_use]
    pub fn anew(&self, ring: &Ring, now: Instant) -> Self {
        Self { skipped: self.skipped, sight: self.sight, ..ring.begin(now) }
    }

    /// The viewer is sent all tiles that it lacks up to `frame`.
    pub fn told(&mut self, frame: u64) {
        self.known = self.known.max(Some(frame));
    }
}

/// What a viewer is to do next.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step {
    /// Send this.
    Send(Bytes),
    /// Frames were left out: the tiles that came meanwhile have to be sent.
    Skipped {
        /// There is no key frame to go on with.
        wants_key: bool,
    },
    /// Wait for more.
    Wait,
}

impl Ring {
    /// Adds a message. What lies before a key frame is of no use to anyone who comes, and is kept for those behind as far as the bounds go.
    pub fn push(&mut self, what: What, bytes: Bytes, at: Instant) {
        self.passed += bytes.len() as u64;
        self.kept += bytes.len();
        if what == What::Key {
            self.key = Some(self.end());
        }
        self.entries.push_back(Entry { bytes, what, at, passed: self.passed });
        // a second is the most that anyone may be behind
        while self.entries.front().is_some_and(|e| {
            let past = self.key.is_some_and(|key| self.first < key) && at.saturating_duration_since(e.at) > BEHIND;
            past || self.kept > KEPT_BYTES || self.entries.len() > KEPT
        }) {
            if let Some(gone) = self.entries.pop_front() {
                self.kept -= gone.bytes.len();
                self.first += 1;
            }
        }
    }

    /// Forgets everything: another publisher, or the same one anew. Whoever has read all is behind by this, too: something may have been missed.
    pub fn clear(&mut self) {
        self.first = self.end() + 1;
        self.entries.clear();
        (self.key, self.kept) = (None, 0);
    }

    /// Number that the next message will have.
    fn end(&self) -> u64 {
        self.first + self.entries.len() as u64
    }

    /// Whether a publisher has sent anything yet that is still there.
    pub fn has_frames(&self) -> bool {
        !self.entries.is_empty()
    }

    /// The last key frame that is still there.
    fn last_key(&self) -> Option<u64> {
        self.key.filter(|key| *key >= self.first)
    }

    /// Where one begins who comes now.
    #[must_use]
    pub fn begin(&self, now: Instant) -> Place {
        let key = self.last_key();
        Place { next: key.unwrap_or(self.end()), waits: key.is_none(), ..self.at_end(now) }
    }

    /// Where one begins who has been told everything so far.
    fn at_end(&self, now: Instant) -> Place {
        let next = self.end();
        Place { next, waits: false, stale: false, known: None, sight: Sight::Seen, lacks: None, heard: 0, since: now, skipped: 0 }
    }

    /// What comes next for a viewer.
    pub fn step(&self, place: &mut Place, now: Instant) -> Step {
        match place.sight {
            Sight::Seen => {}
            Sight::Hidden => return self.sound(place, now),
            Sight::Back => {
                (place.sight, place.heard) = (Sight::Seen, place.next);
                return self.go_on(place, now, 0);
            }
            Sight::Lost => {
                place.sight = Sight::Seen;
                return self.skip(place, now, place.next);
            }
        }
        loop {
            if place.next < self.first || self.is_behind(place, now) {
                return self.skip(place, now, place.next + 1);
            }
            let Some(entry) = self.entries.get((place.next - self.first) as usize) else { return Step::Wait };
            if entry.what == What::Key && place.stale {
                // the tiles that were left out go before the frame that goes on
                place.stale = false;
                return Step::Skipped { wants_key: false };
            }
            let number = place.next;
            place.next += 1;
            let share = (self.passed - entry.passed) as f64 / BEHIND_BYTES as f64;
            let wanted = match entry.what {
                What::Key => {
                    (place.waits, place.lacks) = (false, None);
                    true
                }
                // the higher layers go first, before anything has to be skipped
                What::Frame { layer } => {
                    place.lacks = place.lacks.filter(|lacks| layer >= *lacks);
                    let given = !place.waits && place.lacks.is_none() && share <= KEEPS[layer.min(2) as usize];
                    if !given {
                        place.lacks = place.lacks.or(Some(layer));
                    }
                    given
                }
                What::Geometry { .. } => !place.waits,
                What::Sound => number >= place.heard,
            };
            if wanted {
                if let What::Geometry { frame } = entry.what {
                    place.told(frame);
                }
                return Step::Send(entry.bytes.clone());
            }
            place.skipped += u64::from(matches!(entry.what, What::Frame { .. }));
            place.stale |= matches!(entry.what, What::Geometry { .. });
        }
    }

    fn is_behind(&self, place: &Place, now: Instant) -> bool {
        let Some(entry) = self.entries.get((place.next - self.first) as usize) else { return false };
        let bytes = self.passed - entry.passed;
        bytes > BEHIND_BYTES || now.saturating_duration_since(entry.at.max(place.since)) > BEHIND
    }

    /// The next sound, and nothing else.
    fn sound(&self, place: &mut Place, now: Instant) -> Step {
        place.next = place.next.max(self.first);
        while let Some(entry) = self.entries.get((place.next - self.first) as usize) {
            place.next += 1;
            if entry.what == What::Sound && now.saturating_duration_since(entry.at) <= BEHIND {
                return Step::Send(entry.bytes.clone());
            }
        }
        Step::Wait
    }

    /// The same as [`Self::go_on`]; counts the frames that are left out by it.
    fn skip(&self, place: &mut Place, now: Instant, least: u64) -> Step {
        let from = place.next;
        let step = self.go_on(place, now, least);
        let passed = from.max(self.first)..place.next;
        let frames = passed.filter(|i| {
            let entry = self.entries.get((i - self.first) as usize);
            entry.is_some_and(|e| matches!(e.what, What::Key | What::Frame { .. }))
        });
        place.skipped += frames.count() as u64 + self.first.saturating_sub(from);
        step
    }

    /// Goes on with the last key frame if its number is `least` or more, else with the one that comes.
    fn go_on(&self, place: &mut Place, now: Instant, least: u64) -> Step {
        let near = |key: &u64| {
            *key >= least && self.entries.get((key - self.first) as usize).is_some_and(|e| self.passed - e.passed <= BEHIND_BYTES)
        };
        let key = self.last_key().filter(near);
        (place.next, place.waits, place.stale, place.since) = (key.unwrap_or(self.end()), key.is_none(), false, now);
        Step::Skipped { wants_key: key.is_none() }
    }
}

#[cfg(test)]
mod tests;
