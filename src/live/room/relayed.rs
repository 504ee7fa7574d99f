//! A room of which this node is an edge, or that edges of other nodes watch.

use std::time::Instant;

use bytes::Bytes;
use tokio_util::sync::CancellationToken;

use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::wire::{Bye, Hello};

use super::{Room, Viewer, Watches};
use crate::live::ring::What;
use crate::live::tiles::Chunks;

impl Room {
    /// Whether this node is an edge of the room.
    pub fn is_edge(&self) -> bool {
        self.lock().edge.is_some()
    }

    /// Makes this node an edge of the room, until what this gives is cancelled; none where it is one already, or the publisher is here.
    pub fn begin_edge(&self) -> Option<CancellationToken> {
        let mut state = self.lock();
        if state.taken || state.closed || state.edge.is_some() {
            return None;
        }
        let edge = CancellationToken::new();
        (state.edge, state.farewell) = (Some(edge.clone()), None);
        drop(state);
        // edges of other nodes have to look elsewhere
        self.changed();
        Some(edge)
    }

    /// This node is an edge of the room no more; who watches is told the origin's `farewell`, if there is one.
    pub fn end_edge(&self, edge: &CancellationToken, farewell: Option<Bye>) {
        let mut state = self.lock();
        // a publisher that came here has ended it already
        if !edge.is_cancelled() {
            (state.edge, state.farewell) = (None, farewell);
        }
        drop(state);
        self.changed();
    }

    /// The origin says `hello`, of which `chunks` are to be the tiles; false where the room is further already. The same epoch again goes on.
    pub fn relay_hello(&self, hello: Hello, chunks: Chunks) -> bool {
        let mut state = self.lock();
        if state.edge.is_none() || hello.epoch < state.epoch {
            return false;
        }
        if hello.epoch > state.epoch {
            (state.epoch, state.came, state.farewell) = (hello.epoch, hello.epoch, None);
            state.begin(hello, Some(chunks));
            drop(state);
            self.changed();
        }
        true
    }

    /// Hands on what the origin sent after a HELLO of `epoch`, as the bytes that came; frames that are here already are left out.
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
                    if video.key { What::Key } else { What::Frame { layer: video.layer } }
                }
                Kind::Geometry(tiles) | Kind::Snapshot(tiles) => {
                    if !state.chunks.as_mut().is_some_and(|chunks| chunks.take(tiles)) {
                        return;
                    }
                    What::Geometry { frame: tiles.frame }
                }
                Kind::Sound(_) => What::Sound,
                Kind::Statistics(told) => {
                    state.elsewhere = told.viewers.saturating_sub(state.viewers as u32);
                    state.statistics = *told;
                    return;
                }
                _ => return,
            }
        };
        self.push(epoch, what, bytes);
    }

    /// An edge says how many watch there, and whether one of them needs a key frame.
    pub fn hear_edge(&self, viewer: &mut Viewer, viewers: u32, key: bool) {
        let Watches::Edge(before) = viewer.kind else { return };
        let mut state = self.lock();
        state.at_edges = state.at_edges.saturating_sub(before).saturating_add(viewers);
        viewer.kind = Watches::Edge(viewers);
        if key {
            self.want_key(&mut state, Instant::now());
        }
    }
}
