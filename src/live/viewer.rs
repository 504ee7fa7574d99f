//! The socket of a viewer: it is sent what the room's ring has for it, one message after the other, as fast as it takes them.

use std::sync::Arc;

use axum::extract::ws::{Message, WebSocket};
use bytes::Bytes;
use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use tmpi_core::live::wire::Bye;
use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::write;

use super::room::{Next, Room, Viewer};
use super::{HEARTBEAT, send_away};

/// Why a viewer is sent away.
enum End {
    /// It has gone, or takes nothing.
    Gone,
    /// It is told why.
    Bye(Bye),
}

/// Serves a viewer until it or the room goes.
pub async fn serve(mut socket: WebSocket, room: Arc<Room>, stop: CancellationToken) {
    let Some(mut viewer) = room.join() else {
        return send_away(socket, Bye { reason: "as many watch the room as may".into(), again: true }).await;
    };
    let end = watch(&mut socket, &room, &mut viewer, &stop).await;
    room.part();
    if let End::Bye(bye) = end {
        send_away(socket, bye).await;
    }
}

async fn watch(socket: &mut WebSocket, room: &Room, viewer: &mut Viewer, stop: &CancellationToken) -> End {
    let mut changes = room.watch();
    let mut heartbeat = interval(HEARTBEAT);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        changes.mark_unchanged();
        match room.next(viewer) {
            Next::Send(bytes) => {
                if send(socket, bytes).await.is_err() {
                    return End::Gone;
                }
            }
            Next::Hello(hello) => {
                if send(socket, write(Kind::Hello((*hello).clone()))).await.is_err() || tiles(socket, room, viewer).await.is_err() {
                    return End::Gone;
                }
            }
            Next::Tiles => {
                if tiles(socket, room, viewer).await.is_err() {
                    return End::Gone;
                }
            }
            Next::Closed => return End::Bye(Bye { reason: "the publisher has gone".into(), again: true }),
            Next::Wait => tokio::select! {
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
                came = socket.recv() => match came {
                    // there is nothing that a viewer has to say; pings are answered by the library
                    Some(Ok(Message::Ping(_) | Message::Pong(_))) => {}
                    Some(Ok(Message::Text(_) | Message::Binary(_))) => {
                        return End::Bye(Bye { reason: "viewers send nothing".into(), again: false });
                    }
                    _ => return End::Gone,
                },
                () = stop.cancelled() => return End::Bye(Bye { reason: "the server stops".into(), again: true }),
            },
        }
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
