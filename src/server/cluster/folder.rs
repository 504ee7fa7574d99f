//! Blobs and ledger in a folder: for several processes of one machine, and for the tests of what the ports promise.
//!
//! A file gets its place by a rename or a second name, so that it is whole or not there.

use std::collections::BinaryHeap;
use std::fs::{self, File};
use std::hash::{BuildHasher, RandomState};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use super::index::OWNERS;
use super::ports::{Blobs, Ledger, Tag, unreachable};
use super::records::BLOBS;
use crate::server::files::{Disk, Files as _, private};
use crate::server::store::digest;

/// Age from which a file that has no place yet is nobody's.
const LEFT: Duration = Duration::from_hours(24);

/// The first names after one, of any number that are shown in any order: no more are kept.
struct First<'a> {
    after: Option<&'a str>,
    limit: usize,
    /// The last of them on top.
    names: BinaryHeap<String>,
}

impl First<'_> {
    fn take(&mut self, name: String) {
        if self.after.is_some_and(|after| name.as_str() <= after) {
            return;
        }
        self.names.push(name);
        if self.names.len() > self.limit {
            self.names.pop();
        }
    }
}

/// A folder of synced files.
#[derive(Debug)]
pub struct Folder {
    root: PathBuf,
    /// Tells this process from others, which may have the same number in a namespace of their own.
    own: u64,
    next: AtomicU64,
}

impl Folder {
    /// Opens it, and makes it where it is missing.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn open(root: &Path) -> io::Result<Self> {
        let coming = root.join("coming");
        Disk.create_dir(&coming, true)?;
        // of processes that ended before they gave them a place
        for entry in fs::read_dir(&coming)?.flatten() {
            if entry.metadata().and_then(|of| of.modified()).is_ok_and(|at| at.elapsed().is_ok_and(|age| age > LEFT)) {
                let _ = Disk.remove(&entry.path());
            }
        }
        Ok(Self { root: root.to_owned(), own: RandomState::new().hash_one(std::process::id()), next: AtomicU64::new(0) })
    }

    /// What it means that there is no such file: nothing where the folder itself is gone, as a disk that is not mounted.
    fn missing(&self, error: io::Error) -> io::Error {
        if error.kind() == ErrorKind::NotFound && !self.root.join("coming").is_dir() { unreachable(error) } else { error }
    }

    /// Held by whoever changes or removes a record.
    fn lock(&self) -> io::Result<File> {
        let lock = private().create(true).truncate(false).write(true).open(self.root.join("lock")).map_err(|e| self.missing(e))?;
        lock.lock()?;
        Ok(lock)
    }

    /// A synced file that has no place yet.
    fn coming(&self, bytes: &[u8]) -> io::Result<PathBuf> {
        let name = format!("{:016x}-{}", self.own, self.next.fetch_add(1, Ordering::Relaxed));
        let path = self.root.join("coming").join(name);
        match Disk.write(&path, bytes) {
            Ok(()) => Ok(path),
            Err(e) => {
                // what filled the disk must not keep it full
                let _ = Disk.remove(&path);
                Err(self.missing(e))
            }
        }
    }

    /// Gives a file its place by `place`, durably.
    fn placed<T>(&self, name: &str, bytes: &[u8], place: impl Fn(&Path, &Path) -> io::Result<T>) -> io::Result<T> {
        let to = self.root.join(name);
        let folder = to.parent().unwrap_or(&self.root);
        let coming = self.coming(bytes)?;
        let enter = || {
            if !folder.is_dir() {
                Disk.create_dir(folder, true)?;
                Disk.sync_dir(folder.parent().unwrap_or(&self.root))?;
            }
            place(&coming, &to)
        };
        // an empty folder may be tidied away just before
        let outcome = match enter() {
            Err(e) if e.kind() == ErrorKind::NotFound && !folder.is_dir() => enter(),
            outcome => outcome,
        };
        match Disk.remove(&coming) {
            Err(e) if e.kind() != ErrorKind::NotFound => tracing::warn!(path = %coming.display(), error = %e, "a leftover"),
            _ => {}
        }
        let outcome = outcome?;
        Disk.sync_dir(folder)?;
        Ok(outcome)
    }

    /// Shows the names of all files within a folder, and within those in it, to `first`.
    fn names(&self, folder: &str, first: &mut First<'_>) -> io::Result<()> {
        let entries = match fs::read_dir(self.root.join(folder)).map_err(|e| self.missing(e)) {
            Ok(entries) => entries,
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(()),
            Err(e) => return Err(e),
        };
        for entry in entries {
            let entry = entry?;
            // a name that is no text is nobody's here
            let name = format!("{folder}{}", entry.file_name().to_string_lossy());
            if entry.file_type()?.is_dir() { self.names(&format!("{name}/"), first)? } else { first.take(name) }
        }
        Ok(())
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
        fs::read(self.root.join(name)).map_err(|e| self.missing(e))
    }

    fn discard(&self, name: &str) -> io::Result<()> {
        self.gone(name)
    }

    fn tidy(&self, age: Duration) -> io::Result<usize> {
        let is_old = |of: &fs::Metadata| of.modified().is_ok_and(|at| at.elapsed().is_ok_and(|since| since > age));
        let mut removed = 0;
        for above in [BLOBS, OWNERS] {
            let folders = match fs::read_dir(self.root.join(above)) {
                Err(e) if e.kind() == ErrorKind::NotFound => continue,
                folders => folders?,
            };
            let old = folders.flatten().filter(|entry| entry.metadata().is_ok_and(|of| of.is_dir() && is_old(&of)));
            // one that has something in it stays
            removed += old.filter(|entry| fs::remove_dir(entry.path()).is_ok()).count();
        }
        Ok(removed)
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
        match Blobs::read(self, name) {
            Ok(bytes) => Ok(Some((digest(&bytes), bytes)).map(|(tag, bytes)| (bytes, Tag(tag)))),
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
            Err(e) => Err(e),
        }
    }

    fn swap(&self, name: &str, seen: &Tag, bytes: &[u8]) -> io::Result<Option<Tag>> {
        let _lock = self.lock()?;
        if self.get(name)?.is_none_or(|(_, tag)| tag != *seen) {
            return Ok(None);
        }
        self.placed(name, bytes, |from, to| Disk.rename(from, to))?;
        Ok(Some(Tag(digest(bytes))))
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        let _lock = self.lock()?;
        self.gone(name)
    }

    fn page(&self, folder: &str, after: Option<&str>, limit: usize) -> io::Result<Vec<String>> {
        let mut first = First { after, limit, names: BinaryHeap::new() };
        self.names(folder, &mut first)?;
        Ok(first.names.into_sorted_vec())
    }

    fn all(&self, folder: &str) -> io::Result<Vec<String>> {
        // read once: each page would read the whole folder again
        self.page(folder, None, usize::MAX)
    }
}
