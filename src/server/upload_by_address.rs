//! Uploads by address: a JSON object with the address of a photo instead of its bytes.

use std::time::Duration;

use axum::body::Body;
use axum::extract::Request;
use axum::http::{HeaderMap, StatusCode, header};
use percent_encoding::percent_decode_str;
use reqwest::Url;

use super::app_state::App;
use super::fetch_by_url::{SourceError, Validators};
use super::maker::HeadOf;
use super::photo_options;
use super::problem::Problem;
use super::request_body::{self, CutOff, LimitedBody, media_type};
use super::time_limit::TimeLimit;
use super::upload::{self, UploadParts};
use super::upload_fields::{UploadFields, check_name, of_query};
use super::upload_file::{ReceivedFile, receive};
use tmpi_library::{Digest, LibraryError, Owner, Photo, PhotoState, Source};

/// Most bytes of the object.
const MOST: usize = 16 << 10;
/// Time to fetch everything.
const PATIENCE: Duration = Duration::from_mins(2);
/// Names of the fields with addresses.
const SOURCE: &str = "source";
const DEPTH: &str = "depth_source";

/// A photo of another server. It takes the options of the form, too.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "describes the body in the OpenAPI document; fields are read by hand so that errors name them")]
pub struct SourceOrder {
    /// Address of the photo, of a host that the operator lists.
    #[schema(format = "uri")]
    source: String,
    /// Address of its depth map.
    #[schema(format = "uri")]
    depth_source: Option<String>,
    /// What to call the photo; else the name of the file at the address.
    title: Option<String>,
    /// Name of a preset of the server (`--preset`), whose options are added to those here.
    preset: Option<String>,
}

/// Whether a request names the address of a photo instead of sending the photo.
pub fn is_address(headers: &HeaderMap) -> bool {
    let mut kinds = headers.get_all(header::CONTENT_TYPE).iter().peekable();
    kinds.peek().is_some() && kinds.all(|kind| media_type(Some(kind)) == "application/json")
}

/// Fetches a photo for `owner`, if there are owners, and has it accepted; when this returns, it is on disk.
///
/// # Errors
/// 400 that names a wrong field, 403 if the server does not fetch from there, 502 and 504 if the source is at fault, and those of
/// [`upload::upload`].
pub async fn fetch_upload(
    app: &App,
    query: &[(String, String)],
    request: Request,
    owner: Option<Owner>,
    clock: &TimeLimit,
) -> Result<Photo, Problem> {
    if !app.sources.is_on() {
        let detail = "this server does not fetch photos: tmpi serve --source-hosts lists the hosts that it may fetch from";
        return Err(Problem::new(StatusCode::FORBIDDEN, "no-sources", detail));
    }
    let mut fields = of_query(&app.presets, app.takes_options(request.headers()), query)?;
    let (source, depth) = read(app, &mut fields, request).await?;
    let _slot = upload::take_slot(app).await?;
    clock.allow(app.limits.request + PATIENCE);
    // a depth map that has changed needs the photo, too
    let record = if depth.is_none() { Some(digest_of_source(app, &source, &fields, owner.as_ref())) } else { None };
    let before = if let Some(record) = &record { find_made(app, record).await? } else { None };
    let fetched = async {
        let options = &fields.options;
        let photo = fetch(app, SOURCE, source, before.as_ref().map(|(_, validators)| validators), HeadOf::Photo(options)).await?;
        let depth = match depth {
            Some(depth) => fetch(app, DEPTH, depth, None, HeadOf::Depth).await?.map(|(file, _)| file),
            None => None,
        };
        Ok((photo, depth))
    };
    let (photo, depth) = tokio::time::timeout(PATIENCE, fetched).await.unwrap_or_else(|_| Err(problem(SOURCE, &SourceError::Slow)))?;
    match (photo, before) {
        (Some((file, validators)), _) => {
            let photo = upload::accept(app, UploadParts { photo: Some(file), depth, fields }, owner).await?;
            if let Some(record) = record {
                remember(app, record, &photo, validators).await;
            }
            Ok(photo)
        }
        (None, Some((photo, _))) => {
            let photo = app.library.move_to_front(photo.id).await?;
            upload::update_settings(app, photo, &fields.settings).await
        }
        (None, None) => Err(Problem::internal("a source", &"it answers 304 to a request without validators")),
    }
}

/// Reads the object: the addresses of the photo and its depth map, and into `fields` options as a form has them.
async fn read(app: &App, fields: &mut UploadFields, request: Request) -> Result<(Url, Option<Url>), Problem> {
    let parameters = request_body::json_parameters(&request_body::read(request.into_body(), MOST).await?)?;
    let (mut source, mut depth) = (None, None);
    for (name, text) in parameters {
        match name.as_str() {
            SOURCE => source = Some(app.sources.address(&text).map_err(|e| problem(SOURCE, &e))?),
            DEPTH => depth = Some(app.sources.address(&text).map_err(|e| problem(DEPTH, &e))?),
            _ => {
                check_name(&name, "field; there are source, depth_source, preset, title, visibility, class")?;
                fields.take(&app.presets, &name, &text)?;
            }
        }
    }
    let source = source.ok_or_else(|| Problem::parameter(SOURCE, "is missing"))?;
    fields.file_name = file_name(&source);
    Ok((source, depth))
}

/// The name of the file at an address.
fn file_name(url: &Url) -> Option<String> {
    let last = url.path_segments()?.next_back().filter(|last| !last.is_empty())?;
    percent_decode_str(last).decode_utf8().ok().map(std::borrow::Cow::into_owned)
}

/// The name of a source's record: caller, address, options and program.
fn digest_of_source(app: &App, source: &Url, fields: &UploadFields, owner: Option<&Owner>) -> Digest {
    let options = photo_options::canonical(&photo_options::to_text(&fields.options));
    let owner = owner.map_or("", Owner::as_str);
    Digest::of(format!("{owner}\n{source}\n{}\n{options}", app.maker.identity()).as_bytes())
}

/// The photo made from a source, and the source's validators.
async fn find_made(app: &App, record: &Digest) -> Result<Option<(Photo, Validators)>, Problem> {
    let Some(Source { photo, etag, last_modified }) = app.library.source(record).await? else { return Ok(None) };
    let photo = app.library.find(photo).await?.filter(|photo| !matches!(photo.state, PhotoState::Failed | PhotoState::Damaged));
    Ok(photo.map(|photo| (photo, Validators { etag, last_modified })))
}

/// Remembers the validators of a source, if it sent any. The photo is accepted even if this fails.
async fn remember(app: &App, digest: Digest, photo: &Photo, validators: Validators) {
    let Validators { etag, last_modified } = validators;
    if etag.is_none() && last_modified.is_none() {
        return;
    }
    match app.library.remember_source(&digest, &Source { photo: photo.id, etag, last_modified }).await {
        // it was deleted meanwhile
        Ok(()) | Err(LibraryError::NotFound(_)) => {}
        Err(error) => tracing::warn!(%error, "cannot remember a source; it is fetched again"),
    }
}

/// Fetches a file into the folder of incoming uploads, with the validators of its source; `None` if it is the `known` one.
async fn fetch(
    app: &App,
    field: &str,
    url: Url,
    known: Option<&Validators>,
    of: HeadOf<'_>,
) -> Result<Option<(ReceivedFile, Validators)>, Problem> {
    let fetched = app.sources.fetch(url, known).await.map_err(|e| problem(field, &e))?;
    let Some((body, validators)) = fetched else { return Ok(None) };
    let (guarded, _rest) = LimitedBody::new(body, &app.limits, TimeLimit::new(PATIENCE));
    let received = receive(app, Body::new(guarded).into_data_stream(), of, |e| cut_off(field, &e)).await;
    // problems of the server itself have no field
    let file = received.map_err(|problem| if problem.field.is_some() { problem.field(field) } else { problem })?;
    Ok(Some((file, validators)))
}

/// The answer to a source that ends early.
fn cut_off(field: &str, error: &axum::Error) -> Problem {
    let of = |status, kind, detail: String| Problem::new(status, kind, detail).field(field);
    match CutOff::find(error) {
        Some(CutOff::TooLarge(limit)) => {
            of(StatusCode::PAYLOAD_TOO_LARGE, "source-too-large", format!("the source's file is over the limit of {limit} bytes"))
        }
        Some(CutOff::TooSlow(_) | CutOff::BelowRate(_)) => {
            of(StatusCode::GATEWAY_TIMEOUT, "source-too-slow", "the source sends its file too slowly".into())
        }
        None => of(StatusCode::BAD_GATEWAY, "source-failed", "the source ends within its file".into()),
    }
}

/// The answer to a source that cannot be fetched.
fn problem(field: &str, error: &SourceError) -> Problem {
    let (status, kind) = match error {
        SourceError::Address(_) => return Problem::parameter(field, error),
        SourceError::Host(_) => (StatusCode::FORBIDDEN, "source-host"),
        SourceError::NotPublic(_) => (StatusCode::FORBIDDEN, "source-address"),
        SourceError::Refused(_) => (StatusCode::UNPROCESSABLE_ENTITY, "source-refused"),
        SourceError::Failed(_) => (StatusCode::BAD_GATEWAY, "source-failed"),
        SourceError::Slow => (StatusCode::GATEWAY_TIMEOUT, "source-too-slow"),
    };
    Problem::new(status, kind, error.to_string()).field(field)
}
