//! The socket of a viewer. It gets the messages of the room's ring, one after the other, as fast as it reads them.
//!
//! A viewer may send only CREDIT: 0 frames when it becomes hidden, as in a background tab, 1 or more when it becomes visible, and these
//! with `key` when it cannot decode and needs a key frame. An edge sends it to report its number of viewers, and that one of them needs a
//! key frame.

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
use super::{HEARTBEAT, disconnect};

/// Reason for refusing a viewer of a full room.
pub const FULL: &str = "the room is full";
const GONE: &str = "the publisher has gone";

/// The farewell to viewers after the publisher has gone.
pub fn gone(cause: Cause) -> Bye {
    Bye { reason: GONE.into(), again: true, cause: cause.into() }
}

/// Burst size of a viewer's messages, and seconds for each further one.
const WORDS: u32 = 20;
const WORD: f64 = 0.5;

/// Why a viewer's connection ends.
enum End {
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
    let end = {
        let mut counted = Counted { room: &room, viewer };
        watch(&mut socket, &room, &mut counted.viewer, &stop, ends).await
    };
    if let End::Bye(bye) = end {
        disconnect(socket, bye).await;
    }
}

async fn watch(socket: &mut WebSocket, room: &Room, viewer: &mut Viewer, stop: &CancellationToken, ends: Option<Instant>) -> End {
    let mut changes = room.watch();
    let mut heartbeat = interval(HEARTBEAT);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut words = Words { left: f64::from(WORDS), at: Instant::now() };
    loop {
        // also while messages are waiting: a viewer on a slow line may have hidden its page
        if let Some(end) = socket.recv().now_or_never().and_then(|came| heard(came, &mut words, room, viewer)) {
            return end;
        }
        if stop.is_cancelled() {
            return bye("the server stops", true);
        }
        if ends.is_some_and(|at| at <= Instant::now()) {
            return bye(ENDED, false);
        }
        changes.mark_unchanged();
        match room.next(viewer) {
            NextStep::Send(bytes) => {
                if send(socket, bytes).await.is_err() {
                    return End::Gone;
                }
            }
            NextStep::Hello(hello) => {
                if send(socket, write(Kind::Hello((*hello).clone()))).await.is_err() || tiles(socket, room, viewer).await.is_err() {
                    return End::Gone;
                }
            }
            NextStep::Tiles => {
                if tiles(socket, room, viewer).await.is_err() {
                    return End::Gone;
                }
            }
            NextStep::Closed => return End::Bye(room.farewell().unwrap_or_else(|| gone(Cause::Lost))),
            NextStep::Wait => tokio::select! {
                changed = changes.changed() => {
                    if changed.is_err() {
                        return End::Gone;
                    }
                }
                _ = heartbeat.tick() => {
                    if send(socket, write(Kind::Statistics(room.statistics(viewer)))).await.is_err() {
                        return End::Gone;
                    }
                }
                came = socket.recv() => if let Some(end) = heard(came, &mut words, room, viewer) {
                    return end;
                },
                () = stop.cancelled() => {}
                () = ended(ends) => {}
            },
        }
    }
}

fn bye(reason: &str, again: bool) -> End {
    End::Bye(Bye { reason: reason.into(), again, ..Bye::default() })
}

/// Handles a message of a viewer; `None` if it may stay.
fn heard(came: Option<Result<Message, axum::Error>>, words: &mut Words, room: &Room, viewer: &mut Viewer) -> Option<End> {
    match came {
        // the library answers pings
        Some(Ok(Message::Ping(_) | Message::Pong(_))) => None,
        Some(Ok(Message::Binary(bytes))) => match words.take(bytes, Instant::now()) {
            Ok(Credit { viewers, key, .. }) if matches!(viewer.watches(), ViewerKind::Edge(_)) => {
                room.update_edge(viewer, viewers, key);
                None
            }
            Ok(Credit { frames, key, .. }) => {
                if key && frames > 0 {
                    viewer.skip_to_key();
                }
                viewer.pause(frames == 0);
                None
            }
            Err(reason) => Some(bye(&reason, false)),
        },
        Some(Ok(Message::Text(_))) => Some(bye(NOTHING_ELSE, false)),
        _ => Some(End::Gone),
    }
}

const NOTHING_ELSE: &str = "viewers may send only CREDIT";

/// Rate limit of a viewer's messages.
struct Words {
    left: f64,
    at: Instant,
}

impl Words {
    /// Reads a message of a viewer.
    ///
    /// # Errors
    /// It is not CREDIT, or exceeds the rate limit; the text is for the viewer.
    fn take(&mut self, bytes: Bytes, now: Instant) -> Result<Credit, String> {
        let Ok(Kind::Credit(credit)) = read(bytes) else { return Err(NOTHING_ELSE.into()) };
        let more = now.saturating_duration_since(self.at).as_secs_f64() / WORD;
        (self.left, self.at) = ((self.left + more).min(f64::from(WORDS)) - 1.0, now);
        if self.left < 0.0 {
            return Err(format!("more CREDIT than once per {WORD} s after {WORDS} at once"));
        }
        Ok(credit)
    }
}

async fn tiles(socket: &mut WebSocket, room: &Room, viewer: &mut Viewer) -> Result<(), axum::Error> {
    match room.tiles(viewer) {
        Some(Ok(bytes)) => send(socket, bytes).await,
        Some(Err(error)) => {
            tracing::error!(%error, "coding the tiles of a room");
            Ok(())
        }
        None => Ok(()),
    }
}

async fn send(socket: &mut WebSocket, bytes: Bytes) -> Result<(), axum::Error> {
    socket.send(Message::Binary(bytes)).await
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn credit_messages_are_rate_limited_and_others_refused() {
        let start = Instant::now();
        let mut words = Words { left: f64::from(WORDS), at: start };
        let said = |frames| Credit { frames, key: frames > 0, viewers: 0 };
        let credit = |frames| write(Kind::Credit(said(frames)));
        for n in 0..WORDS {
            assert_eq!(words.take(credit(n % 2), start), Ok(said(n % 2)));
        }
        assert!(words.take(credit(1), start).is_err_and(|reason| reason.contains("0.5 s")));
        let later = start + Duration::from_mins(1);
        assert!((0..WORDS).all(|_| words.take(credit(0), later) == Ok(said(0))));
        assert!(words.take(credit(0), later).is_err());
        let bye = write(Kind::Bye(Bye::default()));
        assert_eq!(words.take(bye, later + Duration::from_mins(1)), Err(NOTHING_ELSE.into()));
        assert_eq!(words.take(vec![0xFF; 9].into(), later), Err(NOTHING_ELSE.into()));
    }
}
