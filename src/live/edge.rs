//! An edge of a room: this node subscribes to the room at its origin once, like a viewer, and serves its own viewers from its ring.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::{SinkExt as _, StreamExt as _};
use tmpi_library::{LibraryError, Origin};
use tokio::time::{Instant, interval, sleep, timeout, timeout_at};
use tokio_tungstenite::tungstenite::{self, Message};
use tokio_util::sync::CancellationToken;

use tmpi_core::live::schema::bye::Cause;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{Bye, Credit};
use tmpi_core::live::{read, write};

use super::origin_client::{Nodes, Socket};
use super::room::Room;
use super::{COME_BACK, RoomHandle};

/// Silence after which the origin counts as lost: it sends something every second.
const SILENCE: Duration = Duration::from_secs(3);
/// Pause before looking up the origin again.
const AGAIN: Duration = Duration::from_millis(200);
/// Time without viewers after which the subscription ends.
const UNWATCHED: Duration = Duration::from_secs(3);
/// Interval for checking the number of viewers, and for reporting it to the origin.
const LOOK: Duration = Duration::from_millis(500);
const COUNT: Duration = Duration::from_secs(2);

#[derive(Debug, thiserror::Error)]
pub enum EdgeError {
    #[error("the origin's address is invalid")]
    Address,
    #[error("the origin is silent")]
    Silent,
    #[error("the origin has closed the connection")]
    Closed,
    #[error("the origin sent an invalid HELLO, or one of an older epoch")]
    Stale,
    #[error(transparent)]
    Socket(#[from] tungstenite::Error),
    #[error(transparent)]
    Library(#[from] LibraryError),
}

/// Serves a room from its origins, one after the other, until it has no viewers here, its publisher comes to this node, or no origin has
/// sent anything for [`COME_BACK`].
pub async fn run(nodes: Arc<Nodes>, entry: RoomHandle, ended: CancellationToken) {
    let now = Instant::now();
    let mut edge = Edge { nodes: &nodes, name: &entry.name, room: &entry.room, epoch: 0, heard: now, watched: now };
    let farewell = tokio::select! {
        farewell = edge.follow() => farewell,
        () = ended.cancelled() => None,
        () = nodes.stop.cancelled() => None,
    };
    entry.room.end_edge(&ended, farewell);
}

struct Edge<'a> {
    nodes: &'a Nodes,
    name: &'a str,
    room: &'a Room,
    /// Epoch of the origin's last HELLO.
    epoch: u64,
    /// When an origin last sent something.
    heard: Instant,
    /// When the room last had viewers here.
    watched: Instant,
}

impl Edge<'_> {
    /// Returns the origin's farewell for viewers if the publisher has gone for good.
    async fn follow(&mut self) -> Option<Bye> {
        let mut gone = false;
        loop {
            let ended = match self.nodes.origin(self.name).await {
                Ok(Some(origin)) => self.subscribe(&origin).await,
                // the origin said that it lost the publisher, and has released the room
                Ok(None) if gone => return None,
                Ok(None) => Err(EdgeError::Closed),
                Err(error) => Err(error.into()),
            };
            if let Err(error) = &ended {
                tracing::debug!(%error, room = self.name, "a room of another node");
            }
            gone = match ended {
                Ok(Some(bye)) if matches!(bye.cause(), Cause::Left | Cause::Rejected) => return Some(bye),
                Ok(Some(bye)) => bye.cause() == Cause::Lost,
                _ => false,
            };
            if self.is_unwatched() || self.heard.elapsed() > COME_BACK {
                return None;
            }
            sleep(AGAIN).await;
        }
    }

    fn is_unwatched(&mut self) -> bool {
        if self.room.local_viewers() > 0 {
            self.watched = Instant::now();
        }
        self.watched.elapsed() > UNWATCHED
    }

    /// Relays one origin until its farewell, or until the last viewer has left.
    async fn subscribe(&mut self, origin: &Origin) -> Result<Option<Bye>, EdgeError> {
        let mut socket = self.nodes.subscribe(origin, self.name).await?;
        let (mut look, mut told, mut told_at) = (interval(LOOK), 0, None::<Instant>);
        let mut silent = Instant::now() + SILENCE;
        loop {
            let key = tokio::select! {
                came = timeout_at(silent, socket.next()) => {
                    let came = came.map_err(|_| EdgeError::Silent)?;
                    self.heard = Instant::now();
                    silent = self.heard + SILENCE;
                    let bye = match came {
                        Some(Ok(Message::Binary(bytes))) => self.take(bytes)?,
                        Some(Ok(Message::Close(_))) | None => return Err(EdgeError::Closed),
                        Some(Ok(_)) => None,
                        Some(Err(error)) => return Err(error.into()),
                    };
                    if bye.is_some() {
                        return Ok(bye);
                    }
                    continue;
                }
                () = self.room.keys.notified() => true,
                _ = look.tick() => {
                    if self.is_unwatched() {
                        return Ok(None);
                    }
                    if told == self.room.local_viewers() || told_at.is_some_and(|at| at.elapsed() < COUNT) {
                        continue;
                    }
                    false
                }
            };
            (told, told_at) = (self.room.local_viewers(), Some(Instant::now()));
            say(&mut socket, Credit { frames: 1, key, viewers: told }).await?;
        }
    }

    /// Handles a message; returns it if it is the farewell.
    fn take(&mut self, bytes: Bytes) -> Result<Option<Bye>, EdgeError> {
        // unknown kinds come from newer versions
        let Ok(kind) = read(bytes.clone()) else { return Ok(None) };
        match kind {
            Kind::Bye(bye) => return Ok(Some(bye)),
            Kind::Hello(hello) => {
                self.epoch = hello.epoch;
                if !self.room.relay_hello(hello) {
                    return Err(EdgeError::Stale);
                }
            }
            kind => self.room.relay(self.epoch, &kind, bytes),
        }
        Ok(None)
    }
}

async fn say(socket: &mut Socket, credit: Credit) -> Result<(), EdgeError> {
    let sent = timeout(SILENCE, socket.send(Message::Binary(write(Kind::Credit(credit))))).await;
    Ok(sent.map_err(|_| EdgeError::Silent)??)
}
