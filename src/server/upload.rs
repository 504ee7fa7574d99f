//! Reads an upload, multipart or raw, onto disk while it comes in.

use std::collections::BTreeSet;
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

use super::access::Owner;
use super::admission::Admission;
use super::app::App;
use super::body;
use super::file_name::file_name;
use super::form::Bounded;
use super::id::PhotoId;
use super::jobs::{Class, Submitted};
use super::limits::Limits;
use super::maker::HeadOf;
use super::options;
use super::problem::Problem;
use super::records::VERSION;
use super::settings::{Settings, title_of_file};
use super::share::{Share, Shares, asker};
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

/// Uploads that come in.
#[derive(Debug)]
pub struct Coming {
    count: AtomicUsize,
    beyond: usize,
    shares: Shares,
}

/// Leave for an upload to come in.
pub struct Ticket<'a> {
    of: &'a Coming,
    _share: Share,
}

impl Drop for Ticket<'_> {
    fn drop(&mut self) {
        self.of.count.fetch_sub(1, Ordering::AcqRel);
    }
}

impl Coming {
    /// By the limits of a server.
    #[must_use]
    pub fn new(limits: &Limits) -> Self {
        let beyond = limits.uploads_beyond;
        Self { count: AtomicUsize::new(0), beyond, shares: Shares::half_of(limits.queue.saturating_add(beyond)) }
    }

    /// Leave for one more where the queue has `free` places. A few come in though it is full: they may be of photos that are known. None
    /// where as many come in already as may, or half of them from this address: an upload may take an hour.
    fn take(&self, free: usize) -> Option<Ticket<'_>> {
        let share = self.shares.take(asker())?;
        let before = self.count.fetch_add(1, Ordering::AcqRel);
        // dropped where it is refused
        let ticket = Ticket { of: self, _share: share };
        (before < free.saturating_add(self.beyond)).then_some(ticket)
    }
}

impl<'a> Ticket<'a> {
    /// Before a byte of the body is taken.
    ///
    /// # Errors
    /// 429 where as many come in already as may, 503 while the server stops.
    pub fn take(app: &'a App) -> Result<Self, Problem> {
        if !app.jobs.is_accepting() {
            return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "stopping", "the server is stopping").retry_after(10));
        }
        app.uploads.take(app.jobs.free_places()).ok_or_else(|| app.jobs.refusal())
    }
}

/// Everything of an upload.
struct Parts {
    incoming: Folder,
    photo: Option<Written>,
    depth: Option<Written>,
    chosen: Chosen,
}

/// Options, each given once.
#[derive(Default)]
struct Chosen {
    options: Options,
    given: BTreeSet<String>,
    /// How urgent making the photo is.
    class: Class,
    /// With the title that the upload names.
    settings: Settings,
    /// Title by the photo's file name, where the upload names none.
    of_file: Option<String>,
}

impl Chosen {
    /// Takes a field or parameter that is text.
    ///
    /// # Errors
    /// 400 that names it: it is wrong, or given a second time, in whatever spelling.
    fn set(&mut self, name: &str, value: &str) -> Result<(), Problem> {
        if name == VISIBILITY {
            self.settings = std::mem::take(&mut self.settings).seen_by(value)?;
        } else if name == CLASS {
            self.class = Class::of_photo(value).ok_or_else(|| Problem::parameter(CLASS, "must be interactive or batch"))?;
        } else if name == TITLE {
            self.settings = std::mem::take(&mut self.settings).titled(value)?;
        } else {
            options::set(&mut self.options, name, value)?;
        }
        if self.given.insert(name.replace('_', "-")) { Ok(()) } else { Err(Problem::parameter(name, "is given twice")) }
    }
}

/// Names of the fields of the title, and of who may see the photo.
const TITLE: &str = "title";
const VISIBILITY: &str = "visibility";
/// Name of the field of how urgent making the photo is.
const CLASS: &str = "class";

/// Refuses what is neither one of these nor an option, before its value is read.
fn known(name: &str, kinds: &str) -> Result<(), Problem> {
    if matches!(name, TITLE | VISIBILITY | CLASS) || options::NAMES.contains(&name.replace('_', "-").as_str()) {
        return Ok(());
    }
    Err(Problem::parameter(name, format!("there is no such {kinds}, {}", options::NAMES.join(", "))))
}

/// Takes an upload of `owner`, where there are such; when this returns, it is on disk.
///
/// # Errors
/// 400 that names a wrong field, 408, 413, 415, 429, 500, 507.
pub async fn take(app: &App, query: &[(String, String)], request: Request, owner: Option<Owner>) -> Result<Submitted, Problem> {
    // what is wrong is told first
    let chosen = chosen(query)?;
    let _leave = Ticket::take(app)?;
    take_chosen(app, chosen, request, owner).await
}

fn chosen(query: &[(String, String)]) -> Result<Chosen, Problem> {
    let mut chosen = Chosen::default();
    for (name, value) in query {
        known(name, "option; there are title, visibility, class")?;
        chosen.set(name, value)?;
    }
    Ok(chosen)
}

async fn take_chosen(app: &App, chosen: Chosen, request: Request, owner: Option<Owner>) -> Result<Submitted, Problem> {
    let jobs = Arc::clone(&app.jobs);
    let incoming =
        tokio::task::spawn_blocking(move || jobs.store.begin()).await.map_err(|e| Problem::internal("beginning an upload", &e))?;
    let incoming = Folder(Some(incoming.map_err(|e| Problem::store(&e))?));
    let mut parts = Parts { incoming, photo: None, depth: None, chosen };
    if is_multipart(request.headers()) {
        read_multipart(app, &mut parts, request).await?;
    } else {
        let stream = request.into_body().into_data_stream();
        let (mut admission, options) = (Admission::new(&app.jobs.maker), &parts.chosen.options);
        let look = |bytes: &[u8]| admission.see(bytes, HeadOf::Photo(options));
        parts.photo = Some(write(&parts.incoming, Part::Upload, stream, |e| body::problem(&e), look).await?);
    }
    let shared = Arc::clone(app);
    // checking it reads it whole: a few at a time
    let submitted = app.change(move || accept(&shared, parts, owner)).await??;
    if submitted.healed {
        app.forget(submitted.entry.id).await;
    }
    Ok(submitted)
}

/// The part of taking an upload that blocks: checks it and makes it durable.
fn accept(app: &App, parts: Parts, owner: Option<Owner>) -> Result<Submitted, Problem> {
    let Parts { mut incoming, photo, depth, chosen } = parts;
    let Chosen { options, class, settings: told, of_file, .. } = chosen;
    let settings = Settings { title: told.title.clone().or(of_file), ..told.clone() };
    let photo = photo.ok_or_else(|| Problem::parameter("photo", "is missing, or its file is empty"))?;
    if photo.bytes == 0 {
        return Err(Problem::parameter("photo", "is empty"));
    }
    let text = options::to_text(&options);
    let id = PhotoId::of(&photo.hash, depth.as_ref().map(|d| &d.hash), &options::canonical(&text), app.jobs.maker.identity());
    let id = app.guard.as_ref().zip(owner.as_ref()).map_or(id, |(guard, owner)| guard.id(owner, id));
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
        owner,
    };
    let folder = incoming.0.take().ok_or_else(gone)?;
    let submitted = app.jobs.submit_as(class, folder, id, accepted, settings)?;
    if submitted.new {
        app.telemetry.uploaded(photo.bytes + depth.map_or(0, |d| d.bytes));
    } else {
        app.jobs.uploaded_again(&submitted.entry, &told)?;
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
    headers.get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).is_some_and(is_form)
}

/// True for the media type of a form; what has another is the photo alone.
#[must_use]
pub fn is_form(content_type: &str) -> bool {
    content_type.split(';').next().is_some_and(|v| v.trim().eq_ignore_ascii_case("multipart/form-data"))
}

/// Reads a form. A field that is empty, as browsers send what nobody filled in, is as if it were not there.
async fn read_multipart(app: &App, parts: &mut Parts, request: Request) -> Result<(), Problem> {
    let content_type = request.headers().get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
    let boundary = multer::parse_boundary(content_type).map_err(|e| Problem::bad_request(format!("the form's boundary: {e}")))?;
    let request = request.map(|body| Body::from_stream(Bounded::new(body.into_data_stream(), &boundary)));
    let mut form = Multipart::from_request(request, &()).await.map_err(|e| Problem::bad_request(e.body_text()))?;
    while let Some(mut field) = form.next_field().await.map_err(|e| body::problem(&e))? {
        let name = field.name().unwrap_or_default().to_owned();
        if name.len() > MAX_NAME {
            return Err(Problem::parameter(name, format!("the name of a field is longer than {MAX_NAME} bytes")));
        }
        let (part, slot) = match name.as_str() {
            "photo" => (Part::Upload, &mut parts.photo),
            "depth" => (Part::Depth, &mut parts.depth),
            _ => {
                known(&name, "field; there are photo, depth, title, visibility, class")?;
                let value = text(&name, field).await?;
                if !value.trim().is_empty() {
                    parts.chosen.set(&name, &value)?;
                }
                continue;
            }
        };
        let title = file_name(field.headers()).and_then(|file| title_of_file(&file));
        let Some(first) = first_bytes(&mut field).await? else { continue };
        if slot.is_some() {
            return Err(Problem::parameter(&name, "is given twice"));
        }
        let file = futures_util::stream::iter([Ok(first)]).chain(field);
        let (mut admission, options) = (Admission::new(&app.jobs.maker), &parts.chosen.options);
        let of = if part == Part::Depth { HeadOf::Depth } else { HeadOf::PhotoSoFar(options) };
        let look = |bytes: &[u8]| admission.see(bytes, of);
        *slot = Some(write(&parts.incoming, part, file, |e| body::problem(&e), look).await?);
        if part == Part::Upload {
            parts.chosen.of_file = title;
        }
    }
    Ok(())
}

/// The first bytes of a field; none where it is empty.
async fn first_bytes(field: &mut axum::extract::multipart::Field<'_>) -> Result<Option<Bytes>, Problem> {
    while let Some(bytes) = field.chunk().await.map_err(|e| body::problem(&e))? {
        if !bytes.is_empty() {
            return Ok(Some(bytes));
        }
    }
    Ok(None)
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

/// Writes a stream to its file, each piece once `look` has seen it and refused nothing.
async fn write<S, E>(
    incoming: &Folder,
    part: Part,
    mut stream: S,
    problem: impl Fn(E) -> Problem,
    mut look: impl FnMut(&[u8]) -> Result<(), Problem>,
) -> Result<Written, Problem>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
{
    let disk = |e: std::io::Error| Problem::store(&e);
    let mut file = tokio::io::BufWriter::with_capacity(BUFFER, create(parts_path(incoming, part)?).await.map_err(disk)?);
    let mut hash = Sha256::new();
    let mut bytes = 0;
    while let Some(chunk) = stream.next().await {
        let chunk = chunk.map_err(&problem)?;
        look(&chunk)?;
        hash.update(&chunk);
        bytes += chunk.len() as u64;
        file.write_all(&chunk).await.map_err(disk)?;
    }
    file.flush().await.map_err(disk)?;
    Ok(Written { hash: hash.finalize().into(), bytes })
}

#[cfg(test)]
mod tests {
    use super::super::share::ASKER;
    use super::*;

    #[test]
    fn an_address_has_half_of_the_places_to_come_in() {
        let coming = Coming::new(&Limits { queue: 3, uploads_beyond: 1, ..Limits::default() });
        let ask = |address: Option<&str>| ASKER.sync_scope(address.map(|a| a.parse().unwrap()), || coming.take(3));
        let slow = (ask(Some("192.0.2.1")), ask(Some("192.0.2.1")));
        assert!(slow.0.is_some() && slow.1.is_some() && ask(Some("192.0.2.1")).is_none(), "a third");
        let others = (ask(Some("192.0.2.2")), ask(None));
        assert!(others.0.is_some() && others.1.is_some() && ask(Some("192.0.2.3")).is_none(), "a fifth");
        drop(others);
        assert!(coming.take(0).is_none() && coming.take(1).is_none() && coming.take(2).is_some());
    }

    #[test]
    fn an_option_is_given_once_however_it_is_spelt() {
        let mut chosen = Chosen::default();
        chosen.set("max-size", "90").unwrap();
        chosen.set("title", "A title").unwrap();
        for name in ["max-size", "max_size"] {
            let p = chosen.set(name, "90").unwrap_err();
            assert_eq!((p.status, p.field.as_deref()), (400, Some(name)));
        }
        assert_eq!(chosen.set("title", "A title").unwrap_err().field.as_deref(), Some("title"));
    }
}
