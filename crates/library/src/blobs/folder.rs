//! Blobs in a local folder.
//!
//! A blob is written to a temporary file, synced, and renamed; then the folder is synced. A crash may leave temporary files, which are
//! deleted when the folder is next opened.

use std::fmt::Debug;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::UNIX_EPOCH;

use bytes::Bytes;

use super::{Listed, Source, Write};
use crate::Millis;
use crate::error::{LibraryError, Result};

/// Folder for temporary files.
const INCOMING: &str = "incoming";
/// Number of the next temporary file.
static NEXT: AtomicU64 = AtomicU64::new(0);

/// Free disk space that uploads must leave, so that accepted photos can be finished.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Reserve {
    /// Bytes; by default [`Reserve::BYTES`], or a twentieth of a smaller disk.
    pub bytes: Option<u64>,
    /// Files; by default [`Reserve::FILES`], or a hundredth of the capacity of a smaller disk.
    pub files: Option<u64>,
}

impl Reserve {
    /// 64 MiB.
    pub const BYTES: u64 = 64 << 20;
    /// 1 024 files.
    pub const FILES: u64 = 1024;
}

/// Free space of a file system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DiskSpace {
    /// Free bytes.
    pub bytes: u64,
    /// All bytes.
    pub all_bytes: u64,
    /// Number of files that can still be created.
    pub files: u64,
    /// Capacity in files; 0 if the file system does not limit their number.
    pub all_files: u64,
}

impl DiskSpace {
    fn has(&self, bytes: u64, reserve: Reserve) -> bool {
        let files = reserve.files.unwrap_or_else(|| Reserve::FILES.min(self.all_files / 100));
        let least = reserve.bytes.unwrap_or_else(|| Reserve::BYTES.min(self.all_bytes / 20));
        (self.all_files == 0 || self.files >= files) && self.bytes.saturating_sub(bytes) >= least
    }
}

/// File operations, which tests replace by a disk that loses unsynced data.
pub(crate) trait Files: Debug + Send + Sync + 'static {
    fn create_dir(&self, path: &Path) -> io::Result<()>;
    /// Writes a whole file and syncs it.
    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()>;
    fn sync(&self, path: &Path) -> io::Result<()>;
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Syncs the entries of a folder.
    fn sync_dir(&self, path: &Path) -> io::Result<()>;
    fn read(&self, path: &Path, range: Option<Range<u64>>) -> io::Result<Vec<u8>>;
    fn remove(&self, path: &Path) -> io::Result<()>;
    /// The files of a folder, by name.
    fn list(&self, path: &Path) -> io::Result<Vec<Listed>>;
    /// Free space; `None` if the system does not tell.
    fn disk_space(&self, path: &Path) -> Option<DiskSpace>;
}

#[derive(Debug)]
pub(crate) struct Disk;

impl Files for Disk {
    fn create_dir(&self, path: &Path) -> io::Result<()> {
        let mut builder = fs::DirBuilder::new();
        builder.recursive(true);
        #[cfg(unix)]
        std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
        builder.create(path)
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let mut options = OpenOptions::new();
        #[cfg(unix)]
        std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
        let mut file = options.create(true).truncate(true).write(true).open(path)?;
        file.write_all(bytes)?;
        file.sync_all()
    }

    fn sync(&self, path: &Path) -> io::Result<()> {
        // some systems only sync files that are open for writing
        OpenOptions::new().write(true).open(path)?.sync_all()
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        // directories cannot be opened as files elsewhere
        if cfg!(unix) { File::open(path)?.sync_all() } else { Ok(()) }
    }

    fn read(&self, path: &Path, range: Option<Range<u64>>) -> io::Result<Vec<u8>> {
        let Some(range) = range else { return fs::read(path) };
        let mut file = File::open(path)?;
        file.seek(SeekFrom::Start(range.start))?;
        let mut bytes = Vec::new();
        file.take(range.end.saturating_sub(range.start)).read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }

    fn list(&self, path: &Path) -> io::Result<Vec<Listed>> {
        let mut all = Vec::new();
        for entry in fs::read_dir(path)? {
            let entry = entry?;
            match entry.metadata() {
                Ok(of) if of.is_file() => {
                    let written_at = of.modified()?.duration_since(UNIX_EPOCH).map_or(0, |age| age.as_millis() as Millis);
                    all.push(Listed { name: entry.file_name().to_string_lossy().into_owned(), bytes: of.len(), written_at });
                }
                Ok(_) => {}
                // deleted meanwhile
                Err(e) if e.kind() == io::ErrorKind::NotFound => {}
                Err(e) => return Err(e),
            }
        }
        Ok(all)
    }

    #[cfg(unix)]
    fn disk_space(&self, path: &Path) -> Option<DiskSpace> {
        let of = rustix::fs::statvfs(path).ok()?;
        let bytes = |blocks: u64| blocks.saturating_mul(of.f_frsize);
        Some(DiskSpace { bytes: bytes(of.f_bavail), all_bytes: bytes(of.f_blocks), files: of.f_favail, all_files: of.f_files })
    }

    #[cfg(not(unix))]
    fn disk_space(&self, _: &Path) -> Option<DiskSpace> {
        None
    }
}

/// Creates a folder, with its parents, that only its owner can read.
pub(crate) fn create_private(path: &Path) -> Result<()> {
    Disk.create_dir(path).map_err(|e| LibraryError::Invalid(format!("the folder {} cannot be made: {e}", path.display())))
}

#[derive(Clone, Debug)]
pub(super) struct Folder {
    files: Arc<dyn Files>,
    root: PathBuf,
    reserve: Reserve,
}

impl Folder {
    pub fn open(root: &Path, reserve: Reserve) -> Result<Self> {
        Self::open_in(Arc::new(Disk), root, reserve)
    }

    pub fn open_in(files: Arc<dyn Files>, root: &Path, reserve: Reserve) -> Result<Self> {
        let folder = Self { files, root: root.to_owned(), reserve };
        folder.prepare().map_err(|e| LibraryError::Invalid(format!("the folder {} cannot be written: {e}", root.display())))?;
        Ok(folder)
    }

    /// Creates missing folders.
    fn prepare(&self) -> io::Result<()> {
        for prefix in super::prefixes().chain([INCOMING.to_owned(), super::PROBE.to_owned()]) {
            self.files.create_dir(&self.root.join(prefix))?;
        }
        self.files.sync_dir(&self.root)?;
        self.root.parent().map_or(Ok(()), |above| self.files.sync_dir(above))
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.root.join(name)
    }

    pub fn disk_space(&self) -> Option<DiskSpace> {
        self.files.disk_space(&self.root)
    }

    pub fn check_space(&self, bytes: u64) -> Result<()> {
        match self.files.disk_space(&self.root) {
            Some(space) if !space.has(bytes, self.reserve) => Err(LibraryError::StorageFull),
            _ => Ok(()),
        }
    }

    /// Runs `work` on a thread that may block.
    async fn blocking<T: Send + 'static>(&self, work: impl FnOnce(&Self) -> io::Result<T> + Send + 'static) -> Result<T> {
        let folder = self.clone();
        let done = tokio::task::spawn_blocking(move || work(&folder)).await;
        done.map_err(|e| LibraryError::Internal(e.to_string()))?.map_err(|e| match e.kind() {
            io::ErrorKind::NotFound => LibraryError::NotFound("blob"),
            _ => LibraryError::blobs(&e),
        })
    }

    pub async fn put_all(&self, writes: Vec<Write>) -> Result<()> {
        self.blocking(move |folder| folder.write_all(&writes)).await
    }

    fn write_all(&self, writes: &[Write]) -> io::Result<()> {
        let mut folders: Vec<PathBuf> = Vec::new();
        for write in writes {
            let place = self.path(&write.name);
            self.write_one(write, &place)?;
            folders.extend(place.parent().map(Path::to_owned));
        }
        folders.sort_unstable();
        folders.dedup();
        folders.iter().try_for_each(|folder| self.files.sync_dir(folder))
    }

    fn write_one(&self, write: &Write, place: &Path) -> io::Result<()> {
        match &write.source {
            Source::Bytes(bytes) => {
                // concurrent writers of one name need different temporary files
                let n = NEXT.fetch_add(1, Ordering::Relaxed);
                let fresh = self.root.join(INCOMING).join(format!("{}-{}-{n}", write.name.replace('/', "-"), std::process::id()));
                let written = self.files.write(&fresh, bytes).and_then(|()| self.files.rename(&fresh, place));
                if written.is_err() {
                    // a partial file must not keep the disk full
                    let _ = self.files.remove(&fresh);
                }
                written
            }
            Source::File(path) => self.files.sync(path).and_then(|()| self.files.rename(path, place)),
        }
    }

    pub async fn get(&self, name: &str, range: Option<Range<u64>>) -> Result<Bytes> {
        let path = self.path(name);
        self.blocking(move |folder| folder.files.read(&path, range)).await.map(Bytes::from)
    }

    pub async fn delete(&self, name: &str) -> Result<()> {
        let path = self.path(name);
        match self.blocking(move |folder| folder.files.remove(&path)).await {
            Err(LibraryError::NotFound(_)) => Ok(()),
            done => done,
        }
    }

    pub async fn list(&self, prefix: &str) -> Result<Vec<Listed>> {
        let folder = prefix.to_owned();
        let listed = self.blocking(move |this| this.files.list(&this.root.join(&folder))).await?;
        Ok(listed.into_iter().map(|file| Listed { name: format!("{prefix}/{}", file.name), ..file }).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_keeps_its_reserve_of_bytes_and_files() {
        const MUCH: u64 = 1 << 40;
        let reserve = Reserve::default();
        let has = |bytes, all_bytes, files, all_files| DiskSpace { bytes, all_bytes, files, all_files }.has(10, reserve);
        assert!(has(Reserve::BYTES + 10, MUCH, Reserve::FILES, MUCH));
        assert!(!has(Reserve::BYTES + 9, MUCH, MUCH, MUCH), "bytes");
        assert!(!has(MUCH, MUCH, Reserve::FILES - 1, MUCH), "files");
        assert!(has((5 << 20) + 10, 100 << 20, 100, 10_000) && !has(5 << 20, 100 << 20, 100, 10_000), "a small disk");
        assert!(has(MUCH, MUCH, 0, 0), "a system that does not limit files");
        let said = Reserve { bytes: Some(50), files: Some(500) };
        let space = DiskSpace { bytes: 60, all_bytes: 100, files: 500, all_files: 600 };
        assert!(space.has(10, said) && !space.has(11, said) && !DiskSpace { files: 499, ..space }.has(10, said), "explicit values hold");
    }
}
