//! The index of a node follows the store, by looking.

use std::collections::HashSet;
use std::io;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use super::records::PHOTOS;
use super::{Cluster, Known};
use crate::server::entry::Entry;
use crate::server::id::PhotoId;
use crate::server::jobs::Jobs;
use crate::server::records::{Accepted, End};
use crate::server::settings::Settings;
use crate::server::store::Store;

/// Pause between two looks at what is to be done.
const TICK: Duration = Duration::from_millis(500);
/// Names of a page of the list.
const PAGE: usize = 1000;

/// What the store says of a photo.
pub struct Seen {
    /// What was accepted.
    pub accepted: Accepted,
    /// What its owner wants of viewers.
    pub settings: Settings,
    /// How the making that counts ended.
    pub end: Option<End>,
}

impl From<Known> for Seen {
    fn from(known: Known) -> Self {
        Self { accepted: known.photo.accepted, settings: known.photo.settings, end: known.end.map(|end| end.end) }
    }
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
        let _looking = self.looking(id);
        let before = self.known().get(&id).map(|known| known.end.clone());
        let seen = self.look(id)?;
        let new = seen.as_ref().map(|known| known.end.clone());
        if before.is_some() && before != new {
            store.forget(id);
        }
        Ok(take(seen.map(Seen::from)))
    }

    /// True where the list was read not long ago.
    pub fn is_listed(&self) -> bool {
        self.rests() || self.listed.lock().is_ok_and(|at| at.is_some_and(|at| at.elapsed() < super::FRESH_ENDED))
    }

    /// Reads the list of all photos: takes over those that are new here, and looks up those that are gone.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn list(&self, jobs: &Jobs) -> io::Result<()> {
        let mut here: HashSet<PhotoId> = jobs.all().iter().map(|entry| entry.id).collect();
        let mut after: Option<String> = None;
        loop {
            let names = self.heard(self.ledger.page(PHOTOS, after.as_deref(), PAGE))?;
            for id in names.iter().filter_map(|name| name.strip_prefix(PHOTOS)?.parse::<PhotoId>().ok()) {
                if !here.remove(&id) {
                    self.refreshed(jobs, id)?;
                }
            }
            after = names.last().filter(|_| names.len() == PAGE).cloned();
            if after.is_none() {
                break;
            }
        }
        let mut gone: Vec<PhotoId> = here.into_iter().collect();
        gone.sort_unstable();
        gone.into_iter().try_for_each(|id| self.refreshed(jobs, id))?;
        if let Ok(mut listed) = self.listed.lock() {
            *listed = Some(Instant::now());
        }
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
    Ok(())
}

/// Looks after the photos that somebody follows.
fn looks(jobs: &Weak<Jobs>, cluster: &Cluster) {
    loop {
        std::thread::sleep(TICK);
        let Some(jobs) = jobs.upgrade() else { return };
        for entry in jobs.all().iter().filter(|entry| entry.is_followed() && !entry.status().is_final()) {
            if !cluster.is_fresh(entry.id)
                && let Err(error) = jobs.refresh(cluster, entry.id)
            {
                tracing::debug!(id = %entry.id, %error, "cannot be looked up now");
            }
        }
    }
}

/// Sweeps what is pending, and reads the list.
fn sweeps(jobs: &Weak<Jobs>, cluster: &Cluster) {
    let mut next = Instant::now();
    loop {
        let Some(jobs) = jobs.upgrade() else { return };
        if Instant::now() >= next {
            next = Instant::now() + cluster.sweep_every();
            if let Err(error) = cluster.sweep().and_then(|()| cluster.list(&jobs)) {
                tracing::warn!(%error, "the store cannot be swept now");
            }
        }
        drop(jobs);
        std::thread::sleep(TICK.min(cluster.sweep_every()));
    }
}
