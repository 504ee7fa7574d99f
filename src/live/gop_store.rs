//! Groups of pictures: the messages from one key frame to another, for caches and HTTP clients.
//!
//! They share their bytes with the ring's messages but have their own bounds. A complete group never changes.

use std::collections::VecDeque;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;

use super::ring::MessageKind;
use super::room::Tiles;
use tmpi_core::live::schema::Hello;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::write;

/// Most groups, with the growing one.
const KEPT: usize = 4;
const KEPT_BYTES: usize = 8 << 20;
/// Shortest duration of a group: in a stream of key frames alone, one group per frame would be too short.
const LEAST: Duration = Duration::from_secs(1);

/// Address of a group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Group {
    pub epoch: u64,
    pub number: u64,
}

impl fmt::Display for Group {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{}", self.epoch, self.number)
    }
}

impl FromStr for Group {
    type Err = ();

    /// Accepts only the canonical form, so that each group has one address.
    fn from_str(text: &str) -> Result<Self, ()> {
        let (epoch, number) = text.split_once('-').ok_or(())?;
        let group = Self { epoch: epoch.parse().map_err(|_| ())?, number: number.parse().map_err(|_| ())? };
        if group.to_string() == text { Ok(group) } else { Err(()) }
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum GroupPart {
    Message(Bytes),
    Wait,
    /// The group ends before this message.
    End,
    /// The group is the next to begin.
    NotYet,
    /// The group was dropped or never existed.
    Gone,
}

struct KeptGroup {
    number: u64,
    hello: Arc<Hello>,
    before: Option<Arc<Tiles>>,
    messages: Vec<Bytes>,
    bytes: usize,
    began: Instant,
    whole: bool,
}

#[derive(Default)]
pub struct Groups {
    kept: VecDeque<KeptGroup>,
    next: u64,
}

impl Groups {
    /// Adds a message of a publisher with `hello`; `before` are the current tiles.
    pub fn push(&mut self, what: MessageKind, bytes: &Bytes, at: Instant, hello: &Arc<Hello>, before: Option<&Arc<Tiles>>) {
        let over = self.kept.back().is_none_or(|k| k.whole || at.saturating_duration_since(k.began) >= LEAST);
        if what == MessageKind::Key && over {
            self.end();
            let (hello, before) = (Arc::clone(hello), before.cloned());
            let (number, messages) = (self.next, Vec::new());
            self.kept.push_back(KeptGroup { number, hello, before, messages, bytes: 0, began: at, whole: false });
            self.next += 1;
        }
        if let Some(last) = self.kept.back_mut().filter(|last| !last.whole) {
            last.bytes += bytes.len();
            last.messages.push(bytes.clone());
            // a group may use half of the bytes
            last.whole = last.bytes > KEPT_BYTES / 2;
        }
        while self.kept.len() > KEPT || self.kept.iter().map(|k| k.bytes).sum::<usize>() > KEPT_BYTES {
            self.kept.pop_front();
        }
    }

    pub fn end(&mut self) {
        if let Some(last) = self.kept.back_mut() {
            last.whole = true;
        }
    }

    pub fn last(&self) -> Option<u64> {
        self.kept.back().map(|k| k.number)
    }

    /// Message `at` of a group, which starts with HELLO and the tiles. Returns the tiles themselves as `Err`: they may yet have to be
    /// encoded.
    pub fn part(&self, number: u64, at: usize) -> Result<GroupPart, Arc<Tiles>> {
        let Some(group) = self.kept.iter().find(|k| k.number == number) else {
            return Ok(if number == self.next { GroupPart::NotYet } else { GroupPart::Gone });
        };
        let before = usize::from(group.before.is_some());
        Ok(match (at, &group.before) {
            (0, _) => GroupPart::Message(write(Kind::Hello((*group.hello).clone()))),
            (1, Some(tiles)) => return Err(Arc::clone(tiles)),
            _ => match group.messages.get(at - 1 - before) {
                Some(bytes) => GroupPart::Message(bytes.clone()),
                None if group.whole => GroupPart::End,
                None => GroupPart::Wait,
            },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(groups: &Groups, number: u64, at: usize) -> GroupPart {
        groups.part(number, at).unwrap_or_else(|_| panic!("there are no tiles"))
    }

    /// The messages of a group after HELLO.
    fn rest(groups: &Groups, number: u64) -> (Vec<Bytes>, GroupPart) {
        let mut messages = Vec::new();
        loop {
            match part(groups, number, 1 + messages.len()) {
                GroupPart::Message(bytes) => messages.push(bytes),
                other => return (messages, other),
            }
        }
    }

    #[test]
    fn a_group_ends_at_the_first_key_frame_after_a_second() {
        let (mut groups, hello, start) = (Groups::default(), Arc::default(), Instant::now());
        let mut push = |what, byte: u8, ms| groups.push(what, &Bytes::from(vec![byte]), start + Duration::from_millis(ms), &hello, None);
        push(MessageKind::Sound, 0, 0);
        push(MessageKind::Key, 1, 10);
        push(MessageKind::Frame { layer: 0 }, 2, 500);
        push(MessageKind::Key, 3, 900);
        push(MessageKind::Geometry { frame: 3 }, 4, 1000);
        push(MessageKind::Key, 5, 1010);
        push(MessageKind::Sound, 6, 1020);
        let bytes = |range: std::ops::RangeInclusive<u8>| range.map(|b| Bytes::from(vec![b])).collect::<Vec<_>>();
        assert_eq!(rest(&groups, 0), (bytes(1..=4), GroupPart::End));
        assert_eq!(rest(&groups, 1), (bytes(5..=6), GroupPart::Wait));
        assert_eq!((part(&groups, 2, 0), part(&groups, 3, 0), groups.last()), (GroupPart::NotYet, GroupPart::Gone, Some(1)));
        groups.end();
        assert_eq!(rest(&groups, 1).1, GroupPart::End);
    }

    #[test]
    fn kept_groups_are_bounded_and_never_change() {
        let (mut groups, hello, start) = (Groups::default(), Arc::default(), Instant::now());
        let mut told: Vec<Option<(Vec<Bytes>, GroupPart)>> = Vec::new();
        for n in 0..400u64 {
            let what = if n % 10 == 0 { MessageKind::Key } else { MessageKind::Frame { layer: 0 } };
            let bytes = Bytes::from(vec![n as u8; 30_000 + 700 * n as usize]);
            groups.push(what, &bytes, start + Duration::from_millis(200 * n), &hello, None);
            assert!(groups.kept.len() <= KEPT && groups.kept.iter().map(|k| k.bytes).sum::<usize>() <= KEPT_BYTES);
            for number in 0..groups.next {
                told.resize(groups.next as usize, None);
                let now = rest(&groups, number);
                if now.1 == GroupPart::End {
                    assert!(told[number as usize].as_ref().is_none_or(|before| *before == now));
                    told[number as usize] = Some(now);
                }
            }
        }
        assert!(groups.next > 30 && part(&groups, 0, 0) == GroupPart::Gone);
        // without another key frame
        for n in 0..2000 {
            groups.push(
                MessageKind::Frame { layer: 0 },
                &Bytes::from(vec![0; 30_000]),
                start + Duration::from_secs(1000 + n),
                &hello,
                None,
            );
        }
        assert!(groups.kept.iter().map(|k| k.bytes).sum::<usize>() <= KEPT_BYTES);
        assert_eq!(rest(&groups, groups.next - 1).1, GroupPart::End);
    }
}
