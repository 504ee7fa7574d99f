//! What is kept of made photos for the next who asks, and what it weighs.

use std::fs::File;
use std::io::{self, Read as _, Write as _};
use std::path::PathBuf;
use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::cache::{Key, Value};
use super::problem::Problem;
use super::source::Source;
use tmpi_core::Scene;
use tmpi_core::container::Tiles;
use tmpi_library::{Blob, BlobStore, LibraryError, Part, PhotoId, hex};

/// A made photo: its id and when it was made, so that nothing of a deleted one is taken for the next of the same id.
pub type Version = (PhotoId, u64);

/// Derived files of more bytes are kept on disk.
const LARGE: usize = 1 << 20;
/// Contents up to this many bytes are kept in memory; larger ones are read while they are sent.
const SMALL: u64 = 256 << 10;
/// What an open file counts in a cache of files: their number is bounded, too.
const OPEN_FILE: usize = 1 << 20;

/// A file of a made photo, or what was derived of one.
#[derive(Clone, Debug)]
pub struct Stored {
    /// Its bytes.
    pub source: Source,
    /// Strong entity tag with its quotes.
    pub etag: Arc<str>,
}

/// What becomes of large derived bytes where the disk is full.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Full {
    /// They stay in memory: views and levels, of which the cache counts the bytes.
    Memory,
    /// They are refused: files to download, of which the cache is as large as a disk's.
    Refuse,
}

impl Stored {
    /// Bytes with their tag.
    #[must_use]
    pub fn of(source: Source, etag: Arc<str>) -> Self {
        Self { source, etag }
    }

    /// Tagged by its bytes.
    #[must_use]
    pub fn new(bytes: Vec<u8>) -> Self {
        let etag = format!("\"{}\"", hex(&Sha256::digest(&bytes)[..16])).into();
        Self::of(Source::Memory(bytes.into()), etag)
    }

    /// Bytes tagged by themselves and, before a dash, by what is part of them.
    #[must_use]
    pub fn derived_in_memory(made: &str, bytes: Vec<u8>) -> Self {
        let Self { source, etag } = Self::new(bytes);
        Self::of(source, format!("\"{made}-{}\"", etag.get(1..17).unwrap_or_default()).into())
    }

    /// A content of the library, tagged by its digest: in memory, or a file or an object that is read while it is sent.
    ///
    /// # Errors
    /// [`LibraryError::Damaged`] where it is not as it was written, [`LibraryError::Unavailable`].
    pub async fn of_blob(blobs: &BlobStore, part: Part, blob: &Blob) -> Result<Self, LibraryError> {
        let etag = format!("\"{}\"", blob.digest.as_str().get(..32).unwrap_or_default()).into();
        if blob.bytes <= SMALL {
            return Ok(Self::of(Source::Memory(blobs.read(part, blob).await?), etag));
        }
        let Some(path) = blobs.path(blob) else { return Ok(Self::of(Source::Object(blobs.clone(), Arc::new(blob.clone())), etag)) };
        let wanted = blob.clone();
        let opened = tokio::task::spawn_blocking(move || open(&path, &wanted)).await;
        let damaged = |detail: &str| LibraryError::Damaged { part, detail: detail.to_owned() };
        match opened.map_err(io::Error::other).flatten() {
            Ok(Some(file)) => Ok(Self::of(Source::File(Arc::new(file), blob.bytes as usize), etag)),
            Ok(None) => Err(damaged("it is not what was written")),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Err(damaged("it is missing")),
            Err(error) => Err(damaged(&format!("it cannot be read: {error}"))),
        }
    }

    /// Derived bytes, tagged by themselves and, where that tells them, by what they were made of: then
    /// [`super::conditional::known_as`] knows them before they are made again. Large ones go into a file that no name leads to, so that slow
    /// readers hold no memory; it goes with the last who reads it. Blocks.
    ///
    /// # Errors
    /// 507 where the disk has no room beyond its reserve, unless they may stay in memory, 500.
    pub fn derived(made: Option<&str>, bytes: Vec<u8>, disk: &Disk, full: Full) -> Result<Self, Problem> {
        let Self { source, etag } = match made {
            Some(made) => Self::derived_in_memory(made, bytes),
            None => Self::new(bytes),
        };
        let source = match source {
            Source::Memory(bytes) if bytes.len() > LARGE => match disk.keep(&bytes) {
                Ok(file) => Source::File(Arc::new(file), bytes.len()),
                Err(LibraryError::StorageFull) if full == Full::Memory => Source::Memory(bytes),
                Err(error) => return Err(error.into()),
            },
            source => source,
        };
        Ok(Self::of(source, etag))
    }
}

/// Opens a file of the library; none where it is not what was written.
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

/// Where files lie that no name leads to.
#[derive(Clone, Debug)]
pub struct Disk {
    /// Says whether there is room beyond the reserve.
    pub blobs: BlobStore,
    /// Their folder.
    pub folder: PathBuf,
}

impl Disk {
    fn keep(&self, bytes: &[u8]) -> Result<File, LibraryError> {
        self.blobs.room_for(bytes.len() as u64)?;
        let written = tempfile::tempfile_in(&self.folder).and_then(|mut file| file.write_all(bytes).map(|()| file));
        written.map_err(|error| match error.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => LibraryError::StorageFull,
            _ => LibraryError::Internal(error.to_string()),
        })
    }
}

impl Value for Stored {
    fn weight(&self) -> usize {
        match &self.source {
            Source::Memory(bytes) => bytes.len(),
            Source::File(..) | Source::Object(..) => OPEN_FILE,
        }
    }
}

/// What a file for download counts at least: the number of those that are open is bounded, too.
const LEAST_EXPORT: usize = 4 << 20;

/// A file for download; what it weighs is disk.
#[derive(Clone, Debug)]
pub struct Export(pub Stored);

impl Value for Export {
    fn weight(&self) -> usize {
        self.0.source.len().max(LEAST_EXPORT)
    }
}

impl Value for Arc<Scene> {
    fn weight(&self) -> usize {
        self.memory()
    }
}

impl Key for Version {
    fn photo(&self) -> PhotoId {
        self.0
    }
}

impl Key for (Version, Part) {
    fn photo(&self) -> PhotoId {
        self.0.0
    }
}

impl Key for (Version, String) {
    fn photo(&self) -> PhotoId {
        self.0.0
    }

    fn weight(&self) -> usize {
        self.1.len()
    }
}

impl Key for (Version, Derived) {
    fn photo(&self) -> PhotoId {
        self.0.0
    }
}

/// A container that is made of a photo's own.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Derived {
    /// `1 / 2^level` of the size.
    pub level: u8,
    /// These tiles alone.
    pub tiles: Option<Tiles>,
    /// These sections alone, by their place among [`tmpi_core::container::SECTIONS`].
    pub sections: Option<Vec<u8>>,
}
