//! The index where the photos are in a store of many nodes: it follows the store as far as it is asked.

use std::sync::Arc;

use super::{Jobs, Submitted};
use crate::server::cluster::{Cluster, Seen};
use crate::server::entry::{Entry, Status};
use crate::server::id::PhotoId;
use crate::server::problem::Problem;
use crate::server::records::{Accepted, Done, End, Found, State};
use crate::server::settings::Settings;
use crate::server::store::{Incoming, Part};
use crate::server::strokes::not_ready;
use axum::http::StatusCode;
use tmpi_pipeline::Progress;

impl Jobs {
    /// Takes over what the store says of a photo, none where it has none.
    pub(in crate::server) fn take_over(&self, id: PhotoId, seen: Option<Seen>) -> Option<Arc<Entry>> {
        let _membership = self.membership();
        let known = self.get(id);
        let Some(Seen { accepted, settings, end, damaged }) = seen else {
            if let Some(entry) = known {
                self.vanish(&entry);
            }
            return None;
        };
        // deleted and uploaded again elsewhere
        let known = known.filter(|entry| {
            let same = entry.accepted == accepted;
            if !same {
                self.vanish(entry);
            }
            same
        });
        let entry = known.unwrap_or_else(|| {
            let state = State::new(0, end.clone());
            let entry = Arc::new(Entry::found(Found { id, accepted, state, settings: settings.clone() }));
            self.lock().insert(&entry);
            entry
        });
        self.is_asked_for(&entry);
        if entry.settings() != settings {
            entry.set_settings(settings);
        }
        match (end, entry.status()) {
            (Some(End::Done(done)), Status::Done(now)) if done == now => {}
            (Some(End::Failed(failed)), Status::Failed(now)) if failed == now => {}
            // what was made is the same, and this node could not read it
            (Some(End::Done(_)), Status::Damaged(_)) if damaged => {}
            (None, Status::Queued | Status::Working) => {}
            (Some(End::Done(done)), _) => entry.set(Status::Done(done)),
            (Some(End::Failed(failed)), _) => entry.set(Status::Failed(failed)),
            (None, _) => entry.set(Status::Queued),
        }
        self.line_up(&entry);
        Some(entry)
    }

    /// Has a photo among those that wait where it waits and there is a place; beyond these it is the store that has it, and a look at what is
    /// pending takes it up later.
    fn line_up(&self, entry: &Arc<Entry>) {
        let mut inner = self.lock();
        let waits = inner.is_waiting(entry);
        match inner.queue.has(entry.id) {
            true if !waits => inner.queue.remove_photo(entry.id),
            false if waits && inner.queue.count() < self.limits.queue => inner.queue.push_photo(entry),
            _ => {}
        }
    }

    /// Takes over how another node goes on with a photo.
    pub(in crate::server) fn made_elsewhere(&self, entry: &Arc<Entry>, stages: Vec<Progress>) {
        let _membership = self.membership();
        entry.follow(stages);
        self.line_up(entry);
    }

    /// A photo that another node was making waits again.
    pub(in crate::server) fn waits_again(&self, entry: &Arc<Entry>) {
        let _membership = self.membership();
        if entry.status() == Status::Working {
            entry.set(Status::Queued);
        }
        self.line_up(entry);
    }

    /// True where this node is making the photo.
    pub(in crate::server) fn is_running(&self, id: PhotoId) -> bool {
        self.lock().running.iter().any(|entry| entry.id == id)
    }

    /// Forgets a photo that is no longer in the store; with membership held.
    fn vanish(&self, entry: &Arc<Entry>) {
        entry.mark_deleted();
        let mut inner = self.lock();
        inner.remove(entry);
        inner.queue.remove_photo(entry.id);
        drop(inner);
        entry.set(Status::Deleted);
        self.store.forget(entry.id);
    }

    /// Whether what was made of a photo is damaged in the store, of which this node may have known and forgotten it; its own copies may be, too.
    fn is_spoilt(&self, id: PhotoId, done: &Done) -> bool {
        let is_damaged = || self.store.damage(id, done).is_some();
        is_damaged() && {
            self.store.forget(id);
            is_damaged()
        }
    }

    /// Takes an upload into the store; see [`Jobs::submit`].
    pub(super) fn submit_shared(
        &self,
        cluster: &Cluster,
        incoming: &Incoming,
        id: PhotoId,
        accepted: &Accepted,
        settings: &Settings,
    ) -> Result<Submitted, Problem> {
        let disk = |e: std::io::Error| Problem::store(&e);
        if let Some(entry) = self.refresh(cluster, id).map_err(disk)? {
            let healed = match entry.status() {
                Status::Damaged(_) => true,
                Status::Done(done) => self.is_spoilt(id, &done),
                _ => false,
            };
            if !healed && !matches!(entry.status(), Status::Failed(_)) {
                return Ok(Submitted { entry, new: false, healed });
            }
            if healed {
                tracing::error!(%id, "what was made of the photo is damaged in the store; it is made again");
            }
            self.room()?;
            cluster.heal(id, uploaded(incoming, accepted).map_err(disk)?).map_err(disk)?;
            cluster.again(id, None).map_err(disk)?;
            entry.set(Status::Queued);
            self.refresh(cluster, id).map_err(disk)?;
            return Ok(Submitted { entry, new: false, healed });
        }
        self.room()?;
        let parts = uploaded(incoming, accepted).map_err(disk)?;
        // last, as it stays in the store's index; which is not waited for with membership held
        let _reserved = self.reserve(cluster, id, accepted)?;
        let new = cluster.accept(id, accepted, settings, parts).map_err(disk)?;
        let entry = self.refresh(cluster, id).map_err(disk)?;
        let entry = entry.ok_or_else(|| Problem::not_found("the photo was deleted meanwhile"))?;
        Ok(Submitted { entry, new, healed: false })
    }

    /// Keeps what a photo's owner wants of viewers; with its gate held.
    ///
    /// # Errors
    /// 412 where another node changed the photo meanwhile, 500, 503 and 507 where the disk or the store fails.
    pub(in crate::server) fn write_settings(&self, id: PhotoId, settings: &Settings) -> Result<(), Problem> {
        let disk = |e: std::io::Error| Problem::store(&e);
        let Some(cluster) = &self.cluster else { return self.store.write_settings(id, settings).map_err(disk) };
        if cluster.set(id, settings).map_err(disk)? { Ok(()) } else { Err(changed()) }
    }

    /// Has a photo of the store made again, with other strokes where those are given; see [`Jobs::touch_up`].
    pub(in crate::server) fn again_shared(&self, cluster: &Cluster, entry: &Entry, strokes: Option<Vec<u8>>) -> Result<(), Problem> {
        if matches!(entry.status(), Status::Queued | Status::Working) {
            return Err(not_ready());
        }
        self.room()?;
        let disk = |e: std::io::Error| Problem::store(&e);
        if !cluster.again(entry.id, strokes).map_err(disk)? {
            return Err(changed());
        }
        self.refresh(cluster, entry.id).map_err(disk)?;
        Ok(())
    }

    /// Brings what is known here of a photo up to date; none where the store has no such photo.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub(in crate::server) fn refresh(&self, cluster: &Cluster, id: PhotoId) -> std::io::Result<Option<Arc<Entry>>> {
        let entry = cluster.refresh(id, |seen| self.take_over(id, seen), &self.store);
        self.let_go(cluster);
        entry
    }

    /// Has the photo counted among those that are being made.
    pub(in crate::server) fn begin(&self, entry: &Arc<Entry>) {
        let mut inner = self.lock();
        inner.queue.remove_photo(entry.id);
        inner.running.push(Arc::clone(entry));
    }

    /// Photos that somebody follows and that have not ended; of the others none is held, so that they may go.
    pub(in crate::server) fn followed(&self) -> Vec<Arc<Entry>> {
        let inner = self.lock();
        inner.by_age.values().filter(|entry| entry.is_followed() && !entry.status().is_final()).cloned().collect()
    }

    /// All photos of the index.
    pub(in crate::server) fn all(&self) -> Vec<Arc<Entry>> {
        self.lock().by_age.values().cloned().collect()
    }
}

/// The files of an upload.
fn uploaded(incoming: &Incoming, accepted: &Accepted) -> std::io::Result<Vec<(Part, Vec<u8>)>> {
    let depth = accepted.depth_bytes.map(|_| Part::Depth);
    [Part::Upload].into_iter().chain(depth).map(|part| Ok((part, std::fs::read(incoming.path(part))?))).collect()
}

/// The answer to who changes what another changed meanwhile.
fn changed() -> Problem {
    Problem::new(StatusCode::PRECONDITION_FAILED, "changed", "the photo was changed meanwhile: look at it again")
}
