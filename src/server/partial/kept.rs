//! Uploads in parts on disk.
//!
//! ```text
//! DIR/uploads/ID/record.json   what is known of it: Record
//!               data           its bytes; as many of them count as the record says
//! ```
//! The record counts only bytes that were synced before it was written: what a crash leaves is what the client goes on from.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::extent::Extent;
use crate::server::access::Owner;
use crate::server::files::Files;

/// Version of the record that this program writes.
pub const VERSION: u32 = 1;
/// File of the record, and of one that is being written.
const RECORD: &str = "record.json";
const FRESH: &str = "record.json.tmp";
/// File of the bytes.
const DATA: &str = "data";

/// What is known of an upload in parts.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Record {
    /// [`VERSION`].
    pub version: u32,
    /// When something came of it last, milliseconds since 1970.
    pub touched_ms: u64,
    /// How far it is.
    #[serde(flatten)]
    pub extent: Extent,
    /// Parameters that it began with.
    pub query: Vec<(String, String)>,
    /// Media type of the whole, where it is not the photo alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub content_type: Option<String>,
    /// Who began it; none where nobody was asked, or they had no secret.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub owner: Option<Owner>,
    /// Id of the photo that it became.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub photo: Option<String>,
}

/// The folder of all of them.
#[derive(Clone, Debug)]
pub struct Kept {
    files: Arc<dyn Files>,
    dir: PathBuf,
}

impl Kept {
    /// Opens the folder, makes it where it is missing, and tells what is there; what cannot be read is removed.
    ///
    /// # Errors
    /// It cannot be read or written.
    pub fn open(files: Arc<dyn Files>, dir: PathBuf) -> io::Result<(Self, Vec<(String, Record)>)> {
        files.create_dir(&dir, true)?;
        if let Some(above) = dir.parent() {
            files.sync_dir(above)?;
        }
        let kept = Self { files, dir };
        let mut all = Vec::new();
        for id in kept.files.names(&kept.dir)? {
            let bytes = kept.files.read(&kept.dir.join(&id).join(RECORD));
            match bytes.and_then(|bytes| Ok(serde_json::from_slice(&bytes)?)) {
                Ok(record) => all.push((id, record)),
                // one that was beginning or going when the server ended
                Err(error) => {
                    tracing::warn!(%error, "an upload in parts cannot be read; it is removed");
                    kept.remove(&id)?;
                }
            }
        }
        Ok((kept, all))
    }

    /// The file of an upload's bytes.
    #[must_use]
    pub fn data(&self, id: &str) -> PathBuf {
        self.dir.join(id).join(DATA)
    }

    /// Begins an upload.
    ///
    /// # Errors
    /// The disk cannot be written.
    pub fn begin(&self, id: &str, record: &Record) -> io::Result<()> {
        let folder = self.dir.join(id);
        self.files.create_dir(&folder, false)?;
        let begun =
            self.files.write(&folder.join(DATA), &[]).and_then(|()| self.write(id, record)).and_then(|()| self.files.sync_dir(&self.dir));
        if begun.is_err() {
            let _ = self.remove(id);
        }
        begun
    }

    /// Writes a record whole or not at all. The bytes that it counts are synced.
    ///
    /// # Errors
    /// The disk cannot be written.
    pub fn write(&self, id: &str, record: &Record) -> io::Result<()> {
        let folder = self.dir.join(id);
        self.files.write(&folder.join(FRESH), &serde_json::to_vec(record)?)?;
        self.files.rename(&folder.join(FRESH), &folder.join(RECORD))?;
        self.files.sync_dir(&folder)
    }

    /// Removes the bytes of an upload that has become a photo.
    ///
    /// # Errors
    /// The disk cannot be written.
    pub fn free(&self, id: &str) -> io::Result<()> {
        gone(self.files.remove(&self.data(id)))
    }

    /// Removes an upload.
    ///
    /// # Errors
    /// The disk cannot be written.
    pub fn remove(&self, id: &str) -> io::Result<()> {
        let folder = self.dir.join(id);
        // without its record it is none, whatever else is left of it
        gone(self.files.remove(&folder.join(RECORD)))?;
        gone(self.files.remove(&folder))
    }
}

fn gone(removed: io::Result<()>) -> io::Result<()> {
    match removed {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        removed => removed,
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::server::forgetful::Forgetful;

    fn record(offset: u64) -> Record {
        Record {
            version: VERSION,
            touched_ms: 1,
            extent: Extent { offset, length: Some(9) },
            query: vec![("title".into(), "A title".into())],
            content_type: None,
            owner: Some(Owner::of_secret("a")),
            photo: Some("7".repeat(32)),
        }
    }

    #[test]
    fn records_are_read_as_they_were_written() {
        for record in [record(3), Record { owner: None, photo: None, content_type: Some("x/y".into()), ..record(0) }] {
            let text = serde_json::to_vec(&record).unwrap();
            assert_eq!(serde_json::from_slice::<Record>(&text).unwrap(), record);
        }
    }

    #[test]
    fn a_crash_at_any_change_leaves_what_was_told_or_what_was_to_be_told() {
        let dir = Path::new("/data/uploads");
        for changes in 0.. {
            let files = Arc::new(Forgetful::new());
            files.create_dir(Path::new("/data"), true).unwrap();
            let open = || Kept::open(files.clone(), dir.to_owned()).unwrap();
            let (kept, none) = open();
            assert!(none.is_empty());
            files.sync_dir(Path::new("/")).unwrap();
            files.end_after(changes);
            let steps = [kept.begin("a", &record(0)), kept.write("a", &record(3)), kept.write("a", &record(6)), kept.remove("a")];
            let told = steps.iter().take_while(|step| step.is_ok()).count();
            files.crash();
            let (kept, found) = open();
            let offset = found.first().map(|(_, record)| record.extent.offset);
            let (before, after) = ([None, Some(0), Some(3), Some(6), None][told], [Some(0), Some(3), Some(6), None, None][told]);
            // what is being removed may be gone or there
            assert!([before, after].contains(&offset) || told == 4 && offset == Some(6), "{changes}: {told} steps, {offset:?}");
            assert!(kept.remove("a").is_ok());
            if told == steps.len() {
                return;
            }
        }
    }
}
