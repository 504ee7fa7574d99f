//! What a node makes of what comes from the owner of a room: which of it is missing, and what its own viewers are told.

use bytes::Bytes;

use tmpi_core::live::read;
use tmpi_core::live::wire::message::Kind;

use super::tiles::Chunks;
use super::wire::{Packet, Sort, Start};
use crate::live::ring::What;
use crate::live::room::Room;

/// How far numbers may go on from what came last: those of a thousand entries a second for a minute, of two each.
const FARTHEST: u64 = 120_000;

/// How far an owner's ring is known here: who comes back to the same one goes on from there.
#[derive(Default)]
pub struct Reached {
    /// The owner's epoch.
    pub epoch: u64,
    /// Number of the next entry; none: a start is wanted.
    pub next: Option<u64>,
    /// Frames are missing: nothing can be decoded before the next key frame.
    pub waits: bool,
}

/// Puts what an owner of one epoch sends into the room's ring here.
pub struct Follower<'a> {
    /// The room here.
    pub room: &'a Room,
    /// The owner's epoch.
    pub epoch: u64,
    /// How far it is known.
    pub reached: &'a mut Reached,
}

impl Follower<'_> {
    /// Takes a start; none where it is none, or of another epoch.
    pub fn begin(&mut self, start: &Start) -> Option<()> {
        let Ok(Kind::Hello(hello)) = read(start.hello.clone()) else { return None };
        let mut chunks = Chunks::new(&hello)?;
        let tiles = match read(start.tiles.clone()) {
            _ if start.tiles.is_empty() => None,
            Ok(Kind::Snapshot(tiles)) if chunks.take(&tiles) => Some(tiles),
            _ => return None,
        };
        // where they are of a publisher that is new here, the tiles are there before anyone is told of it
        if hello.epoch != self.epoch || !self.room.relay(hello, chunks, self.reached.next.is_none()) {
            return None;
        }
        // who watches has missed some, too
        if tiles.is_some_and(|tiles| !self.room.take_missed(self.epoch, &tiles)) {
            return None;
        }
        let from = self.reached.next.unwrap_or(0);
        // what is sent begins with a key frame
        self.reached.waits = start.entries.is_empty() && start.next > from;
        for (_, bytes) in start.entries.iter().filter(|(n, _)| *n >= from) {
            self.entry(bytes.clone())?;
        }
        self.reached.next = Some(start.next.max(from));
        Some(())
    }

    /// Takes what the owner sends.
    pub fn take(&mut self, packet: Packet) -> Taken {
        let Some(next) = self.reached.next else { return Taken::Missing };
        match packet.sort {
            Sort::Entry if packet.number < next => Taken::Yes,
            // no ring holds as many
            Sort::Entry if packet.number - next > FARTHEST || packet.after > packet.number => Taken::No,
            Sort::Entry if packet.after > next => Taken::Missing,
            Sort::Entry => match self.entry(packet.bytes) {
                Some(()) => {
                    self.reached.next = Some(packet.number.saturating_add(1));
                    Taken::Yes
                }
                // the next one tells that it is missing
                None => Taken::No,
            },
            Sort::Aside if packet.after > next.saturating_add(FARTHEST) => Taken::No,
            Sort::Aside => match read(packet.bytes) {
                Ok(Kind::Statistics(told)) => {
                    self.room.take_statistics(self.epoch, told);
                    // the last entry has none behind it that would tell
                    if packet.after > next { Taken::Missing } else { Taken::Yes }
                }
                Ok(Kind::Snapshot(_) | Kind::Geometry(_)) if packet.after > next => Taken::Missing,
                Ok(Kind::Snapshot(tiles) | Kind::Geometry(tiles)) if packet.number < next.saturating_add(FARTHEST) => {
                    if !self.room.take_missed(self.epoch, &tiles) {
                        return Taken::No;
                    }
                    self.reached.next = Some(next.max(packet.number.saturating_add(1)));
                    Taken::Yes
                }
                _ => Taken::No,
            },
            Sort::Start | Sort::Answer => Taken::No,
        }
    }

    /// Puts an entry into the ring, as the bytes that came; none where it is none.
    fn entry(&mut self, bytes: Bytes) -> Option<()> {
        let bounds = self.room.bounds;
        let what = match read(bytes.clone()).ok()? {
            Kind::Video(video) if video.data.len() > bounds.frame => return None,
            Kind::Video(video) if video.key => {
                self.reached.waits = false;
                What::Key
            }
            Kind::Video(_) if self.reached.waits => return Some(()),
            Kind::Video(video) => What::Frame { layer: video.layer },
            Kind::Sound(sound) if sound.data.len() <= bounds.sound => What::Sound,
            Kind::Geometry(tiles) => {
                // what a start told already need not be told again
                if !self.room.take_tiles(self.epoch, &tiles)? {
                    return Some(());
                }
                What::Geometry { frame: tiles.frame }
            }
            _ => return None,
        };
        self.room.push(self.epoch, what, bytes);
        Some(())
    }
}

/// What became of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Taken {
    /// It is there now, or was already.
    Yes,
    /// Something before it is missing.
    Missing,
    /// It is none.
    No,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::Bounds;
    use crate::live::nodes::forward::{self, Reader};
    use crate::live::room::Next;
    use crate::live::room::tests::{EPOCH, Made, Watcher};
    use std::collections::BTreeSet;

    /// A room of one node, and the same at another that follows it.
    struct Pair {
        made: Made,
        reader: Reader,
        there: Room,
        reached: Reached,
    }

    impl Pair {
        fn new() -> Self {
            let (made, there) = (Made::new(), Room::new(Bounds::default()));
            assert!(there.begin_to_follow());
            let reader = Reader::new(&made.room, EPOCH).unwrap();
            let mut pair = Self { made, reader, there, reached: Reached { epoch: EPOCH, ..Reached::default() } };
            pair.begin();
            pair
        }

        fn follower(&mut self) -> Follower<'_> {
            Follower { room: &self.there, epoch: EPOCH, reached: &mut self.reached }
        }

        fn begin(&mut self) {
            let start = forward::start(&self.made.room, EPOCH).unwrap();
            self.follower().begin(&start).expect("a start is taken");
        }

        /// All that the owner sends by now.
        fn sent(&mut self) -> Vec<Packet> {
            let mut sent = Vec::new();
            loop {
                match self.made.room.next(&mut self.reader.viewer) {
                    Next::Send(bytes) => sent.push(self.reader.entry(bytes)),
                    Next::Tiles => sent.extend(self.reader.tiles(&self.made.room)),
                    Next::Wait => return sent,
                    Next::Hello(_) | Next::Closed => panic!("one publisher stays"),
                }
            }
        }

        /// The owner skips over frames for which tiles 2 and 4 were sent; what it sends then.
        fn skip(&mut self) -> Vec<Packet> {
            for changed in [Some(4), None, Some(2), None, Some(4)] {
                let area = changed.map(|tile| self.made.one(tile));
                self.made.next(false, 300_000, area);
            }
            self.made.next(true, 10, None);
            self.made.next(false, 10, None);
            self.sent()
        }
    }

    fn tiles(packet: &Packet) -> BTreeSet<u32> {
        match read(packet.bytes.clone()) {
            Ok(Kind::Geometry(tiles) | Kind::Snapshot(tiles)) => Watcher::held(&tiles),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn who_follows_is_sent_the_tiles_that_were_skipped_alone_and_hands_on_no_other() {
        let mut pair = Pair::new();
        let mut viewer = Watcher::at(&pair.there, &pair.made.tiles);
        pair.made.next(false, 10, Some(pair.made.one(1)));
        for packet in pair.sent() {
            assert_eq!(pair.follower().take(packet), Taken::Yes);
        }
        viewer.read(&pair.there);
        assert_eq!(viewer.given, [BTreeSet::from([1])]);
        let sent = pair.skip();
        assert_eq!((sent[0].sort, tiles(&sent[0])), (Sort::Aside, BTreeSet::from([2, 4])));
        for packet in sent {
            assert_eq!(pair.follower().take(packet), Taken::Yes);
        }
        assert_eq!(viewer.read(&pair.there), [] as [BTreeSet<u32>; 0]);
        assert_eq!(viewer.given[1..], [BTreeSet::from([2, 4])]);
        assert_eq!(viewer.model.geometry().unwrap().tiles, pair.made.tiles.tiles);
        // one who does not read there is told what is newer than it has, as at the owner's node
        for changed in [None, Some(3), None, None, Some(3)] {
            let area = changed.map(|tile| pair.made.one(tile));
            pair.made.next(false, 300_000, area);
            for packet in pair.sent() {
                assert_eq!(pair.follower().take(packet), Taken::Yes);
            }
        }
        pair.made.next(true, 10, None);
        for packet in pair.sent() {
            assert_eq!(pair.follower().take(packet), Taken::Yes);
        }
        assert_eq!(viewer.read(&pair.there), [BTreeSet::from([3])]);
        assert_eq!(viewer.model.geometry().unwrap().tiles, pair.made.tiles.tiles);
    }

    #[test]
    fn tiles_that_were_lost_between_nodes_are_noticed_by_what_comes_next_and_come_with_a_start() {
        let mut pair = Pair::new();
        let mut viewer = Watcher::at(&pair.there, &pair.made.tiles);
        viewer.read(&pair.there);
        let sent = pair.skip();
        assert_eq!((sent[0].sort, sent.len()), (Sort::Aside, 3));
        // the first is lost
        for packet in &sent[1..] {
            assert_eq!(pair.follower().take(packet.clone()), Taken::Missing);
        }
        viewer.read(&pair.there);
        assert_ne!(viewer.model.geometry().unwrap().tiles, pair.made.tiles.tiles);
        pair.begin();
        viewer.read(&pair.there);
        assert_eq!(viewer.model.geometry().unwrap().tiles, pair.made.tiles.tiles);
        assert_eq!(viewer.given, [BTreeSet::from([2, 4])], "what was not missing is not told again");
        for packet in sent {
            assert_eq!(pair.follower().take(packet), Taken::Yes, "what came late is there already");
        }
        pair.made.next(false, 10, Some(pair.made.one(0)));
        for packet in pair.sent() {
            assert_eq!(pair.follower().take(packet), Taken::Yes);
        }
        viewer.read(&pair.there);
        assert_eq!(viewer.model.geometry().unwrap().tiles, pair.made.tiles.tiles);
    }

    #[test]
    fn what_is_sent_beside_entries_has_a_number_of_its_own_though_sound_came_before_the_key_frame() {
        let mut pair = Pair::new();
        for _ in 0..5 {
            pair.made.next(false, 300_000, None);
        }
        // nothing can be decoded: what comes is left out, but for sound
        assert!(pair.sent().is_empty());
        pair.made.next(false, 10, Some(pair.made.one(2)));
        pair.made.room.push(EPOCH, What::Sound, tmpi_core::live::write(Kind::Sound(tmpi_core::live::wire::Sound::default())));
        let mut sent = pair.sent();
        pair.made.next(true, 10, None);
        sent.extend(pair.sent());
        assert_eq!(sent.iter().map(|p| p.sort).collect::<Vec<_>>(), [Sort::Entry, Sort::Aside, Sort::Entry]);
        assert!(sent.windows(2).all(|w| w[1].after == w[0].number + 1 && w[1].number >= w[1].after), "{sent:?}");
        let (sound, key) = (sent[0].clone(), sent[2].clone());
        assert_eq!(pair.follower().take(sound), Taken::Yes);
        assert_eq!(pair.follower().take(key), Taken::Missing);
    }
}
