//! The messages since the last key frame, and each viewer's place in them.
//!
//! Viewers hold only a place; they share the messages in the ring.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use bytes::Bytes;

/// Most bytes in the ring.
const KEPT_BYTES: usize = 8 << 20;
/// Most messages in the ring.
const KEPT: usize = 4096;
/// Bytes by which a viewer may lag.
pub const BEHIND_BYTES: u64 = 1 << 20;
/// Time by which a viewer may lag.
pub const BEHIND: Duration = Duration::from_secs(1);

/// By temporal layer: the share of [`BEHIND_BYTES`] by which a viewer may lag and still get the layer's frames.
const KEEPS: [f64; 3] = [f64::INFINITY, 0.5, 0.25];

/// The kind of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum What {
    /// A key frame.
    Key,
    /// A frame of a temporal layer; frames of layers above 0 can be dropped.
    Frame {
        /// The layer.
        layer: u32,
    },
    /// Planes and labels.
    Geometry {
        /// Their frame.
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
    /// Number of the first entry.
    first: u64,
    /// Number of the last key frame.
    key: Option<u64>,
    /// Bytes of all messages so far, and of those in the ring.
    passed: u64,
    kept: usize,
}

/// Whether the viewer's page is visible.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sight {
    /// Visible, as far as is known.
    Seen,
    /// Hidden: the viewer gets only sound.
    Hidden,
    /// Visible again, but without a frame yet.
    Back,
    /// Visible, but unable to decode what follows.
    Lost,
}

/// A viewer's place.
#[derive(Clone, Debug)]
pub struct Place {
    /// Number of the next message.
    next: u64,
    /// The viewer waits for a key frame.
    waits: bool,
    /// Tiles were dropped meanwhile.
    stale: bool,
    /// The frame up to which the viewer has all tiles; `None` if it has none.
    known: Option<u64>,
    sight: Sight,
    /// The lowest layer with a frame dropped since the last frame of a lower layer: later frames may refer to the dropped one.
    lacks: Option<u32>,
    /// Number of the first message whose sound the viewer has not got: a viewer that becomes visible may go back to a key frame.
    heard: u64,
    /// When the viewer joined or skipped: earlier messages do not count as lag.
    since: Instant,
    /// Number of frames that it did not get.
    pub skipped: u64,
}

impl Place {
    /// The frame up to which the viewer has all tiles; `None` if it has none.
    #[must_use]
    pub const fn known(&self) -> Option<u64> {
        self.known
    }

    /// Whether the viewer gets only sound.
    #[must_use]
    pub const fn is_paused(&self) -> bool {
        matches!(self.sight, Sight::Hidden)
    }

    /// Pauses everything but sound, or resumes, which sends the tiles that the viewer lacks and goes on with a key frame.
    pub const fn pause(&mut self, paused: bool) {
        self.sight = match (paused, self.sight) {
            (true, _) => Sight::Hidden,
            (false, Sight::Hidden) => Sight::Back,
            (false, sight) => sight,
        };
    }

    /// Skips to a key frame that the viewer has not got yet. Does nothing if it waits for a key frame already, or is hidden.
    pub const fn lose(&mut self) {
        if matches!(self.sight, Sight::Seen) && !self.waits {
            self.sight = Sight::Lost;
        }
    }

    /// Whether a visible viewer waits for a key frame.
    #[must_use]
    pub const fn wants_key(&self) -> bool {
        self.waits && !self.is_paused()
    }

    /// The place of the same viewer at the start of another publisher's messages.
    #[must_use]
    pub fn anew(&self, ring: &Ring, now: Instant) -> Self {
        Self { skipped: self.skipped, sight: self.sight, ..ring.begin(now) }
    }

    /// Records that the viewer has all tiles up to `frame`.
    pub fn told(&mut self, frame: u64) {
        self.known = self.known.max(Some(frame));
    }
}

/// What to do next for a viewer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step {
    /// Send this.
    Send(Bytes),
    /// Frames were skipped: send the tiles that came meanwhile.
    Skipped {
        /// The ring has no key frame to continue with.
        wants_key: bool,
    },
    /// Wait for more.
    Wait,
}

impl Ring {
    /// Adds a message. Messages before the last key frame stay, within the bounds, for viewers that lag.
    pub fn push(&mut self, what: What, bytes: Bytes, at: Instant) {
        self.passed += bytes.len() as u64;
        self.kept += bytes.len();
        if what == What::Key {
            self.key = Some(self.end());
        }
        self.entries.push_back(Entry { bytes, what, at, passed: self.passed });
        // no viewer may lag by more than BEHIND
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

    /// Clears the ring for another publisher, or the same one again. Viewers that have read everything count as behind, too: they may have
    /// missed something.
    pub fn clear(&mut self) {
        self.first = self.end() + 1;
        self.entries.clear();
        (self.key, self.kept) = (None, 0);
    }

    /// Number of the next message.
    fn end(&self) -> u64 {
        self.first + self.entries.len() as u64
    }

    /// Whether the ring holds any message.
    pub fn has_frames(&self) -> bool {
        !self.entries.is_empty()
    }

    /// The last key frame in the ring.
    fn last_key(&self) -> Option<u64> {
        self.key.filter(|key| *key >= self.first)
    }

    /// The place of a viewer that joins now.
    #[must_use]
    pub fn begin(&self, now: Instant) -> Place {
        let key = self.last_key();
        Place { next: key.unwrap_or(self.end()), waits: key.is_none(), ..self.at_end(now) }
    }

    /// The place after the last message.
    fn at_end(&self, now: Instant) -> Place {
        let next = self.end();
        Place { next, waits: false, stale: false, known: None, sight: Sight::Seen, lacks: None, heard: 0, since: now, skipped: 0 }
    }

    /// Advances a viewer.
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
                // send the dropped tiles before the key frame
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
                // drop higher layers first, before skipping
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

    /// Advances to the next sound.
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

    /// [`Self::go_on`] that counts the skipped frames.
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

    /// Continues with the last key frame if its number is at least `least`, else with the next one.
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
