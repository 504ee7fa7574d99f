//! The photos of a node alone, brought into a store that several nodes share.

use std::hash::{BuildHasher, RandomState};
use std::io;
use std::path::Path;
use std::sync::Arc;

use serde::Serialize;

use super::index;
use super::ports::{Blobs, Ledger};
use super::records::{self, Marker, Photo};
use crate::server::access::Secret;
use crate::server::id::PhotoId;
use crate::server::part::Part;
use crate::server::records::{End, Found};
use crate::server::store::{Store, damage_of};
use crate::server::time::now_ms;

/// What was brought into a store, or would be.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Migration {
    /// Photos of the data directory.
    pub photos: usize,
    /// Those that were brought.
    pub brought: usize,
    /// Those that the store had already.
    pub known: usize,
    /// Those of what was brought that the nodes of the store are to make.
    pub pending: usize,
    /// Bytes that were brought.
    pub bytes: u64,
    /// Photos that cannot be read, and were left.
    pub unread: Vec<String>,
    /// Photos of which what was made is damaged: they are made again.
    pub damaged: Vec<String>,
    /// The store's secret is another: links that were given out before open nothing, and who uploads a photo again gets another address.
    pub other_secret: bool,
}

/// Brings all photos of the data directory of a node alone into a store; nothing is removed there, and what the store has already stays as
/// it is, so that it can be run again. With `dry_run` nothing is written. Blocks; called within a runtime.
///
/// # Errors
/// A server works in the directory, the address is not understood, or one of the two cannot be reached.
pub fn migrate(data: &Path, store: &str, dry_run: bool) -> io::Result<Migration> {
    if !data.join("photos").is_dir() {
        return Err(io::Error::new(io::ErrorKind::NotFound, format!("{} is no data directory of a node alone", data.display())));
    }
    let (from, found) = Store::open(data, "")?;
    let (blobs, ledger) = super::open::ports_at(store)?;
    let node = format!("{:016x}", RandomState::new().hash_one(std::process::id()));
    let mut to = Migrator { from, blobs, ledger, node, next: 0, dry_run, migration: Migration::default() };
    to.secret(data)?;
    to.index()?;
    to.migration.unread = to.from.unreadable_ids().iter().map(ToString::to_string).collect();
    to.migration.photos = found.len() + to.migration.unread.len();
    for photo in &found {
        to.photo(photo)?;
    }
    Ok(to.migration)
}

struct Migrator {
    from: Store,
    blobs: Arc<dyn Blobs>,
    ledger: Arc<dyn Ledger>,
    node: String,
    next: u64,
    dry_run: bool,
    migration: Migration,
}

impl Migrator {
    /// Takes the secret along, where there is one and the store has none.
    fn secret(&mut self, data: &Path) -> io::Result<()> {
        let Some(own) = Secret::of_existing(data)? else { return Ok(()) };
        let shared = records::Shared { version: records::VERSION, secret: own.text() };
        if let Some((bytes, _)) = self.ledger.get(records::SECRET)? {
            let there: records::Shared = records::read(records::SECRET, &bytes)?;
            self.migration.other_secret = there.secret != shared.secret;
        } else if !self.dry_run {
            self.migration.other_secret = !self.ledger.create(records::SECRET, &serde_json::to_vec_pretty(&shared)?)?;
        }
        Ok(())
    }

    /// Says that the index has all photos, where there are none yet: it will have those that are brought.
    fn index(&self) -> io::Result<()> {
        if !self.dry_run && self.ledger.page(records::PHOTOS, None, 1)?.is_empty() {
            self.ledger.create(index::BUILT, &serde_json::to_vec_pretty(&index::Built { version: records::VERSION })?)?;
        }
        Ok(())
    }

    fn photo(&mut self, found: &Found) -> io::Result<()> {
        let Found { id, accepted, state, settings } = found;
        let id = *id;
        if self.ledger.get(&Photo::name(id))?.is_some() {
            self.migration.known += 1;
            return if self.dry_run { Ok(()) } else { self.enter(id) };
        }
        // by now, not by when it was accepted: what is under way is told by it from leftovers
        let making = format!("{:013}-{}-{}", now_ms(), self.node, self.next);
        self.next += 1;
        self.put(id, &making, Part::Upload)?;
        if accepted.depth_bytes.is_some() {
            self.put(id, &making, Part::Depth)?;
        }
        let strokes = match self.put(id, &making, Part::Strokes) {
            Ok(name) => Some(name),
            Err(e) if e.kind() == io::ErrorKind::NotFound => None,
            Err(e) => return Err(e),
        };
        let of = format!("{making}-{}-0", self.node);
        let outcome = match &state.end {
            Some(End::Done(done)) => {
                if let Some(damage) = damage_of(&self.from.read(id, Part::Atlas)?, done) {
                    self.migration.damaged.push(format!("{id}: {damage}"));
                    None
                } else {
                    for part in [Part::Atlas, Part::Disparity, Part::Thumbnail, Part::Report] {
                        self.put(id, &of, part)?;
                    }
                    state.end.clone()
                }
            }
            end => end.clone(),
        };
        self.migration.brought += 1;
        self.migration.pending += usize::from(outcome.is_none());
        if self.dry_run {
            return Ok(());
        }
        // what says how far it is, and its place in the lists, before what says that it is there
        index::enter(&*self.ledger, id, accepted, index::made(outcome.as_ref()))?;
        match outcome {
            Some(outcome) => {
                let blobs = format!("{}{of}", records::blobs(id));
                let end = records::End { version: records::VERSION, outcome, blobs };
                self.ledger.create(&records::End::name(id, &making), &serde_json::to_vec_pretty(&end)?)?;
            }
            None => {
                self.ledger.create(&Marker::name_of(id, &making), &serde_json::to_vec_pretty(&Marker::new(id, &making))?)?;
            }
        }
        let (accepted, settings, source) = (accepted.clone(), settings.clone(), making.clone());
        let photo = Photo { version: records::VERSION, accepted, settings, source, making, before: None, strokes };
        // one that a node has accepted meanwhile stays; what was brought of it here is left over
        self.ledger.create(&Photo::name(id), &serde_json::to_vec_pretty(&photo)?)?;
        self.enter(id)
    }

    /// Enters a photo that is there: a node that reads the list takes off what it has at a place of long ago before the photo itself.
    fn enter(&self, id: PhotoId) -> io::Result<()> {
        match self.enter_there(id) {
            Err(error) if error.kind() == io::ErrorKind::InvalidData => {
                tracing::error!(%id, %error, "left alone");
                Ok(())
            }
            entered => entered,
        }
    }

    fn enter_there(&self, id: PhotoId) -> io::Result<()> {
        let name = Photo::name(id);
        let Some((bytes, _)) = self.ledger.get(&name)? else { return Ok(()) };
        let photo: Photo = records::read(&name, &bytes)?;
        let name = records::End::name(id, &photo.making);
        let end = self.ledger.get(&name)?.map(|(bytes, _)| records::read::<records::End>(&name, &bytes)).transpose()?;
        index::enter(&*self.ledger, id, &photo.accepted, index::made(end.as_ref().map(|end| &end.outcome)))
    }

    /// Copies a file of a photo, and gives the name of its blob.
    fn put(&mut self, id: PhotoId, of: &str, part: Part) -> io::Result<String> {
        let (name, bytes) = (records::blob(id, of, part), self.from.read(id, part)?);
        self.migration.bytes += bytes.len() as u64;
        if !self.dry_run {
            self.blobs.put(&name, bytes)?;
        }
        Ok(name)
    }
}

#[cfg(test)]
mod tests {
    use super::super::memory::{self, Memory};
    use super::*;
    use crate::server::access::Owner;
    use crate::server::records::State;
    use crate::server::settings::Settings;

    #[test]
    fn what_a_reader_takes_off_the_list_meanwhile_is_entered_again() {
        let (store, dir, owner) = (Memory::default(), tempfile::tempdir().unwrap(), Owner::of_secret("a"));
        let (id, accepted) = memory::accepted(1, 7, Some(&owner));
        let (from, _) = Store::open(dir.path(), "").unwrap();
        let incoming = from.begin().unwrap();
        std::fs::write(incoming.path(Part::Upload), b"photo").unwrap();
        from.accept(incoming, id, &accepted).unwrap();
        let found = Found { id, accepted, state: State::default(), settings: Settings::default() };
        let (blobs, ledger) = (Arc::new(store.clone()), Arc::new(store.clone()));
        let mut to = Migrator { from, blobs, ledger, node: "ab".into(), next: 0, dry_run: false, migration: Migration::default() };
        let taken_off = {
            let (store, owner) = (store.clone(), owner);
            move || {
                assert_eq!(store.entries().len(), 2, "it is entered before it is there");
                index::leave(&store, (7, id), Some(&owner), &[]).unwrap();
            }
        };
        store.meanwhile(records::PENDING, taken_off.clone());
        to.photo(&found).unwrap();
        assert_eq!((store.entries().len(), to.migration.brought), (2, 1));
        taken_off();
        to.photo(&found).unwrap();
        assert_eq!((store.entries().len(), to.migration.known), (2, 1), "also where it was brought before");
    }
}
