//! Blobs and ledger in a folder: for several processes of one machine, and for the tests of what the ports promise.

use std::fs::{self, File};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use super::ports::{Blobs, Ledger, Tag};
use crate::server::files::{Disk, Files as _, private};
use crate::server::store::digest;

/// A folder of synced files.
#[derive(Debug)]
pub struct Folder {
    root: PathBuf,
    next: AtomicU64,
}

impl Folder {
    /// Opens it, and makes it where it is missing.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn open(root: &Path) -> io::Result<Self> {
        Disk.create_dir(&root.join("coming"), true)?;
        Ok(Self { root: root.to_owned(), next: AtomicU64::new(0) })
    }

    /// Held by whoever changes or removes a record.
    fn lock(&self) -> io::Result<File> {
        let lock = private().create(true).truncate(false).write(true).open(self.root.join("lock"))?;
        lock.lock()?;
        Ok(lock)
    }

    /// A synced file that has no place yet.
    fn coming(&self, bytes: &[u8]) -> io::Result<PathBuf> {
        let name = format!("{}-{}", std::process::id(), self.next.fetch_add(1, Ordering::Relaxed));
        let path = self.root.join("coming").join(name);
        Disk.write(&path, bytes)?;
        Ok(path)
    }

    /// Gives a file its place by `place`, durably.
    fn placed<T>(&self, name: &str, bytes: &[u8], place: impl FnOnce(&Path, &Path) -> io::Result<T>) -> io::Result<T> {
        let to = self.root.join(name);
        let folder = to.parent().unwrap_or(&self.root);
        if !folder.is_dir() {
            Disk.create_dir(folder, true)?;
            Disk.sync_dir(folder.parent().unwrap_or(&self.root))?;
        }
        let coming = self.coming(bytes)?;
        let outcome = place(&coming, &to);
        match Disk.remove(&coming) {
            Err(e) if e.kind() != ErrorKind::NotFound => tracing::warn!(path = %coming.display(), error = %e, "a leftover"),
            _ => {}
        }
        let outcome = outcome?;
        Disk.sync_dir(folder)?;
        Ok(outcome)
    }

    fn gone(&self, name: &str) -> io::Result<()> {
        let path = self.root.join(name);
        match Disk.remove(&path) {
            Ok(()) => Disk.sync_dir(path.parent().unwrap_or(&self.root)),
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(()),
            Err(e) => Err(e),
        }
    }
}

impl Blobs for Folder {
    fn put(&self, name: &str, bytes: Vec<u8>) -> io::Result<()> {
        self.placed(name, &bytes, |from, to| Disk.rename(from, to))
    }

    fn read(&self, name: &str) -> io::Result<Vec<u8>> {
        fs::read(self.root.join(name))
    }

    fn discard(&self, name: &str) -> io::Result<()> {
        self.gone(name)
    }
}

impl Ledger for Folder {
    fn create(&self, name: &str, bytes: &[u8]) -> io::Result<bool> {
        // a second name for a whole file: of all who try one succeeds
        self.placed(name, bytes, |from, to| match fs::hard_link(from, to) {
            Ok(()) => Ok(true),
            Err(e) if e.kind() == ErrorKind::AlreadyExists => Ok(false),
            Err(e) => Err(e),
        })
    }

    fn get(&self, name: &str) -> io::Result<Option<(Vec<u8>, Tag)>> {
        match fs::read(self.root.join(name)) {
            Ok(bytes) => Ok(Some((digest(&bytes), bytes)).map(|(tag, bytes)| (bytes, Tag(tag)))),
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
            Err(e) => Err(e),
        }
    }

    fn swap(&self, name: &str, seen: &Tag, bytes: &[u8]) -> io::Result<bool> {
        let _lock = self.lock()?;
        if self.get(name)?.is_none_or(|(_, tag)| tag != *seen) {
            return Ok(false);
        }
        self.placed(name, bytes, |from, to| Disk.rename(from, to))?;
        Ok(true)
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        let _lock = self.lock()?;
        self.gone(name)
    }

    fn page(&self, folder: &str, after: Option<&str>, limit: usize) -> io::Result<Vec<String>> {
        let mut names = match Disk.names(&self.root.join(folder)) {
            Ok(names) => names,
            Err(e) if e.kind() == ErrorKind::NotFound => Vec::new(),
            Err(e) => return Err(e),
        };
        names.iter_mut().for_each(|name| name.insert_str(0, folder));
        names.retain(|name| after.is_none_or(|after| name.as_str() > after));
        names.sort_unstable();
        names.truncate(limit);
        Ok(names)
    }
}
