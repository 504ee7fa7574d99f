//! The photos that the server knows, the queue of those to be made, and the threads that make them.
//!
//! A photo is in the index exactly while its folder is on disk. Whoever changes the index holds `membership`, so that an
//! upload, its twin and a deletion come one after the other; readers only take the short lock on `inner`. Where several nodes share a store, the
//! index has those of its photos that were asked for last and those that wait or are worked on.

mod among;
mod few;
mod line;
mod list;
mod queue;
mod quota;
mod shared;

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use axum::http::StatusCode;

use super::access::Owner;
use super::cluster::{self, Cluster};
use super::entry::{Entry, Status, Tally};
use super::exports::Exports;
use super::id::PhotoId;
use super::limits::Limits;
use super::maker::Maker;
use super::memory::Memory;
use super::problem::Problem;
use super::settings::Settings;
use super::store::{Accepted, Failed, Found, Incoming, State, Store};
use super::telemetry::Telemetry;
use super::time::now_ms;
use super::worker;
pub use line::Class;
use line::Line;
use list::ByAge;
pub use list::Whose;
use queue::Trouble;
use quota::{Coming, Held};

/// Guess of a job's duration before one was measured, in seconds.
const FIRST_GUESS: f64 = 5.0;
/// Longest `Retry-After` in seconds.
const MAX_RETRY_AFTER: u64 = 120;

/// Index, queue and workers.
pub struct Jobs {
    pub(super) store: Store,
    pub(super) maker: Arc<dyn Maker>,
    pub(super) limits: Arc<Limits>,
    pub(super) telemetry: Arc<Telemetry>,
    /// The others, where several nodes share a store.
    pub(super) cluster: Option<Arc<Cluster>>,
    membership: Mutex<()>,
    inner: Mutex<Inner>,
    wake: Condvar,
    idle: Condvar,
    abort: AtomicBool,
    /// Files that were ordered.
    pub(super) exports: Exports,
    /// How often a photo was asked for: those that were so least recently go first where a store has more than are kept here.
    asked: AtomicU64,
    /// Memory of running jobs.
    pub(super) memory: Memory,
}

#[derive(Default)]
struct Inner {
    by_id: HashMap<PhotoId, Arc<Entry>>,
    by_age: ByAge,
    by_owner: HashMap<Owner, ByAge>,
    coming: Vec<Coming>,
    /// Room of uploads in parts, by their ids.
    held: HashMap<String, Held>,
    queue: Line,
    running: Vec<Arc<Entry>>,
    /// Files that are being written.
    writing: usize,
    tally: Arc<Tally>,
    stopping: bool,
    mean_seconds: Option<f64>,
    trouble: Option<Trouble>,
}

/// Counts for health and metrics. Where several nodes share a store, those that have ended are counted as far as the index has them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Photos that wait.
    pub queued: usize,
    /// Photos that are being made.
    pub working: usize,
    /// Finished photos.
    pub done: usize,
    /// Photos that could not be made.
    pub failed: usize,
    /// Photos of which the results are damaged.
    pub damaged: usize,
    /// Photos of the index.
    pub known: usize,
}

/// A page of the list.
pub struct Page {
    /// Newest first.
    pub photos: Vec<Arc<Entry>>,
    /// True where older ones follow.
    pub more: bool,
}

/// What an upload led to.
pub struct Submitted {
    /// The photo.
    pub entry: Arc<Entry>,
    /// False where the photo was known already.
    pub new: bool,
    /// True where what was made of it was damaged, and is made again.
    pub healed: bool,
}

impl Jobs {
    /// Takes up what was found on disk and starts the workers.
    ///
    /// # Errors
    /// No thread can be started.
    pub fn start(
        store: Store,
        found: Vec<Found>,
        maker: Arc<dyn Maker>,
        limits: Arc<Limits>,
        telemetry: Arc<Telemetry>,
    ) -> std::io::Result<Arc<Self>> {
        Self::start_among(None, store, found, maker, limits, telemetry)
    }

    /// The same as one node of several.
    ///
    /// # Errors
    /// No thread can be started.
    pub fn start_among(
        cluster: Option<Arc<Cluster>>,
        store: Store,
        found: Vec<Found>,
        maker: Arc<dyn Maker>,
        limits: Arc<Limits>,
        telemetry: Arc<Telemetry>,
    ) -> std::io::Result<Arc<Self>> {
        let (workers, memory) = (limits.workers, Memory::new(limits.job_memory));
        let jobs = Arc::new(Self {
            exports: Exports::open(&store, &limits),
            store,
            maker,
            limits,
            telemetry,
            cluster,
            membership: Mutex::new(()),
            inner: Mutex::default(),
            wake: Condvar::new(),
            idle: Condvar::new(),
            abort: AtomicBool::new(false),
            asked: AtomicU64::new(0),
            memory,
        });
        jobs.take_up(found);
        {
            let inner = jobs.lock();
            let unreadable = jobs.store.unreadable();
            tracing::info!(photos = inner.by_id.len(), unfinished = inner.queue.count(), unreadable, "data directory");
        }
        if let Some(cluster) = &jobs.cluster {
            cluster::keep_up(&jobs, cluster)?;
            cluster::hear(&jobs, cluster)?;
        }
        for n in 0..workers {
            let jobs = Arc::clone(&jobs);
            let work = move || match &jobs.cluster {
                Some(cluster) => cluster::work(&jobs, cluster),
                None => worker::work(&jobs),
            };
            std::thread::Builder::new().name(format!("tmpi-way-{n}")).spawn(work)?;
        }
        Ok(jobs)
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn membership(&self) -> MutexGuard<'_, ()> {
        self.membership.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes an upload of a class; blocks until it is on disk. A photo that is known already is not stored again; if it had failed,
    /// it gets another try.
    ///
    /// # Errors
    /// 429 where the queue is full, 503 while the server stops, 500 and 507 where the disk fails.
    pub fn submit_as(
        &self,
        class: Class,
        incoming: Incoming,
        id: PhotoId,
        accepted: Accepted,
        settings: Settings,
    ) -> Result<Submitted, Problem> {
        if let Some(cluster) = &self.cluster {
            return self.submit_shared(cluster, &incoming, id, &accepted, &settings);
        }
        // read before the lock is taken: others need not wait for it
        let spoilt = |entry: &Entry| matches!(entry.status(), Status::Done(done) if self.store.damage(id, &done).is_some());
        self.store.settle(&incoming).map_err(|e| Problem::store(&e))?;
        let healed = self.get(id).is_some_and(|entry| matches!(entry.status(), Status::Damaged(_)) || spoilt(&entry));
        let _membership = self.membership();
        let known = self.get(id);
        if let Some(entry) = &known {
            let again = match entry.status() {
                Status::Failed(_) | Status::Damaged(_) => true,
                Status::Done(_) => healed,
                _ => false,
            };
            if !again {
                return Ok(Submitted { entry: Arc::clone(entry), new: false, healed: false });
            }
        }
        if healed {
            tracing::error!(%id, "what was made of the photo is damaged on disk; it is made again");
        }
        self.room()?;
        let (entry, new) = if let Some(entry) = known {
            let gate = entry.gate();
            self.store
                .take_upload(&incoming, id)
                .and_then(|()| self.store.write_state(id, &State::default()))
                .map_err(|e| Problem::store(&e))?;
            entry.set_attempts(0);
            entry.set(Status::Queued);
            drop(gate);
            (entry, false)
        } else {
            self.last_quota(accepted.owner.as_ref(), accepted.bytes())?;
            let kept = if settings == Settings::default() { Ok(()) } else { incoming.write_settings(&settings) };
            let kept = kept.and_then(|()| if class == Class::Batch { incoming.write_batch() } else { Ok(()) });
            kept.and_then(|()| self.store.accept(incoming, id, &accepted)).map_err(|e| Problem::store(&e))?;
            (Arc::new(Entry::new(id, accepted, settings)), true)
        };
        entry.ask();
        entry.set_class(class);
        let mut inner = self.lock();
        inner.insert(&entry);
        inner.queue.push_photo(&entry);
        drop(inner);
        // threads that wait differ in what they take
        self.wake.notify_all();
        Ok(Submitted { entry, new, healed })
    }

    /// An upload that somebody waits for.
    #[cfg(test)]
    pub fn submit(&self, incoming: Incoming, id: PhotoId, accepted: Accepted, settings: Settings) -> Result<Submitted, Problem> {
        self.submit_as(Class::default(), incoming, id, accepted, settings)
    }

    /// Room in the queue; with `membership` held it stays until the caller has used it.
    pub(super) fn room(&self) -> Result<(), Problem> {
        let inner = self.lock();
        if inner.stopping {
            return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "stopping", "the server is stopping").retry_after(10));
        }
        if inner.queue.count() < self.limits.queue {
            return Ok(());
        }
        let seconds = inner.wait(self.limits.workers).ceil() as u64;
        Err(Problem::new(StatusCode::TOO_MANY_REQUESTS, "queue-full", format!("{} photos are waiting already", inner.queue.count()))
            .retry_after(seconds.clamp(1, MAX_RETRY_AFTER)))
    }

    /// Places in the queue that are free.
    #[must_use]
    pub fn free_places(&self) -> usize {
        self.limits.queue.saturating_sub(self.lock().queue.count())
    }

    /// The answer to an upload for which there is no place, before its body is read.
    #[must_use]
    pub fn refusal(&self) -> Problem {
        let seconds = self.lock().wait(self.limits.workers).ceil() as u64;
        Problem::new(StatusCode::TOO_MANY_REQUESTS, "queue-full", "as many photos are waiting and coming in as may")
            .retry_after(seconds.clamp(1, MAX_RETRY_AFTER))
    }

    /// A photo.
    #[must_use]
    pub fn get(&self, id: PhotoId) -> Option<Arc<Entry>> {
        let entry = self.lock().by_id.get(&id).cloned()?;
        entry.asked_for(self.asked.fetch_add(1, Ordering::Relaxed));
        Some(entry)
    }

    /// Photos that wait before this one, as far as these have a place here; none where it does not wait.
    #[must_use]
    pub fn position(&self, id: PhotoId) -> Option<usize> {
        let inner = self.lock();
        if inner.queue.has(id) {
            return inner.queue.photos().position(|e| e.id == id);
        }
        // there was no place for it
        inner.by_id.get(&id).is_some_and(|entry| inner.is_waiting(entry)).then(|| inner.queue.count())
    }

    /// Deletes a photo, whatever it is at; blocks until it is gone from disk. False where there is no such photo.
    ///
    /// # Errors
    /// [`Problem`] 500 where the disk fails; the photo is still there then.
    pub fn delete(&self, id: PhotoId) -> Result<bool, Problem> {
        self.delete_of(id, None)
    }

    /// The same of the upload that was accepted at `at_ms`, milliseconds since 1970, where that is given: false where another took its place.
    ///
    /// # Errors
    /// As [`Jobs::delete`].
    pub fn delete_of(&self, id: PhotoId, at_ms: Option<u64>) -> Result<bool, Problem> {
        if let Some(cluster) = &self.cluster {
            let known = self.get(id).is_some();
            let gone = cluster.remove(id, at_ms).and_then(|gone| self.refresh(cluster, id).map(|_| gone && known));
            return gone.map_err(|e| Problem::store(&e));
        }
        let _membership = self.membership();
        let is_meant = |entry: &Arc<Entry>| at_ms.is_none_or(|at_ms| entry.accepted.at_ms == at_ms);
        let Some(entry) = self.get(id).filter(is_meant) else { return Ok(false) };
        let gate = entry.gate();
        self.store.remove(id).map_err(|e| Problem::store(&e))?;
        entry.mark_deleted();
        drop(gate);
        let mut inner = self.lock();
        inner.remove(&entry);
        inner.queue.remove_photo(id);
        drop(inner);
        entry.set(Status::Deleted);
        Ok(true)
    }

    /// Takes a finished photo out of service, as `damage` says what of it is no longer as it was made at `at_ms`: until it is uploaded
    /// again, whoever asks is told. Nothing happens where it was made again or deleted meanwhile.
    pub fn take_out(&self, id: PhotoId, at_ms: u64, damage: &str) {
        let Some(entry) = self.get(id) else { return };
        let _gate = entry.gate();
        if entry.is_deleted() || !matches!(entry.status(), Status::Done(done) if done.at_ms == at_ms) {
            return;
        }
        tracing::error!(%id, damage, "a result is damaged on disk; the same upload makes it again");
        if let Some(cluster) = &self.cluster {
            cluster.note_damage(id);
        }
        let detail = format!("{damage}: upload the photo again, and it is made anew");
        let problem = Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "damaged", detail);
        entry.set(Status::Damaged(Failed { at_ms: now_ms(), problem }));
    }

    /// Looks whether what was made of a photo is on disk as it was, and takes it out of service where it is not; blocks. Gives the bytes
    /// that were read.
    pub fn look_over(&self, entry: &Entry) -> u64 {
        let Status::Done(done) = entry.status() else { return 0 };
        if let Some(damage) = self.store.damage(entry.id, &done) {
            self.take_out(entry.id, done.at_ms, &damage);
        }
        done.atlas_bytes
    }

    /// True where nobody waits for work.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        let inner = self.lock();
        inner.queue.is_empty() && inner.is_at_rest()
    }

    /// Counts of photos.
    #[must_use]
    pub fn counts(&self) -> Counts {
        let inner = self.lock();
        let [done, failed, damaged] = inner.tally.counts();
        let beyond = self.cluster.as_ref().map_or(0, |cluster| cluster.beyond());
        Counts { queued: inner.queue.count() + beyond, working: inner.running.len(), done, failed, damaged, known: inner.by_id.len() }
    }

    /// Jobs that wait, by the name of their class.
    #[must_use]
    pub fn waiting(&self) -> [(&'static str, usize); 3] {
        self.lock().queue.waiting()
    }

    /// Takes up photos that were found on disk.
    fn take_up(&self, found: Vec<Found>) {
        let latest = found.iter().map(|f| f.accepted.at_ms.max(f.state.at_ms().unwrap_or_default())).max();
        // a clock that was put back would hide new photos behind old ones
        super::time::not_before(latest.unwrap_or_default());
        let _membership = self.membership();
        let mut inner = self.lock();
        for photo in found.into_iter().filter(|f| !inner.by_id.contains_key(&f.id)).collect::<Vec<_>>() {
            let entry = Arc::new(Entry::found(photo));
            // what was accepted is taken up again, however long the queue is
            if entry.status() == Status::Queued {
                entry.set_class(if self.store.is_batch(entry.id) { Class::Batch } else { Class::default() });
                inner.queue.push_photo(&entry);
            }
            inner.insert(&entry);
        }
    }
}

impl Inner {
    /// True where nothing is being made or written.
    fn is_at_rest(&self) -> bool {
        self.running.is_empty() && self.writing == 0
    }

    /// True where a photo waits, and no thread here makes it.
    fn is_waiting(&self, entry: &Entry) -> bool {
        entry.status() == Status::Queued && !self.running.iter().any(|e| e.id == entry.id)
    }

    /// Seconds until what waits and runs now is done.
    fn wait(&self, workers: usize) -> f64 {
        let jobs = (self.queue.count() + self.running.len()).div_ceil(workers.max(1));
        self.mean_seconds.unwrap_or(FIRST_GUESS) * jobs.max(1) as f64
    }

    fn insert(&mut self, entry: &Arc<Entry>) {
        entry.count_in(&self.tally);
        self.by_id.insert(entry.id, Arc::clone(entry));
        self.list(entry);
    }

    /// Gives it its place in the lists.
    fn list(&mut self, entry: &Arc<Entry>) {
        self.by_age.insert(entry.key(), Arc::clone(entry));
        if let Some(owner) = &entry.accepted.owner {
            self.by_owner.entry(owner.clone()).or_default().insert(entry.key(), Arc::clone(entry));
        }
    }

    fn remove(&mut self, entry: &Entry) {
        self.by_id.remove(&entry.id);
        self.unlist(entry);
    }

    /// Takes it out of the lists.
    fn unlist(&mut self, entry: &Entry) {
        self.by_age.remove(&entry.key());
        let Some(owner) = &entry.accepted.owner else { return };
        if let Some(theirs) = self.by_owner.get_mut(owner) {
            theirs.remove(&entry.key());
            if theirs.is_empty() {
                self.by_owner.remove(owner);
            }
        }
    }
}

#[cfg(test)]
pub(in crate::server) mod among_tests;
