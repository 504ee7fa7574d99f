//! Written files on disk, each with a record beside it.
//!
//! ```text
//! DIR/exports/PHOTO-KEY.file     the bytes
//!             PHOTO-KEY.json     what they are: Record; written once they are on disk whole
//! ```
//! What has no record is removed at the next start, so that of a file that was being written nothing is left.

use std::collections::HashSet;
use std::fs::File;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::server::files::Files;
use crate::server::id::PhotoId;
use crate::server::store::Store;

/// End of the name of a file that is being written.
const TEMPORARY: &str = ".tmp";

/// What a file is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Record {
    /// 1.
    pub version: u32,
    /// Which making of the photo it is of: when it was made, milliseconds since 1970.
    pub at_ms: u64,
    /// Names everything that this server derives from that making.
    pub results: String,
    /// The recipe as text.
    pub recipe: String,
    /// Strong entity tag with its quotes.
    pub etag: String,
    /// Bytes.
    pub bytes: u64,
    /// When it was written, milliseconds since 1970.
    pub written_ms: u64,
}

/// The folder of written files.
#[derive(Debug)]
pub struct Shelf {
    files: Arc<dyn Files>,
    folder: PathBuf,
}

impl Shelf {
    /// That of a data directory, and what is in it; blocks.
    pub fn open(store: &Store) -> (Self, Vec<(PhotoId, String, Record)>) {
        let (files, folder) = store.written();
        let shelf = Self { files, folder };
        let found = shelf.look().unwrap_or_else(|error| {
            if error.kind() != io::ErrorKind::NotFound {
                tracing::warn!(%error, "written files cannot be read; they are written again");
            }
            Vec::new()
        });
        (shelf, found)
    }

    fn look(&self) -> io::Result<Vec<(PhotoId, String, Record)>> {
        let names = self.files.names(&self.folder)?;
        let mut found = Vec::new();
        let written: HashSet<&str> = names.iter().filter_map(|n| n.strip_suffix(".file")).collect();
        let whole = |stem: &str| {
            let (photo, key) = stem.split_once('-')?;
            let bytes = self.files.read(&self.folder.join(format!("{stem}.json"))).ok().filter(|_| written.contains(stem))?;
            Some((photo.parse().ok()?, key.to_owned(), serde_json::from_slice(&bytes).ok()?))
        };
        let records: Vec<&str> = names.iter().filter_map(|n| n.strip_suffix(".json")).collect();
        let kept: HashSet<&str> = records.into_iter().filter(|stem| whole(stem).map(|item| found.push(item)).is_some()).collect();
        for name in &names {
            let stem = name.strip_suffix(".json").or_else(|| name.strip_suffix(".file"));
            if !stem.is_some_and(|stem| kept.contains(stem)) {
                self.files.remove(&self.folder.join(name))?;
            }
        }
        Ok(found)
    }

    fn path(&self, photo: PhotoId, key: &str, ending: &str) -> PathBuf {
        self.folder.join(format!("{photo}-{key}.{ending}"))
    }

    /// Keeps a file: when this returns, it survives a crash; where it fails, nothing of it is left.
    ///
    /// # Errors
    /// The data directory cannot be written.
    pub fn put(&self, photo: PhotoId, key: &str, bytes: &[u8], record: &Record) -> io::Result<()> {
        self.files.create_dir(&self.folder, true)?;
        self.folder.parent().map_or(Ok(()), |above| self.files.sync_dir(above))?;
        let written = self.write(photo, key, "file", bytes).and_then(|()| {
            self.files.sync_dir(&self.folder)?;
            self.write(photo, key, "json", &serde_json::to_vec_pretty(record)?)?;
            self.files.sync_dir(&self.folder)
        });
        if written.is_err() {
            // what filled the disk must not keep it full
            self.remove(photo, key);
        }
        written
    }

    fn write(&self, photo: PhotoId, key: &str, ending: &str, bytes: &[u8]) -> io::Result<()> {
        let (path, fresh) = (self.path(photo, key, ending), self.path(photo, key, &format!("{ending}{TEMPORARY}")));
        self.files.write(&fresh, bytes).and_then(|()| self.files.rename(&fresh, &path)).inspect_err(|_| {
            // it may not even have begun
            let _ = self.files.remove(&fresh);
        })
    }

    /// Removes a file; who reads it goes on.
    pub fn remove(&self, photo: PhotoId, key: &str) {
        for ending in ["json", "file"] {
            match self.files.remove(&self.path(photo, key, ending)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    tracing::warn!(%photo, key, %error, "a file cannot be removed now");
                }
                _ => {}
            }
        }
    }

    /// Opens a file.
    ///
    /// # Errors
    /// It is not there, or not of the length that its record has.
    pub fn read(&self, photo: PhotoId, key: &str, record: &Record) -> io::Result<File> {
        let file = File::open(self.path(photo, key, "file"))?;
        let whole = file.metadata()?.len() == record.bytes;
        if whole { Ok(file) } else { Err(io::Error::new(io::ErrorKind::InvalidData, "a file of another length than was written")) }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::server::forgetful::Forgetful;

    fn opened(files: &Arc<Forgetful>) -> (Shelf, Vec<(PhotoId, String, Record)>) {
        let (store, _) = Store::open_in(files.clone(), Path::new("/data"), "", None).unwrap();
        Shelf::open(&store)
    }

    fn record() -> Record {
        Record { version: 1, at_ms: 2, results: "r".into(), recipe: "format=zip".into(), etag: "\"e\"".into(), bytes: 5, written_ms: 3 }
    }

    #[test]
    fn a_crash_leaves_a_file_whole_or_nothing_of_it() {
        let photo = PhotoId::of(&[1; 32], None, "", "");
        for steps in 0.. {
            let files = Arc::new(Forgetful::new());
            let (shelf, _) = opened(&files);
            files.sync_dir(Path::new("/")).unwrap();
            files.end_after(steps);
            let promised = shelf.put(photo, "abc", b"bytes", &record()).is_ok();
            files.crash();
            let (shelf, found) = opened(&files);
            let left = files.names(Path::new("/data/exports")).unwrap_or_default().len();
            assert_eq!(left, 2 * found.len(), "after {steps} steps half of it is there");
            if let [(_, key, seen)] = found.as_slice() {
                assert_eq!((key.as_str(), seen), ("abc", &record()));
                assert_eq!(files.read(&shelf.path(photo, "abc", "file")).unwrap(), b"bytes", "after {steps} steps");
            }
            assert!(!promised || found.len() == 1, "after {steps} steps what was promised is not there");
            if promised {
                assert!(steps > 4, "{steps}");
                return;
            }
        }
    }
}
