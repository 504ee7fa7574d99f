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
//! | `here` | what handlers need of the server, and what lets a request in |
//! | `routes` | the addresses, and the upgrade to web sockets |
//! | `publisher`, `viewer` | one socket each |
//! | `sound` | how much sound may come |
//! | `room` | what sockets and threads of a room share |
//! | `still` | the last frame whose geometry is done |
//! | `ring` | messages since the last key frame |
//! | `gops` | the same as groups of pictures, for plain HTTP |
//! | `fetch` | the newest frame and groups of pictures by plain HTTP |
//! | `tiles` | the tiles of a room as the chunks that were sent |
//! | `origin` | which node has a room |
//! | `edge` | a room that another node has |
//! | `worker` | the threads that decode and make geometry |

mod access;
mod edge;
mod fetch;
mod gops;
mod here;
mod invite;
mod origin;
mod publisher;
mod ring;
mod room;
pub(crate) mod routes;
mod sound;
mod still;
mod tiles;
mod viewer;
mod worker;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tmpi_pipeline::Models;

pub(crate) use access::check_origin;
pub use access::{Role, token};
use axum::extract::ws::{Message, WebSocket};
use axum::http::StatusCode;
pub(crate) use here::Here;
pub use origin::NodeAddress;
use tmpi_core::live::wire::Bye;
use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::write;

use here::{busy, none_publishes};
use origin::{Lease, Nodes};
use room::Room;
use tmpi_library::{Library, LibraryError, Origin};
use tokio_util::sync::CancellationToken;

use crate::server::{Figure, Problem, gauge};

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
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct Bounds {
    /// Rooms at a time. 0 turns rooms off.
    #[schemars(range(max = 64))]
    pub rooms: usize,
    /// Viewers of a room at this node.
    #[schemars(range(min = 1, max = 1_000_000))]
    pub viewers: usize,
    /// Milliseconds that the geometry of a frame may take. If depth, planes or tiles take longer, there are fewer of them.
    #[schemars(range(min = 1, max = 1000))]
    pub budget_ms: f64,
    /// Bytes of a frame, and of its measured depth: who is further behind is given no more frames before the next key frame.
    #[serde(skip)]
    pub frame: usize,
    /// Bytes of a packet of sound.
    #[serde(skip)]
    pub sound: usize,
}

impl Bounds {
    /// 1 024 viewers.
    pub const VIEWERS: usize = 1024;
    /// Milliseconds of geometry. `tmpi-lab live-bench --only still --budget-ms 8,12,20,30` compares: 8.4, 10.3, 13.1 and 17.5 ms of processor a
    /// frame, views of 23.4, 23.3, 23.4 and 23.3 dB, flicker .070, .064, .054 and .080 levels, edges 2.1, 2.2, 2.1 and 2.2 pixels short. At 640×480
    /// 12, 20, 30 and 45 (`--size 640x480 --frames 120`) have edges 2.2, 1.6, 1.6 and 1.7 pixels short. With 20 instead of 30 pictures come a sixth
    /// sooner where all share two cores (`glass-to-glass.mjs`); but at 640×480 there more tiles wait, and what moves is seen torn where they meet
    /// others more often.
    const BUDGET_MS: f64 = 20.0;
}

impl Default for Bounds {
    fn default() -> Self {
        Self { rooms: 16, viewers: Self::VIEWERS, budget_ms: Self::BUDGET_MS, frame: 1 << 20, sound: 16 << 10 }
    }
}

/// All rooms of a server.
pub struct Rooms {
    config: Config,
    bounds: Bounds,
    named: Mutex<HashMap<String, Named>>,
    address: Option<NodeAddress>,
    nodes: OnceLock<Arc<Nodes>>,
}

struct Named {
    room: Arc<Room>,
    /// How many [`Entry`]s there are.
    entries: usize,
}

/// Holds a room open: a publisher that is there or may come back, or an origin of which this node is an edge.
pub struct Entry {
    rooms: Arc<Rooms>,
    /// The room's name.
    pub name: String,
    /// The room.
    pub room: Arc<Room>,
}

impl Drop for Entry {
    fn drop(&mut self) {
        let mut rooms = self.rooms.lock();
        let Some(named) = rooms.get_mut(&self.name) else { return };
        named.entries -= 1;
        if named.entries == 0 {
            rooms.remove(&self.name);
            self.room.close();
        }
    }
}

impl Rooms {
    /// No room yet.
    #[must_use]
    pub fn new(config: Config) -> Self {
        Self { config, bounds: Bounds::default(), named: Mutex::default(), address: None, nodes: OnceLock::new() }
    }

    /// Holds them to other bounds than the usual ones.
    #[must_use]
    pub fn bounded(mut self, bounds: Bounds) -> Self {
        self.bounds = bounds;
        self
    }

    /// Shares them with the other nodes of the library, which reach this one at `address`.
    #[must_use]
    pub fn shared(mut self, address: NodeAddress) -> Self {
        self.address = Some(address);
        self
    }

    /// Shares them by this library until the server stops, where they are to be shared.
    pub(crate) fn start(&self, library: &Library, stop: &CancellationToken) {
        let Some(address) = &self.address else { return };
        match Nodes::new(library.clone(), address.clone(), stop.clone()) {
            // once, as a server runs once
            Ok(nodes) => drop(self.nodes.set(Arc::new(nodes))),
            Err(error) => tracing::error!(%error, "rooms are not shared with other nodes"),
        }
    }

    /// What is counted.
    pub(crate) fn counts(&self) -> Vec<Figure> {
        let (all, edges) = {
            let rooms = self.lock();
            (rooms.len(), rooms.values().filter(|named| named.room.is_edge()).count())
        };
        vec![
            gauge("tmpi_live_rooms", "Rooms that are open at this node", all as f64),
            gauge("tmpi_live_edges", "Rooms of these whose publisher is at another node", edges as f64),
        ]
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, HashMap<String, Named>> {
        self.named.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A room that is served here: a publisher is here or may come back, or this node is an edge of it.
    fn get(&self, name: &str) -> Option<Arc<Room>> {
        self.lock().get(name).map(|named| Arc::clone(&named.room)).filter(|room| room.is_served())
    }

    /// Opens a room, or holds one open that is; none where there are as many as may be.
    fn enter(self: &Arc<Self>, name: &str) -> Option<Entry> {
        let mut rooms = self.lock();
        if !rooms.contains_key(name) && rooms.len() >= self.bounds.rooms {
            return None;
        }
        let bounds = self.bounds;
        let named = rooms.entry(name.to_owned()).or_insert_with(|| Named { room: Arc::new(Room::new(bounds)), entries: 0 });
        named.entries += 1;
        Some(Entry { rooms: Arc::clone(self), name: name.to_owned(), room: Arc::clone(&named.room) })
    }

    /// A room to watch: one that is open here, or that another node has.
    async fn visit(self: &Arc<Self>, name: &str) -> Result<Arc<Room>, Problem> {
        if let Some(room) = self.get(name) {
            return Ok(room);
        }
        self.elsewhere(name).await?.ok_or_else(none_publishes)?;
        let entry = self.enter(name).ok_or_else(busy)?;
        let room = Arc::clone(&entry.room);
        self.follow(entry);
        Ok(room)
    }

    /// The other node that has a room, with this one.
    async fn elsewhere(&self, name: &str) -> Result<Option<(Arc<Nodes>, Origin)>, Problem> {
        let Some(nodes) = self.nodes.get() else { return Ok(None) };
        let origin = nodes.origin(name).await.map_err(|error| unreachable(&error))?;
        Ok(origin.map(|origin| (Arc::clone(nodes), origin)))
    }

    /// Makes this node an edge of a room, unless it is one already or the publisher is here.
    fn follow(&self, entry: Entry) {
        if let Some(nodes) = self.nodes.get()
            && let Some(edge) = entry.room.begin_edge()
        {
            tokio::spawn(edge::run(Arc::clone(nodes), entry, edge));
        }
    }
}

impl Entry {
    /// Holds the room open for a publisher that comes back within [`COME_BACK`]. Where it went to another node, this one becomes an edge.
    async fn linger(self, lease: Option<Lease>, stop: &CancellationToken) {
        let moved = tokio::select! {
            () = tokio::time::sleep(COME_BACK) => false,
            () = stop.cancelled() => false,
            // a lease of before is lost to a later one of this node, too
            () = origin::lost(lease.as_ref()) => lease.as_ref().is_some_and(|lease| self.room.came_with(lease.epoch())),
        };
        // before anybody is told that the room is closed
        if let Some(lease) = lease {
            lease.release().await;
        }
        if moved {
            Arc::clone(&self.rooms).follow(self);
        }
    }
}

fn unreachable(error: &LibraryError) -> Problem {
    tracing::warn!(%error, "the rooms of other nodes");
    Problem::new(StatusCode::SERVICE_UNAVAILABLE, "elsewhere", "the database cannot be reached").retry_after(1)
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
