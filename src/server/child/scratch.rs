//! Folders for temporary files of processes, as the frames of a film on their way to a file: a process that is ended leaves them behind.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Name within the data directory of the folder of all.
const FOLDER: &str = "scratch";
/// By which programs find it.
pub(super) const VARIABLE: &str = if cfg!(windows) { "TMP" } else { "TMPDIR" };
/// Tries to remove one, and the pause between two: what is being ended may still make a file in it.
const TRIES: u32 = 100;
const PAUSE: Duration = Duration::from_millis(2);

/// Removes what processes of before left in a data directory, which is this process's alone by now; blocks.
///
/// # Errors
/// It cannot be removed.
pub fn empty(data: &Path) -> io::Result<()> {
    match std::fs::remove_dir_all(data.join(FOLDER)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// The folder of all in a data directory.
pub(super) fn folder(data: &Path) -> PathBuf {
    let folder = data.join(FOLDER);
    std::path::absolute(&folder).unwrap_or(folder)
}

/// The folder of one process, which goes with this.
#[derive(Debug)]
pub(super) struct Scratch(PathBuf);

impl Scratch {
    /// One that is not there yet: a process begins before the data directory is known to be its server's alone.
    pub fn below(folder: &Path) -> Self {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        Self(folder.join(NEXT.fetch_add(1, Ordering::Relaxed).to_string()))
    }

    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Makes it where it is missing, its owner's alone; blocks.
    ///
    /// # Errors
    /// The data directory cannot be written.
    pub fn make(&self) -> io::Result<()> {
        let mut builder = std::fs::DirBuilder::new();
        #[cfg(unix)]
        std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
        builder.recursive(true).create(&self.0)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        for _ in 0..TRIES {
            match std::fs::remove_dir_all(&self.0) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => std::thread::sleep(PAUSE),
                _ => return,
            }
        }
        tracing::warn!(folder = %self.0.display(), "temporary files cannot be removed now; they go with the next start");
    }
}
