//! Types of the server's answers. Unknown fields are ignored.

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
    /// Could not be made; another upload tries again.
    Failed,
    /// Is no longer on the server's disk as it was made; another upload makes it again.
    Damaged,
    /// What a later server may say.
    #[serde(other)]
    Unknown,
}

/// Stage that a photo is at.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[non_exhaustive]
pub struct Progress {
    /// Name of the stage: `photo`, `depth`, `planes` and so on.
    pub stage: String,
    /// Number of the stage, from 1.
    pub step: u32,
    /// Count of the stages that this photo goes through.
    pub steps: u32,
    /// Milliseconds since the job's start.
    pub elapsed_ms: f64,
}

/// Addresses of what belongs to a photo, without the server's own; [`crate::Client::address`] adds it.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[non_exhaustive]
pub struct Links {
    /// The state.
    #[serde(rename = "self")]
    pub this: String,
    /// The container.
    pub atlas: String,
    /// Rendered views.
    pub view: String,
    /// Small picture.
    pub thumbnail: String,
    /// The view that stands for the photo.
    pub poster: String,
    /// Page with the viewer.
    pub page: String,
    /// The photo alone, for frames of other sites.
    pub embed: String,
    /// Page for viewing and changing it, for [`crate::Client::with_manage_link`]: a secret. Only in the answer to an upload without a key,
    /// on a server with authentication.
    #[serde(default)]
    pub manage: Option<String>,
}

/// A place in the view box, in units of its half extents.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Offset {
    /// Right.
    pub x: f64,
    /// Down.
    pub y: f64,
    /// Forward.
    pub z: f64,
}

/// Who may see a photo, on a server with authentication.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Visibility {
    /// Only its owner.
    Private,
    /// Everyone with its URL.
    Link,
}

/// The owner's settings for viewers. Missing fields are up to the viewer; in a change they stay as they are.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// What to call the photo, 1 to 200 characters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub title: Option<String>,
    /// How far the camera goes, each 0 to 1 of the view box.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub motion: Option<Offset>,
    /// Disparity that stays in place while the camera moves, 0 (infinity) to 1 (the nearest thing).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub focus: Option<f64>,
    /// Where the camera starts, each −1 to 1 of the view box.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<Offset>,
    /// How it moves on its own; `none` for not at all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub idle: Option<String>,
    /// How fast that is, 0.25 to 4 times the usual.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed: Option<f64>,
    /// Who may see it, on a server with authentication.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub visibility: Option<Visibility>,
    /// From where the view is drawn that stands for the photo, each −1 to 1 of the view box.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub poster: Option<Offset>,
}

/// State and sizes of a photo.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[non_exhaustive]
pub struct PhotoState {
    /// Id, 32 hexadecimal digits.
    pub id: String,
    /// How it fares.
    pub state: State,
    /// When it was accepted (RFC 3339, UTC).
    pub created: String,
    /// When it was done or failed.
    #[serde(default)]
    pub finished: Option<String>,
    /// When retention deletes it.
    #[serde(default)]
    pub expires: Option<String>,
    /// Photos that are made before this one; only while it waits.
    #[serde(default)]
    pub position: Option<usize>,
    /// What keeps it from being made, a fault of the server's; only while it waits.
    #[serde(default)]
    pub waits_for: Option<String>,
    /// Stage that it is at; only while it is being made.
    #[serde(default)]
    pub progress: Option<Progress>,
    /// Why it could not be made, or what of it is damaged.
    #[serde(default)]
    pub problem: Option<Problem>,
    /// Size of the uploaded photo in bytes.
    pub photo_bytes: u64,
    /// Size of the container in bytes; once done.
    #[serde(default)]
    pub atlas_bytes: Option<u64>,
    /// Width of the scene in pixels; once done.
    #[serde(default)]
    pub width: Option<u32>,
    /// Height of the scene in pixels; once done.
    #[serde(default)]
    pub height: Option<u32>,
    /// Version of what is made of it; once done.
    #[serde(default)]
    pub version: Option<String>,
    /// A better depth network that is available. Only in the state of a single photo, and only if the caller may have it made again.
    #[serde(default)]
    pub better_depth: Option<String>,
    /// Who may see it; only on a server with authentication.
    #[serde(default)]
    pub visibility: Option<Visibility>,
    /// The owner's settings for viewers.
    #[serde(default)]
    pub settings: Settings,
    /// Options that it is made with.
    #[serde(default)]
    pub options: BTreeMap<String, String>,
    /// Addresses.
    pub links: Links,
}

/// A link to a photo for others.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[non_exhaustive]
pub struct Link {
    /// Page with the viewer.
    pub page: String,
    /// The container.
    pub atlas: String,
    /// Query that gives access to any URL of the photo; `None` on a server without authentication.
    #[serde(default)]
    pub query: Option<String>,
    /// When it ends, in seconds since 1970.
    #[serde(default)]
    pub expires: Option<u64>,
    /// Page on which others see and change this photo only, for [`crate::Client::with_manage_link`]: a secret, valid until
    /// [`crate::Client::take_links_back`].
    #[serde(default)]
    pub manage: Option<String>,
    /// Page that makes another browser the same owner; `None` if the caller has no secret of its own.
    #[serde(default)]
    pub ticket: Option<String>,
}
