//! What is kept of made photos for the next who asks, and what it weighs.

use std::fs::File;
use std::io::{ErrorKind, Write as _};
use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::cache::{Key, Value};
use super::id::{PhotoId, hex};
use super::problem::Problem;
use super::source::Source;
use super::store::{Part, Store};
use tmpi_core::Scene;
use tmpi_core::container::Tiles;

/// A made photo: its id and when it was made, so that nothing of a deleted one is taken for the next of the same id.
pub type Version = (PhotoId, u64);

/// Derived files of more bytes are kept on disk.
const LARGE: usize = 1 << 20;
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

    /// Derived bytes, tagged by themselves and, where that tells them, by what they were made of: then
    /// [`super::conditional::known_as`] knows them before they are made again. Large ones go into a file of `store` that no name leads
    /// to, so that slow readers hold no memory; it goes with the last who reads it. Blocks.
    ///
    /// # Errors
    /// 507 where the disk has no room beyond its reserve, unless they may stay in memory, 500.
    pub fn derived(made: Option<&str>, bytes: Vec<u8>, store: &Store, full: Full) -> Result<Self, Problem> {
        let Self { source, etag } = match made {
            Some(made) => Self::derived_in_memory(made, bytes),
            None => Self::new(bytes),
        };
        let source = match source {
            Source::Memory(bytes) if bytes.len() > LARGE => {
                match store.scratch().and_then(|mut file: File| file.write_all(&bytes).map(|()| file)) {
                    Ok(file) => Source::File(Arc::new(file), bytes.len()),
                    Err(e) if full == Full::Memory && e.kind() == ErrorKind::StorageFull => Source::Memory(bytes),
                    Err(e) => return Err(Problem::store(&e)),
                }
            }
            source => source,
        };
        Ok(Self::of(source, etag))
    }
}

impl Value for Stored {
    fn weight(&self) -> usize {
        match &self.source {
            Source::Memory(bytes) => bytes.len(),
            Source::File(..) => OPEN_FILE,
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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::forgetful::Forgetful;
    use super::*;

    #[test]
    fn what_is_derived_leaves_the_reserve_of_the_disk_alone() {
        let dir = tempfile::tempdir().unwrap();
        let (disk, _) = Store::open(dir.path(), "").unwrap();
        let derive = |bytes, store: &Store, full| Stored::derived(None, vec![7; bytes], store, full);
        assert!(matches!(derive(LARGE + 1, &disk, Full::Refuse).unwrap().source, Source::File(..)));
        assert!(matches!(derive(LARGE, &disk, Full::Refuse).unwrap().source, Source::Memory(_)));
        let files = Arc::new(Forgetful::new());
        let (store, _) = Store::open_in(files.clone(), Path::new("/data"), "", None).unwrap();
        files.fill(true);
        assert_eq!(derive(LARGE + 1, &store, Full::Refuse).unwrap_err().status, 507);
        let view = derive(LARGE + 1, &store, Full::Memory).unwrap();
        assert!(matches!(view.source, Source::Memory(_)) && view.weight() == LARGE + 1, "counted as what it takes");
    }
}
