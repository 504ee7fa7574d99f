//! What the server tells of a photo. Fields of later servers are passed over.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::Problem;

/// How a photo fares.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum State {
    /// Waits for a worker.
    Queued,
    /// Is being made.
    Working,
    /// Finished.
    Done,
    /// Could not be made; the photo's `problem` says why.
    Failed,
    /// Was finished, but is no longer on disk as it was.
    Damaged,
    /// A word of a later server.
    #[serde(other)]
    Other,
}

impl State {
    /// Whether it waits or is being made.
    #[must_use]
    pub fn is_pending(self) -> bool {
        matches!(self, Self::Queued | Self::Working | Self::Other)
    }
}

/// Stage that a photo is at.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Progress {
    /// Name of the stage.
    pub stage: String,
    /// Its number, from 1.
    pub step: u32,
    /// Count of the stages that this photo goes through.
    pub steps: u32,
    /// Milliseconds since the job's start.
    pub elapsed_ms: f64,
}

/// Paths of everything that belongs to a photo, on its server.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct Links {
    /// The container.
    pub atlas: String,
    /// Small picture.
    pub thumbnail: String,
    /// The view that stands for the photo.
    pub poster: String,
    /// Page with the viewer.
    pub page: String,
    /// The photo alone, for frames of other sites.
    pub embed: String,
    /// Page by which to change it: a secret, told once to whoever uploads without one. See [`crate::Builder::owner_link`].
    pub manage: Option<String>,
}

/// Who may see a photo where the server asks who comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Visibility {
    /// Its owner alone.
    Private,
    /// Whoever has its address.
    Link,
}

impl Visibility {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Private => "private",
            Self::Link => "link",
        }
    }
}

/// Right, down and forward.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Offset {
    /// Right.
    #[serde(default)]
    pub x: f64,
    /// Down.
    #[serde(default)]
    pub y: f64,
    /// Forward.
    #[serde(default)]
    pub z: f64,
}

/// What a photo's owner wants of viewers; what is missing is left to them.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
pub struct Settings {
    /// What the photo is called, 1 to 200 characters.
    pub title: Option<String>,
    /// How far the camera goes, each 0 to 1 of the view box.
    pub motion: Option<Offset>,
    /// Disparity that stays in place while the camera moves, 0 to 1.
    pub focus: Option<f64>,
    /// Where the camera starts, each −1 to 1 of the view box.
    pub start: Option<Offset>,
    /// How it moves by itself.
    pub idle: Option<String>,
    /// How fast that is, 0.25 to 4 times the usual.
    pub speed: Option<f64>,
    /// Who may see it.
    pub visibility: Option<Visibility>,
    /// From where its poster is drawn, each −1 to 1 of the view box.
    pub poster: Option<Offset>,
}

/// State and sizes of a photo.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct PhotoState {
    /// Id: 32 hex digits.
    pub id: String,
    /// How it fares.
    pub state: State,
    /// When it was accepted (RFC 3339, UTC).
    pub created: String,
    /// When it was done or failed.
    pub finished: Option<String>,
    /// Photos that are made before this one; only while it waits.
    pub position: Option<usize>,
    /// What keeps it from being made, a fault of the server's; only while it waits.
    pub waits_for: Option<String>,
    /// Stage that it is at; only while it is being made.
    pub progress: Option<Progress>,
    /// Why it could not be made, or what of it is damaged.
    pub problem: Option<Problem>,
    /// Size of the uploaded photo in bytes.
    pub photo_bytes: u64,
    /// Size of the container in bytes; once done.
    pub atlas_bytes: Option<u64>,
    /// Width of the scene in pixels; once done.
    pub width: Option<u32>,
    /// Height of the scene in pixels; once done.
    pub height: Option<u32>,
    /// Version of everything that is made of it, once done.
    pub version: Option<String>,
    /// Who may see it; only where the server asks who comes.
    pub visibility: Option<Visibility>,
    /// What its owner wants of viewers.
    pub settings: Settings,
    /// Options that it is made with.
    pub options: BTreeMap<String, String>,
    /// Paths on the server.
    pub links: Links,
}

/// A page of the list of photos.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct PhotoList {
    /// Newest first.
    pub photos: Vec<PhotoState>,
    /// Path of the next page; none on the last one. [`crate::Client::next_page`] takes it.
    pub next: Option<String>,
}

/// A way to a photo for somebody else.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct Link {
    /// Path of the page with the viewer.
    pub page: String,
    /// Path of the container.
    pub atlas: String,
    /// When it ends, in seconds since 1970; none where the server asks nobody who they are.
    pub expires: Option<u64>,
}
