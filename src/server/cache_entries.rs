//! Entries of the caches, and their weights.

use std::fs::File;
use std::io::{self, Read as _, Write as _};
use std::path::PathBuf;
use std::sync::Arc;

use bytes::Bytes;
use sha2::{Digest, Sha256};

use super::answer_memory::WHOLE;
use super::body_source::Source;
use super::cache::Weight;
use super::problem::Problem;
use tmpi_core::Scene;
use tmpi_core::container::TileRect;
use tmpi_library::{Blob, BlobStore, LibraryError, Part, hex};

/// Derived files with more bytes are stored on disk.
const LARGE: usize = 1 << 20;
/// Files up to this many bytes are cached in memory; larger ones are read while they are sent.
const SMALL: u64 = 256 << 10;
/// Weight of an open file in the file cache, which bounds the number of open files, too.
const OPEN_FILE: usize = 1 << 20;

/// A result file of a photo, or a derived one.
#[derive(Clone, Debug)]
pub struct StoredFile {
    pub source: Source,
    /// Strong entity tag with its quotes.
    pub etag: Arc<str>,
}

/// What to do with large derived bytes if the disk is full.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DiskFullPolicy {
    /// Keep them in memory: views and levels, whose bytes the cache counts.
    Memory,
    /// Refuse them: exports, whose cache is sized for disk.
    Refuse,
}

impl StoredFile {
    /// Bytes tagged by their digest.
    pub fn new(bytes: Vec<u8>) -> Self {
        let etag = format!("\"{}\"", hex(&Sha256::digest(&bytes)[..16])).into();
        Self { source: Source::Memory(bytes.into()), etag }
    }

    /// Bytes tagged by the hash of their inputs, a dash, and their digest.
    pub fn derived_in_memory(made: &str, bytes: Vec<u8>) -> Self {
        let Self { source, etag } = Self::new(bytes);
        Self { source, etag: format!("\"{made}-{}\"", etag.get(1..17).unwrap_or_default()).into() }
    }

    /// A file of the library, tagged by its digest: in memory, or a file or object that is read while it is sent.
    ///
    /// # Errors
    /// [`LibraryError::Damaged`] if it has changed since it was written, [`LibraryError::Unavailable`].
    pub async fn of_blob(blobs: &BlobStore, part: Part, blob: &Blob) -> Result<Self, LibraryError> {
        let etag = format!("\"{}\"", blob.digest.as_str().get(..32).unwrap_or_default()).into();
        if blob.bytes <= SMALL {
            let bytes = blobs.read(part, blob).await?;
            if let Some(held) = WHOLE.hold(&bytes) {
                return Ok(Self { source: held.into(), etag });
            }
        }
        let Some(path) = blobs.path(blob) else {
            return Ok(Self { source: Source::Object(blobs.clone(), Arc::new(blob.clone())), etag });
        };
        let wanted = blob.clone();
        let opened = tokio::task::spawn_blocking(move || open(&path, &wanted)).await;
        let damaged = |detail: &str| LibraryError::Damaged { part, detail: detail.to_owned() };
        match opened.map_err(io::Error::other).flatten() {
            Ok(Some(file)) => Ok(Self { source: Source::File(Arc::new(file), blob.bytes as usize), etag }),
            Ok(None) => Err(damaged("it is not what was written")),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Err(blobs.missing(part).await),
            Err(error) => Err(damaged(&format!("it cannot be read: {error}"))),
        }
    }

    /// Derived bytes, tagged by their digest and, if `made` is given, by it: then [`super::conditional::known_etag`] recognizes them before
    /// they are made again. Large ones, and those beyond [`WHOLE`], go into an unnamed file, so that slow readers hold no memory; the last
    /// reader frees it. Blocks.
    ///
    /// # Errors
    /// 507 if the disk has no space beyond the reserve and they may not stay in memory, 500.
    pub fn derived(made: Option<&str>, bytes: Vec<u8>, disk: &TempFolder, full: DiskFullPolicy) -> Result<Self, Problem> {
        let Self { source, etag } = match made {
            Some(made) => Self::derived_in_memory(made, bytes),
            None => Self::new(bytes),
        };
        let source = match source {
            Source::Memory(bytes) => kept(bytes, disk, full)?,
            source => source,
        };
        Ok(Self { source, etag })
    }
}

/// Keeps derived bytes in memory, or else on disk.
fn kept(bytes: Bytes, disk: &TempFolder, full: DiskFullPolicy) -> Result<Source, Problem> {
    if bytes.len() <= LARGE
        && let Some(held) = WHOLE.hold(&bytes)
    {
        return Ok(held.into());
    }
    match disk.keep(&bytes) {
        Ok(file) => Ok(Source::File(Arc::new(file), bytes.len())),
        Err(LibraryError::StorageFull) if full == DiskFullPolicy::Memory => Ok(bytes.into()),
        Err(error) => Err(error.into()),
    }
}

/// Opens a file of the library; `None` if it differs from what was written.
fn open(path: &std::path::Path, blob: &Blob) -> io::Result<Option<File>> {
    let mut file = File::open(path)?;
    let (mut hash, mut piece, mut bytes) = (Sha256::new(), vec![0; SMALL as usize], 0);
    loop {
        let n = file.read(&mut piece)?;
        if n == 0 {
            break;
        }
        bytes += n as u64;
        hash.update(&piece[..n]);
    }
    Ok((bytes == blob.bytes && hex(&hash.finalize()) == blob.digest.as_str()).then_some(file))
}

/// Where unnamed temporary files lie.
#[derive(Clone, Debug)]
pub struct TempFolder {
    /// Tells whether there is space beyond the reserve.
    pub blobs: BlobStore,
    pub folder: PathBuf,
}

impl TempFolder {
    fn keep(&self, bytes: &[u8]) -> Result<File, LibraryError> {
        self.blobs.check_space(bytes.len() as u64)?;
        let written = tempfile::tempfile_in(&self.folder).and_then(|mut file| file.write_all(bytes).map(|()| file));
        written.map_err(|error| match error.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => LibraryError::StorageFull,
            _ => LibraryError::Internal(error.to_string()),
        })
    }
}

impl Weight for StoredFile {
    fn weight(&self) -> usize {
        match &self.source {
            Source::Memory(bytes) => bytes.len(),
            Source::File(..) | Source::Object(..) => OPEN_FILE,
        }
    }
}

/// Least weight of an export, to bound the number of open files.
const MIN_EXPORT: usize = 4 << 20;

/// An export file; its weight is disk space.
#[derive(Clone, Debug)]
pub struct Export(pub StoredFile);

impl Weight for Export {
    fn weight(&self) -> usize {
        self.0.source.len().max(MIN_EXPORT)
    }
}

impl Weight for Arc<Scene> {
    fn weight(&self) -> usize {
        self.memory()
    }
}

impl Weight for () {}

impl Weight for Part {}

impl Weight for Derived {}

impl Weight for String {
    fn weight(&self) -> usize {
        self.len()
    }
}

/// A container derived from a photo's own.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Derived {
    /// `1 / 2^level` of the size.
    pub level: u8,
    /// Only these tiles.
    pub tiles: Option<TileRect>,
    /// Only these sections, by their index in [`tmpi_core::container::SECTIONS`].
    pub sections: Option<Vec<u8>>,
}
