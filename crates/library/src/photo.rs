//! A photo in the database.

use std::collections::BTreeMap;
use std::fmt;

use serde::de::{DeserializeOwned, IntoDeserializer as _, value};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sqlx::any::AnyRow;
use sqlx::{FromRow, Row as _};

use crate::Millis;
use crate::digest::Digest;
use crate::error::{LibraryError, Result};
use crate::ids::PhotoId;
use crate::owner::Owner;
use crate::string_enum::string_enum;

string_enum! {
    /// State of a photo.
    pub enum PhotoState {
        /// Waiting for a worker.
        Queued = "queued",
        /// A worker is making it.
        Working = "working",
        /// It has its results.
        Done = "done",
        /// It failed.
        Failed = "failed",
        /// Its results are damaged.
        Damaged = "damaged",
    }
}

impl PhotoState {
    /// Whether no job is pending.
    pub const fn is_final(self) -> bool {
        matches!(self, Self::Done | Self::Failed | Self::Damaged)
    }
}

string_enum! {
    /// How urgent a job is.
    #[derive(Default)]
    pub enum Class {
        /// A person is waiting for it.
        #[default]
        Interactive = "interactive",
        /// One of many.
        Batch = "batch",
    }
}

impl Class {
    /// In the database, which orders jobs by it.
    pub(crate) const fn rank(self) -> i64 {
        self as i64
    }
}

string_enum! {
    /// A part of a photo's contents.
    pub enum Part {
        /// The photo as uploaded.
        Upload = "upload",
        /// The depth map that came with it.
        Depth = "depth",
        /// The touch-up, JSON.
        Strokes = "strokes",
        /// The container.
        Container = "container",
        /// Disparity as used, 16-bit grey PNG.
        Disparity = "disparity",
        /// Small JPEG.
        Thumbnail = "thumbnail",
        /// Report of the processing, JSON.
        Report = "report",
        /// A file to download.
        Export = "export",
    }
}

impl Part {
    /// Whether a worker makes this part.
    pub const fn is_result(self) -> bool {
        matches!(self, Self::Container | Self::Disparity | Self::Thumbnail | Self::Report)
    }
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A row's reference to a content in the blob store.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Blob {
    /// Name in the store.
    pub name: String,
    /// Its size.
    pub bytes: u64,
    /// Its SHA-256.
    pub digest: Digest,
}

/// Why something failed, for the photo's owner.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Problem {
    /// Stable kind, such as `gave-up`.
    pub kind: String,
    /// What is wrong with this photo.
    pub detail: String,
    /// Field or option at fault.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
}

impl Problem {
    /// A problem without a field.
    pub fn new(kind: &str, detail: impl Into<String>) -> Self {
        Self { kind: kind.to_owned(), detail: detail.into(), field: None }
    }
}

/// Blobs of a photo by part.
pub type Blobs = BTreeMap<Part, Blob>;

/// A photo.
#[derive(Clone, Debug, PartialEq)]
pub struct Photo {
    /// Its id.
    pub id: PhotoId,
    /// Its owner; `None` if the upload was not authenticated.
    pub owner: Option<Owner>,
    /// When it was accepted.
    pub accepted_at: Millis,
    /// When it was last uploaded, which is the order of the list.
    pub listed_at: Millis,
    /// When it was last viewed, or accepted.
    pub viewed_at: Millis,
    /// How urgent it is to process it.
    pub class: Class,
    /// Options as text, all of them.
    pub options: BTreeMap<String, String>,
    /// The owner's settings for viewers: a JSON object, opaque to this crate.
    pub settings: Value,
    /// Incremented by each change of the settings.
    pub settings_version: i64,
    /// Incremented when the owner revokes links, which are signed over it.
    pub link_generation: i64,
    /// Its state.
    pub state: PhotoState,
    /// Incremented whenever it is queued again. Results of an older version stay until new ones replace them.
    pub version: i64,
    /// When it reached its final state.
    pub finished_at: Option<Millis>,
    /// Details of the results, a JSON object: width, height.
    pub details: Option<Value>,
    /// Why it failed or is damaged.
    pub problem: Option<Problem>,
    /// Its contents.
    pub blobs: Blobs,
    /// Bytes of all its contents, which quotas count.
    pub bytes: u64,
}

/// Columns of [`Photo`].
pub(crate) const COLUMNS: &str = "id, owner, accepted_at, listed_at, viewed_at, class, options, settings, settings_version, link_generation, state, version, finished_at, details, problem, blobs, bytes";

impl Photo {
    /// The blob of a part.
    pub fn blob(&self, part: Part) -> Result<&Blob> {
        self.blobs.get(&part).ok_or(LibraryError::NotFound(part.name()))
    }

    /// Title in its settings.
    pub fn title(&self) -> Option<&str> {
        self.settings.get("title").and_then(Value::as_str)
    }
}

impl FromRow<'_, AnyRow> for Photo {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        Ok(Self {
            id: parsed(row, "id")?,
            owner: row.try_get::<Option<_>, _>("owner")?.map(Owner::from_column),
            accepted_at: row.try_get("accepted_at")?,
            listed_at: row.try_get("listed_at")?,
            viewed_at: row.try_get("viewed_at")?,
            class: class_of(row)?,
            options: json(row, "options")?,
            settings: json(row, "settings")?,
            settings_version: row.try_get("settings_version")?,
            link_generation: row.try_get("link_generation")?,
            state: parsed(row, "state")?,
            version: row.try_get("version")?,
            finished_at: row.try_get("finished_at")?,
            details: optional_json(row, "details")?,
            problem: optional_json(row, "problem")?,
            blobs: json(row, "blobs")?,
            bytes: row.try_get::<i64, _>("bytes")? as u64,
        })
    }
}

/// Names of blobs, for deleting them.
pub(crate) fn blob_names(blobs: &Blobs) -> Vec<String> {
    blobs.values().map(|blob| blob.name.clone()).collect()
}

/// Names of the blobs of deleted jobs.
pub(crate) fn file_names(deleted: &[AnyRow]) -> Result<Vec<String>> {
    let files: sqlx::Result<Vec<Option<Blob>>> = deleted.iter().map(|row| optional_json(row, "result")).collect();
    Ok(files?.into_iter().flatten().map(|blob| blob.name).collect())
}

pub(crate) fn bytes_of(blobs: &Blobs) -> i64 {
    blobs.values().map(|blob| blob.bytes).sum::<u64>() as i64
}

pub(crate) fn class_of(row: &AnyRow) -> sqlx::Result<Class> {
    match row.try_get("class")? {
        0_i64 => Ok(Class::Interactive),
        1 => Ok(Class::Batch),
        rank => Err(sqlx::Error::Decode(format!("class: {rank}").into())),
    }
}

/// The values that a text names, separated by commas.
pub(crate) fn of_names<T: DeserializeOwned>(names: &str) -> sqlx::Result<Vec<T>> {
    names.split(',').filter(|name| !name.is_empty()).map(of_name).collect()
}

/// The value that a text names: a variant of an enum, an id.
fn of_name<T: DeserializeOwned>(name: &str) -> sqlx::Result<T> {
    T::deserialize(name.into_deserializer()).map_err(|e: value::Error| sqlx::Error::Decode(e.into()))
}

/// The value that a column names.
pub(crate) fn parsed<T: DeserializeOwned>(row: &AnyRow, column: &str) -> sqlx::Result<T> {
    of_name(row.try_get(column)?)
}

pub(crate) fn json<T: DeserializeOwned>(row: &AnyRow, column: &str) -> sqlx::Result<T> {
    optional_json(row, column)?.ok_or_else(|| sqlx::Error::Decode(format!("{column}: it is null").into()))
}

pub(crate) fn optional_json<T: DeserializeOwned>(row: &AnyRow, column: &str) -> sqlx::Result<Option<T>> {
    let text: Option<&str> = row.try_get(column)?;
    text.map(|text| serde_json::from_str(text).map_err(|e| sqlx::Error::Decode(format!("{column}: {e}").into()))).transpose()
}

pub(crate) fn to_json<T: Serialize>(value: &T) -> Result<String> {
    serde_json::to_string(value).map_err(|e| LibraryError::Internal(e.to_string()))
}
