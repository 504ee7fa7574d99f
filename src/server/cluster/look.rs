//! The index of a node follows the store, by looking: the photos that are asked for, and those that wait.

use std::collections::{HashMap, HashSet};
use std::io;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, TryLockError, Weak};
use std::time::{Duration, Instant};

use tokio::sync::Semaphore;

use super::ports::unreachable;
use super::records::{Marker, PENDING, Photo};
use super::{Cluster, Known, lock, lock_of};
use crate::server::entry::Entry;
use crate::server::id::PhotoId;
use crate::server::jobs::Jobs;
use crate::server::records::{Accepted, End};
use crate::server::settings::Settings;
use crate::server::store::{Origin as _, Store};

/// Time between two looks whether photos of which there are copies here are still in the store.
const COPIES: Duration = Duration::from_mins(10);
/// Pause between two looks at what is to be done.
const TICK: Duration = Duration::from_millis(500);

/// Pause until a marker that led to nothing is followed again, doubled each time up to its longest: its photo may be on its way.
const REST: Duration = Duration::from_millis(500);
const MOST_REST: Duration = Duration::from_mins(1);
/// As many of these are remembered; what is beyond is followed at each look.
const MOST_BARREN: usize = 1 << 16;

/// Markers without a photo that can be read, by name, with the time until when they rest and for how long: they are the oldest, and would be
/// followed first at each look.
#[derive(Debug, Default)]
pub struct Barren(HashMap<String, (Instant, Duration)>);

impl Barren {
    /// Forgets those that are gone from `pending`, which is sorted.
    fn keep(&mut self, pending: &[String]) {
        self.0.retain(|name, _| pending.binary_search(name).is_ok());
    }

    fn rests(&self, name: &str) -> bool {
        self.0.get(name).is_some_and(|(until, _)| Instant::now() < *until)
    }

    fn add(&mut self, name: &str) {
        let pause = self.0.get(name).map_or(REST, |(_, pause)| (*pause * 2).min(MOST_REST));
        if self.0.len() < MOST_BARREN || self.0.contains_key(name) {
            self.0.insert(name.to_owned(), (Instant::now() + pause, pause));
        }
    }
}

/// What the store says of a photo.
pub struct Seen {
    /// What was accepted.
    pub accepted: Accepted,
    /// What its owner wants of viewers.
    pub settings: Settings,
    /// How the making that counts ended.
    pub end: Option<End>,
    /// This node found that what was made is damaged in the store.
    pub damaged: bool,
}

impl Cluster {
    /// Looks a photo up, has `take` take over what is seen, one look after the other, and gives what it gives. Copies in `store` of what
    /// was made before go.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn refresh(
        &self,
        id: PhotoId,
        take: impl FnOnce(Option<Seen>) -> Option<Arc<Entry>>,
        store: &Store,
    ) -> io::Result<Option<Arc<Entry>>> {
        let began = Instant::now();
        let _looking = self.looking(id);
        // whoever had the lock before may have looked for all who waited
        let looked = self.known().get(&id).filter(|known| known.looked >= began).cloned();
        let seen = match looked {
            Some(known) => Some(known),
            None if lock(&self.away).is_some_and(|at| at >= began) => return Err(unreachable("it could not be reached just now")),
            None => self.look(id)?,
        };
        let damaged = self.is_damaged(id);
        if !store.is_copy_of(id, self.version(id).as_deref()) {
            store.forget(id);
        }
        Ok(take(seen.map(|Known { photo, end, .. }| Seen {
            accepted: photo.accepted,
            settings: photo.settings,
            end: end.map(|end| end.outcome),
            damaged,
        })))
    }

    /// Takes up what is `pending` and not known here, the oldest first, until as many photos wait here as may; what is beyond is counted alone.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn take_up(&self, jobs: &Jobs, pending: &[String]) -> io::Result<()> {
        let id_of = |name: &str| name.strip_prefix(PENDING)?.rsplit_once('.')?.1.parse::<PhotoId>().ok();
        let new: Vec<(&String, PhotoId)> = {
            let mut barren = lock(&self.barren);
            barren.keep(pending);
            let ids = pending.iter().filter(|name| !barren.rests(name)).filter_map(|name| Some((name, id_of(name)?)));
            ids.filter(|(_, id)| jobs.is_left_over(*id)).collect()
        };
        let mut rest = new.as_slice();
        // what led to nothing has taken no place
        loop {
            let (part, behind) = rest.split_at(jobs.free_places().min(rest.len()));
            self.beyond.store(behind.len(), Ordering::Relaxed);
            if part.is_empty() {
                return Ok(());
            }
            for ((name, _), is_there) in part.iter().zip(side_by_side(part, |(_, id)| self.refreshed(jobs, *id))) {
                if !is_there? {
                    lock(&self.barren).add(name);
                }
            }
            rest = behind;
        }
    }

    /// Has copies of photos go that were deleted by others, of which this node may not have heard: nobody may have asked for them since.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn drop_copies(&self, jobs: &Jobs) -> io::Result<()> {
        let look = |id: &PhotoId| match self.heard(self.ledger.get(&Photo::name(*id)))? {
            Some(_) => Ok(()),
            None => self.refreshed(jobs, *id).map(drop),
        };
        side_by_side(&jobs.store.copied(), look).into_iter().collect()
    }

    /// Photos that wait beyond those that this node's index has, when that was last looked at.
    pub fn beyond(&self) -> usize {
        self.beyond.load(Ordering::Relaxed)
    }

    /// Forgets what is known of a photo once `take_out` has taken it out of the index, which tells whether it did; not while it is looked up.
    pub fn let_go(&self, id: PhotoId, take_out: impl FnOnce() -> bool) {
        let _looking = match self.looking[lock_of(id)].try_lock() {
            Ok(looking) => looking,
            Err(TryLockError::Poisoned(looking)) => looking.into_inner(),
            Err(TryLockError::WouldBlock) => return,
        };
        if take_out() {
            self.forget(id);
        }
    }

    /// Looks up photos that are not known to have ended though they are no longer `pending`. What was accepted and has no marker, as
    /// where an upload stood still for longer than one is kept without a photo, is marked again.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn compare(&self, jobs: &Jobs, pending: &[String]) -> io::Result<()> {
        let is_open = |known: &Known| known.end.is_none();
        let is_marked = |id: PhotoId, making: &str| pending.binary_search(&Marker::name_of(id, making)).is_ok();
        let mut open: Vec<(PhotoId, String)> =
            self.known().iter().filter(|(_, known)| is_open(known)).map(|(id, known)| (*id, known.photo.making.clone())).collect();
        open.retain(|(id, making)| !is_marked(*id, making));
        open.sort_unstable();
        let mut unmarked = HashSet::new();
        for (id, making) in open {
            self.refreshed(jobs, id)?;
            let still = self.known().get(&id).is_some_and(|known| is_open(known) && known.photo.making == making);
            if !still {
                continue;
            }
            // what was accepted while the list was read has its marker by the next time
            if lock(&self.unmarked).contains(&(id, making.clone())) {
                tracing::error!(%id, "an accepted photo had no marker; it is marked again");
                self.heard(self.mark(id, &making))?;
            } else {
                unmarked.insert((id, making));
            }
        }
        *lock(&self.unmarked) = unmarked;
        Ok(())
    }

    /// Looks a photo up for the index; false where there is none. A record that cannot be understood is told and left alone.
    fn refreshed(&self, jobs: &Jobs, id: PhotoId) -> io::Result<bool> {
        match jobs.refresh(self, id) {
            Err(error) if error.kind() == io::ErrorKind::InvalidData => {
                tracing::error!(%id, %error, "left alone");
                Ok(false)
            }
            other => other.map(|entry| entry.is_some()),
        }
    }
}

/// Does something with each of many on a few threads, as a store answers slowly but many at a time; what it gives in their order. Where all
/// threads of the process that may read are at work, the caller's does it alone.
pub fn side_by_side<T: Sync, R: Send>(all: &[T], what: impl Fn(&T) -> R + Sync) -> Vec<R> {
    /// Threads, with the caller's.
    const READERS: usize = 16;
    /// Threads of the whole process, without the callers'.
    static FREE: Semaphore = Semaphore::const_new(64);
    let next = AtomicUsize::new(0);
    let work = || {
        let each = std::iter::from_fn(|| {
            let at = next.fetch_add(1, Ordering::Relaxed);
            Some((at, what(all.get(at)?)))
        });
        each.collect::<Vec<_>>()
    };
    let mut done = std::thread::scope(|scope| {
        // where no thread can be started, those that are there do it all
        let others = (1..READERS.min(all.len())).map_while(|_| {
            let permit = FREE.try_acquire().ok()?;
            let reader = move || {
                let _permit = permit;
                work()
            };
            std::thread::Builder::new().spawn_scoped(scope, reader).ok()
        });
        let others: Vec<_> = others.collect();
        let mut done = work();
        for other in others {
            done.extend(other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
        }
        done
    });
    done.sort_unstable_by_key(|(at, _)| *at);
    done.into_iter().map(|(_, given)| given).collect()
}

/// Sweeps, looks after what waits and what is followed, and enters what versions before accepted, until the server stops; on threads of its own.
///
/// # Errors
/// No thread can be started.
pub fn keep_up(jobs: &Arc<Jobs>, cluster: &Arc<Cluster>) -> io::Result<()> {
    let (weak, of) = (Arc::downgrade(jobs), Arc::clone(cluster));
    std::thread::Builder::new().name("tmpi-looks".into()).spawn(move || looks(&weak, &of))?;
    let (weak, of) = (Arc::downgrade(jobs), Arc::clone(cluster));
    std::thread::Builder::new().name("tmpi-sweeps".into()).spawn(move || sweeps(&weak, &of))?;
    let (weak, of) = (Arc::downgrade(jobs), Arc::clone(cluster));
    std::thread::Builder::new().name("tmpi-waits".into()).spawn(move || waits(&weak, &of))?;
    let (weak, of) = (Arc::downgrade(jobs), Arc::clone(cluster));
    std::thread::Builder::new().name("tmpi-builds".into()).spawn(move || builds(&weak, &of))?;
    let (weak, of) = (Arc::downgrade(jobs), Arc::clone(cluster));
    std::thread::Builder::new().name("tmpi-copies".into()).spawn(move || copies(&weak, &of))?;
    Ok(())
}

/// Looks after the photos that somebody follows, and lets go of those that nobody needs.
fn looks(jobs: &Weak<Jobs>, cluster: &Cluster) {
    loop {
        std::thread::sleep(TICK);
        let Some(jobs) = jobs.upgrade() else { return };
        cluster.lapse(&jobs);
        jobs.let_go(cluster);
        for entry in jobs.followed() {
            if !cluster.is_fresh(entry.id)
                && let Err(error) = jobs.refresh(cluster, entry.id)
            {
                tracing::debug!(id = %entry.id, %error, "cannot be looked up now");
            }
        }
    }
}

/// Sweeps what is pending.
fn sweeps(jobs: &Weak<Jobs>, cluster: &Cluster) {
    again_and_again(jobs, cluster, 1, |jobs| {
        let listed = Instant::now();
        let pending = cluster.pending()?;
        cluster.sweep(&pending, listed)?;
        cluster.compare(jobs, &pending)
    });
}

/// Takes up what waits; apart from sweeps, as much may be new here.
fn waits(jobs: &Weak<Jobs>, cluster: &Cluster) {
    again_and_again(jobs, cluster, 20, |jobs| cluster.take_up(jobs, &cluster.pending()?));
}

/// Has copies go of what others deleted.
fn copies(jobs: &Weak<Jobs>, cluster: &Cluster) {
    let mut next = Instant::now() + COPIES;
    loop {
        std::thread::sleep(TICK);
        let Some(jobs) = jobs.upgrade() else { return };
        if Instant::now() < next || cluster.is_away() {
            continue;
        }
        if let Err(error) = cluster.drop_copies(&jobs) {
            tracing::debug!(%error, "it is not known which copies are to go");
        }
        next = Instant::now() + COPIES;
    }
}

/// Enters what versions before accepted, until all of it is in the index.
fn builds(jobs: &Weak<Jobs>, cluster: &Cluster) {
    /// Pause after an error, doubled up to its longest.
    const PAUSE: Duration = Duration::from_secs(1);
    const MOST: Duration = Duration::from_mins(1);
    let mut pause = PAUSE;
    while jobs.strong_count() > 0 {
        match cluster.build_on() {
            Ok(true) => return,
            Ok(false) => pause = PAUSE,
            Err(error) => {
                tracing::warn!(%error, "photos of before are not all on the list yet");
                let until = Instant::now() + pause;
                while Instant::now() < until && jobs.strong_count() > 0 {
                    std::thread::sleep(TICK);
                }
                pause = (pause * 2).min(MOST);
            }
        }
    }
}

/// Does `what` until the server stops; after one that took long it rests for `times` as long, up to a minute.
fn again_and_again(jobs: &Weak<Jobs>, cluster: &Cluster, times: u32, what: impl Fn(&Jobs) -> io::Result<()>) {
    const MOST: Duration = Duration::from_mins(1);
    let mut next = Instant::now();
    loop {
        let Some(jobs) = jobs.upgrade() else { return };
        if Instant::now() >= next {
            let began = Instant::now();
            let done = what(&jobs);
            if let Err(error) = &done {
                tracing::warn!(%error, "the store cannot be looked through now");
            }
            // a store that was away is asked soon
            let rest = if done.is_ok() { began.elapsed().saturating_mul(times).min(MOST) } else { Duration::ZERO };
            next = Instant::now() + cluster.sweep_every().max(rest);
        }
        drop(jobs);
        std::thread::sleep(TICK.min(cluster.sweep_every()));
    }
}
