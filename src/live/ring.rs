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

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MessageKind {
    Key,
    /// A frame of a temporal layer; frames of layers above 0 can be dropped.
    Frame {
        layer: u32,
    },
    Geometry {
        frame: u64,
    },
    Sound,
}

#[derive(Clone, Debug)]
struct Entry {
    bytes: Bytes,
    what: MessageKind,
    at: Instant,
    /// Bytes of all messages up to this one.
    passed: u64,
}

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
enum Visibility {
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
pub struct Cursor {
    next: u64,
    /// The viewer waits for a key frame.
    waits: bool,
    /// Tiles were dropped meanwhile.
    stale: bool,
    /// The frame up to which the viewer has all tiles; `None` if it has none.
    known: Option<u64>,
    visibility: Visibility,
    /// The lowest layer with a frame dropped since the last frame of a lower layer: later frames may refer to the dropped one.
    lacks: Option<u32>,
    /// Number of the first message whose sound the viewer has not got: a viewer that becomes visible may go back to a key frame.
    heard: u64,
    /// When the viewer joined or skipped: earlier messages do not count as lag.
    since: Instant,
    pub skipped: u64,
}

impl Cursor {
    /// The frame up to which the viewer has all tiles; `None` if it has none.
    pub const fn known(&self) -> Option<u64> {
        self.known
    }

    /// Whether the viewer gets only sound.
    pub const fn is_paused(&self) -> bool {
        matches!(self.visibility, Visibility::Hidden)
    }

    /// Pauses everything but sound, or resumes, which sends the tiles that the viewer lacks and goes on with a key frame.
    pub const fn pause(&mut self, paused: bool) {
        self.visibility = match (paused, self.visibility) {
            (true, _) => Visibility::Hidden,
            (false, Visibility::Hidden) => Visibility::Back,
            (false, visibility) => visibility,
        };
    }

    /// Skips to a key frame that the viewer has not got yet. Does nothing if it waits for a key frame already, or is hidden.
    pub const fn skip_to_key(&mut self) {
        if matches!(self.visibility, Visibility::Seen) && !self.waits {
            self.visibility = Visibility::Lost;
        }
    }

    /// Whether a visible viewer waits for a key frame.
    pub const fn wants_key(&self) -> bool {
        self.waits && !self.is_paused()
    }

    /// The place of the same viewer at the start of another publisher's messages.
    pub fn restarted(&self, ring: &Ring, now: Instant) -> Self {
        Self { skipped: self.skipped, visibility: self.visibility, ..ring.begin(now) }
    }

    /// Records that the viewer has all tiles up to `frame`.
    pub fn set_known(&mut self, frame: u64) {
        self.known = self.known.max(Some(frame));
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step {
    Send(Bytes),
    /// Frames were skipped: send the tiles that came meanwhile.
    Skipped {
        /// The ring has no key frame to continue with.
        wants_key: bool,
    },
    Wait,
}

impl Ring {
    /// Adds a message. Messages before the last key frame stay, within the bounds, for viewers that lag.
    pub fn push(&mut self, what: MessageKind, bytes: Bytes, at: Instant) {
        self.passed += bytes.len() as u64;
        self.kept += bytes.len();
        if what == MessageKind::Key {
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

    fn entry(&self, number: u64) -> Option<&Entry> {
        self.entries.get(number.checked_sub(self.first)? as usize)
    }

    fn end(&self) -> u64 {
        self.first + self.entries.len() as u64
    }

    pub fn has_frames(&self) -> bool {
        !self.entries.is_empty()
    }

    fn last_key(&self) -> Option<u64> {
        self.key.filter(|key| *key >= self.first)
    }

    /// The place of a viewer that joins now.
    pub fn begin(&self, now: Instant) -> Cursor {
        let key = self.last_key();
        Cursor {
            next: key.unwrap_or(self.end()),
            waits: key.is_none(),
            stale: false,
            known: None,
            visibility: Visibility::Seen,
            lacks: None,
            heard: 0,
            since: now,
            skipped: 0,
        }
    }

    pub fn step(&self, cursor: &mut Cursor, now: Instant) -> Step {
        match cursor.visibility {
            Visibility::Seen => {}
            Visibility::Hidden => return self.sound(cursor, now),
            Visibility::Back => {
                (cursor.visibility, cursor.heard) = (Visibility::Seen, cursor.next);
                return self.go_on(cursor, now, 0);
            }
            Visibility::Lost => {
                cursor.visibility = Visibility::Seen;
                return self.skip(cursor, now, cursor.next);
            }
        }
        loop {
            if cursor.next < self.first || self.is_behind(cursor, now) {
                return self.skip(cursor, now, cursor.next + 1);
            }
            let Some(entry) = self.entry(cursor.next) else { return Step::Wait };
            if entry.what == MessageKind::Key && cursor.stale {
                // send the dropped tiles before the key frame
                cursor.stale = false;
                return Step::Skipped { wants_key: false };
            }
            let number = cursor.next;
            cursor.next += 1;
            let share = (self.passed - entry.passed) as f64 / BEHIND_BYTES as f64;
            let wanted = match entry.what {
                MessageKind::Key => {
                    (cursor.waits, cursor.lacks) = (false, None);
                    true
                }
                // drop higher layers first, before skipping
                MessageKind::Frame { layer } => {
                    cursor.lacks = cursor.lacks.filter(|lacks| layer >= *lacks);
                    let given = !cursor.waits && cursor.lacks.is_none() && share <= KEEPS[layer.min(2) as usize];
                    if !given {
                        cursor.lacks = cursor.lacks.or(Some(layer));
                    }
                    given
                }
                MessageKind::Geometry { .. } => !cursor.waits,
                MessageKind::Sound => number >= cursor.heard,
            };
            if wanted {
                if let MessageKind::Geometry { frame } = entry.what {
                    cursor.set_known(frame);
                }
                return Step::Send(entry.bytes.clone());
            }
            cursor.skipped += u64::from(matches!(entry.what, MessageKind::Frame { .. }));
            cursor.stale |= matches!(entry.what, MessageKind::Geometry { .. });
        }
    }

    fn is_behind(&self, cursor: &Cursor, now: Instant) -> bool {
        let Some(entry) = self.entry(cursor.next) else { return false };
        let bytes = self.passed - entry.passed;
        bytes > BEHIND_BYTES || now.saturating_duration_since(entry.at.max(cursor.since)) > BEHIND
    }

    /// Advances to the next sound.
    fn sound(&self, cursor: &mut Cursor, now: Instant) -> Step {
        cursor.next = cursor.next.max(self.first);
        while let Some(entry) = self.entry(cursor.next) {
            cursor.next += 1;
            if entry.what == MessageKind::Sound && now.saturating_duration_since(entry.at) <= BEHIND {
                return Step::Send(entry.bytes.clone());
            }
        }
        Step::Wait
    }

    /// [`Self::go_on`] that counts the skipped frames.
    fn skip(&self, cursor: &mut Cursor, now: Instant, least: u64) -> Step {
        let from = cursor.next;
        let step = self.go_on(cursor, now, least);
        let passed = from.max(self.first)..cursor.next;
        let is_frame = |n: &u64| self.entry(*n).is_some_and(|e| matches!(e.what, MessageKind::Key | MessageKind::Frame { .. }));
        cursor.skipped += passed.filter(is_frame).count() as u64 + self.first.saturating_sub(from);
        step
    }

    /// Continues with the last key frame if its number is at least `least`, else with the next one.
    fn go_on(&self, cursor: &mut Cursor, now: Instant, least: u64) -> Step {
        let near = |key: &u64| *key >= least && self.entry(*key).is_some_and(|e| self.passed - e.passed <= BEHIND_BYTES);
        let key = self.last_key().filter(near);
        (cursor.next, cursor.waits, cursor.stale, cursor.since) = (key.unwrap_or(self.end()), key.is_none(), false, now);
        Step::Skipped { wants_key: key.is_none() }
    }
}

#[cfg(test)]
mod tests;
