//! Rooms that several nodes share over one NATS cluster, by core subjects alone: nothing is stored there, so that a plain `nats-server` does.
//!
//! A room has one owner at a time, the node that its publisher came to. Who that is every node says of itself each 300 ms (`table`): a claim
//! is made known, stands where nobody objects for 150 ms and whoever had the room has been silent for 1.2 s, and has a higher epoch than all
//! before. Where a cut of the network lets two have a room, each goes on for its own viewers, and the lower epoch yields as soon as they hear
//! each other. A key-value bucket would need `JetStream` with a majority of its servers to say the same, and that rule besides.
//!
//! | subject | payload |
//! |---|---|
//! | `tmpi.nodes` | JSON of [`table::Presence`]: what a node has, claims and watches |
//! | `tmpi.node.NODE` | JSON of [`Ask`]: a node that watches wants a [`Start`], sent to the inbox that it names, or a key frame; any node the newest frame or a group of pictures (`lend`) |
//! | `tmpi.live.ROOM.EPOCH` | parts of messages (`wire`), while some node watches |
//!
//! Names of rooms are letters, digits, `-` and `_`, and so are parts of subjects as they are. The owner sends what it reads of the room's ring
//! as any viewer reads it: behind by a second or a mebibyte it skips to a key frame, and sends the tiles that are newer than it had sent
//! (`forward`). Everything but statistics has a number, and says up to which everything before it was sent. A node that watches puts what comes into a
//! ring of its own, of which its viewers are served as if the publisher were there (`relay`, `follower`); where something is missing it takes nothing
//! more, asks for a start again and goes on from where it was. Without NATS each node goes on alone.

mod follower;
mod forward;
pub mod fuzzing;
mod lend;
mod relay;
mod table;
mod tiles;
mod wire;

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use async_nats::connection::State;
use async_nats::{Client, Message, Subscriber};
use bytes::Bytes;
use futures_util::StreamExt as _;
use serde::{Deserialize, Serialize};
use tokio::sync::{mpsc, watch};
use tokio::time::{MissedTickBehavior, interval, timeout, timeout_at};
use tokio_util::sync::CancellationToken;

use super::Rooms;
use super::room::Room;
pub use crate::nats::Config;
pub use lend::{Borrower, Silent};
use lend::{Get, Lender};
use table::{BEAT, Owner, Presence, Table, Verdict, Watched};
pub use tiles::Chunks;
#[cfg(test)]
pub use tiles::tests::{geometry, message};
pub use wire::Start;
use wire::{Joined, Joiner, Packet, Sort};

/// Messages of a subscription that wait to be read: a second of video, geometry and sound, as much as a viewer may be behind.
const WAITING: usize = 128;
/// Messages that wait to be sent.
const SENDING: usize = 32;
/// Requests to the owner of a room that wait.
const ASKS: usize = 16;
/// Shortest pause between two answers to what others say.
const ANSWERS: Duration = Duration::from_millis(50);
/// Bytes of what a node says of itself, at most.
const SAID: usize = 64 << 10;
const PRESENCE: &str = "tmpi.nodes";

/// What a node wants of the owner of a room.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Ask {
    node: String,
    room: String,
    epoch: u64,
    /// A key frame; else a [`Start`].
    #[serde(default)]
    key: bool,
    /// Neither, but this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    get: Option<Get>,
}

/// Why a room cannot be had.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refused {
    /// Another node has it.
    Taken,
    /// Another node had it when the others could last be heard.
    Unknown,
}

/// This node among the others.
pub struct Nodes {
    me: String,
    client: Client,
    table: Mutex<Table>,
    /// Rooms that this node has or claims.
    claims: Mutex<HashMap<String, Handle>>,
    /// Counts what was heard, for whoever waits for it.
    heard: watch::Sender<u64>,
    dropped: AtomicU64,
    answered: Mutex<Option<Instant>>,
    stop: CancellationToken,
}

/// How a claim is reached.
struct Handle {
    evicted: CancellationToken,
    asks: mpsc::Sender<(Ask, async_nats::Subject)>,
}

/// Milliseconds since 1970.
fn clock() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_millis() as u64)
}

fn subject(room: &str, epoch: u64) -> String {
    format!("tmpi.live.{room}.{epoch}")
}

impl Nodes {
    /// Joins the others, now or whenever NATS can be reached.
    ///
    /// # Errors
    /// An address that is none; no failure to reach it.
    pub async fn join(config: &Config, rooms: &Arc<Rooms>, stop: CancellationToken) -> Result<Arc<Self>, async_nats::Error> {
        let options = config
            .options()
            .subscription_capacity(WAITING)
            .client_capacity(SENDING)
            .event_callback(|event| async move { tracing::info!(%event, "NATS") });
        let client = options.connect(config.servers.clone()).await?;
        let me = format!("{}-{:08x}", config.name, random());
        let nodes = Arc::new(Self {
            table: Mutex::new(Table::new(me.clone())),
            me,
            client,
            claims: Mutex::default(),
            heard: watch::Sender::new(0),
            dropped: AtomicU64::new(0),
            answered: Mutex::new(None),
            stop,
        });
        tokio::spawn(Arc::clone(&nodes).listen(Arc::clone(rooms)));
        Ok(nodes)
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn claims(&self) -> MutexGuard<'_, HashMap<String, Handle>> {
        self.claims.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the others can be heard.
    pub fn is_connected(&self) -> bool {
        self.client.connection_state() == State::Connected
    }

    /// Messages of others that were none, or of nothing that is followed here.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    fn drop_one(&self) {
        self.dropped.fetch_add(1, Ordering::Relaxed);
    }

    /// The other node that has a room.
    pub fn owner(&self, room: &str) -> Option<Owner> {
        self.table().owner(room, Instant::now())
    }

    /// Hears the others and speaks to them until the server stops.
    async fn listen(self: Arc<Self>, rooms: Arc<Rooms>) {
        let mine = format!("tmpi.node.{}", self.me);
        let (Ok(mut presence), Ok(mut asks)) = (self.client.subscribe(PRESENCE).await, self.client.subscribe(mine).await) else {
            tracing::error!("rooms are not shared: the connection to NATS is closed");
            return;
        };
        let mut beat = interval(BEAT);
        beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                said = presence.next() => match said {
                    Some(said) => self.hear(&said, &rooms).await,
                    None => return,
                },
                ask = asks.next() => match ask {
                    Some(ask) => self.pass(ask),
                    None => return,
                },
                _ = beat.tick() => {
                    self.speak(&rooms, false).await;
                    self.look_after(&rooms);
                }
                () = self.stop.cancelled() => {
                    self.speak(&rooms, true).await;
                    let _ = timeout(BEAT, self.client.flush()).await;
                    return;
                }
            }
        }
    }

    /// Says what this node has and watches.
    async fn speak(&self, rooms: &Rooms, leaving: bool) {
        let followed = rooms.all().into_iter().filter(|(_, room)| room.is_followed());
        let watched = followed.map(|(name, room)| Watched { room: name, viewers: room.viewers() }).filter(|w| w.viewers > 0).collect();
        let presence = self.table().presence(watched, leaving);
        match serde_json::to_vec(&presence) {
            Ok(bytes) => {
                self.publish(PRESENCE.to_owned(), bytes.into()).await;
            }
            Err(error) => tracing::error!(%error, "what this node is"),
        }
    }

    /// Sends a payload; false where NATS is away, or takes nothing for so long that the next words are due.
    async fn publish(&self, subject: String, payload: Bytes) -> bool {
        self.is_connected() && matches!(timeout(BEAT, self.client.publish(subject, payload)).await, Ok(Ok(())))
    }

    async fn hear(&self, said: &Message, rooms: &Arc<Rooms>) {
        let presence = Some(&said.payload).filter(|p| p.len() <= SAID).and_then(|p| serde_json::from_slice::<Presence>(p).ok());
        let heard = presence.and_then(|presence| self.table().hear(presence, Instant::now(), clock()));
        let Some(heard) = heard else { return self.drop_one() };
        for room in &heard.lost {
            tracing::warn!(room, "another node has the room by a later claim");
            if let Some(handle) = self.claims().remove(room) {
                handle.evicted.cancel();
            }
        }
        if heard.answer && self.may_answer() {
            self.speak(rooms, false).await;
        }
        self.heard.send_modify(|n| *n = n.wrapping_add(1));
    }

    fn may_answer(&self) -> bool {
        let mut answered = self.answered.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        let may = answered.is_none_or(|at| now.saturating_duration_since(at) >= ANSWERS);
        if may {
            *answered = Some(now);
        }
        may
    }

    /// Hands a request to the task of its room.
    fn pass(&self, message: Message) {
        let ask = Some(&message.payload).filter(|p| p.len() <= SAID).and_then(|p| serde_json::from_slice::<Ask>(p).ok());
        let known = ask.filter(|ask| self.table().holds(&ask.room, ask.epoch));
        let (Some(ask), reply) = (known, message.reply) else { return self.drop_one() };
        if ask.get.is_none() {
            self.table().watches(&ask.node, &ask.room);
        }
        if let (Some(handle), Some(reply)) = (self.claims().get(&ask.room), reply) {
            // whoever is not answered asks again
            let _ = handle.asks.try_send((ask, reply));
        }
    }

    /// Follows rooms whose publisher is elsewhere now, and counts who watches those that are here.
    fn look_after(self: &Arc<Self>, rooms: &Arc<Rooms>) {
        for (name, room) in rooms.all() {
            if room.is_empty() {
                if room.viewers() > 0 && self.owner(&name).is_some() {
                    self.follow(rooms, &name, &room);
                }
            } else {
                room.set_elsewhere(self.table().audience(&name, Instant::now()).1);
            }
        }
    }

    /// Hands on in `room` what its owner sends, if that is not done already.
    pub fn follow(self: &Arc<Self>, rooms: &Arc<Rooms>, name: &str, room: &Arc<Room>) {
        if room.begin_to_follow() {
            tokio::spawn(relay::run(Arc::clone(self), Arc::clone(rooms), name.to_owned(), Arc::clone(room)));
        }
    }

    /// Claims a room whose epoch here was `floor` last.
    ///
    /// # Errors
    /// [`Refused`].
    pub async fn claim(self: &Arc<Self>, rooms: &Arc<Rooms>, name: &str, floor: u64) -> Result<Claim, Refused> {
        let alone = !self.is_connected();
        if alone && self.table().is_of_another(name) {
            return Err(Refused::Unknown);
        }
        let mut heard = self.heard.subscribe();
        let epoch = self.table().claim(name, floor, Instant::now(), clock()).ok_or(Refused::Taken)?;
        let (give, asks) = mpsc::channel(ASKS);
        let evicted = CancellationToken::new();
        self.claims().insert(name.to_owned(), Handle { evicted: evicted.clone(), asks: give });
        // given back however this ends
        let claim = Claim { nodes: Arc::clone(self), name: name.to_owned(), epoch, evicted, asks: Some(asks) };
        if alone {
            self.table().open(name);
            return Ok(claim);
        }
        self.speak(rooms, false).await;
        loop {
            let verdict = self.table().judge(name, Instant::now());
            match verdict {
                Verdict::Won => break,
                Verdict::Taken => return Err(Refused::Taken),
                Verdict::Wait(until) => tokio::select! {
                    () = tokio::time::sleep_until(until.into()) => {}
                    // nobody else hears: the sender is this node's own
                    _ = heard.changed() => {}
                },
            }
        }
        self.speak(rooms, false).await;
        Ok(claim)
    }

    /// Sends the parts of a message, unless NATS is away or takes nothing.
    async fn send(&self, subject: &str, packet: &wire::Packet) {
        for part in packet.split(self.client.max_payload()).unwrap_or_default() {
            if !self.publish(subject.to_owned(), part).await {
                return;
            }
        }
    }

    /// Asks an owner, and waits for a packet of that sort; none where none came in time.
    async fn request(&self, owner: &Owner, ask: &Ask, sort: Sort, within: Duration) -> Option<Packet> {
        let inbox = self.client.new_inbox();
        let mut answers = self.subscribe(inbox.clone()).await?;
        self.ask(owner, ask, inbox).await;
        let (end, mut joiner) = (tokio::time::Instant::now() + within, Joiner::default());
        loop {
            let message = timeout_at(end, answers.next()).await.ok()??;
            if message.status.is_some() {
                // nobody listens there
                return None;
            }
            match joiner.push(&message.payload) {
                Joined::More => {}
                Joined::Whole(packet) if packet.sort == sort => return Some(packet),
                Joined::Whole(_) | Joined::Wrong => self.drop_one(),
            }
        }
    }

    async fn ask(&self, owner: &Owner, ask: &Ask, reply: String) {
        let Ok(bytes) = serde_json::to_vec(ask) else { return };
        // whoever is not answered asks again
        let _ = timeout(BEAT, self.client.publish_with_reply(format!("tmpi.node.{}", owner.node), reply, Bytes::from(bytes))).await;
    }

    async fn subscribe(&self, subject: String) -> Option<Subscriber> {
        self.client.subscribe(subject).await.ok()
    }
}

/// A room that is this node's as long as this lives.
pub struct Claim {
    nodes: Arc<Nodes>,
    name: String,
    /// Its epoch.
    pub epoch: u64,
    /// Set when another node has the room by right.
    pub evicted: CancellationToken,
    asks: Option<mpsc::Receiver<(Ask, async_nats::Subject)>>,
}

impl Claim {
    /// Sends to the other nodes what is published in `room`, as far as they watch.
    pub fn forward(&mut self, room: &Arc<Room>) {
        if let Some(asks) = self.asks.take() {
            let lender = Lender::new(Arc::clone(room), self.epoch);
            tokio::spawn(forward::run(Arc::clone(&self.nodes), self.name.clone(), self.epoch, (Arc::clone(room), lender), asks));
        }
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        self.nodes.table().release(&self.name, self.epoch);
        if !self.evicted.is_cancelled() {
            self.nodes.claims().remove(&self.name);
        }
    }
}

/// A number that no other run of a node has.
fn random() -> u32 {
    use std::hash::{BuildHasher, RandomState};
    // seeded by the system for each process
    RandomState::new().hash_one(std::process::id()) as u32
}
