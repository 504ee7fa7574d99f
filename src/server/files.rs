//! What the store does with files, as a seam: the disk, and in tests one that forgets what was not synced.

use std::fmt::Debug;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::Path;

/// Room that is kept free for what must be written of photos accepted already: what was said, or as much as is usual.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Reserve {
    /// Bytes; where there is none [`Reserve::BYTES`], or a twentieth of a smaller disk.
    pub bytes: Option<u64>,
    /// Files: a photo has a dozen with those that are on their way; where there is none [`Reserve::FILES`], or a hundredth of a smaller disk's.
    pub files: Option<u64>,
}

impl Reserve {
    /// 64 MiB.
    pub const BYTES: u64 = 64 << 20;
    /// 1 024 files.
    pub const FILES: u64 = 1024;
    const SHARE: u64 = 20;
    const FILES_SHARE: u64 = 100;

    /// Bytes and files of a disk as large as that which has this left.
    #[must_use]
    pub fn of(&self, room: &Room) -> (u64, u64) {
        let bytes = self.bytes.unwrap_or_else(|| Self::BYTES.min(room.all_bytes / Self::SHARE));
        (bytes, self.files.unwrap_or_else(|| Self::FILES.min(room.all_files / Self::FILES_SHARE)))
    }
}

/// Files and folders of a data directory. All that is written is readable by its owner alone.
pub trait Files: Debug + Send + Sync + 'static {
    /// Makes a folder, with those above it where `all`.
    ///
    /// # Errors
    /// As [`fs::create_dir`].
    fn create_dir(&self, path: &Path, all: bool) -> io::Result<()>;

    /// Writes a whole file and syncs it. What could not be written whole is left behind.
    ///
    /// # Errors
    /// As [`fs::write`].
    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()>;

    /// Makes the bytes of a file durable.
    ///
    /// # Errors
    /// There is none, or the system cannot.
    fn sync(&self, path: &Path) -> io::Result<()>;

    /// The bytes of a file.
    ///
    /// # Errors
    /// As [`fs::read`].
    fn read(&self, path: &Path) -> io::Result<Vec<u8>>;

    /// Names within a folder, in any order.
    ///
    /// # Errors
    /// As [`fs::read_dir`].
    fn names(&self, path: &Path) -> io::Result<Vec<String>>;

    /// Renames a file or folder, over a file that is there.
    ///
    /// # Errors
    /// As [`fs::rename`].
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Gives a file a second name.
    ///
    /// # Errors
    /// As [`fs::hard_link`]: [`io::ErrorKind::AlreadyExists`] where there is a file of that name.
    fn link(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// True where there is a folder.
    fn is_dir(&self, path: &Path) -> bool;

    /// Makes what was made, renamed and removed within a folder durable.
    ///
    /// # Errors
    /// The system cannot.
    fn sync_dir(&self, path: &Path) -> io::Result<()>;

    /// Removes a file, or a folder with all that is in it.
    ///
    /// # Errors
    /// As [`fs::remove_file`] and [`fs::remove_dir_all`].
    fn remove(&self, path: &Path) -> io::Result<()>;

    /// What the file system has left; none where it does not tell.
    fn room(&self, path: &Path) -> Option<Room>;
}

/// What a file system has left, for who is no administrator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Room {
    /// Free bytes.
    pub bytes: u64,
    /// All bytes.
    pub all_bytes: u64,
    /// Files that can still be made.
    pub files: u64,
    /// All files that it has place for; 0 where their number has no limit of its own, as on btrfs.
    pub all_files: u64,
}

impl Room {
    /// True where no more is left than what is to be kept free.
    #[must_use]
    pub fn is_short(&self, reserve: Reserve) -> bool {
        let (bytes, files) = reserve.of(self);
        self.bytes < bytes || self.all_files > 0 && self.files < files
    }
}

/// The file system.
#[derive(Debug)]
pub struct Disk;

impl Files for Disk {
    fn create_dir(&self, path: &Path, all: bool) -> io::Result<()> {
        let mut builder = fs::DirBuilder::new();
        builder.recursive(all);
        #[cfg(unix)]
        std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
        builder.create(path)
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let mut file = private().create(true).truncate(true).write(true).open(path)?;
        file.write_all(bytes)?;
        file.sync_all()
    }

    fn sync(&self, path: &Path) -> io::Result<()> {
        // for writing, as some systems want it
        OpenOptions::new().write(true).open(path)?.sync_all()
    }

    fn read(&self, path: &Path) -> io::Result<Vec<u8>> {
        fs::read(path)
    }

    fn names(&self, path: &Path) -> io::Result<Vec<String>> {
        // a name that is no text is nobody's here
        fs::read_dir(path)?.map(|e| Ok(e?.file_name().to_string_lossy().into_owned())).collect()
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::hard_link(from, to)
    }

    fn is_dir(&self, path: &Path) -> bool {
        path.is_dir()
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        // directories cannot be opened as files elsewhere
        if cfg!(unix) { File::open(path)?.sync_all() } else { Ok(()) }
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        match fs::remove_file(path) {
            Err(e) if e.kind() != io::ErrorKind::NotFound && path.is_dir() => fs::remove_dir_all(path),
            done => done,
        }
    }

    #[cfg(unix)]
    #[allow(unsafe_code, reason = "a call of libc that only writes the struct it is handed")]
    fn room(&self, path: &Path) -> Option<Room> {
        let path = std::ffi::CString::new(std::os::unix::ffi::OsStrExt::as_bytes(path.as_os_str())).ok()?;
        // SAFETY: all zeros is a value of this struct of integers
        let mut room: libc::statvfs = unsafe { std::mem::zeroed() };
        // SAFETY: the path ends with a zero, and the struct outlives the call
        let answer = unsafe { libc::statvfs(path.as_ptr(), &raw mut room) };
        #[allow(clippy::useless_conversion, clippy::unnecessary_cast, reason = "the widths differ by system")]
        let (block, blocks, files) = (
            room.f_frsize as u64,
            [u64::from(room.f_bavail), u64::from(room.f_blocks)],
            [u64::from(room.f_favail), u64::from(room.f_files)],
        );
        let [bytes, all_bytes] = blocks.map(|blocks| blocks.saturating_mul(block));
        let [files, all_files] = files;
        (answer == 0).then_some(Room { bytes, all_bytes, files, all_files })
    }

    #[cfg(not(unix))]
    fn room(&self, _: &Path) -> Option<Room> {
        None
    }
}

/// How files are opened that only their owner may read.
pub fn private() -> OpenOptions {
    let mut options = OpenOptions::new();
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_is_short_of_bytes_or_of_files() {
        const MUCH: u64 = 1 << 40;
        let usual = Reserve::default();
        let short = |bytes, all_bytes, files, all_files| Room { bytes, all_bytes, files, all_files }.is_short(usual);
        assert!(!short(Reserve::BYTES, MUCH, Reserve::FILES, MUCH));
        assert!(short(Reserve::BYTES - 1, MUCH, MUCH, MUCH), "bytes");
        assert!(short(MUCH, MUCH, Reserve::FILES - 1, MUCH) && short(MUCH, MUCH, 0, MUCH), "files");
        // of a small disk less is kept
        assert!(
            !short(5 << 20, 100 << 20, 100, 10_000)
                && short((5 << 20) - 1, 100 << 20, 100, 10_000)
                && short(5 << 20, 100 << 20, 99, 10_000)
        );
        // files without a limit
        assert!(!short(MUCH, MUCH, 0, 0) && short(0, MUCH, 0, 0));
        // what was said holds, of a small disk too
        let said = Reserve { bytes: Some(50 << 20), files: Some(500) };
        let room = Room { bytes: 50 << 20, all_bytes: 100 << 20, files: 500, all_files: 10_000 };
        assert!(!room.is_short(said) && !room.is_short(usual));
        assert!(Room { bytes: (50 << 20) - 1, ..room }.is_short(said) && Room { files: 499, ..room }.is_short(said));
        assert!(!Room { files: 0, all_files: 0, ..room }.is_short(said), "files without a limit");
    }

    #[cfg(unix)]
    #[test]
    fn a_disk_tells_what_it_has_left() {
        let dir = tempfile::tempdir().unwrap();
        let room = Disk.room(dir.path()).unwrap();
        assert!(0 < room.bytes && room.bytes <= room.all_bytes, "{room:?}");
        assert!(Disk.room(&dir.path().join("none")).is_none());
    }
}
