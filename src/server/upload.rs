//! Reads an upload, multipart or raw.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::{FromRequest, Multipart, Request};
use axum::http::{StatusCode, header};
use bytes::Bytes;
use futures_util::StreamExt;

use super::app_state::{App, AppState};
use super::client_slots::{ClientSlot, client_address};
use super::maker::HeadOf;
use super::multipart_header_limit::LimitedHeaders;
use super::photo_options;
use super::problem::Problem;
use super::request_body::{self, media_type};
use super::upload_fields::{UploadFields, check_name, of_query};
use super::upload_file::{ReceivedFile, receive};
use super::viewer_settings::{Settings, title_of_file};
use tmpi_library::{LibraryError, Outcome, Owner, Photo, PhotoId, Upload};
use tmpi_pipeline::{Options, Stereo};

/// Longest name of a field in bytes.
const MAX_NAME: usize = 64;
/// Longest value of a text field in bytes.
const MAX_OPTION: usize = 1024;

pub(super) struct UploadParts {
    pub photo: Option<ReceivedFile>,
    pub depth: Option<ReceivedFile>,
    pub fields: UploadFields,
}

/// Takes a slot before the body is read.
///
/// # Errors
/// 429 if too many uploads are in progress, or half of them from this address: an upload may take an hour. 503 while the server stops.
pub(super) async fn take_slot(app: &App) -> Result<ClientSlot, Problem> {
    if app.stop.is_cancelled() {
        return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "stopping", "the server is stopping").retry_after(10));
    }
    let free = app.library.free_places().await? as usize;
    // a few may come in even if the queue is full, since their photos may be known
    let most = free.saturating_add(app.limits.uploads_beyond);
    app.uploads.take(client_address()).filter(|_| app.uploads.taken() <= most).ok_or_else(|| {
        let detail = "the queue is full, and too many uploads are in progress";
        Problem::new(StatusCode::TOO_MANY_REQUESTS, "queue-full", detail).retry_after(5)
    })
}

/// Reads an upload of `owner`, if there are owners, and has it accepted; when this returns, it is on disk.
///
/// # Errors
/// 400 that names a wrong field, 408, 413, 415, 429, 500, 507.
pub async fn upload(app: &App, query: &[(String, String)], request: Request, owner: Option<Owner>) -> Result<Photo, Problem> {
    // errors of the query come first
    let fields = of_query(&app.presets, app.takes_options(request.headers()), query)?;
    let _slot = take_slot(app).await?;
    let mut parts = UploadParts { photo: None, depth: None, fields };
    // a body of another type is the photo itself
    if media_type(request.headers().get(header::CONTENT_TYPE)) == "multipart/form-data" {
        read_multipart(app, &mut parts, request).await?;
    } else {
        let stream = request.into_body().into_data_stream();
        parts.photo = Some(receive(app, stream, HeadOf::Photo(&parts.fields.options), |e| request_body::problem(&e)).await?);
    }
    accept(app, parts, owner).await
}

/// Checks an upload and has it accepted.
pub(super) async fn accept(app: &App, parts: UploadParts, owner: Option<Owner>) -> Result<Photo, Problem> {
    let UploadParts { photo, depth, fields } = parts;
    let UploadFields { mut options, class, settings: given, file_name, .. } = fields;
    let title = given.title.clone().or_else(|| file_name.as_deref().and_then(title_of_file));
    let settings = Settings { title, ..given.clone() };
    if options.stereo == Stereo::Auto {
        options.stereo = file_name.map_or(Ok(Stereo::Auto), |name| Stereo::of_name(&name)).map_err(|e| Problem::from(&e))?;
    }
    let photo = photo.ok_or_else(|| Problem::parameter("photo", "is missing, or its file is empty"))?;
    if photo.bytes == 0 {
        return Err(Problem::parameter("photo", "is empty"));
    }
    let text = photo_options::to_text(&options);
    let depth_digest = depth.as_ref().map(|depth| &depth.digest);
    let content = PhotoId::of_content(&photo.digest, depth_digest, &photo_options::canonical(&text), app.maker.identity());
    let id = app.library.secret().photo_id(owner.as_ref(), content);
    let bytes = photo.bytes + depth.as_ref().map_or(0, |depth| depth.bytes);
    let (photo, depth) = if app.library.find(id).await?.is_some() { (photo, depth) } else { check(app, photo, depth, options).await? };
    let upload = Upload {
        id,
        requester: AppState::requester(owner),
        class,
        options: text,
        settings: settings.to_value(),
        photo: photo.content(),
        depth: depth.as_ref().map(ReceivedFile::content),
    };
    let accepted = app.library.accept(upload).await?;
    match accepted.outcome {
        Outcome::New => app.telemetry.uploaded(bytes),
        Outcome::Known | Outcome::Retried | Outcome::Healed => return update_settings(app, accepted.photo, &given).await,
    }
    Ok(accepted.photo)
}

/// Gives a known photo the title and visibility of its upload.
pub(super) async fn update_settings(app: &App, mut photo: Photo, given: &Settings) -> Result<Photo, Problem> {
    loop {
        let (before, id) = (Settings::of(&photo), photo.id);
        let settings = before.overridden_by(given);
        if settings == before {
            return Ok(photo);
        }
        match app.library.set_settings(&photo, &settings.to_value()).await {
            // a concurrent change was faster
            Err(LibraryError::Changed) => photo = app.library.get(id).await?,
            changed => return Ok(changed?),
        }
    }
}

/// Checks a whole upload, a few at a time.
async fn check(
    app: &App,
    photo: ReceivedFile,
    depth: Option<ReceivedFile>,
    options: Options,
) -> Result<(ReceivedFile, Option<ReceivedFile>), Problem> {
    let maker = Arc::clone(&app.maker);
    let checked = app.change(move || {
        let (bytes, map) = (photo.read()?, depth.as_ref().map(ReceivedFile::read).transpose()?);
        maker.check(&bytes, map.as_deref(), &options).map_err(|e| Problem::from(&e))?;
        Ok((photo, depth))
    });
    checked.await?
}

/// Reads a form. Ignores empty fields, because browsers send fields that the user left empty.
async fn read_multipart(app: &App, parts: &mut UploadParts, request: Request) -> Result<(), Problem> {
    let content_type = request.headers().get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
    let boundary = multer::parse_boundary(content_type).map_err(|e| Problem::bad_request(format!("the form's boundary: {e}")))?;
    let request = request.map(|body| Body::from_stream(LimitedHeaders::new(body.into_data_stream(), &boundary)));
    let mut form = Multipart::from_request(request, &()).await.map_err(|e| Problem::bad_request(e.body_text()))?;
    while let Some(mut field) = form.next_field().await.map_err(|e| request_body::problem(&e))? {
        let name = field.name().unwrap_or_default().to_owned();
        if name.len() > MAX_NAME {
            return Err(Problem::parameter(name, format!("the name of a field is longer than {MAX_NAME} bytes")));
        }
        let slot = match name.as_str() {
            "photo" => &mut parts.photo,
            "depth" | "second" => &mut parts.depth,
            _ => {
                check_name(&name, "field; there are photo, depth, second, preset, title, visibility, class")?;
                let value = text(&name, field).await?;
                if !value.trim().is_empty() {
                    parts.fields.take(&app.presets, &name, &value)?;
                }
                continue;
            }
        };
        // browsers write a quote as `%22` (HTML, multipart/form-data encoding algorithm)
        let file_name = field.file_name().map(|name| name.replace("%22", "\""));
        let Some(first) = first_bytes(&mut field).await? else { continue };
        if slot.is_some() {
            let detail = if name == "photo" { "is given twice" } else { "is given twice: a depth map, or the picture of a second eye" };
            return Err(Problem::parameter(&name, detail));
        }
        if name == "second" {
            parts.fields.set("stereo", &photo_options::value_name(&Stereo::Beside))?;
        }
        let file = futures_util::stream::iter([Ok(first)]).chain(field);
        let of = match name.as_str() {
            "depth" => HeadOf::Depth,
            "second" => HeadOf::Second,
            _ => HeadOf::PhotoSoFar(&parts.fields.options),
        };
        *slot = Some(receive(app, file, of, |e| request_body::problem(&e)).await?);
        if name == "photo" {
            parts.fields.file_name = file_name;
        }
    }
    Ok(())
}

/// The first bytes of a field; `None` if it is empty.
async fn first_bytes(field: &mut axum::extract::multipart::Field<'_>) -> Result<Option<Bytes>, Problem> {
    while let Some(bytes) = field.chunk().await.map_err(|e| request_body::problem(&e))? {
        if !bytes.is_empty() {
            return Ok(Some(bytes));
        }
    }
    Ok(None)
}

async fn text(name: &str, mut field: axum::extract::multipart::Field<'_>) -> Result<String, Problem> {
    let mut value = Vec::new();
    while let Some(bytes) = field.chunk().await.map_err(|e| request_body::problem(&e))? {
        value.extend_from_slice(&bytes);
        if value.len() > MAX_OPTION {
            return Err(Problem::parameter(name, format!("is longer than {MAX_OPTION} bytes")));
        }
    }
    String::from_utf8(value).map_err(|_| Problem::parameter(name, "is not UTF-8"))
}
