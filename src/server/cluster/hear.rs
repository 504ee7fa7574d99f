//! What this node makes of what others tell.

use std::collections::HashMap;
use std::io;
use std::sync::{Arc, Weak};
use std::time::Instant;

use super::bus::{News, Note};
use super::claim::Held;
use super::{Cluster, lock};
use crate::server::entry::Entry;
use crate::server::id::PhotoId;
use crate::server::jobs::Jobs;
use tmpi_pipeline::Progress;

/// Photos that other nodes are making, as was heard last.
#[derive(Debug, Default)]
pub struct Elsewhere(HashMap<PhotoId, Heard>);

#[derive(Debug)]
struct Heard {
    making: String,
    claim: u32,
    at: Instant,
}

impl Elsewhere {
    /// Takes what is heard of a making; false where a later claim was heard of already.
    fn takes(&mut self, id: PhotoId, making: &str, claim: u32) -> bool {
        let at = Instant::now();
        if self.0.get(&id).is_some_and(|known| known.making == making && known.claim > claim) {
            return false;
        }
        self.0.insert(id, Heard { making: making.to_owned(), claim, at });
        true
    }

    fn forgets(&mut self, id: PhotoId) {
        self.0.remove(&id);
    }
}

/// Hears what others tell until the server stops, on a thread of its own.
///
/// # Errors
/// No thread can be started.
pub fn hear(jobs: &Arc<Jobs>, cluster: &Arc<Cluster>) -> io::Result<()> {
    let Some(notes) = cluster.bus.as_ref().and_then(super::bus::Bus::heard) else { return Ok(()) };
    let (jobs, cluster): (Weak<Jobs>, _) = (Arc::downgrade(jobs), Arc::clone(cluster));
    let work = move || {
        for note in notes {
            let Some(jobs) = jobs.upgrade() else { return };
            if let Err(error) = cluster.hear(&jobs, note) {
                tracing::debug!(%error, "cannot be looked up now");
            }
        }
    };
    std::thread::Builder::new().name("tmpi-hears".into()).spawn(work).map(drop)
}

impl Cluster {
    /// Takes what another node tells.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub(super) fn hear(&self, jobs: &Jobs, note: Note) -> io::Result<()> {
        let Note { id, making, news } = note;
        if jobs.get(id).is_none() {
            return Ok(());
        }
        let runs_here = jobs.is_running(id);
        match news {
            // who only makes photos need not know of others
            News::Changed if !self.serves && !runs_here => {}
            News::Changed => {
                lock(&self.elsewhere).forgets(id);
                self.look_again(jobs, id)?;
            }
            News::Making { .. } | News::Waiting { .. } if runs_here => {}
            News::Making { claim, stages } => {
                if !self.is_open(id, &making) {
                    // what is known here may be of before
                    self.look_again(jobs, id)?;
                }
                if self.is_open(id, &making) && lock(&self.elsewhere).takes(id, &making, claim)
                    // the look may have put another in place of what was known before
                    && let Some(entry) = jobs.get(id)
                {
                    jobs.made_elsewhere(&entry, stages);
                }
            }
            News::Waiting { claim } => {
                if self.is_open(id, &making)
                    && lock(&self.elsewhere).takes(id, &making, claim)
                    && let Some(entry) = jobs.get(id)
                {
                    jobs.waits_again(&entry);
                }
            }
        }
        Ok(())
    }

    fn look_again(&self, jobs: &Jobs, id: PhotoId) -> io::Result<()> {
        self.stale(id);
        // while the store is away nobody waits for it here: whoever asks for the photo looks later
        if self.is_away() { Ok(()) } else { jobs.refresh(self, id).map(drop) }
    }

    /// True where that making counts and is not known to have ended.
    fn is_open(&self, id: PhotoId, making: &str) -> bool {
        self.known().get(&id).is_some_and(|known| known.photo.making == making && known.end.is_none())
    }

    /// Photos of which nothing was heard for the time of a lease wait again, as far as is known.
    pub(super) fn lapse(&self, jobs: &Jobs) {
        let silent: Vec<PhotoId> = {
            let mut elsewhere = lock(&self.elsewhere);
            let silent = elsewhere.0.iter().filter(|(_, heard)| heard.at.elapsed() > self.lease).map(|(id, _)| *id).collect();
            elsewhere.0.retain(|_, heard| heard.at.elapsed() <= self.lease);
            silent
        };
        for entry in silent.into_iter().filter(|id| !jobs.is_running(*id)).filter_map(|id| jobs.get(id)) {
            jobs.waits_again(&entry);
        }
    }

    /// Tells the others how the making goes on that this node holds.
    pub(super) fn tell_making(&self, held: &Held, entry: &Entry) {
        let stages: Vec<Progress> = entry.live().stages;
        self.tell(held.id, &held.making, News::Making { claim: held.marker().claims, stages });
    }

    /// Tells the others that this node gave a making back.
    pub(super) fn tell_waiting(&self, held: &Held) {
        self.tell(held.id, &held.making, News::Waiting { claim: held.marker().claims });
    }

    /// Tells the others that the store has something new of a photo.
    pub(super) fn tell_changed(&self, id: PhotoId, making: &str) {
        self.tell(id, making, News::Changed);
    }

    fn tell(&self, id: PhotoId, making: &str, news: News) {
        if let Some(bus) = &self.bus {
            bus.tell(&Note { id, making: making.to_owned(), news });
        }
    }
}
