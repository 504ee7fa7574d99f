//! Whether what was made of a photo is still on disk as it was.

use std::io;

use sha2::{Digest, Sha256};

use super::{Done, Part, Store};
use crate::server::id::{PhotoId, hex};

impl Store {
    /// What of a finished photo is not as it was made; none where all is, or it cannot be told now.
    #[must_use]
    pub fn damage(&self, id: PhotoId, done: &Done) -> Option<String> {
        let rest = [Part::Disparity, Part::Thumbnail, Part::Report];
        [Part::Atlas].into_iter().chain(rest).find_map(|part| match self.read(id, part) {
            Ok(bytes) if part == Part::Atlas => damage_of(&bytes, done),
            Ok(bytes) if bytes.is_empty() => Some(format!("{} is empty", part.name())),
            Ok(_) => None,
            Err(error) => lost(part, &error),
        })
    }
}

/// What of a container is not as it was made.
#[must_use]
pub fn damage_of(container: &[u8], done: &Done) -> Option<String> {
    let (name, length) = (Part::Atlas.name(), container.len() as u64);
    if length != done.atlas_bytes {
        return Some(format!("{name} has {length} bytes, {} were written", done.atlas_bytes));
    }
    (digest(container) != done.atlas_hash).then(|| format!("{name} is not what was written"))
}

/// What an error of reading says of the file itself; none where it may be another's fault, as where no file descriptor is left.
#[must_use]
pub fn lost(part: Part, error: &io::Error) -> Option<String> {
    /// A device that cannot read what lies there.
    const EIO: i32 = 5;
    match error.kind() {
        io::ErrorKind::NotFound => Some(format!("{} is missing", part.name())),
        _ if cfg!(unix) && error.raw_os_error() == Some(EIO) => Some(format!("{} cannot be read from the disk", part.name())),
        _ => None,
    }
}

/// First 128 bits of a SHA-256 in hex, as [`Done`] names a container.
#[must_use]
pub fn digest(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes)[..16])
}
