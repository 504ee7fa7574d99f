//! Copies of what lies in a store of many nodes: fetched when they are asked for, and the ones that nobody asked for longest go first.

use std::collections::HashMap;
use std::fs::File;
use std::io;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use super::{Part, Store, TEMPORARY};
use crate::server::id::PhotoId;

/// Tries to open a copy that others may remove meanwhile.
const TRIES: u32 = 4;

/// Where the truth lies of which this store has copies.
pub trait Origin: std::fmt::Debug + Send + Sync + 'static {
    /// The bytes of a file of a photo as it is now; blocks.
    ///
    /// # Errors
    /// There is none, or it cannot be reached.
    fn fetch(&self, id: PhotoId, part: Part) -> io::Result<Vec<u8>>;

    /// What tells one making of a photo from another.
    fn version(&self, id: PhotoId) -> Option<String>;
}

/// Copies of files, and what they take.
#[derive(Debug)]
pub(super) struct Copies {
    origin: Arc<dyn Origin>,
    /// Bytes that they may take.
    most: u64,
    held: Mutex<Held>,
}

#[derive(Debug, Default)]
struct Held {
    photos: HashMap<PhotoId, Copied>,
    bytes: u64,
}

/// Copies of a photo's files.
#[derive(Debug)]
struct Copied {
    bytes: u64,
    /// When they were asked for last.
    used: Instant,
    /// Of which making.
    version: Option<String>,
}

impl Store {
    /// Has it keep copies of at most `most` bytes of what lies at `origin`.
    #[must_use]
    pub fn of_origin(self, origin: Arc<dyn Origin>, most: u64) -> Self {
        Self { copies: Some(Copies { origin, most, held: Mutex::default() }), ..self }
    }

    /// Opens a file of a photo, which is fetched where it lies elsewhere.
    ///
    /// # Errors
    /// As [`File::open`], and the origin's.
    pub fn open_part(&self, id: PhotoId, part: Part) -> io::Result<File> {
        self.fetched(id, part, |path| File::open(path))
    }

    /// Does something with the path of a file, which is fetched before where it lies elsewhere.
    pub(super) fn fetched<T>(&self, id: PhotoId, part: Part, then: impl Fn(&PathBuf) -> io::Result<T>) -> io::Result<T> {
        let path = self.path(id, part);
        let Some(copies) = &self.copies else { return then(&path) };
        if !self.is_copy_of(id, copies.origin.version(id).as_deref()) {
            self.forget(id);
        }
        let mut tries = 0;
        loop {
            tries += 1;
            match then(&path) {
                // those that are too many may go before they are read
                Err(e) if e.kind() == io::ErrorKind::NotFound && tries < TRIES => copies.fetch(self, id, part)?,
                done => {
                    copies.used(id);
                    return done;
                }
            }
        }
    }

    /// Forgets the copies of a photo; where this is no store of copies, nothing happens.
    pub fn forget(&self, id: PhotoId) {
        if let Some(copies) = &self.copies {
            copies.held().remove(self, id);
        }
    }

    /// True where there are copies of a photo's files here.
    #[must_use]
    pub fn is_copied(&self, id: PhotoId) -> bool {
        self.copies.as_ref().is_some_and(|copies| copies.held().photos.contains_key(&id))
    }

    /// Photos of which there are copies here.
    #[must_use]
    pub fn copied(&self) -> Vec<PhotoId> {
        self.copies.as_ref().map(|copies| copies.held().photos.keys().copied().collect()).unwrap_or_default()
    }

    /// False where there are copies of another making of a photo here.
    #[must_use]
    pub fn is_copy_of(&self, id: PhotoId, version: Option<&str>) -> bool {
        let of = |copies: &Copies| copies.held().photos.get(&id).is_none_or(|copied| copied.version.as_deref() == version);
        self.copies.as_ref().is_none_or(of)
    }
}

impl Copies {
    fn held(&self) -> std::sync::MutexGuard<'_, Held> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn used(&self, id: PhotoId) {
        if let Some(copied) = self.held().photos.get_mut(&id) {
            copied.used = Instant::now();
        }
    }

    fn fetch(&self, store: &Store, id: PhotoId, part: Part) -> io::Result<()> {
        let version = self.origin.version(id);
        let bytes = self.origin.fetch(id, part)?;
        let mut held = self.held();
        // another making took its place: whoever asks tries again
        if self.origin.version(id) != version {
            return Ok(());
        }
        if held.photos.get(&id).is_some_and(|copied| copied.version != version) {
            held.remove(store, id);
        }
        let (path, folder) = (store.path(id, part), store.folder(id));
        if path.exists() {
            // another thread fetched it
            return Ok(());
        }
        let temporary = folder.join(format!("{}{TEMPORARY}", part.name()));
        loop {
            // a copy need not be durable, only whole
            let written = store.files.create_dir(&folder, true).and_then(|()| std::fs::write(&temporary, &bytes));
            let Err(error) = written.and_then(|()| store.files.rename(&temporary, &path)) else { break };
            // what filled the disk must not keep it full
            let _ = store.files.remove(&temporary);
            if error.kind() != io::ErrorKind::StorageFull || !held.remove_oldest(store, id) {
                return Err(error);
            }
        }
        let copied = held.photos.entry(id).or_insert_with(|| Copied { bytes: 0, used: Instant::now(), version });
        copied.bytes += bytes.len() as u64;
        copied.used = Instant::now();
        held.bytes += bytes.len() as u64;
        while held.bytes > self.most && held.remove_oldest(store, id) {}
        Ok(())
    }
}

impl Held {
    /// Removes the copies of the photo that nobody asked for longest, but for those of one; false where there are no others.
    fn remove_oldest(&mut self, store: &Store, but: PhotoId) -> bool {
        let oldest = self.photos.iter().filter(|(id, _)| **id != but).min_by_key(|(_, copied)| copied.used).map(|(id, _)| *id);
        oldest.map(|id| self.remove(store, id)).is_some()
    }

    fn remove(&mut self, store: &Store, id: PhotoId) {
        let Some(copied) = self.photos.remove(&id) else { return };
        self.bytes = self.bytes.saturating_sub(copied.bytes);
        if let Err(error) = store.files.remove(&store.folder(id)) {
            tracing::warn!(%id, %error, "copies cannot be removed now");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gives `bytes` bytes of the version that is set, until it is away.
    #[derive(Debug)]
    struct Far {
        bytes: usize,
        version: Mutex<Option<u8>>,
        fetched: Mutex<usize>,
    }

    impl Origin for Far {
        fn fetch(&self, _: PhotoId, _: Part) -> io::Result<Vec<u8>> {
            *self.fetched.lock().unwrap() += 1;
            let version = self.version.lock().unwrap().ok_or(io::ErrorKind::HostUnreachable)?;
            Ok(vec![version; self.bytes])
        }

        fn version(&self, _: PhotoId) -> Option<String> {
            Some(self.version.lock().unwrap().unwrap_or(1).to_string())
        }
    }

    #[test]
    fn copies_are_of_the_making_that_counts_and_take_no_more_than_they_may() {
        let dir = tempfile::tempdir().unwrap();
        let far = Arc::new(Far { bytes: 100, version: Mutex::new(Some(1)), fetched: Mutex::default() });
        let (store, _) = Store::open(dir.path(), "").unwrap();
        let store = store.of_origin(Arc::clone(&far) as Arc<dyn Origin>, 250);
        let ids = [1, 2, 3].map(|n| PhotoId::of(&[n; 32], None, "", ""));
        let read = |n: usize| store.read(ids[n], Part::Atlas);
        let fetched = || *far.fetched.lock().unwrap();
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| assert_eq!(read(0).unwrap(), vec![1; 100]));
            }
        });
        let before = fetched();
        assert_eq!((read(1).unwrap(), read(0).unwrap()), (vec![1; 100], vec![1; 100]));
        assert_eq!(fetched(), before + 1, "what is here is not fetched");
        read(2).unwrap();
        assert_eq!(ids.map(|id| store.is_copied(id)), [true, false, true], "the one that nobody asked for longest went");
        *far.version.lock().unwrap() = None;
        assert_eq!(read(0).unwrap(), vec![1; 100], "it needs nobody");
        assert_eq!(read(1).unwrap_err().kind(), io::ErrorKind::HostUnreachable);
        *far.version.lock().unwrap() = Some(2);
        assert_eq!(read(0).unwrap(), vec![2; 100], "another making took its place");
    }
}
