//! Rooms that nodes share: edges and their origin.

use std::time::Instant;

use bytes::Bytes;
use tokio_util::sync::CancellationToken;

use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{Bye, Hello};

use super::{Room, Viewer, ViewerKind};
use crate::live::ring::MessageKind;
use crate::live::tile_store::Chunks;

impl Room {
    pub fn is_edge(&self) -> bool {
        self.lock().edge.is_some()
    }

    /// Makes this node an edge of the room until the token is cancelled; `None` if it is one already, the publisher is here, or the room is
    /// closed.
    pub fn begin_edge(&self) -> Option<CancellationToken> {
        let mut state = self.lock();
        if state.taken || state.closed || state.edge.is_some() {
            return None;
        }
        let edge = CancellationToken::new();
        (state.edge, state.farewell) = (Some(edge.clone()), None);
        drop(state);
        // disconnects edges of other nodes, which then look up the origin again
        self.changed();
        Some(edge)
    }

    /// Stops being an edge; viewers get the origin's `farewell`, if any.
    pub fn end_edge(&self, edge: &CancellationToken, farewell: Option<Bye>) {
        self.update(|state| {
            // a publisher that came here has ended it already
            if !edge.is_cancelled() {
                (state.edge, state.farewell) = (None, farewell);
            }
        });
    }

    /// Takes the origin's `hello`; false if this node is no edge any more or `hello` is invalid or has an older epoch. The same epoch
    /// continues.
    pub fn relay_hello(&self, hello: Hello) -> bool {
        let chunks = Chunks::new(&hello);
        let mut state = self.lock();
        if state.edge.is_none() || hello.epoch < state.epoch || chunks.is_none() {
            return false;
        }
        if hello.epoch > state.epoch {
            (state.epoch, state.publisher_epoch, state.farewell) = (hello.epoch, hello.epoch, None);
            state.begin(hello, chunks, None);
            drop(state);
            self.changed();
        }
        true
    }

    /// Passes on a message that the origin sent in `epoch`, unchanged; drops frames that this node has already.
    pub fn relay(&self, epoch: u64, kind: &Kind, bytes: Bytes) {
        let what = {
            let mut state = self.lock();
            if state.epoch != epoch || state.edge.is_none() {
                return;
            }
            match kind {
                Kind::Video(video) if state.relayed >= Some(video.frame) => return,
                Kind::Video(video) => {
                    state.relayed = Some(video.frame);
                    if video.key { MessageKind::Key } else { MessageKind::Frame { layer: video.layer } }
                }
                Kind::Geometry(tiles) | Kind::Snapshot(tiles) => {
                    if !state.chunks.as_mut().is_some_and(|chunks| chunks.take(tiles)) {
                        return;
                    }
                    MessageKind::Geometry { frame: tiles.frame }
                }
                Kind::Sound(_) => MessageKind::Sound,
                Kind::Statistics(told) => {
                    state.remote_viewers = told.viewers.saturating_sub(state.viewers as u32);
                    state.statistics = *told;
                    return;
                }
                _ => return,
            }
        };
        self.push(epoch, what, bytes);
    }

    /// Records an edge's number of viewers, and requests a key frame if one of them needs it.
    pub fn update_edge(&self, viewer: &mut Viewer, viewers: u32, key: bool) {
        let ViewerKind::Edge(before) = viewer.kind else { return };
        let mut state = self.lock();
        state.edge_viewers = state.edge_viewers.saturating_sub(before).saturating_add(viewers);
        viewer.kind = ViewerKind::Edge(viewers);
        if key {
            self.want_key(&mut state, Instant::now());
        }
    }
}
