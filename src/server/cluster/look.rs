//! The index of a node follows the store, by looking.

use std::collections::HashSet;
use std::io;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use super::ports::unreachable;
use super::records::{Marker, PHOTOS};
use super::{Cluster, Known, lock};
use crate::server::entry::Entry;
use crate::server::id::PhotoId;
use crate::server::jobs::Jobs;
use crate::server::records::{Accepted, End};
use crate::server::settings::Settings;
use crate::server::store::{Origin as _, Store};

/// Pause between two looks at what is to be done.
const TICK: Duration = Duration::from_millis(500);

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

    /// True where the list was read not long ago.
    pub fn is_listed(&self) -> bool {
        self.is_away() || self.listed.lock().is_ok_and(|at| at.is_some_and(|at| at.elapsed() < super::FRESH_ENDED))
    }

    /// Reads the list of all photos: takes over those that are new here, and looks up those that are gone.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn list(&self, jobs: &Jobs) -> io::Result<()> {
        let began = Instant::now();
        let _listing = lock(&self.listing);
        if lock(&self.listed).is_some_and(|at| at >= began) {
            return Ok(());
        }
        let mut here: HashSet<PhotoId> = jobs.all().iter().map(|entry| entry.id).collect();
        let names = self.heard(self.ledger.all(PHOTOS))?;
        for id in names.iter().filter_map(|name| name.strip_prefix(PHOTOS)?.parse::<PhotoId>().ok()) {
            if !here.remove(&id) {
                self.refreshed(jobs, id)?;
            }
        }
        let mut gone: Vec<PhotoId> = here.into_iter().collect();
        gone.sort_unstable();
        gone.into_iter().try_for_each(|id| self.refreshed(jobs, id))?;
        *lock(&self.listed) = Some(Instant::now());
        Ok(())
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

    /// Looks a photo up for the index. A record that cannot be understood is told and left alone.
    fn refreshed(&self, jobs: &Jobs, id: PhotoId) -> io::Result<()> {
        match jobs.refresh(self, id) {
            Err(error) if error.kind() == io::ErrorKind::InvalidData => {
                tracing::error!(%id, %error, "left alone");
                Ok(())
            }
            other => other.map(drop),
        }
    }
}

/// Sweeps, lists and looks after what is followed, until the server stops; on threads of its own.
///
/// # Errors
/// No thread can be started.
pub fn keep_up(jobs: &Arc<Jobs>, cluster: &Arc<Cluster>) -> io::Result<()> {
    let (weak, of) = (Arc::downgrade(jobs), Arc::clone(cluster));
    std::thread::Builder::new().name("tmpi-looks".into()).spawn(move || looks(&weak, &of))?;
    let (weak, of) = (Arc::downgrade(jobs), Arc::clone(cluster));
    std::thread::Builder::new().name("tmpi-sweeps".into()).spawn(move || sweeps(&weak, &of))?;
    let (weak, of) = (Arc::downgrade(jobs), Arc::clone(cluster));
    std::thread::Builder::new().name("tmpi-lists".into()).spawn(move || lists(&weak, &of))?;
    Ok(())
}

/// Looks after the photos that somebody follows.
fn looks(jobs: &Weak<Jobs>, cluster: &Cluster) {
    loop {
        std::thread::sleep(TICK);
        let Some(jobs) = jobs.upgrade() else { return };
        cluster.lapse(&jobs);
        for entry in jobs.all().iter().filter(|entry| entry.is_followed() && !entry.status().is_final()) {
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

/// Reads the list of all photos.
fn lists(jobs: &Weak<Jobs>, cluster: &Cluster) {
    again_and_again(jobs, cluster, 20, |jobs| cluster.list(jobs));
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
