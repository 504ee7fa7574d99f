//! One photo that the server knows, and how it fares.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use tokio::sync::watch;

use super::id::PhotoId;
use super::jobs::Class;
use super::settings::Settings;
use super::store::{Accepted, Done, End, Failed, Found};
use super::traces::{self, Parent};
use tmpi_pipeline::Progress;

/// How a photo fares.
#[derive(Clone, Debug, PartialEq)]
pub enum Status {
    /// Waits for a worker.
    Queued,
    /// A worker has it.
    Working,
    /// Finished.
    Done(Done),
    /// Could not be made.
    Failed(Failed),
    /// What was made of it is no longer on disk as it was.
    Damaged(Failed),
    /// Deleted; nothing follows.
    Deleted,
}

impl Status {
    /// True where nothing follows.
    #[must_use]
    pub const fn is_final(&self) -> bool {
        matches!(self, Self::Done(_) | Self::Failed(_) | Self::Damaged(_) | Self::Deleted)
    }
}

/// What listeners of a photo see.
#[derive(Clone, Debug, PartialEq)]
pub struct Live {
    /// How it fares now.
    pub status: Status,
    /// Stages entered in this run of the job.
    pub stages: Vec<Progress>,
}

/// Counts of finished photos, of those that could not be made and of damaged ones, kept as they change: asking for them looks at no photo.
#[derive(Debug, Default)]
pub struct Tally {
    done: AtomicUsize,
    failed: AtomicUsize,
    damaged: AtomicUsize,
}

impl Tally {
    /// Finished photos, those that could not be made, and damaged ones.
    #[must_use]
    pub fn counts(&self) -> [usize; 3] {
        [&self.done, &self.failed, &self.damaged].map(|n| n.load(Ordering::Relaxed))
    }

    fn of(&self, status: &Status) -> Option<&AtomicUsize> {
        match status {
            Status::Done(_) => Some(&self.done),
            Status::Failed(_) => Some(&self.failed),
            Status::Damaged(_) => Some(&self.damaged),
            Status::Queued | Status::Working | Status::Deleted => None,
        }
    }

    fn moved(&self, from: Option<&Status>, to: &Status) {
        if let Some(count) = from.and_then(|status| self.of(status)) {
            count.fetch_sub(1, Ordering::Relaxed);
        }
        if let Some(count) = self.of(to) {
            count.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// One photo.
#[derive(Debug)]
pub struct Entry {
    /// Its id.
    pub id: PhotoId,
    /// What was accepted.
    pub accepted: Accepted,
    live: watch::Sender<Live>,
    tally: OnceLock<Arc<Tally>>,
    attempts: AtomicU32,
    deleted: AtomicBool,
    gate: Mutex<()>,
    settings: Mutex<Settings>,
    seen_ms: AtomicU64,
    used: AtomicU64,
    asked_by: Mutex<Option<Parent>>,
    class: Mutex<Class>,
}

impl Entry {
    /// A fresh upload with the settings that it names.
    #[must_use]
    pub fn new(id: PhotoId, accepted: Accepted, settings: Settings) -> Self {
        Self::found(Found { id, accepted, state: super::store::State::default(), settings })
    }

    /// A photo found on disk.
    #[must_use]
    pub fn found(found: Found) -> Self {
        let status = match found.state.end {
            None => Status::Queued,
            Some(End::Done(done)) => Status::Done(done),
            Some(End::Failed(failed)) => Status::Failed(failed),
        };
        let seen_ms = AtomicU64::new(found.accepted.at_ms);
        Self {
            id: found.id,
            accepted: found.accepted,
            live: watch::Sender::new(Live { status, stages: Vec::new() }),
            tally: OnceLock::new(),
            attempts: AtomicU32::new(found.state.attempts),
            deleted: AtomicBool::new(false),
            gate: Mutex::new(()),
            settings: Mutex::new(found.settings),
            seen_ms,
            used: AtomicU64::new(0),
            asked_by: Mutex::default(),
            class: Mutex::default(),
        }
    }

    /// Keeps the request that works here as the one that asked for its next making, also where it is none.
    pub fn ask(&self) {
        *self.asked_by.lock().unwrap_or_else(PoisonError::into_inner) = traces::parent();
    }

    /// The request that asked for its making.
    #[must_use]
    pub fn asked_by(&self) -> Option<Parent> {
        self.asked_by.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// How urgent its next making is.
    #[must_use]
    pub fn class(&self) -> Class {
        *self.class.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets that, before it waits.
    pub fn set_class(&self, class: Class) {
        *self.class.lock().unwrap_or_else(PoisonError::into_inner) = class;
    }

    /// Place in the list, which shows first what was uploaded last.
    #[must_use]
    pub fn key(&self) -> (u64, PhotoId) {
        let again = self.settings.lock().unwrap_or_else(PoisonError::into_inner).listed_ms;
        (again.unwrap_or(self.accepted.at_ms), self.id)
    }

    /// Somebody looks at it, at so many milliseconds since 1970.
    pub fn look(&self, at_ms: u64) {
        self.seen_ms.fetch_max(at_ms, Ordering::Relaxed);
    }

    /// When somebody looked at it last, or uploaded it, milliseconds since 1970.
    #[must_use]
    pub fn seen_ms(&self) -> u64 {
        self.seen_ms.load(Ordering::Relaxed)
    }

    /// It was asked for as the `nth` of all.
    pub fn asked_for(&self, nth: u64) {
        self.used.fetch_max(nth, Ordering::Relaxed);
    }

    /// As the how manyth of all it was asked for last.
    #[must_use]
    pub fn last_asked(&self) -> u64 {
        self.used.load(Ordering::Relaxed)
    }

    /// Bytes that it takes: what was uploaded, and the container.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        let made = if let Status::Done(done) = &self.live.borrow().status { done.atlas_bytes } else { 0 };
        self.accepted.bytes() + made
    }

    /// How it fares now.
    #[must_use]
    pub fn status(&self) -> Status {
        self.live.borrow().status.clone()
    }

    /// When it was made, in milliseconds since 1970; none where it is not finished.
    #[must_use]
    pub fn done_at(&self) -> Option<u64> {
        if let Status::Done(done) = &self.live.borrow().status { Some(done.at_ms) } else { None }
    }

    /// How it fares now, with the stages entered.
    #[must_use]
    pub fn live(&self) -> Live {
        self.live.borrow().clone()
    }

    /// Follows it.
    #[must_use]
    pub fn watch(&self) -> watch::Receiver<Live> {
        self.live.subscribe()
    }

    /// True where somebody follows it.
    #[must_use]
    pub fn is_followed(&self) -> bool {
        self.live.receiver_count() > 0
    }

    /// Tells listeners how it fares; a new run forgets the stages of the one before.
    pub fn set(&self, status: Status) {
        self.live.send_modify(|live| {
            if !status.is_final() {
                live.stages.clear();
            }
            if let Some(tally) = self.tally.get() {
                tally.moved(Some(&live.status), &status);
            }
            live.status = status;
        });
    }

    /// Counts it from now on; a second time does nothing.
    pub fn count_in(&self, tally: &Arc<Tally>) {
        if self.tally.set(Arc::clone(tally)).is_ok() {
            tally.moved(None, &self.live.borrow().status);
        }
    }

    /// Counts it no longer; it must not change any more.
    pub fn count_out(&self) {
        if let Some(tally) = self.tally.get() {
            tally.moved(Some(&self.live.borrow().status), &Status::Deleted);
        }
    }

    /// Tells listeners of a stage.
    pub fn enter(&self, stage: Progress) {
        self.live.send_modify(|live| live.stages.push(stage));
    }

    /// Tells listeners how another node goes on with it; nothing where it has ended.
    pub fn follow(&self, stages: Vec<Progress>) {
        self.live.send_if_modified(|live| {
            let news = !live.status.is_final() && (live.status != Status::Working || live.stages != stages);
            if news {
                // neither of the two is counted
                live.status = Status::Working;
                live.stages = stages;
            }
            news
        });
    }

    /// Starts of the job so far.
    #[must_use]
    pub fn attempts(&self) -> u32 {
        self.attempts.load(Ordering::Acquire)
    }

    /// Sets the count of starts.
    pub fn set_attempts(&self, n: u32) {
        self.attempts.store(n, Ordering::Release);
    }

    /// True once it is deleted; its folder must no longer be touched.
    #[must_use]
    pub fn is_deleted(&self) -> bool {
        self.deleted.load(Ordering::Acquire)
    }

    /// Marks it as deleted; with the gate held.
    pub fn mark_deleted(&self) {
        self.deleted.store(true, Ordering::Release);
    }

    /// What its owner wants of viewers.
    #[must_use]
    pub fn settings(&self) -> Settings {
        self.settings.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Sets them; with the gate held, once they are on disk.
    pub fn set_settings(&self, settings: Settings) {
        *self.settings.lock().unwrap_or_else(PoisonError::into_inner) = settings;
    }

    /// Held by whoever writes into its folder or removes it.
    pub fn gate(&self) -> MutexGuard<'_, ()> {
        self.gate.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
