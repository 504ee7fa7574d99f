//! Blobs and ledger in a folder: for several processes of one machine, and for the tests of what the ports promise.
//!
//! A file gets its place by a rename or a second name, so that it is whole or not there.

use std::fs::{self, File};
use std::hash::{BuildHasher, RandomState};
use std::io::{self, ErrorKind, Read as _, Seek as _, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::index::OWNERS;
use super::names::{Names, Reading};
use super::ports::{Blobs, Ledger, Tag, unreachable};
use super::records::BLOBS;
use crate::server::files::{Disk, Files, private};
use crate::server::store::digest;

/// Age from which a file that has no place yet is nobody's.
const LEFT: Duration = Duration::from_hours(24);

/// A folder of synced files.
#[derive(Debug)]
pub struct Folder {
    files: Arc<dyn Files>,
    root: PathBuf,
    /// File that is held by whoever changes or removes a record; none where nobody else can.
    lock: Option<PathBuf>,
    /// Tells this process from others, which may have the same number in a namespace of their own.
    own: u64,
    next: AtomicU64,
    names: Names,
}

impl Folder {
    /// Opens it, and makes it where it is missing.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn open(root: &Path) -> io::Result<Self> {
        let folder = Self::open_in(Arc::new(Disk), root, Some(root.join("lock")))?;
        // of processes that ended before they gave them a place
        for entry in fs::read_dir(root.join("coming"))?.flatten() {
            if entry.metadata().and_then(|of| of.modified()).is_ok_and(|at| at.elapsed().is_ok_and(|age| age > LEFT)) {
                let _ = Disk.remove(&entry.path());
            }
        }
        Ok(folder)
    }

    /// The same in whatever `files`.
    fn open_in(files: Arc<dyn Files>, root: &Path, lock: Option<PathBuf>) -> io::Result<Self> {
        let fresh = !files.is_dir(root);
        files.create_dir(&root.join("coming"), true)?;
        files.sync_dir(root)?;
        if let Some(above) = root.parent().filter(|above| fresh && files.is_dir(above)) {
            files.sync_dir(above)?;
        }
        let own = RandomState::new().hash_one(std::process::id());
        Ok(Self { files, root: root.to_owned(), lock, own, next: AtomicU64::new(0), names: Names::default() })
    }

    #[cfg(test)]
    pub fn with_names(self, names: Names) -> Self {
        Self { names, ..self }
    }

    /// What it means that there is no such file: nothing where the folder itself is gone, as a disk that is not mounted.
    fn missing(&self, error: io::Error) -> io::Error {
        if error.kind() == ErrorKind::NotFound && !self.files.is_dir(&self.root.join("coming")) { unreachable(error) } else { error }
    }

    /// Held by whoever changes or removes a record.
    fn lock(&self) -> io::Result<Option<File>> {
        let Some(path) = &self.lock else { return Ok(None) };
        let lock = private().create(true).truncate(false).write(true).open(path).map_err(|e| self.missing(e))?;
        lock.lock()?;
        Ok(Some(lock))
    }

    /// A synced file that has no place yet.
    fn coming(&self, bytes: &[u8]) -> io::Result<PathBuf> {
        let name = format!("{:016x}-{}", self.own, self.next.fetch_add(1, Ordering::Relaxed));
        let path = self.root.join("coming").join(name);
        match self.files.write(&path, bytes) {
            Ok(()) => Ok(path),
            Err(e) => {
                // what filled the disk must not keep it full
                let _ = self.files.remove(&path);
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
            if !self.files.is_dir(folder) {
                self.files.create_dir(folder, true)?;
            }
            place(&coming, &to)
        };
        // an empty folder may be tidied away just before
        let outcome = match enter() {
            Err(e) if e.kind() == ErrorKind::NotFound && !self.files.is_dir(folder) => enter(),
            outcome => outcome,
        };
        match self.files.remove(&coming) {
            Err(e) if e.kind() != ErrorKind::NotFound => tracing::warn!(path = %coming.display(), error = %e, "a leftover"),
            _ => {}
        }
        let outcome = outcome?;
        // also those above it, which another may have made just now and not have synced yet
        for above in folder.ancestors().take_while(|above| above.starts_with(&self.root)) {
            self.files.sync_dir(above)?;
        }
        Ok(outcome)
    }

    /// Shows the names of all files within a folder, and within those in it, to `reading`.
    fn read_names(&self, folder: &str, reading: &mut Reading<'_>) -> io::Result<()> {
        let entries = match fs::read_dir(self.root.join(folder)).map_err(|e| self.missing(e)) {
            Ok(entries) => entries,
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(()),
            Err(e) => return Err(e),
        };
        for entry in entries {
            let entry = entry?;
            // a name that is no text is nobody's here
            let name = format!("{folder}{}", entry.file_name().to_string_lossy());
            if entry.file_type()?.is_dir() {
                reading.is_deep = true;
                self.read_names(&format!("{name}/"), reading)?;
            } else {
                reading.take(name);
            }
        }
        Ok(())
    }

    fn gone(&self, name: &str) -> io::Result<()> {
        let path = self.root.join(name);
        match self.files.remove(&path) {
            Ok(()) => self.files.sync_dir(path.parent().unwrap_or(&self.root)),
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(()),
            Err(e) => Err(e),
        }
    }
}

impl Blobs for Folder {
    fn put(&self, name: &str, bytes: Vec<u8>) -> io::Result<()> {
        self.placed(name, &bytes, |from, to| self.files.rename(from, to))
    }

    fn read(&self, name: &str) -> io::Result<Vec<u8>> {
        self.files.read(&self.root.join(name)).map_err(|e| self.missing(e))
    }

    fn read_range(&self, name: &str, range: Range<u64>) -> io::Result<Vec<u8>> {
        let mut file = File::open(self.root.join(name)).map_err(|e| self.missing(e))?;
        file.seek(SeekFrom::Start(range.start))?;
        let mut bytes = Vec::new();
        file.take(range.end.saturating_sub(range.start)).read_to_end(&mut bytes)?;
        Ok(bytes)
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
        self.placed(name, bytes, |from, to| match self.files.link(from, to) {
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
        self.placed(name, bytes, |from, to| self.files.rename(from, to))?;
        Ok(Some(Tag(digest(bytes))))
    }

    fn remove(&self, name: &str) -> io::Result<()> {
        let _lock = self.lock()?;
        self.gone(name)
    }

    fn page(&self, folder: &str, after: Option<&str>, limit: usize) -> io::Result<Vec<String>> {
        // both before it is read: a change meanwhile is seen the next time
        let stamp = fs::metadata(self.root.join(folder)).and_then(|of| of.modified()).ok();
        let read = Instant::now();
        if let Some(page) = self.names.page(folder, stamp, after, limit) {
            return Ok(page);
        }
        let mut reading = Reading::new(after, limit);
        self.read_names(folder, &mut reading)?;
        Ok(self.names.keep(folder, stamp, read, reading))
    }

    fn all(&self, folder: &str) -> io::Result<Vec<String>> {
        // of one moment, whatever comes meanwhile
        self.page(folder, None, usize::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::forgetful::Forgetful;

    const ROOT: &str = "/stores/one";

    fn folder(files: &Arc<Forgetful>) -> Folder {
        Folder::open_in(files.clone(), Path::new(ROOT), None).unwrap()
    }

    /// A record and a blob as they are kept.
    type Kept = (Option<Vec<u8>>, Option<Vec<u8>>);

    fn kept(folder: &Folder) -> Kept {
        let blob = match folder.read("blobs/a/one") {
            Err(e) if e.kind() == ErrorKind::NotFound => None,
            blob => Some(blob.unwrap()),
        };
        (folder.get("photos/a").unwrap().map(|(bytes, _)| bytes), blob)
    }

    /// A record and a blob from their beginning to their end, as far as it goes: how many of the changes were promised.
    fn life(folder: &Folder) -> usize {
        let swap = |from: &str, to: &str| {
            let (bytes, tag) = folder.get("photos/a")?.unwrap();
            assert_eq!(bytes, from.as_bytes());
            folder.swap("photos/a", &tag, to.as_bytes()).map(|tag| assert!(tag.is_some()))
        };
        let changes: [&dyn Fn() -> io::Result<()>; 7] = [
            &|| folder.put("blobs/a/one", b"blob".to_vec()),
            &|| folder.create("photos/a", b"1").map(|new| assert!(new)),
            &|| swap("1", "22"),
            &|| folder.put("blobs/a/one", b"another".to_vec()),
            &|| swap("22", "333"),
            &|| folder.remove("photos/a"),
            &|| folder.discard("blobs/a/one"),
        ];
        changes.iter().take_while(|change| change().is_ok()).count()
    }

    /// What is kept once so many of them were promised.
    fn promised(changes: usize) -> Kept {
        let record = [None, None, Some("1"), Some("22"), Some("22"), Some("333"), None, None][changes];
        let blob = [None, Some("blob"), Some("blob"), Some("blob"), Some("another"), Some("another"), Some("another"), None][changes];
        (record.map(|text| text.as_bytes().to_vec()), blob.map(|text| text.as_bytes().to_vec()))
    }

    #[test]
    fn what_was_promised_survives_the_machine_stopping_at_each_step() {
        for steps in 0.. {
            let files = Arc::new(Forgetful::new());
            files.create_dir(Path::new("/stores"), true).unwrap();
            files.sync_dir(Path::new("/")).unwrap();
            let before = folder(&files);
            files.end_after(steps);
            let told = life(&before);
            files.crash();
            let found = kept(&folder(&files));
            let next = promised((told + 1).min(7));
            assert!(found == promised(told) || found == next, "after {steps} steps and {told} changes there is {found:?}");
            if told == 7 {
                // each of them is some changes of files
                assert!(steps > 25, "{steps}");
                return;
            }
        }
    }

    #[test]
    fn a_change_that_fails_once_leaves_what_was_or_what_was_to_be() {
        for step in 0..40 {
            let files = Arc::new(Forgetful::new());
            files.create_dir(Path::new("/stores"), true).unwrap();
            let folder = folder(&files);
            files.fail_once_after(step);
            let told = life(&folder);
            files.end_after(usize::MAX);
            let found = kept(&folder);
            assert!(found == promised(told) || found == promised((told + 1).min(7)), "{step}: {told} changes, {found:?}");
        }
    }

    #[test]
    fn a_full_disk_keeps_nothing_that_has_no_place() {
        let files = Arc::new(Forgetful::new());
        files.create_dir(Path::new("/stores"), true).unwrap();
        let folder = folder(&files);
        assert!(folder.create("photos/a", b"1").unwrap());
        let (_, tag) = folder.get("photos/a").unwrap().unwrap();
        files.fill(true);
        let refused = [
            folder.create("photos/b", b"2").err(),
            folder.swap("photos/a", &tag, b"22").err(),
            folder.put("blobs/a/one", vec![7; 100]).err(),
        ];
        assert!(refused.iter().all(|error| error.as_ref().is_some_and(|e| e.kind() == ErrorKind::StorageFull)), "{refused:?}");
        assert_eq!(files.names(&Path::new(ROOT).join("coming")).unwrap(), [""; 0]);
        assert_eq!(kept(&folder), (Some(b"1".to_vec()), None));
        folder.remove("photos/a").unwrap();
        files.fill(false);
        assert!(folder.create("photos/a", b"1").unwrap());
    }
}
