//! What the owner of a room sends to the nodes that watch it: it reads the ring as a viewer does, and skips where NATS is too slow.

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval};

use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::write;

use super::lend::Lender;
use super::wire::{Packet, Sort, Start};
use super::{Ask, Nodes, subject};
use crate::live::HEARTBEAT;
use crate::live::room::{Next, Room, Viewer};

/// Sends until the room is another one's, or has another epoch.
pub async fn run(
    nodes: Arc<Nodes>,
    name: String,
    epoch: u64,
    (room, lender): (Arc<Room>, Lender),
    mut asks: mpsc::Receiver<(Ask, async_nats::Subject)>,
) {
    let to = subject(&name, epoch);
    let mut changes = room.watch();
    let mut beat = interval(HEARTBEAT);
    beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut reading: Option<Reader> = None;
    loop {
        changes.mark_unchanged();
        let next = reading.as_mut().map_or(Next::Wait, |reader| room.next(&mut reader.viewer));
        match (next, &mut reading) {
            // what cannot be sent is missed by those who watch, and they see it by the next one
            (Next::Send(bytes), Some(reader)) if reader.viewer.epoch() == epoch => nodes.send(&to, &reader.entry(bytes)).await,
            // who watches begins with the key frame that comes
            (Next::Tiles, Some(reader)) => {
                if let Some(packet) = reader.tiles(&room) {
                    nodes.send(&to, &packet).await;
                }
            }
            (Next::Wait, _) => tokio::select! {
                // the room is held by this task
                _ = changes.changed(), if reading.is_some() => {}
                ask = asks.recv() => {
                    let Some((ask, reply)) = ask else { return };
                    if let Some(get) = ask.get {
                        lender.lend(&nodes, get, reply);
                        continue;
                    }
                    if ask.key {
                        room.ask_key();
                        continue;
                    }
                    // from here on everything is sent to all: what comes before it, to the one that asks
                    if reading.is_none() {
                        reading = Reader::new(&room, epoch);
                    }
                    let Some(start) = start(&room, epoch) else { return };
                    nodes.send(&reply, &Packet { sort: Sort::Start, number: 0, after: 0, bytes: start.write() }).await;
                }
                _ = beat.tick() => {
                    if !nodes.table().holds(&name, epoch) {
                        return;
                    }
                    if nodes.table().audience(&name, Instant::now()).0 == 0 {
                        reading = None;
                    }
                    if let Some(Reader { viewer, sent }) = &reading {
                        let bytes = write(Kind::Statistics(room.statistics(viewer)));
                        // whoever misses them is told the next ones
                        nodes.send(&to, &Packet { sort: Sort::Aside, number: *sent, after: *sent, bytes }).await;
                    }
                }
                () = nodes.stop.cancelled() => return,
            },
            // another publisher, or none any more
            _ => return,
        }
    }
}

/// Number that an entry of the ring goes by between nodes: an even one, so that the tiles which are sent for what was skipped have one before it.
const fn numbered(entry: u64) -> u64 {
    2 * entry
}

/// What a node begins with that comes late; none where `epoch` is past.
pub fn start(room: &Room, epoch: u64) -> Option<Start> {
    let mut start = room.start(epoch)?;
    start.next = numbered(start.next);
    start.entries.iter_mut().for_each(|(number, _)| *number = numbered(*number));
    Some(start)
}

/// Reads a room's ring for all nodes that watch.
pub struct Reader {
    /// Its place.
    pub viewer: Viewer,
    /// The number up to which everything was sent.
    sent: u64,
}

impl Reader {
    /// At the end of the ring; none where `epoch` is past.
    pub fn new(room: &Room, epoch: u64) -> Option<Self> {
        let viewer = room.reader(epoch)?;
        let sent = numbered(viewer.number());
        Some(Self { viewer, sent })
    }

    /// An entry that the ring gave.
    pub fn entry(&mut self, bytes: Bytes) -> Packet {
        self.packet(Sort::Entry, numbered(self.viewer.number().saturating_sub(1)), bytes)
    }

    /// The tiles that are newer than was sent, before the entry that comes; none where there are none.
    pub fn tiles(&mut self, room: &Room) -> Option<Packet> {
        let bytes = room.tiles(&mut self.viewer)?.inspect_err(|error| tracing::error!(%error, "coding the tiles of a room")).ok()?;
        Some(self.packet(Sort::Aside, numbered(self.viewer.number()).saturating_sub(1).max(self.sent), bytes))
    }

    fn packet(&mut self, sort: Sort, number: u64, bytes: Bytes) -> Packet {
        let after = std::mem::replace(&mut self.sent, number + 1);
        Packet { sort, number, after, bytes }
    }
}
