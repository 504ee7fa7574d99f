//! Reads an upload, multipart or raw, onto disk while it comes in.

use std::sync::Arc;

use axum::extract::{FromRequest, Multipart, Request};
use axum::http::{HeaderMap, header};
use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use sha2::{Digest, Sha256};
use tokio::fs::File;
use tokio::io::AsyncWriteExt;

use super::app::App;
use super::body;
use super::id::PhotoId;
use super::jobs::Submitted;
use super::options;
use super::problem::Problem;
use super::records::VERSION;
use super::store::{Accepted, Incoming, Part};
use super::time::now_ms;
use tmpi_pipeline::Options;

/// Longest text of an option.
const MAX_OPTION: usize = 256;
/// Bytes that are gathered before they are written.
const BUFFER: usize = 256 << 10;

/// A file that was written while it came in.
struct Written {
    hash: [u8; 32],
    bytes: u64,
}

/// Everything of an upload.
struct Parts {
    incoming: Incoming,
    photo: Option<Written>,
    depth: Option<Written>,
    options: Options,
}

/// Takes an upload; when this returns, it is on disk.
///
/// # Errors
/// 400 that names a wrong field, 408, 413, 415, 429, 500, 507.
pub async fn take(app: &App, query: Vec<(String, String)>, request: Request) -> Result<Submitted, Problem> {
    let mut options = Options::default();
    for (name, value) in query {
        if !options::set(&mut options, &name, &value)? {
            return Err(Problem::parameter(&name, format!("there is no such option; there are {}", options::NAMES.join(", "))));
        }
    }
    let incoming = app.jobs.store.begin().map_err(|e| Problem::store(&e))?;
    let mut parts = Parts { incoming, photo: None, depth: None, options };
    if is_multipart(request.headers()) {
        read_multipart(&mut parts, request).await?;
    } else {
        let stream = request.into_body().into_data_stream();
        parts.photo = Some(write(&parts.incoming, Part::Upload, stream, |e| body::problem(&e)).await?);
    }
    let app = Arc::clone(app);
    let accept = tokio::task::spawn_blocking(move || accept(&app, parts));
    accept.await.map_err(|e| Problem::internal("accepting an upload", &e))?
}

/// The part of taking an upload that blocks: checks it and makes it durable.
fn accept(app: &App, parts: Parts) -> Result<Submitted, Problem> {
    let Parts { incoming, photo, depth, options } = parts;
    let photo = photo.filter(|p| p.bytes > 0).ok_or_else(|| Problem::parameter("photo", "is missing"))?;
    if depth.as_ref().is_some_and(|d| d.bytes == 0) {
        return Err(Problem::parameter("depth", "is empty"));
    }
    let text = options::to_text(&options);
    let id = PhotoId::of(&photo.hash, depth.as_ref().map(|d| &d.hash), &options::canonical(&text));
    if app.jobs.get(id).is_none() {
        let read = |part| std::fs::read(incoming.path(part)).map_err(|e| Problem::store(&e));
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
    let submitted = app.jobs.submit(incoming, id, accepted)?;
    if submitted.healed {
        app.forget(id);
    }
    if submitted.new {
        app.telemetry.uploaded(photo.bytes + depth.map_or(0, |d| d.bytes));
    }
    Ok(submitted)
}

fn is_multipart(headers: &HeaderMap) -> bool {
    let value = headers.get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
    value.split(';').next().is_some_and(|v| v.trim().eq_ignore_ascii_case("multipart/form-data"))
}

async fn read_multipart(parts: &mut Parts, request: Request) -> Result<(), Problem> {
    let mut form = Multipart::from_request(request, &()).await.map_err(|e| Problem::bad_request(e.body_text()))?;
    while let Some(field) = form.next_field().await.map_err(|e| body::problem(&e))? {
        let name = field.name().unwrap_or_default().to_owned();
        let (part, slot) = match name.as_str() {
            "photo" => (Part::Upload, &mut parts.photo),
            "depth" => (Part::Depth, &mut parts.depth),
            _ => {
                let value = text(&name, field).await?;
                if !options::set(&mut parts.options, &name, &value)? {
                    let detail = format!("there is no such field; there are photo, depth, {}", options::NAMES.join(", "));
                    return Err(Problem::parameter(&name, detail));
                }
                continue;
            }
        };
        if slot.is_some() {
            return Err(Problem::parameter(&name, "is given twice"));
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
async fn write<S, E>(incoming: &Incoming, part: Part, mut stream: S, problem: impl Fn(E) -> Problem) -> Result<Written, Problem>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
{
    let disk = |e: std::io::Error| Problem::store(&e);
    let mut file = tokio::io::BufWriter::with_capacity(BUFFER, create(incoming.path(part)).await.map_err(disk)?);
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
