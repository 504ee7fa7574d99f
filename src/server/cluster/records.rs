//! The records of the ledger, each with the version of its format.
//!
//! ```text
//! photos/ID                    the photo: Photo; created when it is accepted, changed by compare-and-set, removed when it is deleted
//! ends/ID.MAKING               how a making of it ended: End; created once, so that one result counts
//! pending/MAKING.ID            a making that has not ended: Marker; the oldest are listed first
//! lists/…                       the index of photos, newest first; see index.rs
//! access/secret                what ids and links are made with where the nodes ask who comes: Shared; created once, by the first of them
//! blobs/ID/MAKING.PART         what was uploaded, and strokes
//! blobs/ID/MAKING-NODE-N.PART  what a node made
//! ```

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::server::id::PhotoId;
use crate::server::part::Part;
use crate::server::records::{self, Accepted};
use crate::server::settings::Settings;
use crate::server::traces::{self, Parent};

/// Version of these records. Those of later ones are not touched.
pub const VERSION: u32 = 1;

/// Record of the nodes' secret.
pub const SECRET: &str = "access/secret";
/// Folder of the photos' records.
pub const PHOTOS: &str = "photos/";
/// Folder of how makings ended.
pub const ENDS: &str = "ends/";
/// Folder of what was uploaded and made.
pub const BLOBS: &str = "blobs/";
/// Folder of the markers.
pub const PENDING: &str = "pending/";

/// Ids as text.
pub mod id {
    use serde::{Deserialize as _, Deserializer, Serializer, de::Error as _};

    use crate::server::id::PhotoId;

    pub fn serialize<S: Serializer>(id: &PhotoId, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(id)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<PhotoId, D::Error> {
        String::deserialize(from)?.parse().map_err(D::Error::custom)
    }
}

/// An accepted photo.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Photo {
    /// [`VERSION`].
    pub version: u32,
    /// What was accepted.
    pub accepted: Accepted,
    /// What its owner wants of viewers.
    pub settings: Settings,
    /// The making of which the upload's blobs bear the name.
    pub source: String,
    /// The making that counts.
    pub making: String,
    /// The one before, of which the results may go once this one has ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub before: Option<String>,
    /// Blob of the strokes of a touch-up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub strokes: Option<String>,
}

/// The secret of the nodes of a store.
#[derive(Serialize, Deserialize)]
pub struct Shared {
    /// [`VERSION`].
    pub version: u32,
    /// Hexadecimal digits.
    pub secret: String,
}

/// How a making ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct End {
    /// [`VERSION`].
    pub version: u32,
    /// What became of it.
    pub outcome: records::End,
    /// Begin of the names of its blobs.
    pub blobs: String,
}

/// A making that has not ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Marker {
    /// [`VERSION`].
    pub version: u32,
    /// The photo.
    #[serde(with = "id")]
    pub id: PhotoId,
    /// The making.
    pub making: String,
    /// Times that a node took it up.
    pub claims: u32,
    /// Times that the photo took down the process that made it.
    pub attempts: u32,
    /// Faults of servers so far.
    pub faults: u32,
    /// Counts up while a node works on it, so that others see that it lives.
    pub beats: u64,
    /// It is for whoever has seen it unchanged for that long by a steady clock of its own, in milliseconds: a lease, or the pause
    /// after a fault. No point in time is written: those of two machines are not the same.
    pub rest_ms: u64,
    /// The node that works on it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub node: Option<String>,
    /// The request that asked for it, where that is traced.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trace: Option<Parent>,
}

impl Marker {
    /// One that is for whoever comes, asked for by the request that works here.
    pub fn new(id: PhotoId, making: &str) -> Self {
        Self {
            version: VERSION,
            id,
            making: making.to_owned(),
            claims: 0,
            attempts: 0,
            faults: 0,
            beats: 0,
            rest_ms: 0,
            node: None,
            trace: traces::parent(),
        }
    }

    /// Name of its record.
    pub fn name(&self) -> String {
        Self::name_of(self.id, &self.making)
    }

    /// Name of the record of a making that has not ended.
    pub fn name_of(id: PhotoId, making: &str) -> String {
        format!("{PENDING}{making}.{id}")
    }
}

impl Photo {
    /// Name of the record of a photo.
    pub fn name(id: PhotoId) -> String {
        format!("{PHOTOS}{id}")
    }
}

impl End {
    /// Name of the record of the end of a making.
    pub fn name(id: PhotoId, making: &str) -> String {
        format!("{ENDS}{id}.{making}")
    }
}

/// True for names of records of makings that have not ended; what others say may be any text.
pub fn is_marker(name: &str) -> bool {
    let Some((making, id)) = name.strip_prefix(PENDING).and_then(|rest| rest.split_once('.')) else { return false };
    is_making(making) && id.parse::<PhotoId>().is_ok()
}

/// True for names of makings.
pub fn is_making(making: &str) -> bool {
    /// Digits and dashes of the longest.
    const MOST: usize = 64;
    !making.is_empty() && making.len() <= MOST && making.bytes().all(|b| b.is_ascii_hexdigit() || b == b'-')
}

/// Folder of a photo's blobs.
pub fn blobs(id: PhotoId) -> String {
    format!("{BLOBS}{id}/")
}

/// Name of a blob.
pub fn blob(id: PhotoId, of: &str, part: Part) -> String {
    format!("{}{of}.{}", blobs(id), part.name())
}

#[derive(Deserialize)]
struct Versioned {
    version: u32,
}

/// Reads a record of this version or an earlier one.
///
/// # Errors
/// It is of a later version, or damaged.
pub fn read<T: DeserializeOwned>(name: &str, bytes: &[u8]) -> std::io::Result<T> {
    let wrong = |why: String| std::io::Error::new(std::io::ErrorKind::InvalidData, format!("the record {name}: {why}"));
    let Versioned { version } = serde_json::from_slice(bytes).map_err(|e| wrong(e.to_string()))?;
    if version > VERSION {
        return Err(wrong(format!("version {version} is later than {VERSION}: update this node")));
    }
    serde_json::from_slice(bytes).map_err(|e| wrong(e.to_string()))
}

/// True for a record that no version of this program wrote, as far as this one knows.
pub fn is_damaged<T: DeserializeOwned>(bytes: &[u8]) -> bool {
    let is_later = serde_json::from_slice::<Versioned>(bytes).is_ok_and(|record| record.version > VERSION);
    !is_later && serde_json::from_slice::<T>(bytes).is_err()
}
