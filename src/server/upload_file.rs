//! Writes an uploaded file onto disk while it arrives.

use std::io;
use std::path::PathBuf;

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
    pub fn read(&self) -> Result<Vec<u8>, Problem> {
        std::fs::read(&self.path.0).map_err(|e| Problem::store(&e))
    }

    pub fn content(&self) -> Content {
        Content::of_file(self.path.0.clone(), self.bytes, self.digest.clone())
    }
}

/// The path of a file that is deleted when this is dropped.
struct TempPath(PathBuf);

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
async fn create(folder: PathBuf) -> io::Result<(File, TempPath)> {
    let create = move || {
        let (file, path) = tempfile::Builder::new().prefix("upload-").tempfile_in(folder)?.keep()?;
        Ok::<_, io::Error>((File::from_std(file), TempPath(path)))
    };
    tokio::task::spawn_blocking(create).await?
}

/// Writes a stream to a file, piece by piece, and checks its first bytes as those `of` a part of an upload.
///
/// # Errors
/// Those of `problem` and [`UploadHead::see`], 507, 500.
pub async fn receive<S, E>(app: &App, mut stream: S, of: HeadOf<'_>, problem: impl Fn(E) -> Problem) -> Result<ReceivedFile, Problem>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
{
    let disk = |e: io::Error| Problem::store(&e);
    app.library.blobs().check_space(0)?;
    let (file, path) = create(app.library.incoming().to_owned()).await.map_err(disk)?;
    let mut file = tokio::io::BufWriter::with_capacity(BUFFER, file);
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
