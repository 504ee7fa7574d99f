//! Several nodes on one store: what was accepted and what was made lies in the store, which is the truth; a queue is a
//! hint and may lose everything. What a node has on its own disk and in its memory are copies: of the photos that were asked for last, however many
//! the store has. Lists and sums go by an index there.

mod audit;
mod bus;
mod claim;
mod folder;
mod hear;
mod index;
mod jetstream;
mod local;
mod look;
mod names;
mod objects;
mod open;
mod origin;
mod ports;
mod records;
mod work;

use std::collections::{HashMap, HashSet};
use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};
use std::io;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::access::Secret;
use super::id::PhotoId;
use super::part::Part;
use super::records::Accepted;
use super::settings::Settings;
use super::store::Origin as _;
use super::time::now_ms;
use bus::Bus;
use claim::Sightings;
use hear::Elsewhere;
use ports::{Blobs, Figure, Hint, Ledger, Queue, Tag};
use records::{End, Marker, Photo};

pub use audit::{Audit, Remedy, audit};
pub use hear::hear;
pub use index::{Place, stem};
pub use look::{Seen, keep_up, side_by_side};
pub use open::{Nats, Role, Sharing, check_store};
pub use work::work;

/// Age at which what is known of a photo is looked up again, while it is being made and once it has ended.
const FRESH: Duration = Duration::from_millis(500);
const FRESH_ENDED: Duration = Duration::from_secs(5);
/// Locks of photos.
const LOCKS: usize = 64;

/// What is known here of a photo.
#[derive(Clone, Debug)]
struct Known {
    photo: Photo,
    tag: Tag,
    end: Option<End>,
    looked: Instant,
}

/// A node among others.
#[derive(Debug)]
pub struct Cluster {
    blobs: Arc<dyn Blobs>,
    ledger: Arc<dyn Ledger>,
    queue: Arc<dyn Queue>,
    /// What the others tell at once, where there is NATS.
    bus: Option<Bus>,
    node: String,
    next: AtomicU64,
    /// Of the photos that the node's index has, and of those alone once each look is over.
    known: Mutex<HashMap<PhotoId, Known>>,
    /// Versions of some of these that are damaged in the store, as this node found.
    damaged: Mutex<HashMap<PhotoId, String>>,
    /// Held while a photo is looked up or its record changed, so that nothing older is taken for newer. Taken after an entry's gate and before
    /// the index's locks, and one at a time: another photo may have the same.
    looking: [Mutex<()>; LOCKS],
    /// When the store could not be reached last, until it answers.
    away: Mutex<Option<Instant>>,
    /// The index of the store has all photos.
    built: AtomicBool,
    /// Photos that wait beyond those that this node's index has.
    beyond: AtomicUsize,
    sightings: Mutex<Sightings>,
    /// The marker that was looked at last.
    cursor: Mutex<String>,
    /// Makings of which no marker was seen.
    unmarked: Mutex<HashSet<(PhotoId, String)>>,
    /// Markers without a photo that can be read.
    barren: Mutex<look::Barren>,
    elsewhere: Mutex<Elsewhere>,
    makes: bool,
    serves: bool,
    lease: Duration,
    sweep: Duration,
}

impl Cluster {
    /// Names, meanings and values of what is counted where there is NATS; nothing elsewhere.
    pub fn counts(&self) -> Vec<Figure> {
        let mut counts = self.queue.counts();
        counts.extend(self.bus.as_ref().map(Bus::counts).unwrap_or_default());
        counts
    }

    fn known(&self) -> MutexGuard<'_, HashMap<PhotoId, Known>> {
        lock(&self.known)
    }

    /// A name that no other making has; later ones are greater.
    fn making(&self) -> String {
        format!("{:013}-{}-{}", now_ms(), self.node, self.next.fetch_add(1, Ordering::Relaxed))
    }

    fn looking(&self, id: PhotoId) -> MutexGuard<'_, ()> {
        lock(&self.looking[lock_of(id)])
    }

    /// Whether the store can be reached.
    ///
    /// # Errors
    /// Why not.
    pub fn check(&self) -> io::Result<()> {
        self.heard(self.ledger.page(records::PENDING, None, 1)).map(drop)
    }

    /// The secret of all nodes of the store; made where there is none.
    ///
    /// # Errors
    /// The store cannot be reached, or what it has is none.
    pub fn secret(&self) -> io::Result<Secret> {
        let wrong = || io::Error::new(io::ErrorKind::InvalidData, format!("the record {}: no secret", records::SECRET));
        if self.ledger.get(records::SECRET)?.is_none() {
            let fresh = records::Shared { version: records::VERSION, secret: Secret::fresh()?.text() };
            // of any number who try at a time one succeeds, and what it wrote is read by all
            self.ledger.create(records::SECRET, &serde_json::to_vec_pretty(&fresh)?)?;
        }
        let (bytes, _) = self.ledger.get(records::SECRET)?.ok_or_else(wrong)?;
        let shared: records::Shared = records::read(records::SECRET, &bytes)?;
        Secret::read(&shared.secret).ok_or_else(wrong)
    }

    /// Remembers whether the store answered.
    fn heard<T>(&self, answer: io::Result<T>) -> io::Result<T> {
        let away = answer.as_ref().is_err_and(|e| e.kind() == io::ErrorKind::HostUnreachable);
        *lock(&self.away) = away.then(Instant::now);
        answer
    }

    /// True from when the store could not be reached until it answers: where that can wait it is not asked meanwhile. Sweeps ask it.
    pub fn is_away(&self) -> bool {
        lock(&self.away).is_some()
    }

    /// Reads what the store has of a photo; with `looking` held.
    fn look(&self, id: PhotoId) -> io::Result<Option<Known>> {
        self.heard(self.look_up(id))
    }

    fn look_up(&self, id: PhotoId) -> io::Result<Option<Known>> {
        let read = self.read_up(id)?;
        match &read {
            Some(known) => drop(self.known().insert(id, known.clone())),
            None => self.forget(id),
        }
        Ok(read)
    }

    /// Forgets what is known of a photo.
    fn forget(&self, id: PhotoId) {
        self.known().remove(&id);
        lock(&self.damaged).remove(&id);
    }

    /// Reads what the store has of a photo, and keeps nothing of it.
    fn read_up(&self, id: PhotoId) -> io::Result<Option<Known>> {
        let name = Photo::name(id);
        // before it is read: what is changed meanwhile may not be seen
        let looked = Instant::now();
        let Some((bytes, tag)) = self.ledger.get(&name)? else { return Ok(None) };
        let photo: Photo = records::read(&name, &bytes)?;
        let before = self.known().get(&id).filter(|known| known.photo.making == photo.making).and_then(|known| known.end.clone());
        let end = if before.is_some() {
            // it does not change any more
            before
        } else {
            let name = End::name(id, &photo.making);
            self.ledger.get(&name)?.map(|(bytes, _)| records::read(&name, &bytes)).transpose()?
        };
        Ok(Some(Known { photo, tag, end, looked }))
    }

    /// True where what is known of a photo need not be looked up again.
    pub fn is_fresh(&self, id: PhotoId) -> bool {
        let away = self.is_away();
        self.known().get(&id).is_some_and(|known| {
            let most = if known.end.is_some() { FRESH_ENDED } else { FRESH };
            away || known.looked.elapsed() < most
        })
    }

    /// Has a photo looked up again when it is asked for next.
    fn stale(&self, id: PhotoId) {
        if let Some(known) = self.known().get_mut(&id)
            && let Some(long_ago) = known.looked.checked_sub(FRESH_ENDED)
        {
            known.looked = long_ago;
        }
    }

    /// Keeps an upload in the store; when this returns, it is accepted. False where the photo was there already.
    ///
    /// # Errors
    /// The store cannot be reached: nothing was accepted, as far as is known.
    pub fn accept(&self, id: PhotoId, accepted: &Accepted, settings: &Settings, parts: Vec<(Part, Vec<u8>)>) -> io::Result<bool> {
        self.heard(self.accept_in(id, accepted, settings, parts))
    }

    fn accept_in(&self, id: PhotoId, accepted: &Accepted, settings: &Settings, parts: Vec<(Part, Vec<u8>)>) -> io::Result<bool> {
        let making = self.making();
        for (part, bytes) in parts {
            self.blobs.put(&records::blob(id, &making, part), bytes)?;
        }
        let (accepted, settings, source) = (accepted.clone(), settings.clone(), making.clone());
        let photo = Photo { version: records::VERSION, accepted, settings, source, making: making.clone(), before: None, strokes: None };
        // the marker first: what is accepted without one nobody would make; and its place in the lists
        let hint = self.mark(id, &making)?;
        index::enter(&*self.ledger, id, &photo.accepted, 0)?;
        let created = self.ledger.create(&Photo::name(id), &serde_json::to_vec_pretty(&photo)?)?;
        // an answer that was lost on its way may have been tried again, against its own outcome
        let there = if created { None } else { self.read_up(id)?.map(|known| known.photo) };
        let ours = created || there.as_ref().is_some_and(|there| there.making == making);
        if ours {
            self.queue.offer(&hint);
            self.stale(id);
        } else {
            // a twin of the same millisecond has the same place
            if there.is_none_or(|there| index::stem((there.accepted.at_ms, id)) != index::stem((photo.accepted.at_ms, id))) {
                index::leave(&*self.ledger, (photo.accepted.at_ms, id), photo.accepted.owner.as_ref(), &[])?;
            }
            self.discard(id, std::slice::from_ref(&making), &[]);
            self.ledger.remove(&hint.marker)?;
        }
        Ok(ours)
    }

    /// Marks a making as pending.
    fn mark(&self, id: PhotoId, making: &str) -> io::Result<Hint> {
        let marker = Marker::new(id, making);
        let name = marker.name();
        self.ledger.create(&name, &serde_json::to_vec_pretty(&marker)?)?;
        Ok(Hint { marker: name })
    }

    /// Has a photo made again, with other strokes where those are given; false where it was changed or deleted meanwhile.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn again(&self, id: PhotoId, strokes: Option<Vec<u8>>) -> io::Result<bool> {
        let Some(Known { mut photo, tag, .. }) = self.known().get(&id).cloned() else { return Ok(false) };
        let making = self.making();
        if let Some(bytes) = strokes {
            let name = records::blob(id, &making, Part::Strokes);
            self.blobs.put(&name, bytes)?;
            photo.strokes = Some(name);
        }
        let hint = self.mark(id, &making)?;
        photo.before = Some(std::mem::replace(&mut photo.making, making));
        let swapped = self.swap(id, &tag, &photo)?;
        if swapped {
            self.queue.offer(&hint);
            self.tell_changed(id, &photo.making);
        } else {
            self.ledger.remove(&hint.marker)?;
        }
        Ok(swapped)
    }

    /// Sets what a photo's owner wants of viewers; false where the photo was changed or deleted meanwhile.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn set(&self, id: PhotoId, settings: &Settings) -> io::Result<bool> {
        let Some(Known { mut photo, tag, .. }) = self.known().get(&id).cloned() else { return Ok(false) };
        photo.settings = settings.clone();
        let swapped = self.swap(id, &tag, &photo)?;
        if swapped {
            self.tell_changed(id, &photo.making);
        }
        Ok(swapped)
    }

    fn swap(&self, id: PhotoId, seen: &Tag, photo: &Photo) -> io::Result<bool> {
        let _looking = self.looking(id);
        let swapped = self.heard(self.write_over(&Photo::name(id), seen, &serde_json::to_vec_pretty(photo)?))?;
        self.stale(id);
        Ok(swapped.is_some())
    }

    /// Writes a record in place of what was seen, and gives its tag; none where it is another by now.
    fn write_over(&self, name: &str, seen: &Tag, bytes: &[u8]) -> io::Result<Option<Tag>> {
        if let Some(tag) = self.ledger.swap(name, seen, bytes)? {
            return Ok(Some(tag));
        }
        // what is there tells: a write that was tried again may have met its own outcome
        Ok(self.ledger.get(name)?.filter(|(now, _)| now == bytes).map(|(_, tag)| tag))
    }

    /// Keeps what was uploaded once more: what the store has of it may be damaged.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn heal(&self, id: PhotoId, parts: Vec<(Part, Vec<u8>)>) -> io::Result<()> {
        let Some(Known { photo, .. }) = self.known().get(&id).cloned() else { return Ok(()) };
        parts.into_iter().try_for_each(|(part, bytes)| self.heard(self.blobs.put(&records::blob(id, &photo.source, part), bytes)))
    }

    /// Remembers that what was made of a photo is damaged in the store.
    pub fn note_damage(&self, id: PhotoId) {
        if let Some(version) = self.version(id) {
            lock(&self.damaged).insert(id, version);
        }
    }

    fn is_damaged(&self, id: PhotoId) -> bool {
        self.version(id).is_some_and(|version| lock(&self.damaged).get(&id) == Some(&version))
    }

    /// Removes a photo from the store: its record first, so that it is gone when this returns, whatever is left of the rest. With `at_ms` only the
    /// upload that was accepted then, in milliseconds since 1970: false where there is none, or another.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn remove(&self, id: PhotoId, at_ms: Option<u64>) -> io::Result<bool> {
        let looking = self.looking(id);
        let known = self.look(id)?;
        // deleted meanwhile, and perhaps uploaded again
        if at_ms.is_some_and(|at_ms| known.as_ref().is_none_or(|known| known.photo.accepted.at_ms != at_ms)) {
            return Ok(false);
        }
        self.heard(self.ledger.remove(&Photo::name(id)))?;
        self.forget(id);
        drop(looking);
        let Some(Known { photo, .. }) = known else { return Ok(true) };
        // whoever makes it stops
        self.tell_changed(id, &photo.making);
        if let Err(error) = index::leave(&*self.ledger, (photo.accepted.at_ms, id), photo.accepted.owner.as_ref(), &[]) {
            tracing::warn!(%id, %error, "a deleted photo is on the list until that is read");
        }
        let makings: Vec<String> = [Some(photo.source), Some(photo.making), photo.before].into_iter().flatten().collect();
        for making in &makings {
            for record in [Marker::name_of(id, making), End::name(id, making)] {
                if let Err(error) = self.ledger.remove(&record) {
                    tracing::warn!(%id, record, %error, "left behind of a deleted photo");
                }
            }
        }
        self.discard(id, &makings, &[]);
        if let Some(strokes) = photo.strokes {
            let _ = self.blobs.discard(&strokes);
        }
        Ok(true)
    }

    /// Removes the blobs of makings, without those to `keep`; what cannot be removed stays behind.
    fn discard(&self, id: PhotoId, makings: &[String], keep: &[&str]) {
        let folder = records::blobs(id);
        let is_of = |name: &str, making: &String| {
            let rest = name.strip_prefix(&folder).and_then(|name| name.strip_prefix(making.as_str()));
            rest.is_some_and(|rest| rest.starts_with(['.', '-']))
        };
        let of = |name: &str| makings.iter().any(|making| is_of(name, making));
        let removed = self.ledger.all(&folder).and_then(|names| {
            for name in names.iter().filter(|name| of(name) && !keep.contains(&name.as_str())) {
                self.blobs.discard(name)?;
            }
            Ok(())
        });
        if let Err(error) = removed {
            tracing::warn!(%id, %error, "blobs are left behind");
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Which lock is a photo's.
fn lock_of(id: PhotoId) -> usize {
    BuildHasherDefault::<DefaultHasher>::default().hash_one(id) as usize % LOCKS
}

#[cfg(test)]
mod google;
#[cfg(test)]
mod index_tests;
#[cfg(test)]
pub mod memory;
#[cfg(test)]
mod tests;
