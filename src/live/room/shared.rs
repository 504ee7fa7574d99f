//! A room that several nodes have: one makes it, the others hand on what it made.

use std::time::Instant;

use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::wire::{self, Hello, Statistics};
use tmpi_core::live::write;

use super::{Room, Viewer};
use crate::live::nodes::{Chunks, Start};
use crate::live::ring::What;

impl Room {
    /// Another node asks for a key frame.
    pub fn ask_key(&self) {
        self.want_key(&mut self.lock(), Instant::now());
    }

    /// Notes how many watch at other nodes.
    pub fn set_elsewhere(&self, viewers: u32) {
        self.lock().elsewhere = viewers;
    }

    /// Whether what another node makes is handed on here.
    pub fn is_followed(&self) -> bool {
        self.lock().followed
    }

    /// Begins to hand on here what another node makes; false where that is done already, or the publisher is here.
    pub fn begin_to_follow(&self) -> bool {
        let mut state = self.lock();
        !state.publishing && !state.closed && !std::mem::replace(&mut state.followed, true)
    }

    /// Ends it; false where there was nothing to end, as the publisher is here now.
    pub fn end_to_follow(&self) -> bool {
        std::mem::take(&mut self.lock().followed)
    }

    /// Another node's publisher says `hello`, of which `chunks` are to be the tiles; false where the room is further already. The same epoch
    /// anew changes nothing, but that what was left of it is forgotten where nothing is known any more of how far it went.
    pub fn relay(&self, hello: Hello, chunks: Chunks, anew: bool) -> bool {
        let mut state = self.lock();
        if !state.followed || hello.epoch < state.epoch {
            return false;
        }
        if hello.epoch > state.epoch {
            state.epoch = hello.epoch;
            state.begin(hello, Some(chunks));
            drop(state);
            self.changed();
        } else if anew {
            state.ring.clear();
        }
        true
    }

    /// Takes tiles that another node's publisher of `epoch` has; gives whether any is newer than what was known here. None where they are none of it.
    pub fn take_tiles(&self, epoch: u64, tiles: &wire::Geometry) -> Option<bool> {
        let mut state = self.lock();
        let current = state.epoch == epoch;
        let chunks = state.chunks.as_mut().filter(|_| current)?;
        let before = chunks.newest();
        chunks.take(tiles).then(|| chunks.newest() > before)
    }

    /// The same of tiles that came for what was missed; hands on those that are newer. False where they are none of it.
    pub fn take_missed(&self, epoch: u64, tiles: &wire::Geometry) -> bool {
        let mut state = self.lock();
        let current = state.epoch == epoch;
        let Some(chunks) = state.chunks.as_mut().filter(|_| current) else { return false };
        // nothing that came later was taken before what is missing, so all that is missing is newer
        let before = chunks.newest();
        if !chunks.take(tiles) {
            return false;
        }
        let Some(frame) = chunks.newest().filter(|frame| before.is_none_or(|before| before < *frame)) else { return true };
        let bytes = match before.and_then(|before| chunks.newer(before)) {
            Some(chunks) => Some(write(Kind::Geometry(wire::Geometry { frame, chunks }))),
            None => chunks.snapshot(),
        };
        drop(state);
        if let Some(bytes) = bytes {
            self.push(epoch, What::Geometry { frame }, bytes);
        }
        true
    }

    /// Takes what the node of the publisher of `epoch` has counted.
    pub fn take_statistics(&self, epoch: u64, told: Statistics) {
        let mut state = self.lock();
        if state.epoch == epoch && state.chunks.is_some() {
            state.elsewhere = told.viewers.saturating_sub(state.viewers as u32);
            state.statistics = told;
        }
    }

    /// A place at the end of the ring for who reads it for other nodes; none where `epoch` is past.
    pub fn reader(&self, epoch: u64) -> Option<Viewer> {
        let state = self.lock();
        if state.epoch != epoch || state.closed {
            return None;
        }
        let mut place = state.ring.at_end(Instant::now());
        // every node begins with a start that is made later than this
        if let Some(frame) = state.made.as_ref().and_then(Chunks::newest) {
            place.told(frame);
        }
        Some(Viewer { place, epoch })
    }

    /// What a node begins with that comes late; none where `epoch` is past.
    pub fn start(&self, epoch: u64) -> Option<Start> {
        let (hello, (next, entries), made) = {
            let mut state = self.lock();
            let hello = state.hello.clone().filter(|_| state.epoch == epoch && !state.closed)?;
            // as they were sent: a node that missed some sees which
            let made = state.made.as_mut().filter(|made| made.are_few()).and_then(Chunks::snapshot);
            (hello, state.ring.since_key(), made)
        };
        // tiles may be newer than the last entry: their versions say so
        let tiles = made.or_else(|| self.snapshot().and_then(Result::ok)).unwrap_or_default();
        Some(Start { next, hello: write(Kind::Hello((*hello).clone())), tiles, entries })
    }
}
