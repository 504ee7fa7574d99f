//! Folders for the temporary files of child processes, such as frames of a film, which a killed process leaves behind.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Name of the parent folder in the data directory.
const FOLDER: &str = "scratch";
/// Environment variable that names the folder.
pub(super) const VARIABLE: &str = if cfg!(windows) { "TMP" } else { "TMPDIR" };
/// Tries to remove a folder, and the pause between them: a process being killed may still create a file in it.
const TRIES: u32 = 100;
const PAUSE: Duration = Duration::from_millis(2);

/// Removes leftovers of earlier processes from a data directory that this process has locked; blocks.
pub fn remove_leftovers(data: &Path) -> io::Result<()> {
    match std::fs::remove_dir_all(data.join(FOLDER)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// The parent folder in a data directory.
pub(super) fn folder(data: &Path) -> PathBuf {
    let folder = data.join(FOLDER);
    std::path::absolute(&folder).unwrap_or(folder)
}

/// The folder of one process; dropping it removes the folder.
#[derive(Debug)]
pub(super) struct Scratch(PathBuf);

impl Scratch {
    /// A folder that is not created yet: a process starts before the server has locked the data directory.
    pub fn below(folder: &Path) -> Self {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        Self(folder.join(NEXT.fetch_add(1, Ordering::Relaxed).to_string()))
    }

    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Creates it if it is missing, accessible only to its owner; blocks.
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
        tracing::warn!(folder = %self.0.display(), "cannot remove temporary files; the next start does");
    }
}
