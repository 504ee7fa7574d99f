//! Who works on a making: leases on its marker. They are advice; which result counts is decided when it ends.

use std::io;
use std::sync::Mutex;
use std::sync::PoisonError;
use std::time::Duration;

use super::ports::{Hint, Tag};
use super::records::{self, Marker};
use super::{Cluster, Known};
use crate::server::id::PhotoId;
use crate::server::time::now_ms;

/// A marker without a photo is left for that long: its upload may still be on its way.
const ORPHAN_MS: u64 = 3_600_000;
/// Pause after a fault of a server, doubled with each further one, and its longest.
const REPAIR_MS: u64 = 500;
const MOST_REPAIR_MS: u64 = 60_000;

/// What a hint led to.
pub enum Claim {
    /// This node has it now.
    Ours(Held),
    /// Nothing is to be done, or another node has it.
    Over,
    /// Its time has not come.
    Later(Duration),
}

/// A marker that this node holds.
pub struct Held {
    /// The photo.
    pub id: PhotoId,
    /// Its making.
    pub making: String,
    now: Mutex<(Marker, Tag)>,
}

impl Held {
    /// The marker as it was written last.
    pub fn marker(&self) -> Marker {
        self.now.lock().unwrap_or_else(PoisonError::into_inner).0.clone()
    }
}

impl Cluster {
    /// Takes up what a hint names.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn claim(&self, hint: &Hint) -> io::Result<Claim> {
        self.heard(self.claim_it(hint))
    }

    fn claim_it(&self, hint: &Hint) -> io::Result<Claim> {
        let Some((bytes, tag)) = self.ledger.get(&hint.marker)? else { return Ok(Claim::Over) };
        let mut marker: Marker = records::read(&hint.marker, &bytes)?;
        let now = now_ms();
        if marker.due_ms > now {
            // where another has it, the sweep finds it when that one is lost
            let other = marker.node.is_some();
            return Ok(if other { Claim::Over } else { Claim::Later(Duration::from_millis(marker.due_ms - now)) });
        }
        match self.look_up(marker.id)? {
            Some(Known { photo, end: None, .. }) if photo.making == marker.making => {}
            // the node that ended it did not come to remove it
            Some(Known { photo, end: Some(_), .. }) if photo.making == marker.making => {
                self.ledger.remove(&hint.marker)?;
                return Ok(Claim::Over);
            }
            _ => {
                if marker.due_ms + ORPHAN_MS < now {
                    self.ledger.remove(&hint.marker)?;
                }
                return Ok(Claim::Over);
            }
        }
        marker.claims += 1;
        marker.node = Some(self.node.clone());
        marker.due_ms = now + self.lease.as_millis() as u64;
        Ok(match self.put(&hint.marker, &tag, &marker)? {
            Some(tag) => Claim::Ours(Held { id: marker.id, making: marker.making.clone(), now: Mutex::new((marker, tag)) }),
            None => Claim::Over,
        })
    }

    /// Writes a marker; none where it was changed meanwhile.
    fn put(&self, name: &str, seen: &Tag, marker: &Marker) -> io::Result<Option<Tag>> {
        let bytes = serde_json::to_vec_pretty(marker)?;
        self.ledger.swap(name, seen, &bytes)?;
        // what is there tells: a write that was tried again may have met its own outcome
        Ok(self.ledger.get(name)?.filter(|(now, _)| *now == bytes).map(|(_, tag)| tag))
    }

    /// Changes a marker that this node holds; false where it is gone or another's.
    ///
    /// # Errors
    /// The store cannot be reached.
    fn update(&self, held: &Held, change: impl FnOnce(&mut Marker)) -> io::Result<bool> {
        let mut now = held.now.lock().unwrap_or_else(PoisonError::into_inner);
        let mut marker = now.0.clone();
        change(&mut marker);
        let written = self.heard(self.put(&marker.name(), &now.1, &marker))?;
        let ours = written.is_some();
        if let Some(tag) = written {
            *now = (marker, tag);
        }
        Ok(ours)
    }

    /// Keeps a making for this node; false where it is another's by now, has ended, or its photo was deleted.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn extend(&self, held: &Held) -> io::Result<bool> {
        let until = now_ms() + self.lease.as_millis() as u64;
        self.update(held, |marker| marker.due_ms = until)
    }

    /// Gives a making to whoever comes.
    ///
    /// # Errors
    /// The store cannot be reached; it is taken up when the lease has run out.
    pub fn release(&self, held: &Held) -> io::Result<()> {
        let now = now_ms();
        self.update(held, |marker| (marker.node, marker.due_ms) = (None, now)).map(drop)
    }

    /// Counts a try that took down what made the photo, and gives it to whoever comes.
    ///
    /// # Errors
    /// As [`Cluster::release`].
    pub fn crashed(&self, held: &Held) -> io::Result<()> {
        let now = now_ms();
        let change = |marker: &mut Marker| {
            (marker.node, marker.due_ms) = (None, now);
            marker.attempts += 1;
        };
        self.update(held, change).map(drop)
    }

    /// Counts a fault of the server; the photo waits the longer the more often that happened. Gives that time.
    ///
    /// # Errors
    /// As [`Cluster::release`].
    pub fn put_back(&self, held: &Held) -> io::Result<Duration> {
        let pause = REPAIR_MS.saturating_mul(1 << held.marker().faults.min(16)).min(MOST_REPAIR_MS);
        let due = now_ms() + pause;
        let change = |marker: &mut Marker| {
            (marker.node, marker.due_ms) = (None, due);
            marker.faults += 1;
        };
        self.update(held, change)?;
        Ok(Duration::from_millis(pause))
    }

    /// Looks through what is pending, and queues what is overdue: the queue may have lost it, or the node that had it.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn sweep(&self) -> io::Result<()> {
        /// Markers that are looked at, the oldest.
        const MOST: usize = 512;
        for name in self.heard(self.ledger.page(records::PENDING, None, MOST))? {
            let Some((bytes, _)) = self.heard(self.ledger.get(&name))? else { continue };
            let Ok(marker) = records::read::<Marker>(&name, &bytes) else { continue };
            if marker.due_ms <= now_ms() {
                self.queue.push(&Hint { marker: name });
            }
        }
        Ok(())
    }

    /// Time between two sweeps.
    #[must_use]
    pub const fn sweep_every(&self) -> Duration {
        self.sweep
    }
}
