//! A photo's state as clients read it.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::server::app::Shared;
use crate::server::made::Done;
use crate::server::options;
use crate::server::problem::Problem;
use crate::server::settings::{Settings, Visibility};
use crate::server::time::rfc3339;
use tmpi_library::{Kind, LibraryError, Part, Photo, PhotoState as Phase};

/// How a photo fares.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum StateName {
    /// Waits for a worker.
    Queued,
    /// Is being made.
    Working,
    /// Finished: atlas, views, depth, report and thumbnail are there.
    Done,
    /// Could not be made; `problem` says why. Another upload of the same photo tries again.
    Failed,
    /// Was finished, but is no longer on disk as it was; `problem` says what of it. Another upload of the same photo makes it again.
    Damaged,
}

/// Stage that a photo is at.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Progress {
    /// Name of the stage: `photo`, `depth`, `planes`, and so on.
    pub stage: String,
    /// Number of the stage, from 1.
    pub step: u32,
    /// Count of the stages that this photo goes through.
    pub steps: u32,
    /// Milliseconds since the job's start.
    pub elapsed_ms: f64,
}

impl From<&tmpi_pipeline::Progress> for Progress {
    fn from(p: &tmpi_pipeline::Progress) -> Self {
        Self { stage: p.stage.to_owned(), step: p.step, steps: p.steps, elapsed_ms: p.elapsed_ms }
    }
}

/// Addresses of everything that belongs to a photo. Those of results answer once it is done. Those that take no other parameters than `v` then
/// name the version: what lies there never changes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct Links {
    /// This state.
    #[serde(rename = "self")]
    pub this: String,
    /// Progress as server-sent events.
    pub events: String,
    /// What its owner wants of viewers, alone.
    pub settings: String,
    /// The container.
    pub atlas: String,
    /// Rendered views.
    pub view: String,
    /// Disparity as used.
    pub depth: String,
    /// What was done, left out, and at what error and cost.
    pub report: String,
    /// Strokes that the depth is touched up with.
    pub strokes: String,
    /// Small picture.
    pub thumbnail: String,
    /// The view that stands for the photo: the one that its settings name, else the thumbnail.
    pub poster: String,
    /// Page, model or archive to download.
    pub export: String,
    /// Page with the viewer.
    pub page: String,
    /// The photo alone, for frames of other sites.
    pub embed: String,
    /// Page by which to see and change it, with its token behind the `#`: a secret, told once to whoever uploads without one where the server asks
    /// who comes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub manage: Option<String>,
}

/// State and sizes of a photo.
#[derive(Clone, Debug, PartialEq, Serialize, utoipa::ToSchema)]
pub struct PhotoState {
    /// Id: 32 hex digits, a hash of photo, depth map and options.
    #[schema(example = "0123456789abcdef0123456789abcdef")]
    pub id: String,
    /// How it fares.
    pub state: StateName,
    /// When it was accepted (RFC 3339, UTC).
    #[schema(format = DateTime)]
    pub created: String,
    /// When it was done or failed, or was found damaged.
    #[schema(format = DateTime)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub finished: Option<String>,
    /// When it goes by itself; only where photos do by their age.
    #[schema(format = DateTime)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub expires: Option<String>,
    /// Photos that are made before this one; only while it waits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position: Option<u64>,
    /// What keeps it from being made, a fault of the server's; only while it waits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub waits_for: Option<String>,
    /// Stage that it is at; only while it is being made.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub progress: Option<Progress>,
    /// Why it could not be made, or what of it is damaged; only if it failed or is damaged.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub problem: Option<Problem>,
    /// Size of the uploaded photo in bytes.
    pub photo_bytes: u64,
    /// Size of the uploaded depth map in bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth_bytes: Option<u64>,
    /// Size of the container in bytes; once done.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub atlas_bytes: Option<u64>,
    /// Width of the scene in pixels; once done.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub width: Option<u32>,
    /// Height of the scene in pixels; once done.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height: Option<u32>,
    /// Version of everything that is made of it, once done: results at addresses with `v=VERSION` never change.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub version: Option<String>,
    /// Name of a network that is at hand and better than the one that estimated its depth; only in the answer to a `GET` of this state, and only to
    /// whoever may have it made again (`POST …/again`). Where a store has several nodes it is that of the node that answers; another may make it.
    #[schema(example = "depth-anything-v2-small-fp16")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub better_depth: Option<String>,
    /// Who may see it; only where the server asks who comes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub visibility: Option<Visibility>,
    /// What its owner wants of viewers.
    pub settings: Settings,
    /// Options that it is made with, all of them.
    pub options: BTreeMap<String, String>,
    /// Addresses.
    pub links: Links,
}

/// A page of the list of photos.
#[derive(Clone, Debug, PartialEq, Serialize, utoipa::ToSchema)]
pub struct PhotoList {
    /// Newest first.
    pub photos: Vec<PhotoState>,
    /// Address of the next page; missing on the last one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub next: Option<String>,
}

impl From<Phase> for StateName {
    fn from(state: Phase) -> Self {
        match state {
            Phase::Queued => Self::Queued,
            Phase::Working => Self::Working,
            Phase::Done => Self::Done,
            Phase::Failed => Self::Failed,
            Phase::Damaged => Self::Damaged,
        }
    }
}

impl PhotoState {
    /// The state of a photo as it was read.
    ///
    /// # Errors
    /// 503 where the library cannot be reached.
    pub async fn of(app: &Shared, photo: &Photo) -> Result<Self, Problem> {
        let mut state = Self::of_row(app, photo);
        match photo.state {
            Phase::Queued => {
                state.position = app.library.position(Kind::Make, photo.id, None).await?.map(|position| position.ahead);
                state.waits_for = match app.library.job(Kind::Make, photo.id, None).await {
                    Ok(job) => job.problem.filter(|problem| problem.kind == "fault").map(|problem| problem.detail),
                    Err(LibraryError::NotFound(_)) => None,
                    Err(error) => return Err(error.into()),
                };
            }
            Phase::Working => {
                let said = app.library.progress_of(photo.id);
                state.progress = said.and_then(|said| serde_json::from_value(said).ok());
            }
            Phase::Done | Phase::Failed | Phase::Damaged => {}
        }
        Ok(state)
    }

    /// The same, but for what the row of the photo does not say.
    fn of_row(app: &Shared, photo: &Photo) -> Self {
        let (settings, done) = (Settings::of(photo), Done::of(photo));
        let poster = settings.poster_query(&options::view_box_of(&photo.options)).map(|query| format!("/view?{query}"));
        let at = |part: &str| format!("/v1/photos/{}{part}", photo.id);
        let version = done.as_ref().map(|done| app.version(done));
        // what lies there never changes, so browsers need not ask again
        let fixed = |part: &str| match &version {
            Some(v) => at(&format!("{part}{}v={v}", if part.contains('?') { '&' } else { '?' })),
            None => at(part),
        };
        let bytes = |part| photo.blobs.get(&part).map(|blob| blob.bytes);
        Self {
            id: photo.id.to_string(),
            state: photo.state.into(),
            created: rfc3339(photo.accepted_at),
            finished: photo.finished_at.map(rfc3339),
            expires: app.library.ends_at(photo.accepted_at).map(rfc3339),
            position: None,
            waits_for: None,
            progress: None,
            problem: matches!(photo.state, Phase::Failed | Phase::Damaged).then(|| Problem::of_photo(photo)),
            photo_bytes: bytes(Part::Upload).unwrap_or_default(),
            depth_bytes: bytes(Part::Depth),
            atlas_bytes: done.as_ref().map(|done| done.atlas_bytes),
            width: done.as_ref().map(|done| done.width),
            height: done.as_ref().map(|done| done.height),
            version: version.clone(),
            better_depth: None,
            visibility: app.guard.as_ref().map(|_| settings.visibility.unwrap_or(Visibility::Private)),
            settings,
            options: photo.options.clone(),
            links: Links {
                this: at(""),
                events: at("/events"),
                settings: at("/settings"),
                atlas: fixed("/atlas"),
                view: at("/view"),
                depth: fixed("/depth"),
                report: fixed("/report"),
                strokes: at("/strokes"),
                thumbnail: fixed("/thumbnail"),
                poster: fixed(poster.as_deref().unwrap_or("/thumbnail")),
                export: at("/export"),
                page: format!("/view/{}", photo.id),
                embed: format!("/embed/{}", photo.id),
                manage: None,
            },
        }
    }
}
