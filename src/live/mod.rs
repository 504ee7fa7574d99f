//! Rooms: one publisher's camera and its viewers (schema of the messages in `proto/live.proto`).
//!
//! The publisher's socket passes each frame on at once and unchanged: to the ring, which every viewer's socket reads at its own pace, and
//! to the room's threads, which decode it only for its geometry. A viewer that falls behind, or was hidden, skips to a key frame and gets
//! the tiles that it lacks. Viewers have no queues, so a room's memory does not depend on slow viewers.
//!
//! | file | what |
//! |---|---|
//! | `signed_token` | the tokens with which people publish and watch |
//! | `request_access` | the state of the handlers, and access checks |
//! | `room_status` | the state of a room, for its pages |
//! | `routes` | the routes, the upgrade to WebSockets, and tokens for viewers |
//! | `publisher`, `viewer` | one socket each |
//! | `token_bucket` | the rate limit of a client's messages |
//! | `room` | the state that sockets and threads of a room share |
//! | `snapshot` | the last frame with its geometry |
//! | `ring` | messages since the last key frame |
//! | `gop_store` | the same as groups of pictures (GOPs), for plain HTTP |
//! | `frames_over_http` | the newest frame and groups of pictures by plain HTTP |
//! | `tile_store` | the tiles of a room as encoded chunks |
//! | `origin_lease` | which node has a room, and this node's lease of it |
//! | `origin_client` | requests to the node that has a room |
//! | `group_relay` | groups of pictures of a room that another node has |
//! | `edge` | a room that another node has |
//! | `frame_threads` | the threads that decode frames and make geometry |

mod edge;
mod frame_threads;
mod frames_over_http;
mod gop_store;
mod group_relay;
mod origin_client;
mod origin_lease;
mod publisher;
mod request_access;
mod ring;
mod room;
mod room_status;
pub(crate) mod routes;
mod signed_token;
mod snapshot;
mod tile_store;
mod token_bucket;
mod viewer;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tmpi_pipeline::Models;

use axum::extract::ws::{Message, WebSocket};
use axum::http::{HeaderMap, StatusCode};
use futures_util::future::BoxFuture;
pub use origin_client::NodeAddress;
pub(crate) use request_access::RoomsContext;
pub use signed_token::room_token;
use tmpi_core::live::schema::Bye;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::write;
pub use tmpi_library::Grant;

use origin_client::Nodes;
use origin_lease::Lease;
use request_access::{busy, none_publishes};
use room::Room;
use signed_token::token_in_headers;
use tmpi_library::{Library, LibraryError, Origin};
use tokio_util::sync::CancellationToken;

use crate::server::{Metric, Problem};

/// Longest silence of a publisher, also before its first message.
const SILENCE: Duration = Duration::from_secs(10);
/// Interval of statistics for viewers and of credit for publishers, which also show that the connection works.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// A publisher's frames that may be in flight.
const CREDIT: u32 = 2;
/// Shortest mean time between two frames.
const FASTEST: Duration = Duration::from_micros(8_333);
/// Shortest time between two requests for a key frame.
const KEYS: Duration = Duration::from_secs(1);
/// Undecodable frames in a row before the server disconnects the publisher.
const BROKEN: u32 = 30;
/// The same before the first decoded frame.
const BROKEN_FIRST: u32 = 10;
/// Panics in a row of the geometry before the server disconnects the publisher.
const PANICS: u32 = 10;
const NAME: usize = 64;
/// How long a request waits to learn whether another node sent it; then it counts as a client's. This is before its own time limit begins.
const NODE_CHECK: Duration = Duration::from_secs(2);
/// How long a room waits for its publisher to come back.
const COME_BACK: Duration = Duration::from_secs(10);

/// Limits of rooms.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct RoomLimits {
    /// Open rooms at a time. 0 disables rooms.
    #[schemars(range(max = 64))]
    pub rooms: usize,
    /// Viewers of a room at this node.
    #[schemars(range(min = 1, max = 1_000_000))]
    pub viewers: usize,
    /// Milliseconds that the geometry of a frame should take. If it takes longer, depth runs at a smaller size or less often, and tiles get fewer planes.
    #[schemars(range(min = 1, max = 1000))]
    pub budget_ms: f64,
    /// Largest frame, and largest measured depth, in bytes.
    #[serde(skip)]
    pub frame: usize,
    /// Largest packet of sound, in bytes.
    #[serde(skip)]
    pub sound: usize,
}

impl RoomLimits {
    /// 1 024 viewers.
    pub const VIEWERS: usize = 1024;
}

impl Default for RoomLimits {
    fn default() -> Self {
        Self { rooms: 16, viewers: Self::VIEWERS, budget_ms: tmpi_live::BUDGET_MS, frame: 1 << 20, sound: 16 << 10 }
    }
}

/// All rooms of a server.
pub struct Rooms {
    models: Models,
    key: Option<Vec<u8>>,
    bounds: RoomLimits,
    named: Mutex<HashMap<String, Named>>,
    address: Option<NodeAddress>,
    nodes: OnceLock<Arc<Nodes>>,
    library: OnceLock<Library>,
}

struct Named {
    room: Arc<Room>,
    /// Number of [`RoomHandle`]s.
    entries: usize,
}

/// Holds a room open: for a publisher that is here or may come back, or while this node is an edge.
pub struct RoomHandle {
    rooms: Arc<Rooms>,
    /// The room's name.
    pub name: String,
    /// The room.
    pub room: Arc<Room>,
}

impl Drop for RoomHandle {
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
    /// Starts without rooms. `key` signs tokens; without it only this machine's own user may enter rooms.
    pub fn new(models: Models, key: Option<Vec<u8>>) -> Self {
        Self {
            models,
            key,
            bounds: RoomLimits::default(),
            named: Mutex::default(),
            address: None,
            nodes: OnceLock::new(),
            library: OnceLock::new(),
        }
    }

    /// Replaces the default limits.
    pub fn with_limits(mut self, bounds: RoomLimits) -> Self {
        self.bounds = bounds;
        self
    }

    /// Shares the rooms with the library's other nodes, which reach this one at `address`.
    pub fn shared(mut self, address: NodeAddress) -> Self {
        self.address = Some(address);
        self
    }

    /// Tells this library of rooms; starts sharing by it, if [`Self::shared`] was called, until the server stops.
    pub(crate) fn start(&self, library: &Library, stop: &CancellationToken) {
        // a server runs only once
        drop(self.library.set(library.clone()));
        let Some(address) = &self.address else { return };
        match Nodes::new(library.clone(), address.clone(), stop.clone()) {
            Ok(nodes) => drop(self.nodes.set(Arc::new(nodes))),
            Err(error) => tracing::error!(%error, "cannot share rooms with other nodes"),
        }
    }

    pub(crate) fn counts(&self) -> [Metric; 2] {
        let (all, edges) = {
            let rooms = self.lock();
            (rooms.len(), rooms.values().filter(|named| named.room.is_edge()).count())
        };
        [
            ("tmpi_live_rooms", "Open rooms at this node", all as f64),
            ("tmpi_live_edges", "Open rooms at this node whose publisher is at another node", edges as f64),
        ]
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, HashMap<String, Named>> {
        self.named.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A room that is served here: its publisher is here or may come back, or this node is an edge of it.
    fn get(&self, name: &str) -> Option<Arc<Room>> {
        self.lock().get(name).map(|named| Arc::clone(&named.room)).filter(|room| room.is_served())
    }

    /// Opens a room, or holds an open one; `None` if the limit of rooms is reached.
    fn open(self: &Arc<Self>, name: &str) -> Option<RoomHandle> {
        let mut rooms = self.lock();
        if !rooms.contains_key(name) && rooms.len() >= self.bounds.rooms {
            return None;
        }
        let bounds = self.bounds;
        let named = rooms.entry(name.to_owned()).or_insert_with(|| Named { room: Arc::new(Room::new(bounds)), entries: 0 });
        named.entries += 1;
        Some(RoomHandle { rooms: Arc::clone(self), name: name.to_owned(), room: Arc::clone(&named.room) })
    }

    /// A room to watch, from this node or another.
    async fn watch_room(self: &Arc<Self>, name: &str) -> Result<Arc<Room>, Problem> {
        if let Some(room) = self.get(name) {
            return Ok(room);
        }
        self.remote_origin(name).await?.ok_or_else(none_publishes)?;
        let entry = self.open(name).ok_or_else(busy)?;
        let room = Arc::clone(&entry.room);
        self.follow(entry);
        Ok(room)
    }

    /// The other node that has a room, with the access to it.
    async fn remote_origin(&self, name: &str) -> Result<Option<(Arc<Nodes>, Origin)>, Problem> {
        let Some(nodes) = self.nodes.get() else { return Ok(None) };
        let origin = nodes.origin(name).await.map_err(|error| unreachable(&error))?;
        Ok(origin.map(|origin| (Arc::clone(nodes), origin)))
    }

    /// Whether another node asks, at this path of a room, for viewers that it counts itself; `None` if no node does.
    pub(crate) fn asked_by_node(&self, path: &str, headers: &HeaderMap) -> Option<BoxFuture<'static, bool>> {
        let nodes = Arc::clone(self.nodes.get()?);
        let room = path.strip_prefix("/v1/live/")?.split('/').next()?.to_owned();
        let token = token_in_headers(headers)?.to_owned();
        Some(Box::pin(async move { tokio::time::timeout(NODE_CHECK, nodes.admits(&room, &token)).await.unwrap_or(false) }))
    }

    /// Tells the library that a room begins or ends, unless its lease does.
    async fn announce(&self, name: &str, is_live: bool) {
        let Some(library) = self.library.get().filter(|_| self.nodes.get().is_none()) else { return };
        let told = if is_live { library.start_room(name).await } else { library.end_room(name).await };
        if let Err(error) = told {
            tracing::warn!(%error, room = name, "cannot tell webhooks of a room");
        }
    }

    /// Makes this node an edge of a room, unless it is one already or the publisher is here.
    fn follow(&self, entry: RoomHandle) {
        if let Some(nodes) = self.nodes.get()
            && let Some(edge) = entry.room.begin_edge()
        {
            tokio::spawn(edge::run(Arc::clone(nodes), entry, edge));
        }
    }
}

impl RoomHandle {
    /// Holds the room open for [`COME_BACK`], for its publisher to come back. If the publisher went to another node, this one becomes an
    /// edge.
    async fn wait_for_publisher(self, lease: Option<Lease>, stop: &CancellationToken) {
        let moved = tokio::select! {
            () = tokio::time::sleep(COME_BACK) => false,
            () = stop.cancelled() => false,
            // this node itself may have taken a newer lease
            () = origin_lease::lost(lease.as_ref()) => lease.as_ref().is_some_and(|lease| self.room.is_publisher_epoch(lease.epoch())),
        };
        // before the room closes, which tells its viewers
        if let Some(lease) = lease {
            lease.release().await;
        } else if self.room.is_empty() {
            self.rooms.announce(&self.name, false).await;
        }
        if moved {
            Arc::clone(&self.rooms).follow(self);
        }
    }
}

fn unreachable(error: &LibraryError) -> Problem {
    tracing::warn!(%error, "cannot look up the rooms of other nodes");
    Problem::new(StatusCode::SERVICE_UNAVAILABLE, "elsewhere", "the database cannot be reached").retry_after(1)
}

/// How long to read and drop a disconnected client's messages, so that it gets to read BYE.
const LINGER: Duration = Duration::from_secs(2);

async fn disconnect(mut socket: WebSocket, bye: Bye) {
    let farewell = async {
        // the client may have gone
        let _ = socket.send(Message::Binary(write(Kind::Bye(bye)))).await;
        let _ = socket.send(Message::Close(None)).await;
        while let Some(Ok(_)) = socket.recv().await {}
    };
    let _ = tokio::time::timeout(LINGER, farewell).await;
}

/// Whether a room may have this name: letters, digits, `-` and `_`.
fn is_name(name: &str) -> bool {
    !name.is_empty() && name.len() <= NAME && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_".contains(&b))
}
