//! Rooms: one publisher's camera, and all who watch it (schema of the messages in `proto/live.proto`).
//!
//! The publisher's socket hands each frame on at once, as the bytes that came: to the ring, which every viewer's socket reads at its
//! own pace, and to the room's worker, which decodes it for its geometry alone. A viewer that falls behind skips to a key frame and
//! is told the tiles that are newer than it has, as one that looks again after it was hidden; nothing is queued for anyone, so a room's memory does not depend on how slowly it is read.
//!
//! | file | what |
//! |---|---|
//! | `access` | who may publish and watch |
//! | `invite` | what pages ask of a room, and tokens for those who watch |
//! | `routes` | the addresses, and the upgrade to web sockets |
//! | `publisher`, `viewer` | one socket each |
//! | `sound` | how much sound may come |
//! | `room` | what sockets and threads of a room share |
//! | `still` | the last frame whose geometry is done |
//! | `ring` | messages since the last key frame |
//! | `gops` | the same as groups of pictures, for plain HTTP |
//! | `fetch` | the newest frame and groups of pictures by plain HTTP, of whichever node has them |
//! | `nodes` | rooms that several servers share |
//! | `worker` | the threads that decode and make geometry |

mod access;
mod fetch;
mod gops;
mod invite;
mod nodes;
mod publisher;
mod ring;
mod room;
pub(crate) mod routes;
mod sound;
mod still;
mod viewer;
mod worker;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use tmpi_pipeline::Models;

pub(crate) use access::check_origin;
pub use access::{Role, token};
pub use async_nats::ServerAddr as NatsAddress;
use axum::extract::ws::{Message, WebSocket};
pub use nodes::Config as NodeConfig;
pub(crate) use nodes::fuzzing;
pub(crate) use publisher::TAKEN;
use tmpi_core::live::wire::Bye;
use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::write;

use nodes::{Claim, Nodes, Refused};
use room::Room;
use tokio_util::sync::CancellationToken;

use crate::server::{Figure, counter, gauge};

/// Time for the first message, and longest time for which a publisher publishes nothing.
const SILENCE: Duration = Duration::from_secs(10);
/// Pause between two messages of statistics, or two of credit for publishers, which also tell that the room lives.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Frames of a publisher that may be under way.
const CREDIT: u32 = 2;
/// Shortest mean time between two frames.
const FASTEST: Duration = Duration::from_micros(8_333);
/// Time between two requests for a key frame.
const KEYS: Duration = Duration::from_secs(1);
/// Frames in a row that cannot be decoded before the publisher is sent away.
const BROKEN: u32 = 30;
/// The same where none could be decoded yet.
const BROKEN_FIRST: u32 = 10;
/// Panics in a row of what makes geometry before the publisher is sent away.
const PANICS: u32 = 10;
/// Bytes of a name.
const NAME: usize = 64;
/// Time that a room waits for its publisher to come back.
const COME_BACK: Duration = Duration::from_secs(10);

/// What rooms are made with.
#[derive(Clone)]
pub struct Config {
    /// The networks.
    pub models: Models,
    /// Milliseconds that the geometry of a frame may take.
    pub frame_ms: f64,
    /// Key of the tokens that let strangers in; without one, rooms are for this machine's own user.
    pub key: Option<Vec<u8>>,
}

/// Bounds on rooms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bounds {
    /// Rooms at a time.
    pub rooms: usize,
    /// Viewers of a room.
    pub viewers: usize,
    /// Bytes of a frame, and of its measured depth.
    pub frame: usize,
    /// Bytes of a packet of sound.
    pub sound: usize,
}

impl Bounds {
    /// 16 rooms.
    pub const ROOMS: usize = 16;
    /// 1 024 viewers.
    pub const VIEWERS: usize = 1024;
    /// 1 MiB: who is further behind is given no more frames before the next key frame.
    pub const FRAME: usize = 1 << 20;
    /// 16 KiB.
    pub const SOUND: usize = 16 << 10;
    /// Rooms at a time where there are most: nodes tell each other of no more.
    pub const MOST_ROOMS: usize = 64;
}

impl Default for Bounds {
    fn default() -> Self {
        Self { rooms: Self::ROOMS, viewers: Self::VIEWERS, frame: Self::FRAME, sound: Self::SOUND }
    }
}

/// All rooms of a server.
pub struct Rooms {
    config: Config,
    bounds: Bounds,
    named: Mutex<HashMap<String, Arc<Room>>>,
    shared: Option<NodeConfig>,
    nodes: OnceLock<Arc<Nodes>>,
}

impl Rooms {
    /// No room yet.
    #[must_use]
    pub fn new(config: Config) -> Self {
        Self { config, bounds: Bounds::default(), named: Mutex::default(), shared: None, nodes: OnceLock::new() }
    }

    /// Holds them to other bounds than the usual ones.
    #[must_use]
    pub fn bounded(mut self, bounds: Bounds) -> Self {
        self.bounds = bounds;
        self
    }

    /// Shares them with other nodes.
    #[must_use]
    pub fn shared(mut self, config: NodeConfig) -> Self {
        self.shared = Some(config);
        self
    }

    /// Joins the other nodes, where there are to be any, until the server stops.
    pub(crate) async fn start(self: &Arc<Self>, stop: CancellationToken) {
        let Some(config) = &self.shared else { return };
        match Nodes::join(config, self, stop).await {
            Ok(nodes) => drop(self.nodes.set(nodes)),
            Err(error) => tracing::error!(%error, "rooms are not shared"),
        }
    }

    /// Why rooms are not what they are to be, for whoever asks whether the server is ready.
    pub(crate) fn trouble(&self) -> Option<&'static str> {
        let alone = self.shared.is_some() && !self.nodes.get().is_some_and(|n| n.is_connected());
        alone.then_some("NATS cannot be reached: rooms are not shared with other nodes")
    }

    /// What is counted; nothing where rooms are not shared.
    pub(crate) fn counts(&self) -> Vec<Figure> {
        let of = |n: &Arc<Nodes>| {
            vec![
                gauge("tmpi_live_nats_connected", "Whether other nodes can be heard", f64::from(u8::from(n.is_connected()))),
                counter("tmpi_live_nats_dropped", "Messages of other nodes that were none", n.dropped() as f64),
            ]
        };
        self.nodes.get().map(of).unwrap_or_default()
    }

    /// All of them, by name.
    fn all(&self) -> Vec<(String, Arc<Room>)> {
        let mut rooms = self.lock();
        // a room that nobody holds, of which others could not come to know
        rooms.retain(|_, room| Arc::strong_count(room) > 1);
        let mut all: Vec<_> = rooms.iter().map(|(name, room)| (name.clone(), Arc::clone(room))).collect();
        all.sort_by(|a, b| a.0.cmp(&b.0));
        all
    }

    /// Whether another node has the publisher of a room.
    fn is_elsewhere(&self, name: &str) -> bool {
        self.nodes.get().is_some_and(|nodes| nodes.owner(name).is_some())
    }

    /// A room to watch: one that is there, or that another node has.
    fn visit(self: &Arc<Self>, name: &str) -> Option<Arc<Room>> {
        let known = self.get(name);
        let Some(nodes) = self.nodes.get().filter(|_| self.is_elsewhere(name)) else { return known };
        let room = known.or_else(|| self.enter(name))?;
        nodes.follow(self, name, &room);
        Some(room)
    }

    /// Makes the room this node's, whose epoch here was `floor` last; nothing to hold where there are no other nodes.
    async fn claim(self: &Arc<Self>, name: &str, floor: u64) -> Result<Option<Claim>, Refused> {
        match self.nodes.get() {
            Some(nodes) => nodes.claim(self, name, floor).await.map(Some),
            None => Ok(None),
        }
    }

    /// Ends to follow a room; where its publisher is nowhere any more, whoever watches is sent away.
    fn leave_followed(&self, name: &str, room: &Arc<Room>, alone: bool) {
        if alone {
            self.leave(name, room);
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, HashMap<String, Arc<Room>>> {
        self.named.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A room that is there.
    fn get(&self, name: &str) -> Option<Arc<Room>> {
        self.lock().get(name).cloned()
    }

    /// A room, made where it is not there; none where there are as many as may be.
    fn enter(&self, name: &str) -> Option<Arc<Room>> {
        let mut rooms = self.lock();
        if !rooms.contains_key(name) && rooms.len() >= self.bounds.rooms {
            return None;
        }
        Some(Arc::clone(rooms.entry(name.to_owned()).or_insert_with(|| Arc::new(Room::new(self.bounds)))))
    }

    /// Takes a room away that no publisher has come back to.
    fn leave(&self, name: &str, room: &Arc<Room>) {
        let mut rooms = self.lock();
        if rooms.get(name).is_some_and(|r| Arc::ptr_eq(r, room)) && room.is_empty() && !room.is_followed() {
            rooms.remove(name);
            room.close();
        }
    }
}

/// Time for which what still comes is read and dropped: a client whose words are not read never hears why it was sent away.
const LINGER: Duration = Duration::from_secs(2);

/// Sends a client away with a reason.
async fn send_away(mut socket: WebSocket, bye: Bye) {
    let farewell = async {
        // whoever has gone already does not hear it
        let _ = socket.send(Message::Binary(write(Kind::Bye(bye)))).await;
        let _ = socket.send(Message::Close(None)).await;
        while let Some(Ok(_)) = socket.recv().await {}
    };
    let _ = tokio::time::timeout(LINGER, farewell).await;
}

/// Names of rooms: letters, digits, `-` and `_`.
fn is_name(name: &str) -> bool {
    !name.is_empty() && name.len() <= NAME && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_".contains(&b))
}
