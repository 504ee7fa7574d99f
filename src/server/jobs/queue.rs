//! The queue as the threads see that make photos: the next one, what becomes of it, and the end.

use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use super::Jobs;
use super::line::{Class, Hand, Job, Next};
use crate::server::entry::Entry;
use crate::server::exports::Ordered;

/// Pause after a fault of the server, doubled with each further one, and its longest.
const REPAIR: Duration = Duration::from_millis(500);
const MOST_REPAIR: Duration = Duration::from_mins(1);
/// How often photos that could not be read are looked at again.
const LOOK_AGAIN: Duration = Duration::from_secs(10);

/// A fault of the server that keeps photos from being made.
#[derive(Debug)]
pub(super) struct Trouble {
    reason: String,
    /// No photo is tried before.
    until: Instant,
    /// Tries so far.
    tries: u32,
}

impl Jobs {
    /// The next photo to be made; blocks; none once the server stops.
    pub(in crate::server) fn take(&self) -> Option<Arc<Entry>> {
        let mut inner = self.lock();
        loop {
            if inner.stopping {
                return None;
            }
            let pause = inner.trouble.as_ref().map(|t| t.until.saturating_duration_since(Instant::now()));
            let mut pause = pause.filter(|p| !p.is_zero() && inner.queue.count() > 0);
            if pause.is_none() {
                match inner.queue.take(Hand::Maker, true, Instant::now()) {
                    Next::Job(Job::Photo(entry)) => {
                        inner.running.push(Arc::clone(&entry));
                        // others may have given way to it
                        self.wake.notify_all();
                        return Some(entry);
                    }
                    Next::Later(until) => pause = Some(until.saturating_duration_since(Instant::now())),
                    Next::Job(Job::File(_)) | Next::Nothing => {}
                }
            }
            let unread = self.store.unreadable() > 0;
            inner = match pause.or(unread.then_some(LOOK_AGAIN)) {
                Some(pause) => self.wake.wait_timeout(inner, pause).unwrap_or_else(PoisonError::into_inner).0,
                None => self.wake.wait(inner).unwrap_or_else(PoisonError::into_inner),
            };
            if unread && inner.queue.count() == 0 && !inner.stopping {
                drop(inner);
                self.take_up(self.store.look_again());
                inner = self.lock();
            }
        }
    }

    /// The next file to be written; blocks; none once the server stops.
    pub(in crate::server) fn take_file(&self) -> Option<Arc<Ordered>> {
        let mut inner = self.lock();
        loop {
            if inner.stopping {
                return None;
            }
            // photos that wait for a repair are not begun, and those of a store by whichever node
            let alone = self.cluster.is_none() && inner.trouble.is_none();
            let next = inner.queue.take(Hand::Writer, alone, Instant::now());
            inner = match next {
                Next::Job(Job::File(file)) => {
                    inner.writing += 1;
                    self.wake.notify_all();
                    return Some(file);
                }
                Next::Later(until) => {
                    let pause = until.saturating_duration_since(Instant::now());
                    self.wake.wait_timeout(inner, pause).unwrap_or_else(PoisonError::into_inner).0
                }
                Next::Job(Job::Photo(_)) | Next::Nothing => self.wake.wait(inner).unwrap_or_else(PoisonError::into_inner),
            };
        }
    }

    /// The counterpart of [`Jobs::take_file`].
    pub(in crate::server) fn release_file(&self) {
        self.lock().writing -= 1;
        self.idle.notify_all();
    }

    /// Puts a file behind those that wait.
    pub(in crate::server) fn push_file(&self, file: &Arc<Ordered>) {
        self.lock().queue.push(Class::Export, Job::File(Arc::clone(file)));
        self.wake.notify_all();
    }

    /// Takes a file from those that wait.
    pub(in crate::server) fn drop_file(&self, file: &Arc<Ordered>) {
        self.lock().queue.remove_file(file);
        self.wake.notify_all();
    }

    /// Puts a photo behind those that wait.
    pub(in crate::server) fn queue_again(&self, entry: &Arc<Entry>) {
        self.lock().queue.push_photo(entry);
        self.wake.notify_all();
    }

    /// Puts a photo back behind the others, which may need nothing of what is amiss; none is tried for a while, the longer the more
    /// often that happened.
    pub(in crate::server) fn wait_for_repair(&self, entry: &Arc<Entry>, reason: String) {
        let mut inner = self.lock();
        let tries = inner.trouble.as_ref().map_or(0, |t| t.tries);
        let pause = REPAIR.saturating_mul(1 << tries.min(16)).min(MOST_REPAIR);
        inner.trouble = Some(Trouble { reason, until: Instant::now() + pause, tries: tries + 1 });
        inner.queue.push_photo(entry);
    }

    /// Remembers a fault of the server, until when nothing is made here.
    pub(in crate::server) fn suffer(&self, reason: String, until: Instant) {
        let mut inner = self.lock();
        let tries = inner.trouble.as_ref().map_or(0, |t| t.tries);
        let pause = REPAIR.saturating_mul(1 << tries.min(16)).min(MOST_REPAIR);
        inner.trouble = Some(Trouble { reason, until: until.max(Instant::now() + pause), tries: tries + 1 });
    }

    /// Until when nothing is made here, after a fault of the server.
    pub(in crate::server) fn suffers_until(&self) -> Option<Instant> {
        self.lock().trouble.as_ref().map(|t| t.until)
    }

    /// A photo was made: whatever kept others from it is over.
    pub(in crate::server) fn mended(&self) {
        self.lock().trouble = None;
        self.wake.notify_all();
    }

    /// The fault of the server that keeps photos from being made, if there is one.
    #[must_use]
    pub fn trouble(&self) -> Option<String> {
        // the photo that met it may have been made by another node
        let is_over = |t: &Trouble| self.cluster.is_some() && Instant::now() > t.until + MOST_REPAIR;
        self.lock().trouble.as_ref().filter(|t| !is_over(t)).map(|t| t.reason.clone())
    }

    /// The counterpart of [`Jobs::take`].
    pub(in crate::server) fn release(&self, entry: &Arc<Entry>, took: Duration) {
        let mut inner = self.lock();
        // a photo that failed and was uploaded again at once may be there twice
        if let Some(at) = inner.running.iter().position(|e| Arc::ptr_eq(e, entry)) {
            inner.running.swap_remove(at);
        }
        let mean = inner.mean_seconds.map_or(took.as_secs_f64(), |m| 0.8 * m + 0.2 * took.as_secs_f64());
        inner.mean_seconds = Some(mean);
        drop(inner);
        self.idle.notify_all();
    }

    /// True once running jobs are to give up.
    pub(in crate::server) fn aborted(&self) -> bool {
        self.abort.load(Ordering::Acquire)
    }

    /// No further job starts, and no further upload is taken.
    pub fn stop(&self) {
        self.lock().stopping = true;
        self.wake.notify_all();
    }

    /// True while jobs are taken.
    #[must_use]
    pub fn is_accepting(&self) -> bool {
        !self.lock().stopping
    }

    /// Waits for the jobs under way, until `deadline`; those that are not finished by then are left for the next start.
    pub fn drain(&self, deadline: Instant) {
        self.stop();
        let wait = |until: Instant| {
            let left = until.saturating_duration_since(Instant::now());
            let inner = self.idle.wait_timeout_while(self.lock(), left, |inner| !inner.is_at_rest());
            inner.unwrap_or_else(PoisonError::into_inner).0.is_at_rest()
        };
        if wait(deadline) {
            return;
        }
        self.abort.store(true, Ordering::Release);
        // what is cut off was never counted: there is nothing to put right
        wait(Instant::now() + Duration::from_millis(500));
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::Path;

    use super::super::{Limits, PhotoId};
    use super::*;
    use crate::server::files::Files as _;
    use crate::server::forgetful::Forgetful;
    use crate::server::maker::Never;
    use crate::server::settings::Settings;
    use crate::server::store::{Accepted, Part, Store};

    #[test]
    fn a_photo_that_runs_twice_is_waited_for_twice() {
        let dir = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(dir.path(), "").unwrap();
        // nobody else takes anything
        let limits = Arc::new(Limits { workers: 0, ..Limits::default() });
        let jobs = Jobs::start(store, Vec::new(), Arc::new(Never), limits, Arc::default()).unwrap();
        let accepted = Accepted { version: 1, at_ms: 1, photo_bytes: 1, depth_bytes: None, options: BTreeMap::new(), owner: None };
        let entry = Arc::new(Entry::new(PhotoId::of(&[1; 32], None, "", ""), accepted, Settings::default()));
        for _ in 0..2 {
            // it failed and was uploaded again before the first worker let it go
            jobs.queue_again(&entry);
            assert!(jobs.take().is_some());
        }
        jobs.release(&entry, Duration::ZERO);
        assert_eq!(jobs.counts().working, 1);
        let began = Instant::now();
        jobs.drain(began + Duration::from_millis(50));
        assert!(began.elapsed() >= Duration::from_millis(50) && jobs.aborted(), "one still runs");
        jobs.release(&entry, Duration::ZERO);
        assert_eq!(jobs.counts().working, 0);
    }

    #[test]
    fn what_was_answered_is_on_disk_whole_though_the_machine_stops_at_once() {
        let (files, dir) = (Arc::new(Forgetful::new()), Path::new("/data"));
        let (store, _) = Store::open_in(files.clone(), dir, "", None).unwrap();
        files.sync_dir(Path::new("/")).unwrap();
        let limits = Arc::new(Limits { workers: 0, ..Limits::default() });
        let jobs = Jobs::start(store, Vec::new(), Arc::new(Never), limits, Arc::default()).unwrap();
        let incoming = jobs.store.begin().unwrap();
        for part in [Part::Upload, Part::Depth] {
            // as a stream leaves it
            files.write_unsynced(&incoming.path(part), b"photo");
        }
        let id = PhotoId::of(&[1; 32], None, "", "");
        let accepted = Accepted { version: 1, at_ms: 1, photo_bytes: 5, depth_bytes: Some(5), options: BTreeMap::new(), owner: None };
        assert!(jobs.submit(incoming, id, accepted, Settings::default()).unwrap().new);
        files.crash();
        let (store, found) = Store::open_in(files, dir, "", None).unwrap();
        assert_eq!(found.len(), 1);
        for part in [Part::Upload, Part::Depth] {
            assert_eq!(store.read(id, part).unwrap(), b"photo", "{}", part.name());
        }
    }
}
