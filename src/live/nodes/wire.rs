//! Bytes between nodes: messages in parts that a NATS server takes, and what a node that comes late is sent first.
//!
//! Each payload begins with 24 bytes, numbers in little endian: `T` and the version, what it is ([`Sort`], from 0 on), 0, part and parts (`u16`
//! each), number and `after` (`u64` each). The rest of all parts together is one message of `proto/live.proto`, a [`Start`], or what was asked for (`lend`).

use bytes::Bytes;

use tmpi_core::live::MAX_MESSAGE;

/// Version of these bytes.
const VERSION: u8 = 1;
/// Bytes before those of the message.
pub const HEAD: usize = 24;
/// Bytes of a [`Start`] at most: what the ring keeps, all tiles, and the heads.
const MAX_START: usize = 16 << 20;

/// What a message between nodes is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sort {
    /// An entry of the owner's ring.
    Entry,
    /// Beside the ring: statistics, or all tiles where the owner's sender had to skip.
    Aside,
    /// A [`Start`].
    Start,
    /// What a node asked for, of which number and `after` say more.
    Answer,
}

impl Sort {
    const fn most(self) -> usize {
        match self {
            Self::Entry | Self::Aside => MAX_MESSAGE,
            Self::Start | Self::Answer => MAX_START,
        }
    }
}

/// A message and its place in the owner's ring.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Packet {
    /// What it is.
    pub sort: Sort,
    /// Its number in the owner's ring.
    pub number: u64,
    /// What was sent before it went up to this number: whoever has less has missed something.
    pub after: u64,
    /// The message.
    pub bytes: Bytes,
}

impl Packet {
    /// Payloads of `most` bytes at most; none where it would be too many.
    pub fn split(&self, most: usize) -> Option<Vec<Bytes>> {
        let room = most.checked_sub(HEAD).filter(|r| *r > 0)?;
        let parts = u16::try_from(self.bytes.len().div_ceil(room).max(1)).ok()?;
        let part = |n: u16| {
            let from = usize::from(n) * room;
            let body = &self.bytes[from..self.bytes.len().min(from + room)];
            let mut payload = Vec::with_capacity(HEAD + body.len());
            payload.extend([b'T', VERSION, self.sort as u8, 0]);
            payload.extend(n.to_le_bytes());
            payload.extend(parts.to_le_bytes());
            payload.extend(self.number.to_le_bytes());
            payload.extend(self.after.to_le_bytes());
            payload.extend(body);
            Bytes::from(payload)
        };
        Some((0..parts).map(part).collect())
    }
}

/// Puts parts together, which come in their order: of one message at a time, and of no more bytes than such a message may have.
#[derive(Debug, Default)]
pub struct Joiner {
    begun: Option<(Packet, u16, u16, Vec<u8>)>,
}

/// What became of a payload.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Joined {
    /// A message is whole.
    Whole(Packet),
    /// More parts are to come.
    More,
    /// It is no such payload, or not the one that was to come: it and what was there of its message are forgotten.
    Wrong,
}

impl Joiner {
    /// Takes a payload.
    pub fn push(&mut self, payload: &Bytes) -> Joined {
        let Some((head, body)) = payload.split_first_chunk::<HEAD>() else {
            self.begun = None;
            return Joined::Wrong;
        };
        let short = |at: usize| u16::from_le_bytes([head[at], head[at + 1]]);
        let long = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| head[at + i]));
        let sort = [Sort::Entry, Sort::Aside, Sort::Start, Sort::Answer].into_iter().find(|s| *s as u8 == head[2]);
        let (part, parts, number, after) = (short(4), short(6), long(8), long(16));
        let begun = self.begun.take();
        let Some(sort) = sort.filter(|_| head[..2] == [b'T', VERSION] && head[3] == 0 && part < parts) else { return Joined::Wrong };
        let packet = Packet { sort, number, after, bytes: Bytes::new() };
        if parts == 1 {
            let bytes = payload.slice(HEAD..);
            return if bytes.len() <= sort.most() { Joined::Whole(Packet { bytes, ..packet }) } else { Joined::Wrong };
        }
        let mut bytes = match (part, begun) {
            (0, _) => Vec::new(),
            (_, Some((p, next, all, bytes))) if p == packet && (next, all) == (part, parts) => bytes,
            _ => return Joined::Wrong,
        };
        // a part without bytes would let one count to 65 535 for nothing
        if body.is_empty() || bytes.len() + body.len() > sort.most() {
            return Joined::Wrong;
        }
        bytes.extend_from_slice(body);
        if part + 1 == parts {
            return Joined::Whole(Packet { bytes: bytes.into(), ..packet });
        }
        self.begun = Some((packet, part + 1, parts, bytes));
        Joined::More
    }
}

/// What a node is sent that begins to watch: as a message, the number of the next entry (`u64`), then each of the following after its length
/// (`u32`): HELLO; SNAPSHOT, empty where there is none; the entries of the ring from the last key frame on, each after its number (`u64`).
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Start {
    /// Number of the next entry.
    pub next: u64,
    /// HELLO.
    pub hello: Bytes,
    /// All tiles; empty where there are none yet.
    pub tiles: Bytes,
    /// Numbers and bytes of entries.
    pub entries: Vec<(u64, Bytes)>,
}

impl Start {
    /// Its bytes.
    pub fn write(&self) -> Bytes {
        let all = self.entries.iter().map(|(_, b)| b.len() + 12).sum::<usize>() + self.hello.len() + self.tiles.len() + 16;
        let mut out = Vec::with_capacity(all);
        out.extend(self.next.to_le_bytes());
        for piece in [&self.hello, &self.tiles] {
            out.extend((piece.len() as u32).to_le_bytes());
            out.extend(&piece[..]);
        }
        for (number, bytes) in &self.entries {
            out.extend(number.to_le_bytes());
            out.extend((bytes.len() as u32).to_le_bytes());
            out.extend(&bytes[..]);
        }
        out.into()
    }

    /// Reads it; none where it is none. Its pieces share the memory of `bytes`.
    pub fn read(mut bytes: Bytes) -> Option<Self> {
        let number =
            |bytes: &mut Bytes| bytes.split_first_chunk::<8>().map(|(n, _)| u64::from_le_bytes(*n)).inspect(|_| drop(bytes.split_to(8)));
        let piece = |bytes: &mut Bytes| {
            let length = u32::from_le_bytes(*bytes.first_chunk::<4>()?) as usize;
            drop(bytes.split_to(4));
            (length <= bytes.len()).then(|| bytes.split_to(length))
        };
        let (next, hello, tiles) = (number(&mut bytes)?, piece(&mut bytes)?, piece(&mut bytes)?);
        let mut entries = Vec::new();
        while !bytes.is_empty() {
            entries.push((number(&mut bytes)?, piece(&mut bytes)?));
        }
        let ordered = entries.windows(2).all(|w| w[0].0 < w[1].0) && entries.last().is_none_or(|(n, _)| *n < next);
        ordered.then_some(Self { next, hello, tiles, entries })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn packet(sort: Sort, length: usize) -> Packet {
        Packet { sort, number: 7, after: 5, bytes: (0..length).map(|i| (i * 31) as u8).collect() }
    }

    #[test]
    fn what_is_split_comes_together() {
        for length in [0, 1, 99, 100, 101, 1000, 70_000] {
            let (sent, mut joiner) = (packet(Sort::Entry, length), Joiner::default());
            let parts = sent.split(100 + HEAD).unwrap();
            assert!(parts.iter().all(|p| p.len() <= 100 + HEAD));
            assert_eq!(parts.len(), length.div_ceil(100).max(1));
            for part in &parts[..parts.len() - 1] {
                assert_eq!(joiner.push(part), Joined::More);
            }
            assert_eq!(joiner.push(&parts[parts.len() - 1]), Joined::Whole(sent));
        }
        assert!(packet(Sort::Entry, 10).split(HEAD).is_none());
        assert!(packet(Sort::Start, 70_000).split(HEAD + 1).is_none(), "more parts than can be counted");
    }

    #[test]
    fn parts_that_are_missing_or_of_another_message_spoil_it() {
        let parts = packet(Sort::Entry, 300).split(100 + HEAD).unwrap();
        let mut joiner = Joiner::default();
        assert_eq!((joiner.push(&parts[0]), joiner.push(&parts[2])), (Joined::More, Joined::Wrong));
        assert_eq!(joiner.push(&parts[1]), Joined::Wrong);
        let other = Packet { number: 8, ..packet(Sort::Entry, 300) }.split(100 + HEAD).unwrap();
        assert_eq!((joiner.push(&parts[0]), joiner.push(&other[1])), (Joined::More, Joined::Wrong));
        assert_eq!((joiner.push(&parts[0]), joiner.push(&parts[1])), (Joined::More, Joined::More), "and the next one is whole");
        assert!(matches!(joiner.push(&parts[2]), Joined::Whole(_)));
    }

    #[test]
    fn nothing_grows_beyond_what_a_message_may_have() {
        for (sort, most) in [(Sort::Entry, MAX_MESSAGE), (Sort::Start, MAX_START), (Sort::Answer, MAX_START)] {
            let mut joiner = Joiner::default();
            let last = |length: usize, joiner: &mut Joiner| {
                let parts = packet(sort, length).split(1 << 20).unwrap();
                parts.iter().map(|p| joiner.push(p)).last().unwrap()
            };
            assert!(matches!(last(most, &mut joiner), Joined::Whole(p) if p.bytes.len() == most));
            assert_eq!(last(most + 1, &mut joiner), Joined::Wrong);
            assert_eq!(joiner.push(&packet(sort, most + 1).split(usize::MAX).unwrap()[0]), Joined::Wrong);
        }
    }

    #[test]
    fn a_start_is_read_as_it_was_written() {
        let piece = |n: u8, length: usize| Bytes::from(vec![n; length]);
        let start = Start { next: 9, hello: piece(1, 30), tiles: Bytes::new(), entries: vec![(4, piece(2, 5)), (8, piece(3, 0))] };
        assert_eq!(Start::read(start.write()), Some(start.clone()));
        let bytes = start.write();
        let good: Vec<usize> = (0..bytes.len()).filter(|n| Start::read(bytes.slice(..*n)).is_some()).collect();
        assert_eq!(good.len(), 2, "only where entries are left out at the end: {good:?}");
        assert_eq!(Start::read(Start { next: 8, ..start }.write()), None, "an entry that is yet to come");
    }

    proptest! {
        /// Whatever comes: no panic, and no more memory than was sent.
        #[test]
        fn garbage_is_told_from_messages(payloads in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..60), 1..20)) {
            let mut joiner = Joiner::default();
            for mut payload in payloads {
                if payload.len() > 4 && payload[0] < 128 {
                    let sort = payload[2] % 5;
                    payload[..4].copy_from_slice(&[b'T', VERSION, sort, 0]);
                }
                let payload = Bytes::from(payload);
                if let Joined::Whole(packet) = joiner.push(&payload) {
                    drop(Start::read(packet.bytes));
                }
            }
        }
    }
}
