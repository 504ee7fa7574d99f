//! Photos on disk.
//!
//! ```text
//! DIR/lock                     held by the one process that works in DIR
//! DIR/incoming/N/              an upload on its way in, or a photo on its way out; emptied at start
//! DIR/scratch/N/               temporary files of a process that works for the server, see child/scratch.rs; emptied at start
//! DIR/looked.json              when photos were looked at, see retain.rs
//! DIR/exports/                 files to download that were written as jobs, see exports/shelf.rs
//! DIR/photos/ID/upload         the photo as uploaded
//!               depth          the user's depth map, if any
//!               options.json   what was accepted: Accepted
//!               state.json     what became of it: State; missing until the first start of the job
//!               settings.json  what its owner wants of viewers: Settings; missing until something is set
//!               batch          there where it was uploaded as one of many
//!               strokes.json   what a person put right of the depth; missing until something is
//!               report.json atlas.tmpi depth.png thumbnail.jpg     once done
//! ```
//! A photo appears by one rename of a synced folder, so what is there is whole. Each file in it changes by a synced
//! temporary file and a rename; `state.json` says `done` only after everything else is on disk. All of it is its owner's alone to read.

mod copies;
mod damage;
mod found;

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use super::files::{Disk, Files, Reserve, Room};
use super::id::PhotoId;
pub use super::part::Part;
pub use super::records::{Accepted, Done, End, Failed, Found, State};
use super::settings::Settings;
pub use copies::Origin;
pub use damage::{damage_of, digest, lost};

/// File of when photos were looked at.
const LOOKED: &str = "looked.json";
const PAUSE: Duration = Duration::from_millis(20);

/// The data directory.
#[derive(Debug)]
pub struct Store {
    files: Arc<dyn Files>,
    photos: PathBuf,
    incoming: PathBuf,
    /// Identity of what makes photos, a part of their ids.
    pipeline: String,
    next: AtomicU64,
    /// Photos that could not be read so far.
    unread: Mutex<Vec<PhotoId>>,
    /// Where the truth lies elsewhere.
    copies: Option<copies::Copies>,
    /// Room that is kept free.
    reserve: Reserve,
    // unlocked when dropped
    _lock: Option<File>,
}

/// Takes the lock; a process that is about to end, or has just begun to, is waited for.
fn locked(lock: &File, dir: &Path) -> io::Result<()> {
    const TRIES: u32 = 50;
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
    /// tells what is there, oldest first. Folders that cannot be read are left alone and logged; see [`Store::look_again`].
    ///
    /// # Errors
    /// The directory cannot be written, or another process works in it for more than a second.
    pub fn open(dir: &Path, pipeline: &str) -> io::Result<(Self, Vec<Found>)> {
        Disk.create_dir(&dir.join("photos"), true)?;
        let lock = super::files::private().create(true).truncate(false).write(true).open(dir.join("lock"))?;
        locked(&lock, dir)?;
        // those of before were everybody's to read
        #[cfg(unix)]
        fs::set_permissions(dir.join("photos"), std::os::unix::fs::PermissionsExt::from_mode(0o700))?;
        Self::open_in(Arc::new(Disk), dir, pipeline, Some(lock))
    }

    /// The same on other files than the disk's.
    pub(super) fn open_in(files: Arc<dyn Files>, dir: &Path, pipeline: &str, lock: Option<File>) -> io::Result<(Self, Vec<Found>)> {
        let (photos, incoming) = (dir.join("photos"), dir.join("incoming"));
        files.create_dir(&photos, true)?;
        match files.remove(&incoming) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
        files.create_dir(&incoming, false)?;
        files.sync_dir(dir)?;
        let (next, unread) = (AtomicU64::new(0), Mutex::default());
        let store = Self {
            files,
            photos,
            incoming,
            pipeline: pipeline.into(),
            next,
            unread,
            copies: None,
            reserve: Reserve::default(),
            _lock: lock,
        };
        let ids = store.ids()?;
        let found = store.look_at(&ids);
        Ok((store, found))
    }

    /// The same that keeps other room free than is usual.
    #[must_use]
    pub fn keeping(mut self, reserve: Reserve) -> Self {
        self.reserve = reserve;
        self
    }

    /// What its disk has left, and how much of that is kept free, in bytes and files; none where the system does not tell.
    #[must_use]
    pub fn left(&self) -> Option<(Room, (u64, u64))> {
        self.files.room(&self.photos).map(|room| (room, self.reserve.of(&room)))
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
    /// The data directory cannot be written, or has no more than its reserve.
    pub fn begin(&self) -> io::Result<Incoming> {
        self.room()?;
        let folder = self.fresh();
        self.files.create_dir(&folder, false)?;
        Ok(Incoming { files: Arc::clone(&self.files), folder, accepted: false })
    }

    /// A file for what is derived of photos: no name leads to it, and it goes when it is closed.
    ///
    /// # Errors
    /// As [`Store::begin`].
    pub fn scratch(&self) -> io::Result<File> {
        self.room()?;
        tempfile::tempfile_in(&self.incoming)
    }

    /// Makes the files of an upload durable, as they were written while they came in; blocks.
    ///
    /// # Errors
    /// The system cannot.
    pub fn settle(&self, incoming: &Incoming) -> io::Result<()> {
        [Part::Upload, Part::Depth].into_iter().try_for_each(|part| match self.files.sync(&incoming.path(part)) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => Err(e),
            _ => Ok(()),
        })
    }

    /// Where written files are kept, and what does so.
    #[must_use]
    pub fn written(&self) -> (Arc<dyn Files>, PathBuf) {
        (Arc::clone(&self.files), self.photos.with_file_name("exports"))
    }

    /// When photos were looked at, as it was kept.
    ///
    /// # Errors
    /// It cannot be read, or was not kept.
    pub fn read_looked(&self) -> io::Result<Vec<u8>> {
        self.files.read(&self.photos.with_file_name(LOOKED))
    }

    /// Keeps when photos were looked at.
    ///
    /// # Errors
    /// The data directory cannot be written.
    pub fn write_looked(&self, text: &[u8]) -> io::Result<()> {
        let (file, fresh) = (self.photos.with_file_name(LOOKED), self.photos.with_file_name(format!("{LOOKED}{TEMPORARY}")));
        self.files.write(&fresh, text).and_then(|()| self.files.rename(&fresh, &file))
    }

    /// Whether a photo was uploaded as one of many.
    #[must_use]
    pub fn is_batch(&self, id: PhotoId) -> bool {
        self.files.read(&self.folder(id).join(BATCH)).is_ok()
    }

    /// Refuses where no more than the reserve is left.
    ///
    /// # Errors
    /// That.
    pub fn room(&self) -> io::Result<()> {
        self.room_for(0)
    }

    /// Refuses where no more than the reserve would be left beside so many more bytes.
    ///
    /// # Errors
    /// That.
    pub fn room_for(&self, bytes: u64) -> io::Result<()> {
        match self.files.room(&self.photos) {
            Some(room) if (Room { bytes: room.bytes.saturating_sub(bytes), ..room }).is_short(self.reserve) => {
                Err(io::ErrorKind::StorageFull.into())
            }
            _ => Ok(()),
        }
    }

    /// Accepts an upload: when this returns, the photo is on disk and survives a crash. Its files must be [settled](Store::settle).
    ///
    /// # Errors
    /// The data directory cannot be written; nothing was accepted then.
    pub fn accept(&self, mut incoming: Incoming, id: PhotoId, accepted: &Accepted) -> io::Result<()> {
        self.files.write(&incoming.path(Part::Options), &serde_json::to_vec_pretty(accepted)?)?;
        self.files.sync_dir(&incoming.folder)?;
        let (folder, gone) = (self.folder(id), self.fresh());
        // a folder that could not be read; this upload of the same photo replaces it, both or neither being durable
        let replaced = match self.files.rename(&folder, &gone) {
            Ok(()) => true,
            Err(e) if e.kind() == io::ErrorKind::NotFound => false,
            Err(e) => return Err(e),
        };
        let placed = self.files.rename(&incoming.folder, &folder).and_then(|()| self.files.sync_dir(&self.photos));
        if let Err(error) = placed {
            // what is refused must not appear at the next start
            let back = self.files.rename(&folder, &incoming.folder);
            let old = if replaced { self.files.rename(&gone, &folder) } else { Ok(()) };
            if let Err(undo) = back.and(old) {
                tracing::error!(%id, %undo, "an upload that was not accepted may appear at the next start");
            }
            return Err(error);
        }
        incoming.accepted = true;
        self.unread().retain(|other| *other != id);
        if replaced {
            self.discard(id, &gone);
        }
        Ok(())
    }

    /// Takes over the files of another upload of a photo that is there already, whose own may be damaged.
    ///
    /// # Errors
    /// The data directory cannot be written.
    pub fn take_upload(&self, incoming: &Incoming, id: PhotoId) -> io::Result<()> {
        for part in [Part::Upload, Part::Depth] {
            match self.files.rename(&incoming.path(part), &self.path(id, part)) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
                _ => {}
            }
        }
        self.files.sync_dir(&self.folder(id))
    }

    fn discard(&self, id: PhotoId, gone: &Path) {
        // a leftover is removed at the next start
        if let Err(error) = self.files.remove(gone) {
            tracing::warn!(%id, %error, "cannot be removed now");
        }
    }

    /// The bytes of a file of a photo.
    ///
    /// # Errors
    /// As [`fs::read`].
    pub fn read(&self, id: PhotoId, part: Part) -> io::Result<Vec<u8>> {
        self.fetched(id, part, |path| self.files.read(path))
    }

    /// Writes files of a photo, each whole or not at all; all are on disk when this returns.
    ///
    /// # Errors
    /// The data directory cannot be written, or the photo is gone.
    pub fn write(&self, id: PhotoId, parts: &[(Part, &[u8])]) -> io::Result<()> {
        let folder = self.folder(id);
        for (part, bytes) in parts {
            let temporary = folder.join(format!("{}{TEMPORARY}", part.name()));
            let written = self.files.write(&temporary, bytes).and_then(|()| self.files.rename(&temporary, &folder.join(part.name())));
            if let Err(error) = written {
                // what filled the disk must not keep it full
                let _ = self.files.remove(&temporary);
                return Err(error);
            }
        }
        self.files.sync_dir(&folder)
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
        self.files.rename(&self.folder(id), &gone)?;
        self.files.sync_dir(&self.photos)?;
        self.discard(id, &gone);
        Ok(())
    }

    /// Checks that the data directory can be written and has room beyond its reserve.
    ///
    /// # Errors
    /// What stands against it.
    pub fn check(&self) -> io::Result<()> {
        self.room()?;
        // beside the uploads, which are nobody else's
        let probe = self.incoming.with_file_name("probe");
        // an empty file takes no room, and is written to a full disk
        let written = self.files.write(&probe, b"room");
        let removed = self.files.remove(&probe);
        written.and(removed)
    }
}

/// End of the name of a file that is being written.
const TEMPORARY: &str = ".tmp";
/// An empty file beside a photo that was uploaded as one of many.
const BATCH: &str = "batch";
/// Settings that this program does not understand.
const KEPT_SETTINGS: &str = "settings.json.kept";

/// A folder for an upload on its way in; removed when dropped before [`Store::accept`].
#[derive(Debug)]
pub struct Incoming {
    files: Arc<dyn Files>,
    folder: PathBuf,
    accepted: bool,
}

impl Incoming {
    /// Where a file of the upload belongs.
    #[must_use]
    pub fn path(&self, part: Part) -> PathBuf {
        self.folder.join(part.name())
    }

    /// Writes the settings that an upload brings along; they are accepted with it.
    ///
    /// # Errors
    /// The data directory cannot be written.
    pub fn write_settings(&self, settings: &Settings) -> io::Result<()> {
        self.files.write(&self.path(Part::Settings), &serde_json::to_vec_pretty(settings)?)
    }
}

impl Incoming {
    /// Says that the photo is one of many; that is accepted with it.
    ///
    /// # Errors
    /// The data directory cannot be written.
    pub fn write_batch(&self) -> io::Result<()> {
        self.files.write(&self.folder.join(BATCH), b"")
    }
}

impl Drop for Incoming {
    fn drop(&mut self) {
        if !self.accepted
            && let Err(error) = self.files.remove(&self.folder)
        {
            tracing::warn!(folder = %self.folder.display(), %error, "leftover of an upload cannot be removed now");
        }
    }
}

#[cfg(test)]
#[path = "store_tests.rs"]
mod tests;
