//! A room of another node, for the viewers of this one: what comes is put into a ring as if the publisher were here.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::StreamExt as _;
use tokio::time::{interval, timeout};

use tmpi_core::live::read;
use tmpi_core::live::wire::message::Kind;

use super::table::{BEAT, Owner};
use super::tiles::Chunks;
use super::wire::{Joined, Joiner, Packet, Sort, Start};
use super::{Ask, Nodes, subject};
use crate::live::ring::What;
use crate::live::room::Room;
use crate::live::{COME_BACK, HEARTBEAT, Rooms};

/// Time for which an owner's answer is waited for.
const ANSWER: Duration = Duration::from_secs(1);
/// Shortest pause between two requests for a start.
const STARTS: Duration = Duration::from_millis(250);
/// Entries that an owner may have sent since the last one that came; a thousand a second for a minute.
const FARTHEST: u64 = 60_000;
/// Time without a word after which an owner is asked anew, who speaks each second: it may have lost sight of this node, and of that alone.
const SILENCE: Duration = HEARTBEAT.saturating_mul(2);
/// Time for which a room without viewers is kept.
const NOBODY: Duration = Duration::from_secs(2);

/// Follows a room's owners, one after the other, until nobody watches, the publisher comes here, or there is none for [`COME_BACK`].
pub async fn run(nodes: Arc<Nodes>, rooms: Arc<Rooms>, name: String, room: Arc<Room>) {
    let mut heard = nodes.heard.subscribe();
    let (mut alone_since, mut nobody, mut reached) = (None, None, Reached::default());
    while room.is_followed() && !nodes.stop.is_cancelled() && !is_left(&room, &mut nobody) {
        let now = Instant::now();
        if let Some(owner) = nodes.owner(&name) {
            alone_since = None;
            if reached.epoch != owner.epoch {
                reached = Reached { epoch: owner.epoch, ..Reached::default() };
            }
            Session { nodes: &nodes, name: &name, room: &room, owner, reached: &mut reached, nobody: &mut nobody }.run().await;
            // one that cannot be followed is not asked without end
            tokio::time::sleep(Duration::from_millis(20)).await;
            continue;
        }
        // without NATS nobody knows whether the publisher is still there
        let since = *alone_since.get_or_insert(now);
        if now.saturating_duration_since(since) > COME_BACK && nodes.is_connected() {
            break;
        }
        // nobody else hears: the sender is this node's own
        let _ = timeout(BEAT, heard.changed()).await;
    }
    if room.end_to_follow() {
        rooms.leave_followed(&name, &room, alone_since.is_some());
    }
}

/// How far an owner's ring is known here: who comes back to the same one goes on from there.
#[derive(Default)]
struct Reached {
    epoch: u64,
    /// Number of the next entry; none: a start is wanted.
    next: Option<u64>,
    /// Frames are missing: nothing can be decoded before the next key frame.
    waits: bool,
}

/// One owner with one epoch.
struct Session<'a> {
    nodes: &'a Nodes,
    name: &'a str,
    room: &'a Arc<Room>,
    owner: Owner,
    reached: &'a mut Reached,
    nobody: &'a mut Option<Instant>,
}

/// Whether nobody has watched a room for a while; `since` is when that was first seen.
fn is_left(room: &Room, since: &mut Option<Instant>) -> bool {
    *since = (room.viewers() == 0).then(|| since.unwrap_or_else(Instant::now));
    since.is_some_and(|since| since.elapsed() > NOBODY)
}

impl Session<'_> {
    async fn run(mut self) {
        let Some(mut frames) = self.nodes.subscribe(subject(self.name, self.owner.epoch)).await else { return };
        let mut heard = self.nodes.heard.subscribe();
        let mut look = interval(BEAT);
        let mut joiner = Joiner::default();
        let (mut missing, mut asked, mut came) = (true, None::<Instant>, Instant::now());
        loop {
            if came.elapsed() > SILENCE {
                (missing, came) = (true, Instant::now());
            }
            if missing && asked.is_none_or(|at| at.elapsed() >= STARTS) {
                asked = Some(Instant::now());
                missing = !self.catch_up().await;
                if self.reached.waits {
                    self.ask_key().await;
                }
            }
            tokio::select! {
                message = frames.next() => {
                    let Some(message) = message else { return };
                    match joiner.push(&message.payload) {
                        Joined::More => {}
                        Joined::Wrong => self.nodes.drop_one(),
                        Joined::Whole(packet) => match self.take(packet) {
                            Taken::Yes => came = Instant::now(),
                            Taken::Missing => missing = true,
                            Taken::No => self.nodes.drop_one(),
                        },
                    }
                }
                () = self.room.keys.notified() => self.ask_key().await,
                _ = heard.changed() => {
                    if !self.goes_on() {
                        return;
                    }
                }
                _ = look.tick() => {
                    if !self.goes_on() || is_left(self.room, self.nobody) {
                        return;
                    }
                }
                () = self.nodes.stop.cancelled() => return,
            }
        }
    }

    fn goes_on(&self) -> bool {
        self.room.is_followed() && self.nodes.owner(self.name).as_ref() == Some(&self.owner)
    }

    fn words(&self, key: bool) -> Ask {
        Ask { node: self.nodes.me.clone(), room: self.name.to_owned(), epoch: self.owner.epoch, key, get: None }
    }

    async fn ask_key(&self) {
        self.nodes.ask(&self.owner, &self.words(true), self.nodes.client.new_inbox()).await;
    }

    /// Asks for a start and takes of it what is not there yet; false where none came.
    async fn catch_up(&mut self) -> bool {
        let Some(packet) = self.nodes.request(&self.owner, &self.words(false), Sort::Start, ANSWER).await else { return false };
        let begun = Start::read(packet.bytes).and_then(|start| self.begin(&start)).is_some();
        if !begun {
            self.nodes.drop_one();
        }
        begun
    }

    /// Takes a start; none where it is none, or of another epoch.
    fn begin(&mut self, start: &Start) -> Option<()> {
        let Ok(Kind::Hello(hello)) = read(start.hello.clone()) else { return None };
        if hello.epoch != self.owner.epoch || !self.room.relay(hello.clone(), Chunks::new(&hello)?, self.reached.next.is_none()) {
            return None;
        }
        if !start.tiles.is_empty() {
            let Ok(Kind::Snapshot(tiles)) = read(start.tiles.clone()) else { return None };
            if !self.room.take_tiles(self.owner.epoch, &tiles) {
                return None;
            }
            // who watches has missed some, too
            if self.reached.next.is_some() {
                self.room.push(self.owner.epoch, What::Geometry { frame: tiles.frame }, start.tiles.clone());
            }
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

    fn take(&mut self, packet: Packet) -> Taken {
        let Some(next) = self.reached.next else { return Taken::Missing };
        match packet.sort {
            Sort::Entry if packet.number < next => Taken::Yes,
            // no ring holds as many
            Sort::Entry if packet.number - next > FARTHEST || packet.after > packet.number => Taken::No,
            Sort::Entry if packet.after > next => Taken::Missing,
            Sort::Entry => match self.entry(packet.bytes) {
                Some(()) => {
                    self.reached.next = Some(packet.number + 1);
                    Taken::Yes
                }
                // the next one tells that it is missing
                None => Taken::No,
            },
            Sort::Aside if packet.after > next + FARTHEST => Taken::No,
            Sort::Aside => match read(packet.bytes.clone()) {
                Ok(Kind::Statistics(told)) => {
                    self.room.take_statistics(self.owner.epoch, told);
                    // the last entry has none behind it that would tell
                    if packet.after > next { Taken::Missing } else { Taken::Yes }
                }
                Ok(Kind::Snapshot(tiles)) if self.room.take_tiles(self.owner.epoch, &tiles) => {
                    self.room.push(self.owner.epoch, What::Geometry { frame: tiles.frame }, packet.bytes);
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
                if !self.room.take_tiles(self.owner.epoch, &tiles) {
                    return None;
                }
                What::Geometry { frame: tiles.frame }
            }
            _ => return None,
        };
        self.room.push(self.owner.epoch, what, bytes);
        Some(())
    }
}

/// What became of a message.
enum Taken {
    Yes,
    /// Something before it is missing.
    Missing,
    /// It is none.
    No,
}
