//! Types of the server's answers.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::Problem;

/// State of a photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum State {
    /// Waiting for a worker.
    Queued,
    /// Being processed.
    Working,
    /// Finished.
    Done,
    /// Processing failed; upload the photo again to retry.
    Failed,
    /// The stored result is corrupt; upload the photo again to repair it.
    Damaged,
    /// A state that this version does not know.
    #[serde(other)]
    Unknown,
}

/// Progress of a photo's processing.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[non_exhaustive]
pub struct Progress {
    /// Name of the stage: `photo`, `depth`, `planes` and so on.
    pub stage: String,
    /// Number of the stage, from 1.
    pub step: u32,
    /// Number of stages for this photo.
    pub steps: u32,
    /// Milliseconds since the job's start.
    pub elapsed_ms: f64,
}

/// Paths of a photo's resources. [`crate::Client::address`] resolves them to URLs.
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
    /// The thumbnail.
    pub thumbnail: String,
    /// The poster: a view that represents the photo.
    pub poster: String,
    /// Page with the viewer.
    pub page: String,
    /// Page with only the photo, to embed in other sites.
    pub embed: String,
    /// Page to view and change the photo, for [`crate::Client::with_key`]. It is a secret, and present only in the answer to an
    /// upload without a key to a server with authentication.
    pub manage: Option<String>,
}

/// A camera position in the view box, in units of its half extents.
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
    /// Everyone who has its URL.
    Link,
}

/// The owner's settings for viewers. The viewer chooses missing fields; in a change, missing fields keep their value.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Title of the photo, 1 to 200 characters.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub title: Option<String>,
    /// How far the camera moves, each 0 to 1 of the view box.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub motion: Option<Offset>,
    /// Disparity that stays in place while the camera moves, 0 (infinity) to 1 (the nearest surface).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focus: Option<f64>,
    /// Where the camera starts, each −1 to 1 of the view box.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<Offset>,
    /// Idle animation of the camera; `none` disables it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub idle: Option<String>,
    /// Speed of the idle animation, 0.25 to 4 times the default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed: Option<f64>,
    /// Who may see it, on a server with authentication.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub visibility: Option<Visibility>,
    /// Camera position of the poster, each −1 to 1 of the view box.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub poster: Option<Offset>,
}

/// State and sizes of a photo.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[non_exhaustive]
pub struct PhotoState {
    /// Id, 32 hexadecimal digits.
    pub id: String,
    /// Its state.
    pub state: State,
    /// When the server accepted it (RFC 3339, UTC).
    pub created: String,
    /// Why processing failed, or what is damaged.
    pub problem: Option<Problem>,
    /// Width of the scene in pixels; once done.
    pub width: Option<u32>,
    /// Height of the scene in pixels; once done.
    pub height: Option<u32>,
    /// Version of the result; once done.
    pub version: Option<String>,
    /// Who may see it; only on a server with authentication.
    pub visibility: Option<Visibility>,
    /// The owner's settings for viewers.
    #[serde(default)]
    pub settings: Settings,
    /// Options that the photo is processed with.
    #[serde(default)]
    pub options: BTreeMap<String, String>,
    /// Paths of its resources.
    pub links: Links,
    /// Whatever else the server says, for example `position` in the queue, `progress`, `expires` and `atlas_bytes`.
    #[serde(flatten)]
    pub more: serde_json::Map<String, serde_json::Value>,
}

/// A link that gives others access to a photo.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[non_exhaustive]
pub struct Link {
    /// Page with the viewer.
    pub page: String,
    /// The container.
    pub atlas: String,
    /// Query that gives access to any URL of the photo; `None` on a server without authentication.
    pub query: Option<String>,
    /// When it expires, in seconds since 1970.
    pub expires: Option<u64>,
    /// Page where others can view and change only this photo, for [`crate::Client::with_key`]. It is a secret, valid until
    /// [`crate::Client::take_links_back`].
    pub manage: Option<String>,
    /// Page that signs another browser in as the same owner; `None` if the caller has no secret of its own.
    pub ticket: Option<String>,
}
