//! Reads an upload, multipart or raw, onto disk while it comes in.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use axum::body::Body;
use axum::extract::{FromRequest, Multipart, Request};
use axum::http::{HeaderMap, StatusCode, header};
use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use sha2::{Digest, Sha256};
use tokio::fs::File;
use tokio::io::AsyncWriteExt;

use super::app::App;
use super::body;
use super::form::Bounded;
use super::id::PhotoId;
use super::jobs::Submitted;
use super::options;
use super::problem::Problem;
use super::records::VERSION;
use super::settings::{Settings, title_of_file};
use super::store::{Accepted, Incoming, Part};
use super::time::now_ms;
use tmpi_pipeline::Options;

/// Longest name of a field in bytes.
const MAX_NAME: usize = 64;
/// Longest text of an option or a title, bytes.
const MAX_OPTION: usize = 1024;
/// Bytes that are gathered before they are written.
const BUFFER: usize = 256 << 10;

/// A file that was written while it came in.
struct Written {
    hash: [u8; 32],
    bytes: u64,
}

/// A folder on its way in of which the removal, which blocks, keeps no other request waiting.
struct Folder(Option<Incoming>);

impl Drop for Folder {
    fn drop(&mut self) {
        let incoming = self.0.take();
        if let (Some(incoming), Ok(runtime)) = (incoming, tokio::runtime::Handle::try_current()) {
            runtime.spawn_blocking(move || drop(incoming));
        }
    }
}

/// Leave for an upload to come in.
struct Ticket<'a>(&'a AtomicUsize);

impl Drop for Ticket<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::AcqRel);
    }
}

impl<'a> Ticket<'a> {
    /// Before a byte of the body is taken. A few come in though the queue is full: they may be of photos that are known.
    ///
    /// # Errors
    /// 429 where as many come in already as may, 503 while the server stops.
    fn take(app: &'a App) -> Result<Self, Problem> {
        let ticket = Self(&app.uploads);
        let before = app.uploads.fetch_add(1, Ordering::AcqRel);
        if !app.jobs.is_accepting() {
            return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "stopping", "the server is stopping").retry_after(10));
        }
        if before >= app.jobs.free_places() + app.limits.uploads_beyond { Err(app.jobs.refusal()) } else { Ok(ticket) }
    }
}

/// Everything of an upload.
struct Parts {
    incoming: Folder,
    photo: Option<Written>,
    depth: Option<Written>,
    options: Options,
    /// With the title that the upload names.
    settings: Settings,
    /// Title by the photo's file name, where the upload names none.
    of_file: Option<String>,
}

impl Parts {
    /// Takes a field or parameter that is text.
    ///
    /// # Errors
    /// 400 that names it: it is wrong, or the title is given twice.
    fn set(&mut self, name: &str, value: &str) -> Result<(), Problem> {
        if name != TITLE {
            return options::set(&mut self.options, name, value).map(drop);
        }
        if self.settings.title.is_some() {
            return Err(Problem::parameter(name, "is given twice"));
        }
        self.settings = std::mem::take(&mut self.settings).titled(value)?;
        Ok(())
    }
}

/// Name of the field of the title.
const TITLE: &str = "title";

/// Refuses what is neither the title nor an option, before its value is read.
fn known(name: &str, kinds: &str) -> Result<(), Problem> {
    if name == TITLE || options::NAMES.contains(&name.replace('_', "-").as_str()) {
        return Ok(());
    }
    Err(Problem::parameter(name, format!("there is no such {kinds}, {}", options::NAMES.join(", "))))
}

/// Takes an upload; when this returns, it is on disk.
///
/// # Errors
/// 400 that names a wrong field, 408, 413, 415, 429, 500, 507.
pub async fn take(app: &App, query: Vec<(String, String)>, request: Request) -> Result<Submitted, Problem> {
    let incoming = Folder(None);
    let (options, settings) = (Options::default(), Settings::default());
    let mut parts = Parts { incoming, photo: None, depth: None, options, settings, of_file: None };
    for (name, value) in query {
        known(&name, "option; there are title")?;
        parts.set(&name, &value)?;
    }
    let _ticket = Ticket::take(app)?;
    let jobs = Arc::clone(&app.jobs);
    let incoming =
        tokio::task::spawn_blocking(move || jobs.store.begin()).await.map_err(|e| Problem::internal("beginning an upload", &e))?;
    parts.incoming = Folder(Some(incoming.map_err(|e| Problem::store(&e))?));
    if is_multipart(request.headers()) {
        read_multipart(&mut parts, request).await?;
    } else {
        let stream = request.into_body().into_data_stream();
        parts.photo = Some(write(&parts.incoming, Part::Upload, stream, |e| body::problem(&e)).await?);
    }
    let shared = Arc::clone(app);
    let accept = tokio::task::spawn_blocking(move || accept(&shared, parts));
    let submitted = accept.await.map_err(|e| Problem::internal("accepting an upload", &e))??;
    if submitted.healed {
        app.forget(submitted.entry.id).await;
    }
    Ok(submitted)
}

/// The part of taking an upload that blocks: checks it and makes it durable.
fn accept(app: &App, parts: Parts) -> Result<Submitted, Problem> {
    let Parts { mut incoming, photo, depth, options, mut settings, of_file } = parts;
    settings.title = settings.title.or(of_file);
    let photo = photo.filter(|p| p.bytes > 0).ok_or_else(|| Problem::parameter("photo", "is missing"))?;
    if depth.as_ref().is_some_and(|d| d.bytes == 0) {
        return Err(Problem::parameter("depth", "is empty"));
    }
    let text = options::to_text(&options);
    let id = PhotoId::of(&photo.hash, depth.as_ref().map(|d| &d.hash), &options::canonical(&text), app.jobs.maker.identity());
    if app.jobs.get(id).is_none() {
        let read = |part| std::fs::read(parts_path(&incoming, part)?).map_err(|e| Problem::store(&e));
        let (photo, map) = (read(Part::Upload)?, depth.as_ref().map(|_| read(Part::Depth)).transpose()?);
        app.jobs.maker.check(&photo, map.as_deref(), &options).map_err(|e| Problem::from(&e))?;
    }
    let accepted = Accepted {
        version: VERSION,
        at_ms: now_ms(),
        photo_bytes: photo.bytes,
        depth_bytes: depth.as_ref().map(|d| d.bytes),
        options: text,
    };
    let folder = incoming.0.take().ok_or_else(gone)?;
    let submitted = app.jobs.submit(folder, id, accepted, settings)?;
    if submitted.new {
        app.telemetry.uploaded(photo.bytes + depth.map_or(0, |d| d.bytes));
    }
    Ok(submitted)
}

/// Where a part of an upload belongs.
fn parts_path(folder: &Folder, part: Part) -> Result<PathBuf, Problem> {
    folder.0.as_ref().map(|incoming| incoming.path(part)).ok_or_else(gone)
}

fn gone() -> Problem {
    Problem::internal("an upload", &"its folder was given away already")
}

fn is_multipart(headers: &HeaderMap) -> bool {
    let value = headers.get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
    value.split(';').next().is_some_and(|v| v.trim().eq_ignore_ascii_case("multipart/form-data"))
}

async fn read_multipart(parts: &mut Parts, request: Request) -> Result<(), Problem> {
    let content_type = request.headers().get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
    let boundary = multer::parse_boundary(content_type).map_err(|e| Problem::bad_request(format!("the form's boundary: {e}")))?;
    let request = request.map(|body| Body::from_stream(Bounded::new(body.into_data_stream(), &boundary)));
    let mut form = Multipart::from_request(request, &()).await.map_err(|e| Problem::bad_request(e.body_text()))?;
    while let Some(field) = form.next_field().await.map_err(|e| body::problem(&e))? {
        let name = field.name().unwrap_or_default().to_owned();
        if name.len() > MAX_NAME {
            return Err(Problem::parameter(name, format!("the name of a field is longer than {MAX_NAME} bytes")));
        }
        let (part, slot) = match name.as_str() {
            "photo" => (Part::Upload, &mut parts.photo),
            "depth" => (Part::Depth, &mut parts.depth),
            _ => {
                known(&name, "field; there are photo, depth, title")?;
                let value = text(&name, field).await?;
                parts.set(&name, &value)?;
                continue;
            }
        };
        if slot.is_some() {
            return Err(Problem::parameter(&name, "is given twice"));
        }
        if part == Part::Upload {
            parts.of_file = field.file_name().and_then(title_of_file);
        }
        *slot = Some(write(&parts.incoming, part, field, |e| body::problem(&e)).await?);
    }
    Ok(())
}

async fn text(name: &str, mut field: axum::extract::multipart::Field<'_>) -> Result<String, Problem> {
    let mut value = Vec::new();
    while let Some(bytes) = field.chunk().await.map_err(|e| body::problem(&e))? {
        value.extend_from_slice(&bytes);
        if value.len() > MAX_OPTION {
            return Err(Problem::parameter(name, format!("is longer than {MAX_OPTION} bytes")));
        }
    }
    String::from_utf8(value).map_err(|_| Problem::parameter(name, "is not UTF-8"))
}

/// A new file that only its owner may read.
async fn create(path: std::path::PathBuf) -> std::io::Result<File> {
    let mut options = tokio::fs::OpenOptions::from(super::files::private());
    options.create(true).truncate(true).write(true).open(path).await
}

/// Writes a stream to its file, synced.
async fn write<S, E>(incoming: &Folder, part: Part, mut stream: S, problem: impl Fn(E) -> Problem) -> Result<Written, Problem>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
{
    let disk = |e: std::io::Error| Problem::store(&e);
    let mut file = tokio::io::BufWriter::with_capacity(BUFFER, create(parts_path(incoming, part)?).await.map_err(disk)?);
    let mut hash = Sha256::new();
    let mut bytes = 0;
    while let Some(chunk) = stream.next().await {
        let chunk = chunk.map_err(&problem)?;
        hash.update(&chunk);
        bytes += chunk.len() as u64;
        file.write_all(&chunk).await.map_err(disk)?;
    }
    file.flush().await.map_err(disk)?;
    file.get_ref().sync_all().await.map_err(disk)?;
    Ok(Written { hash: hash.finalize().into(), bytes })
}
