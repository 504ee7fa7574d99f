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
    /// Number of the message that comes next.
    #[must_use]
    pub const fn number(&self) -> u64 {
        self.next
    }

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
    #[must_use]
    pub fn at_end(&self, now: Instant) -> Place {
        let next = self.end();
        Place { next, waits: false, stale: false, known: None, sight: Sight::Seen, lacks: None, heard: 0, since: now, skipped: 0 }
    }

    /// Number that the next message will have, and all since the last key frame with theirs.
    #[must_use]
    pub fn since_key(&self) -> (u64, Vec<(u64, Bytes)>) {
        let from = self.last_key().unwrap_or(self.end());
        let entries = self.entries.iter().zip(self.first..).filter(|(_, n)| *n >= from);
        (self.end(), entries.map(|(e, n)| (n, e.bytes.clone())).collect())
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
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn message(n: u8, length: usize) -> Bytes {
        vec![n; length].into()
    }

    /// Frames of 10 kB, a key every `gop`, 30 a second, from `start` on.
    fn frames(ring: &mut Ring, numbers: std::ops::Range<u32>, gop: u32, start: Instant) {
        for n in numbers {
            let what = if n.is_multiple_of(gop) { What::Key } else { What::Frame { layer: 0 } };
            ring.push(what, message(n as u8, 10_000), start + Duration::from_millis(u64::from(n) * 33));
        }
    }

    fn read(ring: &Ring, place: &mut Place, now: Instant) -> Vec<u8> {
        let mut read = Vec::new();
        while let Step::Send(bytes) = ring.step(place, now) {
            read.push(bytes[0]);
        }
        read
    }

    #[test]
    fn who_comes_late_begins_with_the_last_key_frame() {
        let (mut ring, start) = (Ring::default(), Instant::now());
        frames(&mut ring, 0..100, 60, start);
        let now = start + Duration::from_millis(100 * 33);
        let mut place = ring.begin(now);
        assert_eq!(read(&ring, &mut place, now), (60..100).collect::<Vec<u8>>());
        assert_eq!((ring.step(&mut place, now), place.skipped), (Step::Wait, 0));
    }

    #[test]
    fn who_comes_before_any_key_frame_waits_for_it() {
        let (mut ring, now) = (Ring::default(), Instant::now());
        let mut place = ring.begin(now);
        ring.push(What::Frame { layer: 0 }, message(1, 10), now);
        ring.push(What::Geometry { frame: 1 }, message(2, 10), now);
        ring.push(What::Key, message(3, 10), now);
        ring.push(What::Frame { layer: 0 }, message(4, 10), now);
        assert_eq!(ring.step(&mut place, now), Step::Skipped { wants_key: false }, "the tiles that were left out come first");
        assert_eq!(place.known(), None);
        place.told(1);
        assert_eq!(read(&ring, &mut place, now), [3, 4]);
        assert_eq!(ring.step(&mut place, now), Step::Wait);
    }

    #[test]
    fn who_stops_reading_skips_to_a_key_frame_and_never_gets_half_a_group() {
        let (mut ring, start) = (Ring::default(), Instant::now());
        let mut place = ring.begin(start);
        frames(&mut ring, 0..10, 60, start);
        assert_eq!(read(&ring, &mut place, start + Duration::from_millis(330)).len(), 10);
        frames(&mut ring, 10..130, 60, start);
        let now = start + Duration::from_millis(130 * 33);
        assert_eq!(ring.step(&mut place, now), Step::Skipped { wants_key: false });
        assert_eq!(read(&ring, &mut place, now), (120..130).collect::<Vec<u8>>());
        assert!(place.skipped > 50, "{}", place.skipped);
        // past the key and behind again: the next one is waited for
        frames(&mut ring, 130..175, 60, start);
        let now = start + Duration::from_millis(175 * 33);
        assert_eq!(ring.step(&mut place, now), Step::Skipped { wants_key: true });
        frames(&mut ring, 175..182, 60, start);
        assert_eq!(read(&ring, &mut place, start + Duration::from_millis(182 * 33)), [180, 181]);
    }

    #[test]
    fn who_does_not_look_is_sent_sound_alone_and_then_goes_on_with_a_key_frame_and_hears_nothing_twice() {
        let (mut ring, start) = (Ring::default(), Instant::now());
        let at = |n: u8| start + Duration::from_millis(u64::from(n) * 20);
        let mut place = ring.begin(start);
        // sound between the frames, a key frame at 0, 20, 40, …; geometry at 5, 25, …
        let push = |ring: &mut Ring, numbers: std::ops::Range<u8>| {
            for n in numbers {
                let what = match n % 20 {
                    0 => What::Key,
                    5 => What::Geometry { frame: n.into() },
                    k if k % 2 == 1 => What::Sound,
                    _ => What::Frame { layer: 0 },
                };
                ring.push(what, message(n, 10), at(n));
            }
        };
        push(&mut ring, 0..4);
        assert_eq!(read(&ring, &mut place, at(4)), [0, 1, 2, 3]);
        place.pause(true);
        push(&mut ring, 4..30);
        let sounds = |range: std::ops::Range<u8>| range.filter(|n| n % 2 == 1 && n % 20 != 5).collect::<Vec<u8>>();
        assert_eq!(read(&ring, &mut place, at(30)), sounds(4..30));
        push(&mut ring, 30..34);
        assert_eq!((ring.step(&mut place, at(200)), place.skipped), (Step::Wait, 0), "sound of over a second ago is none any more");
        push(&mut ring, 34..36);
        place.pause(false);
        assert_eq!(ring.step(&mut place, at(36)), Step::Skipped { wants_key: false });
        assert_eq!(place.known(), None, "the tiles were left out");
        place.told(25);
        assert_eq!(read(&ring, &mut place, at(36)), [20, 22, 24, 25, 26, 28, 30, 32, 34, 35], "what was heard is not heard again");
        // nothing changes for who looks already
        place.pause(false);
        push(&mut ring, 36..38);
        assert_eq!(read(&ring, &mut place, at(38)), [36, 37]);
        // a place in what another publisher sends
        place.pause(true);
        let other = Ring::default();
        let mut place = place.anew(&other, at(38));
        assert!(place.is_paused());
        place.pause(false);
        assert_eq!(other.step(&mut place, at(38)), Step::Skipped { wants_key: true });
    }

    #[test]
    fn higher_layers_go_before_anything_is_skipped() {
        let (mut ring, now) = (Ring::default(), Instant::now());
        let mut place = ring.begin(now);
        ring.push(What::Key, message(0, 100), now);
        for n in 1..=60u8 {
            let layer = [0, 2, 1, 2][usize::from(n % 4)];
            ring.push(What::Frame { layer }, message(n, 15_000), now);
        }
        let got = read(&ring, &mut place, now);
        let has = |layer: [u8; 2], range: std::ops::Range<u8>| range.filter(|n| layer.contains(&(n % 4))).all(|n| got.contains(&n));
        assert!(has([0, 0], 1..61) && has([1, 3], 50..61) && !got.contains(&1) && !got.contains(&2));
        assert!(got.is_sorted() && place.skipped > 20);
    }

    #[test]
    fn a_frame_that_may_refer_to_one_that_was_left_out_is_left_out_too() {
        let (mut ring, now) = (Ring::default(), Instant::now());
        let mut place = ring.begin(now);
        ring.push(What::Key, message(0, 100), now);
        // one of layer 1 that is far behind the end, the next one just before it
        ring.push(What::Frame { layer: 1 }, message(1, 100), now);
        ring.push(What::Frame { layer: 2 }, message(2, 600_000), now);
        ring.push(What::Frame { layer: 1 }, message(3, 100), now);
        ring.push(What::Frame { layer: 0 }, message(4, 100), now);
        ring.push(What::Frame { layer: 2 }, message(5, 100), now);
        ring.push(What::Frame { layer: 1 }, message(6, 100), now);
        assert_eq!(read(&ring, &mut place, now), [0, 4, 5, 6]);
        assert_eq!(place.skipped, 3);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Whatever comes and however it is read: memory is bounded, order is kept, nothing is decoded without what it needs.
        #[test]
        fn any_reader_gets_whole_groups_in_order(steps in prop::collection::vec((0u8..12, 0u16..60_000, 0u64..200, 0u8..4), 1..400)) {
            let (mut ring, mut now) = (Ring::default(), Instant::now());
            let mut place = ring.begin(now);
            let (mut sent, mut got, mut next): (Vec<(u32, What)>, Option<u32>, u32) = (Vec::new(), None, 0);
            let frame_of = |what: &What| if let What::Geometry { frame } = what { Some(*frame) } else { None };
            for (kind, length, ms, reads) in steps {
                now += Duration::from_millis(ms);
                let what = match kind { 0 => What::Key, 1 => What::Geometry { frame: next.into() }, 2 => What::Sound, _ => What::Frame { layer: 0 } };
                let mut bytes = next.to_le_bytes().to_vec();
                bytes.resize(usize::from(length).max(4), 0);
                ring.push(what, bytes.into(), now);
                sent.push((next, what));
                next += 1;
                prop_assert!(ring.kept <= KEPT_BYTES);
                for _ in 0..reads {
                    let step = ring.step(&mut place, now);
                    if matches!(step, Step::Skipped { .. })
                        && let Some(newest) = sent.iter().filter_map(|(_, w)| frame_of(w)).next_back()
                    {
                        place.told(newest);
                    }
                    if let Step::Send(bytes) = step {
                        let n = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
                        prop_assert!(got.is_none_or(|g| g < n));
                        // no tiles are missing that came before what is looked at
                        let tiles = sent[..n as usize].iter().filter_map(|(_, w)| frame_of(w)).next_back();
                        let is_sound = sent[n as usize].1 == What::Sound;
                        prop_assert!(is_sound || tiles <= place.known(), "{tiles:?} before {n}, known are those of {:?}", place.known());
                        if let What::Frame { .. } = sent[n as usize].1 {
                            let before = sent[..n as usize].iter().rev().find(|(_, w)| matches!(w, What::Key | What::Frame { .. }));
                            // the frame that it refers to was given, too
                            prop_assert!(before.is_some_and(|(b, _)| got.is_some_and(|g| g >= *b)), "frame {n} after {got:?}");
                        }
                        got = Some(n);
                    }
                }
            }
        }
    }
}
