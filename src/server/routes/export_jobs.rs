//! Export files that jobs write.

use std::collections::BTreeMap;

use axum::Json;
use axum::extract::{FromRequestParts, Path, Request, State};
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE, LOCATION, RETRY_AFTER};
use axum::http::request::Parts;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::path_photo::PathPhoto;
use super::query::{NoQuery, decode};
use crate::server::access::Guard;
use crate::server::app_state::{App, AppState, StoredFile};
use crate::server::conditional::{ContentCoding, Entity, REVALIDATE, insert, respond};
use crate::server::content_disposition::content_disposition;
use crate::server::exports::Recipe;
use crate::server::finished_photo::FinishedPhoto;
use crate::server::presets::PRESET;
use crate::server::problem::Problem;
use crate::server::timestamps::rfc3339;
use crate::server::{program_digest, request_body};
use tmpi_library::{Class, Job, JobKind, JobState, LibraryError, NewExport, Part, Photo, QueueLimit};

/// Most bytes of the parameters.
const MOST: usize = 4 << 10;
/// Seconds of `Retry-After` while a file is not written.
const LATER: u64 = 1;

/// Parameters of an export file: those of an export, or with `path` those of a view, which becomes a film.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "describes the body in the OpenAPI document; parameters are read by hand so that errors name them")]
pub struct ExportOrder {
    /// `html` (default), `glb`, `ora`, `rgbd` or `zip`; with `path`: `webp` (default) or `mp4`.
    format: Option<String>,
    /// Space of a `glb`: `relief` or `metric`.
    shape: Option<String>,
    /// Textures of a `glb`: `plain`, JPEG and PNG, or `webp`.
    textures: Option<String>,
    /// The camera's path, `orbit`, `swing`, `dolly`, `dolly-zoom` or `zoom`: the file is a film. It takes all parameters of a view.
    path: Option<String>,
    /// Name of a preset of the server (`--preset`) with `path`, whose options are added to those here.
    preset: Option<String>,
    /// Frames of a film, 2 to 240.
    frames: Option<u32>,
    /// Width of a film in pixels.
    w: Option<u32>,
    /// Height of a film in pixels.
    h: Option<u32>,
}

/// Addresses of a file.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct ExportLinks {
    /// This state.
    #[serde(rename = "self")]
    this: String,
    /// The bytes, once they are written.
    file: String,
    /// The photo.
    photo: String,
}

/// An export file that a job writes.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct ExportState {
    /// Its name, unique among the photo's files.
    key: String,
    /// `queued`: waits. `working`: is being written. `done`: download it at `links.file`. `failed`: could not be written; `problem` says
    /// why, and ordering it again retries.
    state: &'static str,
    /// All its parameters, including defaults.
    parameters: BTreeMap<String, String>,
    /// Bytes, once it is written.
    #[serde(skip_serializing_if = "Option::is_none")]
    bytes: Option<u64>,
    /// Why it could not be written.
    #[serde(skip_serializing_if = "Option::is_none")]
    problem: Option<Problem>,
    /// When it is deleted unless a client fetches it before (RFC 3339, UTC).
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(format = DateTime)]
    expires: Option<String>,
    /// Addresses.
    links: ExportLinks,
}

impl ExportState {
    fn of(app: &AppState, job: &Job) -> Self {
        let key = job.key().unwrap_or_default().to_owned();
        let photo = app.base.at(&format!("/v1/photos/{}", job.photo));
        let this = format!("{photo}/exports/{key}");
        let stays = app.limits.exports.keep.as_millis() as i64;
        Self {
            key,
            state: job.state.name(),
            parameters: form_urlencoded::parse(recipe_of(job).as_bytes()).into_owned().collect(),
            bytes: job.result.as_ref().map(|blob| blob.bytes),
            problem: job.problem.as_ref().filter(|_| job.state == JobState::Failed).map(Problem::of_library),
            expires: job.result.as_ref().map(|_| rfc3339(job.used_at.saturating_add(stays))),
            links: ExportLinks { file: format!("{this}/file"), this, photo },
        }
    }

    fn answer(self, ended: StatusCode) -> Response {
        let waits = matches!(self.state, "queued" | "working");
        let location = self.links.this.clone();
        let mut response = (if waits { StatusCode::ACCEPTED } else { ended }, Json(self)).into_response();
        insert(&mut response, LOCATION, &location);
        insert(&mut response, axum::http::header::CACHE_CONTROL, "no-store");
        if waits {
            insert(&mut response, RETRY_AFTER, &LATER.to_string());
        }
        response
    }
}

/// The parameters of a request, from its query and its body (a form or a JSON object).
async fn parameters(request: Request) -> Result<Vec<(String, String)>, Problem> {
    let mut pairs = decode(request.uri())?;
    let (parts, body) = request.into_parts();
    let body = request_body::read(body, MOST).await?;
    match request_body::media_type(parts.headers.get(CONTENT_TYPE)).as_str() {
        _ if body.is_empty() => {}
        "application/x-www-form-urlencoded" => pairs.extend(form_urlencoded::parse(&body).into_owned()),
        "application/json" => pairs.extend(request_body::json_parameters(&body)?),
        _ => {
            let detail = "parameters are application/json, application/x-www-form-urlencoded or a query";
            return Err(Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported-parameters", detail).field("Content-Type"));
        }
    }
    Ok(pairs)
}

/// Order an export file.
///
/// A job writes it in a process of its own: a page, a model, layers, an archive, or a film along a path of the camera. The same parameters
/// for the same version of a photo give the same address, and the file is written once; ordering a failed file again retries. The server
/// keeps a file until no client has fetched it for a while, other files need the space, or the photo is deleted or made again.
#[utoipa::path(
    post, path = "/v1/photos/{id}/exports", tag = "photos",
    request_body(description = "The parameters; the query may hold them, too", content(
        (ExportOrder = "application/json"), (ExportOrder = "application/x-www-form-urlencoded"))),
    responses(
        (status = 200, description = "It is written", body = ExportState, headers(("Location" = String, description = "Address of the file's state"))),
        (status = 202, description = "It waits, or is being written", body = ExportState, headers(
            ("Location" = String, description = "Address of the file's state"), ("Retry-After" = u64, description = "Seconds"))),
        (status = 400, description = "A parameter is wrong; `field` names it"),
        (status = 403, description = "The server takes only presets; `field` names another option"),
        (status = 409, description = "The photo is not finished yet"),
        (status = 413, description = "The parameters are too large"),
        (status = 415, description = "Neither a form nor JSON"),
        (status = 503, description = "Too much waits; `Retry-After` says when to come back"),
    )
)]
pub async fn order(State(app): State<App>, PathPhoto(photo): PathPhoto, request: Request) -> Result<Response, Problem> {
    let free = app.takes_options(request.headers());
    let mut pairs = parameters(request).await?;
    // the options of other files cost nothing
    if pairs.iter().any(|(name, _)| name == PRESET || name == "path") {
        pairs = app.presets.expand(pairs, free)?;
    }
    let (_, done) = AppState::finished(&photo)?;
    let recipe = Recipe::read(pairs, (done.width, done.height), &app.limits)?;
    let text = recipe.text();
    let key = key_of(&app, &done, &text);
    let order = NewExport {
        photo: &photo,
        key: &key,
        kind: if matches!(recipe, Recipe::Film(..)) { JobKind::Film } else { JobKind::Export },
        payload: text.into(),
        class: Class::Interactive,
        requester: &AppState::requester(Guard::owner()),
    };
    match app.library.order_export(&order).await {
        Ok(ordered) => Ok(ExportState::of(&app, &ordered.job).answer(StatusCode::OK)),
        Err(LibraryError::QueueFull { share, retry_after, .. }) => {
            let detail = match share {
                QueueLimit::All => "too many files are waiting to be written (exports.waiting)",
                QueueLimit::Owner | QueueLimit::Address => "your files already take half of the queue",
            };
            Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", detail).retry_after(retry_after.as_secs().max(1)))
        }
        Err(error) => Err(error.into()),
    }
}

/// Extractor of the ordered file in the path, if it belongs to the photo's current version.
pub struct OrderedFile {
    photo: Photo,
    key: String,
    job: Job,
}

impl FromRequestParts<App> for OrderedFile {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self, Problem> {
        let PathPhoto(photo) = PathPhoto::from_request_parts(parts, app).await?;
        let none = || Problem::not_found("the photo has no such file: it was not ordered, or was deleted; order it again");
        let Path((_, key)) = Path::<(String, String)>::from_request_parts(parts, app).await.map_err(|_| none())?;
        let (_, done) = AppState::finished(&photo).map_err(|_| none())?;
        let job = match app.library.job(JobKind::Export, photo.id, Some(&key)).await {
            Err(LibraryError::NotFound(_)) => return Err(none()),
            job => job?,
        };
        // files of an older version of the photo or of the program expire on their own
        let is_current = job.version == photo.version && key_of(app, &done, recipe_of(&job)) == key;
        if is_current { Ok(Self { photo, key, job }) } else { Err(none()) }
    }
}

/// The name of the file of a recipe.
fn key_of(app: &AppState, done: &FinishedPhoto, recipe: &str) -> String {
    program_digest::short(&format!("file {} {recipe}", app.version(done)))
}

fn recipe_of(job: &Job) -> &str {
    job.payload.as_str().unwrap_or_default()
}

/// State of an export file.
#[utoipa::path(
    get, path = "/v1/photos/{id}/exports/{key}", tag = "photos", operation_id = "export_state",
    responses(
        (status = 200, description = "It is written, or could not be", body = ExportState),
        (status = 202, description = "It waits, or is being written", body = ExportState,
            headers(("Retry-After" = u64, description = "Seconds"))),
    )
)]
pub async fn state(State(app): State<App>, _: NoQuery, file: OrderedFile) -> Response {
    ExportState::of(&app, &file.job).answer(StatusCode::OK)
}

/// The bytes of a written file.
#[utoipa::path(
    get, path = "/v1/photos/{id}/exports/{key}/file", tag = "photos",
    params(
        ("Range" = Option<String>, Header, description = "One range of bytes"),
        ("If-None-Match" = Option<String>, Header, description = "Entity tags that the client has"),
    ),
    responses(
        (status = 200, description = "The file", content(
            (String = "text/html"), (String = "model/gltf-binary"), (String = "image/openraster"), (String = "image/png"), (String = "application/zip"),
            (String = "image/webp"), (String = "video/mp4")),
            headers(("ETag" = String, description = "Strong entity tag"), ("Content-Disposition" = String, description = "Name of the file"))),
        (status = 206, description = "The range", content(
            (String = "text/html"), (String = "model/gltf-binary"), (String = "image/openraster"), (String = "image/png"), (String = "application/zip"),
            (String = "image/webp"), (String = "video/mp4"))),
        (status = 304, description = "The client has it"),
        (status = 409, description = "It is not written yet"),
        (status = 416, description = "There are no such bytes"),
    )
)]
pub async fn file(State(app): State<App>, _: NoQuery, file: OrderedFile, headers: HeaderMap) -> Result<Response, Problem> {
    let OrderedFile { photo, key, job } = file;
    let blob = match (&job.result, &job.problem) {
        (Some(blob), _) => blob,
        (None, Some(problem)) if job.state == JobState::Failed => return Err(Problem::of_library(problem)),
        (None, _) => return Err(Problem::new(StatusCode::CONFLICT, "not-ready", "the file is not written yet").retry_after(LATER)),
    };
    let stored = match StoredFile::of_blob(app.library.blobs(), Part::Export, blob).await {
        Err(error @ LibraryError::Damaged { .. }) => {
            tracing::error!(photo = %photo.id, key, %error, "an export file is damaged; the next order writes it again");
            app.library.cancel_export(photo.id, &key).await?;
            return Err(Problem::not_found("the file is deleted; order it again"));
        }
        opened => opened?,
    };
    if let Err(error) = app.library.note_export_fetch(&job).await {
        tracing::warn!(%error, key, "cannot record a fetch; the file may be deleted early");
    }
    // without checking today's limits: the file was written under earlier ones
    let (content_type, ending) = Recipe::kind(recipe_of(&job)).unwrap_or(("application/octet-stream", "bin"));
    let etag = format!("\"{key}-{}\"", blob.digest.as_str().get(..16).unwrap_or_default());
    let entity = Entity { source: stored.source, etag: &etag, content_type, cache_control: REVALIDATE, coding: ContentCoding::Plain };
    let mut response = respond(&headers, entity);
    insert(&mut response, CONTENT_DISPOSITION, &content_disposition(&photo, ending));
    Ok(response)
}

/// Cancel the writing of an export file, or delete it.
#[utoipa::path(
    delete, path = "/v1/photos/{id}/exports/{key}", tag = "photos", operation_id = "export_cancel",
    responses(
        (status = 204, description = "Cancelled or deleted"),
    )
)]
pub async fn cancel(State(app): State<App>, _: NoQuery, file: OrderedFile) -> Result<StatusCode, Problem> {
    app.library.cancel_export(file.photo.id, &file.key).await?;
    Ok(StatusCode::NO_CONTENT)
}
