//! The socket of a viewer. It gets the messages of the room's ring, one after the other, as fast as it reads them.
//!
//! A viewer may send only CREDIT: 0 frames when it becomes hidden, as in a background tab, 1 or more when it becomes visible, and these
//! with `key` when it cannot decode and needs a key frame. An edge sends it to report its number of viewers, and that one of them needs a
//! key frame.

use std::convert::Infallible;
use std::sync::Arc;

use axum::extract::ws::{Message, WebSocket};
use bytes::Bytes;
use futures_util::FutureExt as _;
use tokio::time::{Instant, MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use tmpi_core::live::schema::bye::Cause;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{Bye, Credit};
use tmpi_core::live::{read, write};

use super::request_access::{ENDED, ended};
use super::room::{NextStep, Room, Viewer, ViewerKind};
use super::token_bucket::Bucket;
use super::{HEARTBEAT, disconnect};

/// Reason for refusing a viewer of a full room.
pub const FULL: &str = "the room is full";
const GONE: &str = "the publisher has gone";

/// The farewell to viewers after the publisher has gone.
pub fn gone(cause: Cause) -> Bye {
    Bye { reason: GONE.into(), again: true, cause: cause.into() }
}

/// A viewer's messages at once, and a second.
const WORDS: f64 = 20.0;
const WORDS_A_SECOND: f64 = 2.0;
const NOTHING_ELSE: &str = "viewers may send only CREDIT";

enum ConnectionEnd {
    /// It has gone, or cannot be written to.
    Gone,
    /// The server disconnects it with a reason.
    Bye(Bye),
}

/// Counts a viewer while it lives.
struct Counted<'a> {
    room: &'a Room,
    viewer: Viewer,
}

impl Drop for Counted<'_> {
    fn drop(&mut self) {
        self.room.leave(&self.viewer);
    }
}

/// Serves a viewer until it leaves, the room closes, or its token ends at `ends`.
pub async fn serve(mut socket: WebSocket, (room, kind): (Arc<Room>, ViewerKind), stop: CancellationToken, ends: Option<Instant>) {
    let Some(viewer) = room.join(kind) else {
        let full = Bye { reason: FULL.into(), again: true, cause: Cause::Full.into() };
        let closed = || room.farewell().unwrap_or_else(|| gone(Cause::Lost));
        return disconnect(socket, if room.is_full() { full } else { closed() }).await;
    };
    let Err(end) = {
        let mut counted = Counted { room: &room, viewer };
        watch(&mut socket, &room, &mut counted.viewer, &stop, ends).await
    };
    if let ConnectionEnd::Bye(bye) = end {
        disconnect(socket, bye).await;
    }
}

async fn watch(
    socket: &mut WebSocket,
    room: &Room,
    viewer: &mut Viewer,
    stop: &CancellationToken,
    ends: Option<Instant>,
) -> Result<Infallible, ConnectionEnd> {
    let mut changes = room.watch();
    let mut heartbeat = interval(HEARTBEAT);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut words = Bucket::new(WORDS_A_SECOND, WORDS);
    loop {
        // also while messages are waiting: a viewer on a slow line may have hidden its page
        if let Some(came) = socket.recv().now_or_never() {
            heard(came, &mut words, room, viewer)?;
        }
        if stop.is_cancelled() {
            return Err(bye("the server stops", true));
        }
        if ends.is_some_and(|at| at <= Instant::now()) {
            return Err(bye(ENDED, false));
        }
        changes.mark_unchanged();
        match room.next(viewer) {
            NextStep::Send(bytes) => send(socket, Some(bytes)).await?,
            NextStep::Hello(hello) => {
                send(socket, Some(write(Kind::Hello((*hello).clone())))).await?;
                send(socket, room.tiles(viewer)).await?;
            }
            NextStep::Tiles => send(socket, room.tiles(viewer)).await?,
            NextStep::Closed => return Err(ConnectionEnd::Bye(room.farewell().unwrap_or_else(|| gone(Cause::Lost)))),
            NextStep::Wait => tokio::select! {
                changed = changes.changed() => changed.map_err(|_| ConnectionEnd::Gone)?,
                _ = heartbeat.tick() => send(socket, Some(write(Kind::Statistics(room.statistics(viewer))))).await?,
                came = socket.recv() => heard(came, &mut words, room, viewer)?,
                () = stop.cancelled() => {}
                () = ended(ends) => {}
            },
        }
    }
}

fn bye(reason: &str, again: bool) -> ConnectionEnd {
    ConnectionEnd::Bye(Bye { reason: reason.into(), again, ..Bye::default() })
}

fn heard(came: Option<Result<Message, axum::Error>>, words: &mut Bucket, room: &Room, viewer: &mut Viewer) -> Result<(), ConnectionEnd> {
    match came {
        // the library answers pings
        Some(Ok(Message::Ping(_) | Message::Pong(_))) => {}
        Some(Ok(Message::Binary(bytes))) => {
            let Credit { frames, key, viewers } = credit(bytes, words).map_err(|reason| bye(&reason, false))?;
            if matches!(viewer.watches(), ViewerKind::Edge(_)) {
                room.update_edge(viewer, viewers, key);
            } else {
                if key && frames > 0 {
                    viewer.skip_to_key();
                }
                viewer.pause(frames == 0);
            }
        }
        Some(Ok(Message::Text(_))) => return Err(bye(NOTHING_ELSE, false)),
        _ => return Err(ConnectionEnd::Gone),
    }
    Ok(())
}

/// Reads a message of a viewer.
///
/// # Errors
/// It is not CREDIT, or one too many; the text is for the viewer.
fn credit(bytes: Bytes, words: &mut Bucket) -> Result<Credit, String> {
    match read(bytes) {
        Ok(Kind::Credit(credit)) if words.take(1.0, Instant::now()) => Ok(credit),
        Ok(Kind::Credit(_)) => Err(format!("more CREDIT than {WORDS_A_SECOND} a second after {WORDS} at once")),
        _ => Err(NOTHING_ELSE.into()),
    }
}

async fn send(socket: &mut WebSocket, bytes: Option<Bytes>) -> Result<(), ConnectionEnd> {
    let Some(bytes) = bytes else { return Ok(()) };
    socket.send(Message::Binary(bytes)).await.map_err(|_| ConnectionEnd::Gone)
}
