//! What the sockets and threads of a room share.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use bytes::Bytes;
use tokio::sync::{Notify, watch};
use tokio_util::sync::CancellationToken;

use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::wire::{self, Bye, Hello, Statistics};
use tmpi_core::live::{LiveError, write};

use super::gops::{Group, Groups, Part};
use super::ring::{Place, Ring, Step, What};
pub use super::still::{Newest, Still, Tiles};
use super::tiles::Chunks;
use super::{Bounds, KEYS};
use crate::server::Problem;

mod relayed;

/// A room.
pub struct Room {
    state: Mutex<State>,
    /// Counts changes, for whoever waits for one.
    changes: watch::Sender<u64>,
    /// A key frame is wanted.
    pub keys: Notify,
    /// How much it takes.
    pub bounds: Bounds,
}

#[derive(Default)]
struct State {
    ring: Ring,
    /// Of the publisher that is there or was last; none: there was none yet.
    hello: Option<Arc<Hello>>,
    epoch: u64,
    /// The epoch that the publisher came with; changes of the pictures' size begin others.
    came: u64,
    /// Somebody is about to publish here, or does.
    taken: bool,
    publishing: bool,
    closed: bool,
    /// Why the publisher is gone for good; none while one is here or may come back.
    farewell: Option<Bye>,
    viewers: usize,
    /// Viewers of the edges that watch here, as these count them.
    at_edges: u32,
    /// This node is an edge of the room: cancelled when it ends to be one.
    edge: Option<CancellationToken>,
    /// Of an edge: viewers at all other nodes, the tiles, and the last frame that came.
    elsewhere: u32,
    chunks: Option<Chunks>,
    relayed: Option<u64>,
    /// The tiles that were made here as they were sent.
    made: Option<Chunks>,
    groups: Groups,
    still: Option<Arc<Still>>,
    asked: Option<Instant>,
    statistics: Statistics,
}

/// What a viewer does next.
pub enum Next {
    /// Send this.
    Send(Bytes),
    /// Say this, then send all tiles: there is another publisher.
    Hello(Arc<Hello>),
    /// Send the tiles that it lacks: frames were skipped.
    Tiles,
    /// Wait for a change.
    Wait,
    /// The room is no more, or its publisher is gone for good.
    Closed,
}

/// A viewer's place in a room.
pub struct Viewer {
    place: Place,
    epoch: u64,
    kind: Watches,
}

/// For whom a viewer watches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Watches {
    /// For itself.
    Itself,
    /// For so many viewers of an edge.
    Edge(u32),
}

impl Room {
    /// A room without anyone.
    pub fn new(bounds: Bounds) -> Self {
        Self { state: Mutex::default(), changes: watch::Sender::new(0), keys: Notify::new(), bounds }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn changed(&self) {
        self.changes.send_modify(|n| *n = n.wrapping_add(1));
    }

    /// Told of every change.
    pub fn watch(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    /// True where no publisher is here or about to be.
    pub fn is_empty(&self) -> bool {
        !self.lock().taken
    }

    /// Whether a publisher is here.
    pub fn is_publishing(&self) -> bool {
        self.lock().publishing
    }

    /// Whether viewers are served here: a publisher is here, about to be or was here last, or this node is an edge of the room.
    pub fn is_served(&self) -> bool {
        let state = self.lock();
        state.taken || state.edge.is_some() || (state.hello.is_some() && state.chunks.is_none())
    }

    /// Whether this is the room's epoch.
    pub fn has_epoch(&self, epoch: u64) -> bool {
        self.lock().epoch == epoch
    }

    /// Whether this is the epoch that the last publisher came with.
    pub fn came_with(&self, epoch: u64) -> bool {
        self.lock().came == epoch
    }

    /// Sends everybody away.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed();
    }

    /// Takes the place of the room's publisher; false where there is one already.
    pub fn take(&self) -> bool {
        let mut state = self.lock();
        !state.closed && !std::mem::replace(&mut state.taken, true)
    }

    /// The publisher that took the room says `hello`, or its pictures have another size; gives the epoch that begins, `least` or more.
    pub fn publish(&self, mut hello: Hello, clock: u64, least: u64) -> u64 {
        let mut state = self.lock();
        state.farewell = None;
        if let Some(edge) = state.edge.take() {
            edge.cancel();
        }
        state.epoch = least.max(state.epoch + 1);
        if !std::mem::replace(&mut state.publishing, true) {
            state.came = state.epoch;
        }
        (hello.epoch, hello.clock) = (state.epoch, clock);
        state.begin(hello, None);
        let epoch = state.epoch;
        drop(state);
        self.changed();
        epoch
    }

    /// The publisher is gone for good: who watches is told why.
    pub fn end(&self, farewell: Bye) {
        self.lock().farewell = Some(farewell);
        self.changed();
    }

    /// Why the publisher is gone for good.
    pub fn farewell(&self) -> Option<Bye> {
        self.lock().farewell.clone()
    }

    /// The publisher has gone.
    pub fn unpublish(&self) {
        let mut state = self.lock();
        (state.taken, state.publishing) = (false, false);
        state.groups.end();
        drop(state);
        self.changed();
    }

    /// Hands a message on that comes of a publisher of `epoch`; what is left of one that has gone is dropped.
    pub fn push(&self, epoch: u64, what: What, bytes: Bytes) {
        let mut guard = self.lock();
        let state = &mut *guard;
        if state.epoch != epoch {
            return;
        }
        match what {
            What::Key | What::Frame { .. } => {
                state.statistics.frames += 1;
                state.statistics.video_bytes += bytes.len() as u64;
            }
            What::Geometry { .. } => state.statistics.geometry_bytes += bytes.len() as u64,
            What::Sound => {}
        }
        let now = Instant::now();
        // groups are asked for at the origin
        if let Some(hello) = state.hello.as_ref().filter(|_| state.chunks.is_none()) {
            state.groups.push(what, &bytes, now, hello, state.still.as_ref().map(|s| &s.tiles));
        }
        state.ring.push(what, bytes, now);
        drop(guard);
        self.changed();
    }

    /// Hands tiles on that were made here of a frame of a publisher of `epoch`, as [`Self::push`] does.
    pub fn push_tiles(&self, epoch: u64, tiles: wire::Geometry) {
        let mut state = self.lock();
        // kept before anyone is told: who skips in between is sent them twice, and never not at all
        if state.epoch == epoch
            && let Some(made) = &mut state.made
        {
            made.take(&tiles);
        }
        drop(state);
        self.push(epoch, What::Geometry { frame: tiles.frame }, write(Kind::Geometry(tiles)));
    }

    /// Keeps the tiles of a frame of a publisher of `epoch`, as [`Self::push`] does; `count` counts it.
    pub fn keep(&self, epoch: u64, still: Still, count: impl FnOnce(&mut Statistics)) {
        let mut state = self.lock();
        if state.epoch != epoch {
            return;
        }
        state.statistics.frame = still.tiles.frame;
        count(&mut state.statistics);
        state.still = Some(Arc::new(still));
    }

    /// Counts something.
    pub fn count(&self, count: impl FnOnce(&mut Statistics)) {
        count(&mut self.lock().statistics);
    }

    /// The newest frame whose geometry is done, as a container; none where there is none yet.
    ///
    /// # Errors
    /// 500 where it cannot be written.
    pub async fn newest(&self) -> Result<Option<Newest>, Problem> {
        let Some((epoch, still)) = self.still() else { return Ok(None) };
        Ok(Some(Newest { epoch, number: still.tiles.frame, container: still.container().await? }))
    }

    /// The newest frame whose geometry is done, and the epoch that it is of.
    pub fn still(&self) -> Option<(u64, Arc<Still>)> {
        let state = self.lock();
        state.still.as_ref().map(|still| (state.epoch, Arc::clone(still)))
    }

    /// SNAPSHOT of all tiles as they are, with the frame that it is as of; none as long as there are none, or in another epoch.
    fn everything(&self, epoch: u64) -> Option<(u64, Result<Bytes, LiveError>)> {
        let still = {
            let mut guard = self.lock();
            let state = &mut *guard;
            if state.epoch != epoch {
                // all of it is told with the next HELLO
                return None;
            }
            let (still, made) = (state.still.clone(), state.made.as_mut());
            // tiles that were sent before there are all of a frame are in no still
            let newer = made.filter(|made| made.newest() > still.as_ref().map(|s| s.tiles.frame));
            let told = |chunks: &mut Chunks| chunks.newest().zip(chunks.snapshot().map(Ok));
            match &mut state.chunks {
                Some(chunks) => return told(chunks),
                None => match newer.and_then(told) {
                    Some(told) => return Some(told),
                    None => still,
                },
            }
        };
        still.map(|still| (still.tiles.frame, still.tiles.snapshot()))
    }

    /// What a viewer lacks of the tiles, as a message, and counts it as sent: SNAPSHOT where it has none, else GEOMETRY of those that are newer
    /// than it has; none where there are none, or nobody looks.
    pub fn tiles(&self, viewer: &mut Viewer) -> Option<Result<Bytes, LiveError>> {
        if viewer.place.is_paused() {
            return None;
        }
        if let Some(known) = viewer.place.known() {
            let state = self.lock();
            if state.epoch != viewer.epoch {
                return None;
            }
            let kept = state.chunks.as_ref().or(state.made.as_ref());
            if let Some((frame, chunks)) = kept.and_then(|kept| kept.newest().zip(kept.newer(known))) {
                drop(state);
                viewer.place.told(frame);
                let tiles = || Ok(write(Kind::Geometry(wire::Geometry { frame, chunks })));
                return (frame > known).then(tiles);
            }
        }
        let (frame, bytes) = self.everything(viewer.epoch)?;
        viewer.place.told(frame);
        Some(bytes)
    }

    /// What is counted, for a viewer.
    pub fn statistics(&self, viewer: &Viewer) -> Statistics {
        let state = self.lock();
        Statistics { viewers: state.everyone(), skipped: viewer.place.skipped, ..state.statistics }
    }

    /// Message `at` of a group of pictures, HELLO and tiles counted.
    pub fn group(&self, group: Group, at: usize) -> Part {
        let part = {
            let state = self.lock();
            if state.closed || group.epoch != state.epoch {
                return Part::Gone;
            }
            match state.groups.part(group.number, at) {
                Ok(Part::NotYet) if !state.publishing => return Part::Gone,
                part => part,
            }
        };
        part.unwrap_or_else(|tiles| match tiles.snapshot() {
            Ok(bytes) => Part::Message(bytes),
            Err(error) => {
                tracing::error!(%error, "coding the tiles of a room");
                Part::Gone
            }
        })
    }

    /// The newest group of pictures.
    pub fn last_group(&self) -> Option<Group> {
        let state = self.lock();
        state.groups.last().map(|number| Group { epoch: state.epoch, number })
    }

    /// Lets a viewer in; none where there are as many as may be, or the room is no more. Edges are not counted, and find the origin alone.
    pub fn join(&self, kind: Watches) -> Option<Viewer> {
        let mut state = self.lock();
        let refused = match kind {
            Watches::Itself => state.viewers >= self.bounds.viewers,
            Watches::Edge(_) => state.edge.is_some(),
        };
        if refused || state.closed {
            return None;
        }
        match kind {
            Watches::Itself => state.viewers += 1,
            Watches::Edge(viewers) => state.at_edges += viewers,
        }
        // an epoch that is none: everything is to be told first
        Some(Viewer { place: state.ring.begin(Instant::now()), epoch: 0, kind })
    }

    /// How many watch, at other nodes, too.
    pub fn everyone(&self) -> u32 {
        self.lock().everyone()
    }

    /// How many watch here.
    pub fn viewers(&self) -> u32 {
        self.lock().viewers as u32
    }

    /// Whether as many watch here as may.
    pub fn is_full(&self) -> bool {
        self.lock().viewers >= self.bounds.viewers
    }

    /// A viewer has gone.
    pub fn part(&self, viewer: &Viewer) {
        let mut state = self.lock();
        match viewer.kind {
            Watches::Itself => state.viewers = state.viewers.saturating_sub(1),
            Watches::Edge(viewers) => state.at_edges = state.at_edges.saturating_sub(viewers),
        }
    }

    /// What comes next for a viewer.
    pub fn next(&self, viewer: &mut Viewer) -> Next {
        let mut state = self.lock();
        let now = Instant::now();
        let is_edge_of_edge = matches!(viewer.kind, Watches::Edge(_)) && state.edge.is_some();
        if state.closed || state.farewell.is_some() || is_edge_of_edge {
            return Next::Closed;
        }
        let Some(hello) = state.hello.clone() else { return Next::Wait };
        if viewer.epoch != state.epoch {
            viewer.epoch = state.epoch;
            viewer.place = viewer.place.anew(&state.ring, now);
            return Next::Hello(hello);
        }
        match state.ring.step(&mut viewer.place, now) {
            Step::Send(bytes) => Next::Send(bytes),
            Step::Wait => {
                // again and again: one that was asked for just before may have been for somebody else, or is lost
                if viewer.place.wants_key() && state.ring.has_frames() {
                    self.want_key(&mut state, now);
                }
                Next::Wait
            }
            Step::Skipped { wants_key } => {
                if wants_key {
                    self.want_key(&mut state, now);
                }
                Next::Tiles
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
    /// Forgets what was, for a publisher that says `hello`.
    fn begin(&mut self, hello: Hello, chunks: Option<Chunks>) {
        self.made = if chunks.is_none() { Chunks::new(&hello) } else { None };
        self.hello = Some(Arc::new(hello));
        self.ring.clear();
        (self.groups, self.still, self.statistics) = (Groups::default(), None, Statistics::default());
        (self.chunks, self.elsewhere, self.relayed) = (chunks, 0, None);
    }

    fn everyone(&self) -> u32 {
        (self.viewers as u32).saturating_add(self.elsewhere).saturating_add(self.at_edges)
    }
}

impl Viewer {
    /// Sends it sound alone from now on, or all again.
    pub const fn pause(&mut self, paused: bool) {
        self.place.pause(paused);
    }

    /// It cannot decode what follows: it goes on with a key frame that it was not sent yet.
    pub const fn lose(&mut self) {
        self.place.lose();
    }

    /// For whom it watches.
    pub const fn watches(&self) -> Watches {
        self.kind
    }
}

#[cfg(test)]
pub mod tests;
