//! What is kept beside a photo as JSON, each with the version of its format.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::access::Owner;
use super::id::PhotoId;
use super::problem::Problem;
use super::settings::Settings;

/// Version of the records that this program writes. Later ones are read as far as they are understood.
pub const VERSION: u32 = 1;

/// Records of before they told their version are of the first.
const fn first() -> u32 {
    1
}

/// An accepted upload.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Accepted {
    /// [`VERSION`].
    #[serde(default = "first")]
    pub version: u32,
    /// When it was accepted, milliseconds since 1970.
    pub at_ms: u64,
    /// Size of the photo.
    pub photo_bytes: u64,
    /// Size of the depth map, if there is one.
    pub depth_bytes: Option<u64>,
    /// Options as text, all of them.
    pub options: BTreeMap<String, String>,
    /// Whose it is; none where nobody was asked who they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub owner: Option<Owner>,
}

impl Accepted {
    /// Bytes of what was uploaded.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.photo_bytes + self.depth_bytes.unwrap_or_default()
    }
}

/// What became of an accepted upload.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct State {
    /// [`VERSION`].
    #[serde(default = "first")]
    pub version: u32,
    /// Times that the photo took down the process that made it, and nothing else.
    pub attempts: u32,
    /// How it ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub end: Option<End>,
}

impl State {
    /// A state as this program writes it.
    #[must_use]
    pub const fn new(attempts: u32, end: Option<End>) -> Self {
        Self { version: VERSION, attempts, end }
    }

    /// When it ended, milliseconds since 1970.
    #[must_use]
    pub fn at_ms(&self) -> Option<u64> {
        self.end.as_ref().map(|end| match end {
            End::Done(done) => done.at_ms,
            End::Failed(failed) => failed.at_ms,
        })
    }
}

impl Default for State {
    fn default() -> Self {
        Self::new(0, None)
    }
}

/// How a job ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum End {
    /// All files are there.
    Done(Done),
    /// The photo could not be made.
    Failed(Failed),
}

/// A finished photo.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Done {
    /// When, milliseconds since 1970.
    pub at_ms: u64,
    /// Width of the scene in pixels.
    pub width: u32,
    /// Height of the scene in pixels.
    pub height: u32,
    /// Size of the container.
    pub atlas_bytes: u64,
    /// First 128 bits of the container's SHA-256 in hex.
    pub atlas_hash: String,
}

/// A photo that could not be made.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failed {
    /// When, milliseconds since 1970.
    pub at_ms: u64,
    /// Why.
    pub problem: Problem,
}

/// A photo found at start.
#[derive(Debug)]
pub struct Found {
    /// Its id.
    pub id: PhotoId,
    /// What was accepted.
    pub accepted: Accepted,
    /// What became of it so far.
    pub state: State,
    /// What its owner wants of viewers.
    pub settings: Settings,
}
