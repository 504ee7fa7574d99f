//! A photo's state as JSON.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::server::app_state::AppState;
use crate::server::finished_photo::FinishedPhoto;
use crate::server::photo_options;
use crate::server::problem::Problem;
use crate::server::timestamps::rfc3339;
use crate::server::viewer_settings::{Settings, Visibility};
use tmpi_library::{JobKind, LibraryError, Part, Photo, PhotoState as Phase};

/// Current stage of a photo, as [`tmpi_pipeline::Progress`] tells it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Progress {
    /// Name of the stage: `photo`, `depth`, `planes`, and so on.
    pub stage: String,
    /// Number of the stage, from 1.
    pub step: u32,
    /// Number of stages of this photo.
    pub steps: u32,
    /// Milliseconds since the job's start.
    pub elapsed_ms: f64,
}

/// Addresses of everything that belongs to a photo. Those of results work once it is done; addresses with `v` then name the version, and
/// their content never changes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct Links {
    /// This state.
    #[serde(rename = "self")]
    pub this: String,
    /// Progress as server-sent events.
    pub events: String,
    /// The owner's settings for viewers.
    pub settings: String,
    /// The container.
    pub atlas: String,
    /// Rendered views.
    pub view: String,
    /// Disparity as used.
    pub depth: String,
    /// Report: steps taken, steps skipped, errors and costs.
    pub report: String,
    /// Strokes that touch up the depth.
    pub strokes: String,
    /// Small picture.
    pub thumbnail: String,
    /// Preview image: the view that the settings name, else the thumbnail.
    pub poster: String,
    /// Page, model or archive to download.
    pub export: String,
    /// Page with the viewer.
    pub page: String,
    /// The viewer without the page around it, for frames of other sites.
    pub embed: String,
    /// Page with the photo's token after its `#`, to see and change the photo: a secret. With private access, the answer to an upload
    /// without credentials has it, once.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub manage: Option<String>,
}

/// State and sizes of a photo.
#[derive(Clone, Debug, PartialEq, Serialize, utoipa::ToSchema)]
pub struct PhotoState {
    /// Id: 32 hex digits, a hash of photo, depth map and options.
    #[schema(example = "0123456789abcdef0123456789abcdef")]
    pub id: String,
    /// `queued`: waits for a worker. `working`: a worker is making it. `done`: atlas, views, depth, report and thumbnail are available.
    /// `failed`: could not be made. `damaged`: was done, but its files are damaged. `problem` then says why or which, and uploading the
    /// same photo again makes it again.
    pub state: &'static str,
    /// When it was accepted (RFC 3339, UTC).
    #[schema(format = DateTime)]
    pub created: String,
    /// When it was done or failed, or was found damaged.
    #[schema(format = DateTime)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub finished: Option<String>,
    /// When the server deletes it; only if photos expire.
    #[schema(format = DateTime)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub expires: Option<String>,
    /// Number of photos ahead in the queue; only while it waits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position: Option<u64>,
    /// Fault of the server that keeps it from being made; only while it waits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub waits_for: Option<String>,
    /// Current stage; only while it is being made.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub progress: Option<Progress>,
    /// Why it failed, or which part is damaged; only if it failed or is damaged.
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
    /// Version of its results, once done: results at addresses with `v=VERSION` never change.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub version: Option<String>,
    /// Name of this node's network, if it is better than the one that estimated the photo's depth; only in answers to `GET` of this state,
    /// and only if the caller may have the photo made again (`POST …/remake`). With several nodes on one store, another node may make it.
    #[schema(example = "depth-anything-v2-small-fp16")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub better_depth: Option<String>,
    /// Who may see it; only with private access.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub visibility: Option<Visibility>,
    /// The owner's settings for viewers.
    pub settings: Settings,
    /// All options that it is made with.
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

impl PhotoState {
    /// The full state of a photo.
    pub async fn of(app: &AppState, photo: &Photo) -> Result<Self, Problem> {
        let mut state = Self::of_row(app, photo);
        match photo.state {
            Phase::Queued => {
                state.position = app.library.position(photo.id).await?;
                state.waits_for = match app.library.job(JobKind::Make, photo.id, None).await {
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

    /// The part of the state that the photo's row holds.
    fn of_row(app: &AppState, photo: &Photo) -> Self {
        let (settings, done) = (Settings::of(photo), FinishedPhoto::of(photo));
        let pose = settings.poster_pose(&photo_options::view_box_of(&photo.options));
        let poster = pose.map(|pose| format!("/view?{pose}w=640&format=jpeg"));
        let at = |part: &str| app.base.at(&format!("/v1/photos/{}{part}", photo.id));
        let version = done.as_ref().map(|done| app.version(done));
        // content at such an address never changes, so browsers need not revalidate
        let fixed = |part: &str| match &version {
            Some(v) => at(&format!("{part}{}v={v}", if part.contains('?') { '&' } else { '?' })),
            None => at(part),
        };
        let bytes = |part| photo.blobs.get(&part).map(|blob| blob.bytes);
        Self {
            id: photo.id.to_string(),
            state: photo.state.name(),
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
                page: app.base.at(&format!("/view/{}", photo.id)),
                embed: app.base.at(&format!("/embed/{}", photo.id)),
                manage: None,
            },
        }
    }
}
