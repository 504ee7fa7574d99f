//! What the owner of a room sends to the nodes that watch it: it reads the ring as a viewer does, and skips where NATS is too slow.

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval};

use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::write;

use super::lend::Lender;
use super::wire::{Packet, Sort};
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
    // the reader, and the number up to which everything was sent
    let mut reading: Option<(Viewer, u64)> = None;
    loop {
        changes.mark_unchanged();
        let next = reading.as_mut().map_or(Next::Wait, |(viewer, _)| room.next(viewer));
        match (next, &mut reading) {
            (Next::Send(bytes), Some((viewer, sent))) if viewer.epoch() == epoch => {
                let number = viewer.number() - 1;
                let packet = Packet { sort: Sort::Entry, number, after: *sent, bytes };
                // what cannot be sent is missed by those who watch, and they see it by the next one
                nodes.send(&to, &packet).await;
                *sent = number + 1;
            }
            // who watches begins with the key frame that comes
            (Next::Tiles, Some((_, sent))) => {
                if let Some(Ok(bytes)) = room.snapshot() {
                    aside(&nodes, &to, *sent, bytes).await;
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
                        reading = room.reader(epoch).map(|viewer| { let from = viewer.number(); (viewer, from) });
                    }
                    let Some(start) = room.start(epoch) else { return };
                    nodes.send(&reply, &Packet { sort: Sort::Start, number: 0, after: 0, bytes: start.write() }).await;
                }
                _ = beat.tick() => {
                    if !nodes.table().holds(&name, epoch) {
                        return;
                    }
                    if nodes.table().audience(&name, Instant::now()).0 == 0 {
                        reading = None;
                    }
                    if let Some((viewer, sent)) = &reading {
                        aside(&nodes, &to, *sent, write(Kind::Statistics(room.statistics(viewer)))).await;
                    }
                }
                () = nodes.stop.cancelled() => return,
            },
            // another publisher, or none any more
            _ => return,
        }
    }
}

async fn aside(nodes: &Nodes, to: &str, sent: u64, bytes: Bytes) {
    // whoever misses it is told the next one
    nodes.send(to, &Packet { sort: Sort::Aside, number: sent, after: sent, bytes }).await;
}
