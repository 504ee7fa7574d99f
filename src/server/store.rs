//! Photos on disk.
//!
//! ```text
//! DIR/lock                     held by the one process that works in DIR
//! DIR/incoming/N/              an upload on its way in, or a photo on its way out; emptied at start
//! DIR/photos/ID/upload         the photo as uploaded
//!               depth          the user's depth map, if any
//!               options.json   what was accepted: Accepted
//!               state.json     what became of it: State; missing until the first start of the job
//!               settings.json  what its owner wants of viewers: Settings; missing until something is set
//!               report.json atlas.tmpi depth.png thumbnail.jpg     once done
//! ```
//! A photo appears by one rename of a synced folder, so what is there is whole. Each file in it changes by a synced
//! temporary file and a rename; `state.json` says `done` only after everything else is on disk.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::id::PhotoId;
use super::problem::Problem;
use super::settings::Settings;

/// A file of a photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Part {
    /// The photo as uploaded.
    Upload,
    /// The user's depth map.
    Depth,
    /// What was accepted.
    Options,
    /// What became of it.
    State,
    /// What its owner wants of viewers.
    Settings,
    /// Report of the way, JSON.
    Report,
    /// The container.
    Atlas,
    /// Disparity as used, 16-bit grey PNG.
    Disparity,
    /// Small JPEG.
    Thumbnail,
}

impl Part {
    /// File name.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Upload => "upload",
            Self::Depth => "depth",
            Self::Options => "options.json",
            Self::State => "state.json",
            Self::Settings => "settings.json",
            Self::Report => "report.json",
            Self::Atlas => "atlas.tmpi",
            Self::Disparity => "depth.png",
            Self::Thumbnail => "thumbnail.jpg",
        }
    }
}

/// An accepted upload.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Accepted {
    /// When it was accepted, milliseconds since 1970.
    pub at_ms: u64,
    /// Size of the photo.
    pub photo_bytes: u64,
    /// Size of the depth map, if there is one.
    pub depth_bytes: Option<u64>,
    /// Options as text, all of them.
    pub options: BTreeMap<String, String>,
}

/// What became of an accepted upload.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct State {
    /// Starts of the job so far.
    pub attempts: u32,
    /// How it ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub end: Option<End>,
}

/// How a job ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum End {
    /// All files are there.
    Done(Done),
    /// The photo could not be made.
    Failed(Failed),
}

/// A finished photo.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Done {
    /// When, milliseconds since 1970.
    pub at_ms: u64,
    /// Width of the scene in pixels.
    pub width: u32,
    /// Height of the scene in pixels.
    pub height: u32,
    /// Size of the container.
    pub atlas_bytes: u64,
    /// First 128 bits of the container's SHA-256 in hex.
    pub atlas_hash: String,
}

/// A photo that could not be made.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failed {
    /// When, milliseconds since 1970.
    pub at_ms: u64,
    /// Why.
    pub problem: Problem,
}

/// A photo found at start.
#[derive(Debug)]
pub struct Found {
    /// Its id.
    pub id: PhotoId,
    /// What was accepted.
    pub accepted: Accepted,
    /// What became of it so far.
    pub state: State,
    /// What its owner wants of viewers.
    pub settings: Settings,
}

/// The data directory.
#[derive(Debug)]
pub struct Store {
    photos: PathBuf,
    incoming: PathBuf,
    next: AtomicU64,
    // unlocked when dropped
    _lock: File,
}

/// Takes the lock; a process that is about to end, or has just begun to, is waited for.
fn locked(lock: &File, dir: &Path) -> io::Result<()> {
    const TRIES: u32 = 50;
    const PAUSE: Duration = Duration::from_millis(20);
    for _ in 0..TRIES {
        match lock.try_lock() {
            Ok(()) => return Ok(()),
            Err(fs::TryLockError::WouldBlock) => std::thread::sleep(PAUSE),
            Err(fs::TryLockError::Error(e)) => return Err(e),
        }
    }
    Err(io::Error::new(io::ErrorKind::ResourceBusy, format!("another process works in {}", dir.display())))
}

impl Store {
    /// Opens the data directory, makes it where it is missing, removes leftovers of uploads that were never accepted, and
    /// tells what is there, oldest first. Folders that cannot be read are left alone and logged.
    ///
    /// # Errors
    /// The directory cannot be written, or another process works in it for more than a second.
    pub fn open(dir: &Path) -> io::Result<(Self, Vec<Found>)> {
        let (photos, incoming) = (dir.join("photos"), dir.join("incoming"));
        fs::create_dir_all(&photos)?;
        let lock = File::options().create(true).truncate(false).write(true).open(dir.join("lock"))?;
        locked(&lock, dir)?;
        match fs::remove_dir_all(&incoming) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
        fs::create_dir(&incoming)?;
        sync_dir(dir)?;
        let store = Self { photos, incoming, next: AtomicU64::new(0), _lock: lock };
        let mut found = store.scan()?;
        found.sort_by_key(|f| (f.accepted.at_ms, f.id));
        Ok((store, found))
    }

    fn scan(&self) -> io::Result<Vec<Found>> {
        let mut found = Vec::new();
        for entry in fs::read_dir(&self.photos)? {
            let entry = entry?;
            let Some(id) = entry.file_name().to_str().and_then(|n| n.parse().ok()) else {
                tracing::warn!(path = %entry.path().display(), "not a photo, left alone");
                continue;
            };
            match self.look(id) {
                Ok(photo) => found.push(photo),
                Err(error) => tracing::error!(%id, %error, "cannot be read, left alone"),
            }
        }
        Ok(found)
    }

    fn look(&self, id: PhotoId) -> io::Result<Found> {
        let accepted: Accepted = serde_json::from_slice(&self.read(id, Part::Options)?)?;
        let state = match self.read(id, Part::State) {
            Ok(bytes) => serde_json::from_slice(&bytes)?,
            Err(e) if e.kind() == io::ErrorKind::NotFound => State::default(),
            Err(e) => return Err(e),
        };
        for entry in fs::read_dir(self.folder(id))? {
            let path = entry?.path();
            if path.extension().is_some_and(|e| e == "tmp") {
                fs::remove_file(path)?;
            }
        }
        let settings = match self.read(id, Part::Settings) {
            Ok(bytes) => Settings::read(&bytes).map_err(io::Error::other)?,
            Err(e) if e.kind() == io::ErrorKind::NotFound => Settings::default(),
            Err(e) => return Err(e),
        };
        Ok(Found { id, accepted, state, settings })
    }

    fn folder(&self, id: PhotoId) -> PathBuf {
        self.photos.join(id.to_string())
    }

    fn fresh(&self) -> PathBuf {
        self.incoming.join(self.next.fetch_add(1, Ordering::Relaxed).to_string())
    }

    /// Where a file of a photo lies.
    #[must_use]
    pub fn path(&self, id: PhotoId, part: Part) -> PathBuf {
        self.folder(id).join(part.name())
    }

    /// A folder for an upload on its way in.
    ///
    /// # Errors
    /// The data directory cannot be written.
    pub fn begin(&self) -> io::Result<Incoming> {
        let folder = self.fresh();
        fs::create_dir(&folder)?;
        Ok(Incoming { folder })
    }

    /// Accepts an upload: when this returns, the photo is on disk and survives a crash. Its files must be synced already.
    ///
    /// # Errors
    /// The data directory cannot be written; nothing was accepted then.
    pub fn accept(&self, incoming: Incoming, id: PhotoId, accepted: &Accepted) -> io::Result<()> {
        let mut file = File::create(incoming.path(Part::Options))?;
        file.write_all(&serde_json::to_vec_pretty(accepted)?)?;
        file.sync_all()?;
        sync_dir(&incoming.folder)?;
        let folder = self.folder(id);
        if folder.exists() {
            // a folder that could not be read at start; a fresh upload of the same photo replaces it
            self.remove(id)?;
        }
        fs::rename(&incoming.folder, folder)?;
        // the folder is at its place: there is nothing left to clean up
        std::mem::forget(incoming);
        sync_dir(&self.photos)
    }

    /// The bytes of a file of a photo.
    ///
    /// # Errors
    /// As [`fs::read`].
    pub fn read(&self, id: PhotoId, part: Part) -> io::Result<Vec<u8>> {
        fs::read(self.path(id, part))
    }

    /// Writes files of a photo, each whole or not at all; all are on disk when this returns.
    ///
    /// # Errors
    /// The data directory cannot be written, or the photo is gone.
    pub fn write(&self, id: PhotoId, parts: &[(Part, &[u8])]) -> io::Result<()> {
        let folder = self.folder(id);
        for (part, bytes) in parts {
            let temporary = folder.join(format!("{}.tmp", part.name()));
            let mut file = File::create(&temporary)?;
            file.write_all(bytes)?;
            file.sync_all()?;
            fs::rename(temporary, folder.join(part.name()))?;
        }
        sync_dir(&folder)
    }

    /// Writes what became of a photo.
    ///
    /// # Errors
    /// As [`Store::write`].
    pub fn write_state(&self, id: PhotoId, state: &State) -> io::Result<()> {
        self.write(id, &[(Part::State, &serde_json::to_vec_pretty(state)?)])
    }

    /// Writes what a photo's owner wants of viewers.
    ///
    /// # Errors
    /// As [`Store::write`].
    pub fn write_settings(&self, id: PhotoId, settings: &Settings) -> io::Result<()> {
        self.write(id, &[(Part::Settings, &serde_json::to_vec_pretty(settings)?)])
    }

    /// Removes a photo with all its files; when this returns, it does not come back.
    ///
    /// # Errors
    /// The data directory cannot be written.
    pub fn remove(&self, id: PhotoId) -> io::Result<()> {
        let gone = self.fresh();
        fs::rename(self.folder(id), &gone)?;
        sync_dir(&self.photos)?;
        // a leftover is removed at the next start
        if let Err(error) = fs::remove_dir_all(&gone) {
            tracing::warn!(%id, %error, "cannot be removed now");
        }
        Ok(())
    }

    /// True where the data directory can be written.
    #[must_use]
    pub fn writable(&self) -> bool {
        let probe = self.fresh();
        fs::write(&probe, b"").and_then(|()| fs::remove_file(&probe)).is_ok()
    }
}

/// A folder for an upload on its way in; removed when dropped before [`Store::accept`].
#[derive(Debug)]
pub struct Incoming {
    folder: PathBuf,
}

impl Incoming {
    /// Where a file of the upload belongs.
    #[must_use]
    pub fn path(&self, part: Part) -> PathBuf {
        self.folder.join(part.name())
    }
}

impl Drop for Incoming {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_dir_all(&self.folder) {
            tracing::warn!(folder = %self.folder.display(), %error, "leftover of an upload cannot be removed now");
        }
    }
}

/// Makes renames within `dir` durable.
fn sync_dir(dir: &Path) -> io::Result<()> {
    // directories cannot be opened as files elsewhere
    if cfg!(unix) { File::open(dir)?.sync_all() } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn accepted(at_ms: u64) -> Accepted {
        Accepted { at_ms, photo_bytes: 5, depth_bytes: None, options: BTreeMap::from([("quality".into(), "90".into())]) }
    }

    fn put(store: &Store, n: u8, at_ms: u64) -> PhotoId {
        let id = PhotoId::of(&[n; 32], None, "", "");
        let incoming = store.begin().unwrap();
        fs::write(incoming.path(Part::Upload), b"photo").unwrap();
        store.accept(incoming, id, &accepted(at_ms)).unwrap();
        id
    }

    #[test]
    fn what_was_accepted_is_found_again_oldest_first() {
        let dir = tempfile::tempdir().unwrap();
        let (store, found) = Store::open(dir.path()).unwrap();
        assert!(found.is_empty());
        let (b, a) = (put(&store, 2, 20), put(&store, 1, 10));
        let state = State { attempts: 2, end: None };
        store.write_state(b, &state).unwrap();
        drop(store);
        let (store, found) = Store::open(dir.path()).unwrap();
        assert_eq!(found.iter().map(|f| f.id).collect::<Vec<_>>(), [a, b]);
        assert_eq!((&found[0].state, &found[1].state), (&State::default(), &state));
        assert_eq!(found[0].accepted, accepted(10));
        assert_eq!(store.read(a, Part::Upload).unwrap(), b"photo");
    }

    #[test]
    fn leftovers_go_and_strangers_stay() {
        let dir = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(dir.path()).unwrap();
        let id = put(&store, 1, 1);
        std::mem::forget(store.begin().unwrap());
        fs::write(store.folder(id).join("atlas.tmpi.tmp"), b"half").unwrap();
        fs::create_dir(store.photos.join("stranger")).unwrap();
        drop(store);
        let (store, found) = Store::open(dir.path()).unwrap();
        assert_eq!(found.len(), 1);
        assert_eq!(fs::read_dir(&store.incoming).unwrap().count(), 0);
        assert!(!store.folder(id).join("atlas.tmpi.tmp").exists());
        assert!(store.photos.join("stranger").exists());
    }

    #[test]
    fn an_upload_that_is_given_up_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(dir.path()).unwrap();
        let incoming = store.begin().unwrap();
        fs::write(incoming.path(Part::Upload), b"photo").unwrap();
        drop(incoming);
        assert_eq!(fs::read_dir(&store.incoming).unwrap().count(), 0);
    }

    #[test]
    fn removal_is_for_good_and_writes_after_it_fail() {
        let dir = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(dir.path()).unwrap();
        let id = put(&store, 1, 1);
        store.remove(id).unwrap();
        assert!(store.write_state(id, &State::default()).is_err());
        assert!(store.remove(id).is_err());
        drop(store);
        assert!(Store::open(dir.path()).unwrap().1.is_empty());
    }

    #[test]
    fn a_folder_of_which_the_record_is_damaged_is_kept() {
        let dir = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(dir.path()).unwrap();
        let id = put(&store, 1, 1);
        fs::write(store.path(id, Part::Options), b"{").unwrap();
        drop(store);
        let (store, found) = Store::open(dir.path()).unwrap();
        assert!(found.is_empty());
        assert_eq!(store.read(id, Part::Upload).unwrap(), b"photo");
        assert_eq!(put(&store, 1, 2), id, "another upload of the photo heals it");
        drop(store);
        assert_eq!(Store::open(dir.path()).unwrap().1.len(), 1);
    }

    #[test]
    fn a_process_that_is_about_to_end_is_waited_for() {
        let dir = tempfile::tempdir().unwrap();
        let (before, _) = Store::open(dir.path()).unwrap();
        let ending = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(100));
            drop(before);
        });
        assert!(Store::open(dir.path()).is_ok());
        ending.join().unwrap();
    }

    #[test]
    fn one_process_at_a_time() {
        let dir = tempfile::tempdir().unwrap();
        let first = Store::open(dir.path()).unwrap();
        assert_eq!(Store::open(dir.path()).unwrap_err().kind(), io::ErrorKind::ResourceBusy);
        drop(first);
        Store::open(dir.path()).unwrap();
    }
}
