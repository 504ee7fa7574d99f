//! Who works on a making: leases on its marker. They are advice; which result counts is decided when it ends.

use std::collections::HashMap;
use std::io;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use super::ports::{Hint, Tag};
use super::records::{self, Marker};
use super::{Cluster, Known, lock};
use crate::server::id::PhotoId;

/// A marker without a photo is left for that long: its upload may still be on its way.
pub(super) const ORPHAN: Duration = Duration::from_hours(1);
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

/// How long markers were seen unchanged, by this node's own steady clock.
#[derive(Debug, Default)]
pub struct Sightings(HashMap<String, Sighting>);

#[derive(Debug)]
struct Sighting {
    tag: Tag,
    quiet: Duration,
    at: Instant,
}

impl Sightings {
    /// Time for which a record is seen with this tag. Between two looks no more than `most` counts: while the store is away, or this
    /// process stands still, nothing is heard of those who are well.
    fn saw(&mut self, name: &str, tag: &Tag, most: Duration) -> Duration {
        let now = Instant::now();
        if let Some(seen) = self.0.get_mut(name).filter(|seen| seen.tag == *tag) {
            seen.quiet = seen.quiet.saturating_add(now.saturating_duration_since(seen.at).min(most));
            seen.at = now;
            return seen.quiet;
        }
        self.0.insert(name.to_owned(), Sighting { tag: tag.clone(), quiet: Duration::ZERO, at: now });
        Duration::ZERO
    }
}

impl Held {
    /// The marker as it was written last.
    pub fn marker(&self) -> Marker {
        lock(&self.now).0.clone()
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
        let Some((bytes, seen)) = self.ledger.get(&hint.marker)? else { return Ok(Claim::Over) };
        let mut marker: Marker = records::read(&hint.marker, &bytes)?;
        let (quiet, rest) = (self.saw(&marker, &seen), Duration::from_millis(marker.rest_ms));
        if quiet < rest {
            // where another has it, the sweep finds it when that one is lost
            return Ok(if marker.node.is_some() { Claim::Over } else { Claim::Later(rest.saturating_sub(quiet)) });
        }
        match self.read_up(marker.id)? {
            Some(Known { photo, end: None, .. }) if photo.making == marker.making => {}
            // the node that ended it did not come to remove it
            Some(Known { photo, end: Some(_), .. }) if photo.making == marker.making => {
                self.ledger.remove(&hint.marker)?;
                return Ok(Claim::Over);
            }
            _ => {
                if quiet > ORPHAN {
                    self.ledger.remove(&hint.marker)?;
                }
                return Ok(Claim::Over);
            }
        }
        marker.claims += 1;
        marker.node = Some(self.node.clone());
        marker.rest_ms = self.lease.as_millis() as u64;
        let (id, making) = (marker.id, marker.making.clone());
        let written = self.write_over(&hint.marker, &seen, &serde_json::to_vec_pretty(&marker)?)?;
        Ok(written.map_or(Claim::Over, |tag| Claim::Ours(Held { id, making, now: Mutex::new((marker, tag)) })))
    }

    /// How long a marker has been seen as it is now.
    fn saw(&self, marker: &Marker, tag: &Tag) -> Duration {
        let most = if marker.node.is_some() { Duration::from_millis(marker.rest_ms / 4) } else { Duration::MAX };
        lock(&self.sightings).saw(&marker.name(), tag, most)
    }

    /// Changes a marker that this node holds; false where it is gone or another's.
    ///
    /// # Errors
    /// The store cannot be reached.
    fn update(&self, held: &Held, change: impl FnOnce(&mut Marker)) -> io::Result<bool> {
        self.heard(self.update_it(held, change))
    }

    fn update_it(&self, held: &Held, change: impl FnOnce(&mut Marker)) -> io::Result<bool> {
        let mut now = lock(&held.now);
        let (mut marker, mut seen) = now.clone();
        change(&mut marker);
        let (name, bytes) = (marker.name(), serde_json::to_vec_pretty(&marker)?);
        let mut written = self.write_over(&name, &seen, &bytes)?;
        if written.is_none() {
            // what is there may be ours: a write before this one of which the answer was lost
            let Some((there, tag)) = self.ledger.get(&name)? else { return Ok(false) };
            let there: Marker = records::read(&name, &there)?;
            if there.node != now.0.node || there.claims != now.0.claims {
                return Ok(false);
            }
            seen = tag;
            written = self.write_over(&name, &seen, &bytes)?;
        }
        let Some(tag) = written else { return Ok(false) };
        // a pause begins now, also here
        self.saw(&marker, &tag);
        *now = (marker, tag);
        Ok(true)
    }

    /// Keeps a making for this node; false where it is another's by now, has ended, or its photo was deleted.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn extend(&self, held: &Held) -> io::Result<bool> {
        self.update(held, |marker| marker.beats += 1)
    }

    /// Gives a making to whoever comes.
    ///
    /// # Errors
    /// The store cannot be reached; it is taken up when the lease has run out.
    pub fn release(&self, held: &Held) -> io::Result<()> {
        self.update(held, |marker| (marker.node, marker.rest_ms) = (None, 0)).map(drop)
    }

    /// Counts a try that took down what made the photo, and gives it to whoever comes.
    ///
    /// # Errors
    /// As [`Cluster::release`].
    pub fn crashed(&self, held: &Held) -> io::Result<()> {
        let change = |marker: &mut Marker| {
            (marker.node, marker.rest_ms) = (None, 0);
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
        let change = |marker: &mut Marker| {
            (marker.node, marker.rest_ms) = (None, pause);
            marker.faults += 1;
        };
        self.update(held, change)?;
        Ok(Duration::from_millis(pause))
    }

    /// Names of all that is pending, in order.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn pending(&self) -> io::Result<Vec<String>> {
        self.heard(self.ledger.all(records::PENDING))
    }

    /// Looks through what was `pending` when it was `listed` and queues what is nobody's: the queue may have lost it, or the node that
    /// had it.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn sweep(&self, pending: &[String], listed: Instant) -> io::Result<()> {
        /// Markers that are read at a time; the next sweep goes on behind them.
        const MOST: usize = 512;
        if !self.makes {
            return Ok(());
        }
        self.queue.keep(pending, listed);
        lock(&self.sightings).0.retain(|name, _| pending.binary_search(name).is_ok());
        let first = pending.partition_point(|name| *name <= *lock(&self.cursor));
        let mut read = 0;
        for name in pending[first..].iter().chain(&pending[..first]) {
            let hint = Hint { marker: name.clone() };
            if self.queue.has(&hint) {
                continue;
            }
            read += 1;
            if read > MOST {
                break;
            }
            lock(&self.cursor).clone_from(name);
            let Some((bytes, tag)) = self.heard(self.ledger.get(name))? else { continue };
            match records::read::<Marker>(name, &bytes) {
                Ok(marker) if self.saw(&marker, &tag) >= Duration::from_millis(marker.rest_ms) => self.queue.push(&hint),
                // told once, and left alone
                Err(error) if lock(&self.sightings).saw(name, &tag, Duration::MAX).is_zero() => tracing::error!(%error, "left alone"),
                _ => {}
            }
        }
        // what fits into one sweep is looked at from the oldest on
        if read <= MOST {
            lock(&self.cursor).clear();
        }
        Ok(())
    }

    /// Time between two sweeps.
    #[must_use]
    pub const fn sweep_every(&self) -> Duration {
        self.sweep
    }
}
