//! Files that forget, at a crash, what was not synced; and a disk that is full.

use std::collections::BTreeMap;
use std::io;
use std::path::{Component, Path};
use std::sync::{Mutex, PoisonError};

use super::files::{Files, Room};

type Entries = BTreeMap<String, usize>;

#[derive(Clone, Debug)]
enum Node {
    File {
        now: Vec<u8>,
        synced: Option<Vec<u8>>,
    },
    Folder {
        now: Entries,
        synced: Entries,
    },
    /// A file on sectors that have gone.
    Worn,
}

impl Node {
    fn folder() -> Self {
        Self::Folder { now: Entries::new(), synced: Entries::new() }
    }
}

/// Bytes that there are, and files.
const ALL: u64 = 1 << 30;

#[derive(Debug)]
struct Inner {
    nodes: Vec<Node>,
    /// Changes that are still made; the one after them and all that follow fail.
    left: usize,
    /// Whether that is as the disk being full: what takes no room goes on.
    full: bool,
    /// Bytes that are free while it is not.
    free: u64,
    /// Whether there is no place for another file, however much room.
    no_files: bool,
    /// Whether only one change fails.
    once: bool,
}

/// Files in memory.
#[derive(Debug)]
pub struct Forgetful(Mutex<Inner>);

impl Forgetful {
    pub fn new() -> Self {
        Self(Mutex::new(Inner { nodes: vec![Node::folder()], left: usize::MAX, full: false, free: ALL, no_files: false, once: false }))
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The process ends after so many more changes: each later one fails.
    pub fn end_after(&self, changes: usize) {
        let mut inner = self.lock();
        (inner.left, inner.full, inner.once) = (changes, false, false);
    }

    /// The change after so many more fails, and only that.
    pub fn fail_once_after(&self, changes: usize) {
        self.end_after(changes);
        self.lock().once = true;
    }

    /// From now on there is no room, or there is again.
    pub fn fill(&self, full: bool) {
        let mut inner = self.lock();
        (inner.left, inner.full) = (if full { 0 } else { usize::MAX }, full);
    }

    /// From now on there is no place for another file, or there is again.
    pub fn use_up_files(&self, used: bool) {
        self.lock().no_files = used;
    }

    /// From now on so many bytes are free, whatever is written.
    pub fn leave(&self, bytes: u64) {
        self.lock().free = bytes;
    }

    /// The machine stops: what was not synced is gone.
    pub fn crash(&self) {
        let mut inner = self.lock();
        inner.left = usize::MAX;
        for node in &mut inner.nodes {
            match node {
                Node::File { now, synced } => *now = synced.clone().unwrap_or_default(),
                Node::Folder { now, synced } => now.clone_from(synced),
                Node::Worn => {}
            }
        }
    }

    /// Writes a file that is not synced.
    pub fn write_unsynced(&self, path: &Path, bytes: &[u8]) {
        self.lock().put(path, Node::File { now: bytes.to_vec(), synced: None }).unwrap();
    }

    /// From now on a file cannot be read from the disk.
    pub fn wear_out(&self, path: &Path) {
        let mut inner = self.lock();
        let at = inner.find(path).unwrap();
        inner.nodes[at] = Node::Worn;
    }

    pub fn exists(&self, path: &Path) -> bool {
        self.lock().find(path).is_ok()
    }

    /// Overwrites a file as damage does.
    pub fn spoil(&self, path: &Path, bytes: &[u8]) {
        let mut inner = self.lock();
        let at = inner.find(path).unwrap();
        inner.nodes[at] = Node::File { now: bytes.to_vec(), synced: Some(bytes.to_vec()) };
    }
}

fn missing() -> io::Error {
    io::ErrorKind::NotFound.into()
}

fn parts(path: &Path) -> Vec<String> {
    path.components()
        .filter_map(|c| match c {
            Component::Normal(name) => Some(name.to_string_lossy().into_owned()),
            _ => None,
        })
        .collect()
}

impl Inner {
    fn find(&self, path: &Path) -> io::Result<usize> {
        parts(path).iter().try_fold(0, |at, name| match &self.nodes[at] {
            Node::Folder { now, .. } => now.get(name).copied().ok_or_else(missing),
            Node::File { .. } | Node::Worn => Err(missing()),
        })
    }

    fn change(&mut self, takes_room: bool) -> io::Result<()> {
        if self.full && !takes_room {
            return Ok(());
        }
        match self.left.checked_sub(1) {
            Some(left) => self.left = left,
            None if std::mem::take(&mut self.once) => {
                self.left = usize::MAX;
                return Err(io::Error::other("an error of the disk"));
            }
            None => return Err(if self.full { io::ErrorKind::StorageFull.into() } else { io::Error::other("the process has ended") }),
        }
        Ok(())
    }

    fn entries(&mut self, path: &Path) -> io::Result<(&mut Entries, String)> {
        let (Some(folder), Some(name)) = (path.parent(), path.file_name()) else { return Err(missing()) };
        let at = self.find(folder)?;
        match &mut self.nodes[at] {
            Node::Folder { now, .. } => Ok((now, name.to_string_lossy().into_owned())),
            Node::File { .. } | Node::Worn => Err(missing()),
        }
    }

    fn put(&mut self, path: &Path, node: Node) -> io::Result<()> {
        if self.no_files && self.find(path).is_err() {
            return Err(io::ErrorKind::StorageFull.into());
        }
        let at = self.nodes.len();
        let (entries, name) = self.entries(path)?;
        entries.insert(name, at);
        self.nodes.push(node);
        Ok(())
    }
}

impl Files for Forgetful {
    fn create_dir(&self, path: &Path, all: bool) -> io::Result<()> {
        let mut inner = self.lock();
        if inner.find(path).is_ok() {
            return if all { Ok(()) } else { Err(io::ErrorKind::AlreadyExists.into()) };
        }
        inner.change(true)?;
        if all && let Some(above) = path.parent().filter(|p| inner.find(p).is_err()) {
            drop(inner);
            self.create_dir(above, true)?;
            return self.create_dir(path, true);
        }
        inner.put(path, Node::folder())
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let mut inner = self.lock();
        // what a process leaves that ends while it writes: a part of it, and nothing synced
        let half = Node::File { now: bytes[..bytes.len() / 2].to_vec(), synced: None };
        inner.put(path, half)?;
        inner.change(true)?;
        let at = inner.find(path)?;
        inner.nodes[at] = Node::File { now: bytes.to_vec(), synced: Some(bytes.to_vec()) };
        Ok(())
    }

    fn sync(&self, path: &Path) -> io::Result<()> {
        let mut inner = self.lock();
        let at = inner.find(path)?;
        inner.change(true)?;
        if let Node::File { now, synced } = &mut inner.nodes[at] {
            *synced = Some(now.clone());
        }
        Ok(())
    }

    fn read(&self, path: &Path) -> io::Result<Vec<u8>> {
        let inner = self.lock();
        match &inner.nodes[inner.find(path)?] {
            Node::File { now, .. } => Ok(now.clone()),
            Node::Folder { .. } => Err(missing()),
            // EIO
            Node::Worn => Err(io::Error::from_raw_os_error(5)),
        }
    }

    fn names(&self, path: &Path) -> io::Result<Vec<String>> {
        let inner = self.lock();
        match &inner.nodes[inner.find(path)?] {
            Node::Folder { now, .. } => Ok(now.keys().cloned().collect()),
            Node::File { .. } | Node::Worn => Err(missing()),
        }
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut inner = self.lock();
        let at = inner.find(from)?;
        inner.change(false)?;
        let (entries, name) = inner.entries(from)?;
        entries.remove(&name);
        let (entries, name) = inner.entries(to)?;
        entries.insert(name, at);
        Ok(())
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut inner = self.lock();
        let at = inner.find(from)?;
        if inner.find(to).is_ok() {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        inner.change(true)?;
        let (entries, name) = inner.entries(to)?;
        entries.insert(name, at);
        Ok(())
    }

    fn is_dir(&self, path: &Path) -> bool {
        let inner = self.lock();
        inner.find(path).is_ok_and(|at| matches!(inner.nodes[at], Node::Folder { .. }))
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        let mut inner = self.lock();
        let at = inner.find(path)?;
        inner.change(false)?;
        if let Node::Folder { now, synced } = &mut inner.nodes[at] {
            synced.clone_from(now);
        }
        Ok(())
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        let mut inner = self.lock();
        inner.find(path)?;
        inner.change(false)?;
        let (entries, name) = inner.entries(path)?;
        entries.remove(&name);
        Ok(())
    }

    fn room(&self, _: &Path) -> Option<Room> {
        let inner = self.lock();
        Some(Room {
            bytes: if inner.full { 0 } else { inner.free },
            all_bytes: ALL,
            files: if inner.no_files { 0 } else { ALL },
            all_files: ALL,
        })
    }
}
