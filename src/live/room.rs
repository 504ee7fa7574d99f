//! The state that the sockets and threads of a room share.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use bytes::Bytes;
use tokio::sync::{Notify, watch};
use tokio_util::sync::CancellationToken;

use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{self, Bye, Hello, Statistics};
use tmpi_core::live::write;

use super::gop_store::{Group, GroupPart, Groups};
use super::ring::{Cursor, MessageKind, Ring, Step};
pub use super::snapshot::{FrameWithTiles, Tiles};
use super::tile_store::Chunks;
use super::{KEYS, RoomLimits};

mod relayed;

pub struct Room {
    state: Mutex<State>,
    /// Counts changes, for tasks that wait for one.
    changes: watch::Sender<u64>,
    /// Notified when a viewer needs a key frame.
    pub keys: Notify,
    pub bounds: RoomLimits,
}

#[derive(Default)]
struct State {
    ring: Ring,
    /// HELLO of the current or last publisher; `None` before the first.
    hello: Option<Arc<Hello>>,
    epoch: u64,
    /// The epoch in which the publisher joined; changes of the pictures' size begin further ones.
    publisher_epoch: u64,
    taken: bool,
    publishing: bool,
    closed: bool,
    /// Why the publisher has gone for good; `None` while one is here or may come back.
    farewell: Option<Bye>,
    viewers: usize,
    /// Viewers at the edges that watch here, as the edges report them.
    edge_viewers: u32,
    /// Set while this node is an edge of the room; cancelled when it stops being one.
    edge: Option<CancellationToken>,
    /// At an edge: viewers at all other nodes, and the last frame.
    remote_viewers: u32,
    relayed: Option<u64>,
    /// The tiles as they were sent; `None` without a valid `hello`.
    chunks: Option<Chunks>,
    /// At the origin: the groups of pictures, and the newest frame with all tiles.
    groups: Option<Groups>,
    newest_frame: Option<Arc<FrameWithTiles>>,
    asked: Option<Instant>,
    statistics: Statistics,
}

pub enum NextStep {
    Send(Bytes),
    /// Send this, then all tiles: a new epoch began.
    Hello(Arc<Hello>),
    /// Send the tiles that it lacks: frames were skipped.
    Tiles,
    Wait,
    /// The room is closed, or its publisher has gone for good.
    Closed,
}

/// A viewer's place in a room.
pub struct Viewer {
    cursor: Cursor,
    epoch: u64,
    kind: ViewerKind,
}

/// For whom a viewer watches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ViewerKind {
    Local,
    /// For this many viewers of an edge.
    Edge(u32),
}

impl Room {
    pub fn new(bounds: RoomLimits) -> Self {
        Self { state: Mutex::default(), changes: watch::Sender::new(0), keys: Notify::new(), bounds }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn changed(&self) {
        self.changes.send_modify(|n| *n = n.wrapping_add(1));
    }

    /// Changes the state, then wakes those who wait for a change.
    fn update<T>(&self, change: impl FnOnce(&mut State) -> T) -> T {
        let done = change(&mut self.lock());
        self.changed();
        done
    }

    pub fn watch(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    pub fn is_empty(&self) -> bool {
        !self.lock().taken
    }

    pub fn is_publishing(&self) -> bool {
        self.lock().publishing
    }

    /// Whether this node serves viewers: a publisher has the seat or was here last, or this node is an edge of the room.
    pub fn is_served(&self) -> bool {
        let state = self.lock();
        state.taken || state.edge.is_some() || state.groups.is_some()
    }

    pub fn has_epoch(&self, epoch: u64) -> bool {
        self.lock().epoch == epoch
    }

    /// Whether the last publisher joined in this epoch.
    pub fn is_publisher_epoch(&self, epoch: u64) -> bool {
        self.lock().publisher_epoch == epoch
    }

    /// Closes the room, which disconnects its viewers.
    pub fn close(&self) {
        self.update(|state| state.closed = true);
    }

    /// Takes the publisher's seat; false if it is taken or the room is closed.
    pub fn claim_seat(&self) -> bool {
        let mut state = self.lock();
        !state.closed && !std::mem::replace(&mut state.taken, true)
    }

    /// Begins an epoch with `hello`, for a new publisher or a new size of its pictures. Returns the epoch, at least `least`.
    pub fn publish(&self, mut hello: Hello, clock: u64, least: u64) -> u64 {
        self.update(|state| {
            state.farewell = None;
            if let Some(edge) = state.edge.take() {
                edge.cancel();
            }
            state.epoch = least.max(state.epoch + 1);
            if !std::mem::replace(&mut state.publishing, true) {
                state.publisher_epoch = state.epoch;
            }
            (hello.epoch, hello.clock) = (state.epoch, clock);
            let chunks = Chunks::new(&hello);
            state.begin(hello, chunks, Some(Groups::default()));
            state.epoch
        })
    }

    /// Records that the publisher has gone for good; viewers get `farewell`.
    pub fn end(&self, farewell: Bye) {
        self.update(|state| state.farewell = Some(farewell));
    }

    pub fn farewell(&self) -> Option<Bye> {
        self.lock().farewell.clone()
    }

    pub fn unpublish(&self) {
        self.update(|state| {
            (state.taken, state.publishing) = (false, false);
            if let Some(groups) = &mut state.groups {
                groups.end();
            }
        });
    }

    /// Passes on a message of the publisher; drops it if `epoch` is not the current one.
    pub fn push(&self, epoch: u64, what: MessageKind, bytes: Bytes) {
        let mut guard = self.lock();
        let state = &mut *guard;
        if state.epoch != epoch {
            return;
        }
        match what {
            MessageKind::Key | MessageKind::Frame { .. } => {
                state.statistics.frames += 1;
                state.statistics.video_bytes += bytes.len() as u64;
            }
            MessageKind::Geometry { .. } => state.statistics.geometry_bytes += bytes.len() as u64,
            MessageKind::Sound => {}
        }
        let now = Instant::now();
        if let (Some(hello), Some(groups)) = (&state.hello, &mut state.groups) {
            groups.push(what, &bytes, now, hello, state.newest_frame.as_ref().map(|s| &s.tiles));
        }
        state.ring.push(what, bytes, now);
        drop(guard);
        self.changed();
    }

    /// Passes on tiles that were made here, like [`Self::push`].
    pub fn push_tiles(&self, epoch: u64, tiles: schema::Geometry) {
        let mut state = self.lock();
        // store before pushing: a viewer that skips in between gets them twice rather than never
        if state.epoch == epoch
            && let Some(chunks) = &mut state.chunks
        {
            chunks.take(&tiles);
        }
        drop(state);
        self.push(epoch, MessageKind::Geometry { frame: tiles.frame }, write(Kind::Geometry(tiles)));
    }

    /// Stores the tiles of a frame if `epoch` is the current one; `count` updates the statistics.
    pub fn set_newest_frame(&self, epoch: u64, frame: FrameWithTiles, count: impl FnOnce(&mut Statistics)) {
        let mut state = self.lock();
        if state.epoch != epoch {
            return;
        }
        state.statistics.frame = frame.tiles.frame;
        count(&mut state.statistics);
        state.newest_frame = Some(Arc::new(frame));
    }

    pub fn count(&self, count: impl FnOnce(&mut Statistics)) {
        count(&mut self.lock().statistics);
    }

    /// The newest frame with its geometry, and its epoch.
    pub fn newest_frame(&self) -> Option<(u64, Arc<FrameWithTiles>)> {
        let state = self.lock();
        state.newest_frame.as_ref().map(|frame| (state.epoch, Arc::clone(frame)))
    }

    /// SNAPSHOT of all current tiles, with its frame; `None` if the room has no tiles yet, or another epoch.
    fn everything(&self, epoch: u64) -> Option<(u64, Bytes)> {
        let mut state = self.lock();
        if state.epoch != epoch {
            // the viewer gets all tiles after the next HELLO
            return None;
        }
        let (frame, chunks) = (state.newest_frame.clone(), state.chunks.as_mut()?);
        let newest = chunks.newest();
        // all tiles in one chunk are shorter, but those that were sent before their frame was complete are not in `frame`
        let Some(frame) = frame.filter(|frame| newest <= Some(frame.tiles.frame)) else { return newest.zip(chunks.snapshot()) };
        drop(state);
        Some((frame.tiles.frame, frame.tiles.snapshot()?))
    }

    /// A message with the tiles that a viewer lacks, which counts as sent: SNAPSHOT if it has none, else GEOMETRY with the newer ones.
    /// `None` if it lacks none or is hidden.
    pub fn tiles(&self, viewer: &mut Viewer) -> Option<Bytes> {
        if viewer.cursor.is_paused() {
            return None;
        }
        if let Some(known) = viewer.cursor.known() {
            let state = self.lock();
            if state.epoch != viewer.epoch {
                return None;
            }
            if let Some((frame, chunks)) = state.chunks.as_ref().and_then(|kept| kept.newest().zip(kept.newer(known))) {
                drop(state);
                viewer.cursor.set_known(frame);
                let tiles = || write(Kind::Geometry(schema::Geometry { frame, chunks }));
                return (frame > known).then(tiles);
            }
        }
        let (frame, bytes) = self.everything(viewer.epoch)?;
        viewer.cursor.set_known(frame);
        Some(bytes)
    }

    pub fn statistics(&self, viewer: &Viewer) -> Statistics {
        let state = self.lock();
        Statistics { viewers: state.all_viewers(), skipped: viewer.cursor.skipped, ..state.statistics }
    }

    /// Message `at` of a group of pictures, which starts with HELLO and the tiles.
    pub fn group(&self, group: Group, at: usize) -> GroupPart {
        let part = {
            let state = self.lock();
            if state.closed || group.epoch != state.epoch {
                return GroupPart::Gone;
            }
            let Some(groups) = &state.groups else { return GroupPart::Gone };
            match groups.part(group.number, at) {
                Ok(GroupPart::NotYet) if !state.publishing => return GroupPart::Gone,
                part => part,
            }
        };
        part.unwrap_or_else(|tiles| tiles.snapshot().map_or(GroupPart::Gone, GroupPart::Message))
    }

    pub fn last_group(&self) -> Option<Group> {
        let state = self.lock();
        state.groups.as_ref()?.last().map(|number| Group { epoch: state.epoch, number })
    }

    /// Admits a viewer; `None` if the room is full or closed. Edges do not count towards the limit; only the origin admits them.
    pub fn join(&self, kind: ViewerKind) -> Option<Viewer> {
        let mut state = self.lock();
        let refused = match kind {
            ViewerKind::Local => state.viewers >= self.bounds.viewers,
            ViewerKind::Edge(_) => state.edge.is_some(),
        };
        if refused || state.closed {
            return None;
        }
        match kind {
            ViewerKind::Local => state.viewers += 1,
            ViewerKind::Edge(viewers) => state.edge_viewers += viewers,
        }
        // an invalid epoch, so that the viewer first gets HELLO and all tiles
        Some(Viewer { cursor: state.ring.begin(Instant::now()), epoch: 0, kind })
    }

    pub fn all_viewers(&self) -> u32 {
        self.lock().all_viewers()
    }

    pub fn local_viewers(&self) -> u32 {
        self.lock().viewers as u32
    }

    /// Whether the limit of viewers at this node is reached.
    pub fn is_full(&self) -> bool {
        self.lock().viewers >= self.bounds.viewers
    }

    pub fn leave(&self, viewer: &Viewer) {
        let mut state = self.lock();
        match viewer.kind {
            ViewerKind::Local => state.viewers = state.viewers.saturating_sub(1),
            ViewerKind::Edge(viewers) => state.edge_viewers = state.edge_viewers.saturating_sub(viewers),
        }
    }

    pub fn next(&self, viewer: &mut Viewer) -> NextStep {
        let mut state = self.lock();
        let now = Instant::now();
        let is_edge_of_edge = matches!(viewer.kind, ViewerKind::Edge(_)) && state.edge.is_some();
        if state.closed || state.farewell.is_some() || is_edge_of_edge {
            return NextStep::Closed;
        }
        let Some(hello) = state.hello.clone() else { return NextStep::Wait };
        if viewer.epoch != state.epoch {
            viewer.epoch = state.epoch;
            viewer.cursor = viewer.cursor.restarted(&state.ring, now);
            return NextStep::Hello(hello);
        }
        match state.ring.step(&mut viewer.cursor, now) {
            Step::Send(bytes) => NextStep::Send(bytes),
            Step::Wait => {
                // ask repeatedly: an earlier request may have been for another viewer, or was lost
                if viewer.cursor.wants_key() && state.ring.has_frames() {
                    self.want_key(&mut state, now);
                }
                NextStep::Wait
            }
            Step::Skipped { wants_key } => {
                if wants_key {
                    self.want_key(&mut state, now);
                }
                NextStep::Tiles
            }
        }
    }

    fn want_key(&self, state: &mut State, now: Instant) {
        if state.asked.is_none_or(|at| now.saturating_duration_since(at) >= KEYS) {
            state.asked = Some(now);
            self.keys.notify_one();
        }
    }
}

impl State {
    /// Resets the state for a new `hello`.
    fn begin(&mut self, hello: Hello, chunks: Option<Chunks>, groups: Option<Groups>) {
        (self.hello, self.chunks, self.groups) = (Some(Arc::new(hello)), chunks, groups);
        self.ring.clear();
        (self.newest_frame, self.statistics) = (None, Statistics::default());
        (self.remote_viewers, self.relayed) = (0, None);
    }

    fn all_viewers(&self) -> u32 {
        (self.viewers as u32).saturating_add(self.remote_viewers).saturating_add(self.edge_viewers)
    }
}

impl Viewer {
    pub const fn pause(&mut self, paused: bool) {
        self.cursor.pause(paused);
    }

    pub const fn skip_to_key(&mut self) {
        self.cursor.skip_to_key();
    }

    pub const fn watches(&self) -> ViewerKind {
        self.kind
    }
}

#[cfg(test)]
pub mod tests;
