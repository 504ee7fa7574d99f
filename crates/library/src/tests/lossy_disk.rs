//! Files that lose unsynced data in a crash, and a full disk.

use std::collections::BTreeMap;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use crate::blobs::{Files, Listed};

#[derive(Clone, Debug)]
struct File {
    now: Vec<u8>,
    synced: Option<Vec<u8>>,
}

#[derive(Debug, Default)]
struct Inner {
    files: Vec<File>,
    /// Files by name, now and after a crash.
    now: BTreeMap<PathBuf, usize>,
    synced: BTreeMap<PathBuf, usize>,
    /// Number of changes that still succeed; all later ones fail.
    left: Option<usize>,
    is_full: bool,
}

/// Files in memory.
#[derive(Debug, Default)]
pub struct LossyDisk(Mutex<Inner>);

impl LossyDisk {
    /// Ends the process after this many more changes.
    pub fn end_after(&self, changes: usize) {
        self.0.lock().unwrap().left = Some(changes);
    }

    /// Fills or frees the disk.
    pub fn fill(&self, is_full: bool) {
        self.0.lock().unwrap().is_full = is_full;
    }

    /// Stops the machine: unsynced data is lost.
    pub fn crash(&self) {
        let mut inner = self.0.lock().unwrap();
        inner.left = None;
        inner.now = inner.synced.clone();
        for file in &mut inner.files {
            file.now = file.synced.clone().unwrap_or_default();
        }
    }
}

impl Inner {
    fn find(&self, path: &Path) -> io::Result<usize> {
        self.now.get(path).copied().ok_or_else(|| io::ErrorKind::NotFound.into())
    }

    fn change(&mut self) -> io::Result<()> {
        match self.left.as_mut() {
            None => Ok(()),
            Some(0) => Err(io::Error::other("the process has ended")),
            Some(left) => {
                *left -= 1;
                Ok(())
            }
        }
    }
}

impl Files for LossyDisk {
    fn create_dir(&self, _: &Path) -> io::Result<()> {
        Ok(())
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let mut inner = self.0.lock().unwrap();
        // a process that ends while writing leaves an unsynced part
        let at = inner.files.len();
        inner.files.push(File { now: bytes[..bytes.len() / 2].to_vec(), synced: None });
        inner.now.insert(path.to_owned(), at);
        if inner.is_full {
            return Err(io::ErrorKind::StorageFull.into());
        }
        inner.change()?;
        inner.files[at] = File { now: bytes.to_vec(), synced: Some(bytes.to_vec()) };
        Ok(())
    }

    fn sync(&self, path: &Path) -> io::Result<()> {
        let mut inner = self.0.lock().unwrap();
        let at = inner.find(path)?;
        inner.change()?;
        inner.files[at].synced = Some(inner.files[at].now.clone());
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut inner = self.0.lock().unwrap();
        let at = inner.find(from)?;
        inner.change()?;
        inner.now.remove(from);
        inner.now.insert(to.to_owned(), at);
        Ok(())
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        let mut inner = self.0.lock().unwrap();
        inner.change()?;
        let here = |name: &PathBuf| name.parent() == Some(path);
        inner.synced.retain(|name, _| !here(name));
        let now: Vec<_> = inner.now.iter().filter(|(name, _)| here(name)).map(|(name, at)| (name.clone(), *at)).collect();
        inner.synced.extend(now);
        Ok(())
    }

    fn read(&self, path: &Path, range: Option<Range<u64>>) -> io::Result<Vec<u8>> {
        let inner = self.0.lock().unwrap();
        let bytes = &inner.files[inner.find(path)?].now;
        let range = range.map_or(0..bytes.len(), |range| range.start as usize..(range.end as usize).min(bytes.len()));
        Ok(bytes[range].to_vec())
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        let mut inner = self.0.lock().unwrap();
        inner.find(path)?;
        inner.change()?;
        inner.now.remove(path);
        Ok(())
    }

    fn list(&self, path: &Path) -> io::Result<Vec<Listed>> {
        let inner = self.0.lock().unwrap();
        let here = inner.now.iter().filter(|(name, _)| name.parent() == Some(path));
        let name = |path: &Path| path.file_name().unwrap().to_str().unwrap().to_owned();
        Ok(here.map(|(path, at)| Listed { name: name(path), bytes: inner.files[*at].now.len() as u64, written_at: 0 }).collect())
    }

    fn disk_space(&self, _: &Path) -> Option<crate::blobs::DiskSpace> {
        None
    }
}

#[cfg(unix)]
#[test]
fn the_disk_reports_its_free_space() {
    use crate::blobs::Disk;
    let dir = tempfile::tempdir().unwrap();
    assert!(Disk.disk_space(dir.path()).is_some() && Disk.disk_space(&dir.path().join("none")).is_none());
}
