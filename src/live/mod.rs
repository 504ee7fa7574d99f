//! Rooms: one publisher's camera, and all who watch it (schema of the messages in `proto/live.proto`).
//!
//! The publisher's socket hands each frame on at once, as the bytes that came: to the ring, which every viewer's socket reads at its
//! own pace, and to the room's worker, which decodes it for its geometry alone. A viewer that falls behind skips to a key frame and
//! is told all tiles anew; nothing is queued for anyone, so a room's memory does not depend on how slowly it is read.
//!
//! | file | what |
//! |---|---|
//! | `access` | who may publish and watch |
//! | `invite` | what pages ask of a room, and tokens for those who watch |
//! | `routes` | the addresses, and the upgrade to web sockets |
//! | `publisher`, `viewer` | one socket each |
//! | `room` | what sockets and threads of a room share |
//! | `ring` | messages since the last key frame |
//! | `gops` | the same as groups of pictures, for plain HTTP |
//! | `worker` | the threads that decode and make geometry |

mod access;
mod gops;
mod invite;
mod publisher;
mod ring;
mod room;
pub(crate) mod routes;
mod viewer;
mod worker;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tmpi_pipeline::Models;

pub use access::{Role, token};
use axum::extract::ws::{Message, WebSocket};
use tmpi_core::live::wire::Bye;
use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::write;

use room::Room;

/// Rooms at a time.
const ROOMS: usize = 16;
/// Viewers of a room.
const VIEWERS: usize = 1024;
/// Time for the first message, and longest silence of a publisher.
const SILENCE: Duration = Duration::from_secs(10);
/// Pause between two messages of statistics, which also tell that the room lives.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Frames of a publisher that may be under way.
const CREDIT: u32 = 2;
/// Shortest mean time between two frames.
const FASTEST: Duration = Duration::from_micros(8_333);
/// Bytes of a frame.
const FRAME_BYTES: usize = 1 << 20;
/// Bytes of a packet of sound.
const SOUND_BYTES: usize = 16 << 10;
/// Time between two requests for a key frame.
const KEYS: Duration = Duration::from_secs(1);
/// Frames in a row that cannot be decoded before the publisher is sent away.
const BROKEN: u32 = 30;
/// Bytes of a name.
const NAME: usize = 64;

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

/// All rooms of a server.
pub struct Rooms {
    config: Config,
    rooms: Mutex<HashMap<String, Arc<Room>>>,
}

impl Rooms {
    /// No room yet.
    #[must_use]
    pub fn new(config: Config) -> Self {
        Self { config, rooms: Mutex::default() }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, HashMap<String, Arc<Room>>> {
        self.rooms.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A room that is there.
    fn get(&self, name: &str) -> Option<Arc<Room>> {
        self.lock().get(name).cloned()
    }

    /// A room, made where it is not there; none where there are as many as may be.
    fn enter(&self, name: &str) -> Option<Arc<Room>> {
        let mut rooms = self.lock();
        if !rooms.contains_key(name) && rooms.len() >= ROOMS {
            return None;
        }
        Some(Arc::clone(rooms.entry(name.to_owned()).or_insert_with(|| Arc::new(Room::new()))))
    }

    /// Takes a room away that no publisher has come back to.
    fn leave(&self, name: &str, room: &Arc<Room>) {
        let mut rooms = self.lock();
        if rooms.get(name).is_some_and(|r| Arc::ptr_eq(r, room)) && room.is_empty() {
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
