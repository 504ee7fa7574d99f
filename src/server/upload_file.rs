//! Writes an uploaded file onto disk while it arrives.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use sha2::{Digest as _, Sha256};
use tokio::fs::File;
use tokio::io::AsyncWriteExt;

use super::app_state::App;
use super::maker::HeadOf;
use super::problem::Problem;
use super::upload_head::UploadHead;
use tmpi_library::{Content, Digest};

/// Size of the write buffer.
const BUFFER: usize = 256 << 10;

/// A received file. Dropping this deletes it, unless the library has taken it.
pub struct ReceivedFile {
    path: TempPath,
    pub digest: Digest,
    pub bytes: u64,
}

impl ReceivedFile {
    /// Reads it whole.
    pub fn read(&self) -> Result<Vec<u8>, Problem> {
        std::fs::read(&self.path.0).map_err(|e| Problem::store(&e))
    }

    /// For the library.
    pub fn content(&self) -> Content {
        Content::of_file(self.path.0.clone(), self.bytes, self.digest.clone())
    }
}

/// The path of a file that is deleted when this is dropped.
struct TempPath(PathBuf);

impl TempPath {
    /// A unique path.
    fn within(folder: &Path) -> Self {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        Self(folder.join(format!("upload-{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed))))
    }
}

impl Drop for TempPath {
    fn drop(&mut self) {
        let path = std::mem::take(&mut self.0);
        // removal blocks; a file that the library has moved is gone already
        let remove = move || drop(std::fs::remove_file(path));
        match tokio::runtime::Handle::try_current() {
            Ok(runtime) => drop(runtime.spawn_blocking(remove)),
            Err(_) => remove(),
        }
    }
}

/// A new file that only its owner may read.
async fn create(path: &Path) -> std::io::Result<File> {
    let mut options = std::fs::OpenOptions::new();
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options.create_new(true).write(true);
    tokio::fs::OpenOptions::from(options).open(path).await
}

/// Writes a stream to a file, piece by piece, and checks its first bytes as those `of` a part of an upload.
///
/// # Errors
/// Those of `problem` and [`UploadHead::see`], 507, 500.
pub async fn receive<S, E>(app: &App, mut stream: S, of: HeadOf<'_>, problem: impl Fn(E) -> Problem) -> Result<ReceivedFile, Problem>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
{
    let disk = |e: std::io::Error| Problem::store(&e);
    app.library.blobs().check_space(0)?;
    let path = TempPath::within(app.library.incoming());
    let mut file = tokio::io::BufWriter::with_capacity(BUFFER, create(&path.0).await.map_err(disk)?);
    let (mut head, mut hash) = (UploadHead::new(&app.maker), Sha256::new());
    let mut bytes = 0;
    while let Some(chunk) = stream.next().await {
        let chunk = chunk.map_err(&problem)?;
        head.see(&chunk, of)?;
        hash.update(&chunk);
        bytes += chunk.len() as u64;
        file.write_all(&chunk).await.map_err(disk)?;
    }
    file.flush().await.map_err(disk)?;
    Ok(ReceivedFile { path, digest: Digest::from_bytes(&hash.finalize().into()), bytes })
}
