//! Reads an upload, multipart or raw, onto disk while it comes in.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::body::Body;
use axum::extract::{FromRequest, Multipart, Request};
use axum::http::{HeaderMap, StatusCode, header};
use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use sha2::{Digest as _, Sha256};
use tokio::fs::File;
use tokio::io::AsyncWriteExt;

use super::app_state::{App, Shared};
use super::client_slots::{ClientSlot, client_address};
use super::header_limit::Bounded;
use super::maker::HeadOf;
use super::photo_options;
use super::photo_settings::{Settings, title_of_file};
use super::problem::Problem;
use super::request_body;
use super::upload_head::UploadHead;
use tmpi_library::{Class, Content, Digest, LibraryError, Outcome, Owner, Photo, PhotoId, Upload};
use tmpi_pipeline::{Options, Stereo};

/// Longest name of a field in bytes.
const MAX_NAME: usize = 64;
/// Longest text of an option or a title, bytes.
const MAX_OPTION: usize = 1024;
/// Bytes that are gathered before they are written.
const BUFFER: usize = 256 << 10;

/// A file that was written while it came in; it goes with this, unless the library has taken it.
pub(super) struct Written {
    file: Fresh,
    digest: Digest,
    bytes: u64,
}

impl Written {
    fn content(&self) -> Content {
        Content::of_file(self.file.0.clone(), self.bytes, self.digest.clone())
    }
}

/// A path of which the file goes with this.
struct Fresh(PathBuf);

impl Fresh {
    /// One that nobody else has.
    fn within(folder: &Path) -> Self {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        Self(folder.join(format!("upload-{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed))))
    }
}

impl Drop for Fresh {
    fn drop(&mut self) {
        let path = std::mem::take(&mut self.0);
        // the removal blocks, and must keep no other request waiting; what was moved is not there any more
        let remove = move || drop(std::fs::remove_file(path));
        match tokio::runtime::Handle::try_current() {
            Ok(runtime) => drop(runtime.spawn_blocking(remove)),
            Err(_) => remove(),
        }
    }
}

/// Leave to come in, before a byte of the body is taken.
///
/// # Errors
/// 429 where as many come in already as may, or half of them from this address: an upload may take an hour. 503 while the server stops.
pub(super) async fn leave(app: &App) -> Result<ClientSlot, Problem> {
    if app.stop.is_cancelled() {
        return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "stopping", "the server is stopping").retry_after(10));
    }
    let free = app.library.free_places().await? as usize;
    // a few may come in even if the queue is full, since their photos may be known
    let most = free.saturating_add(app.limits.uploads_beyond);
    app.uploads.take(client_address()).filter(|_| app.uploads.taken() <= most).ok_or_else(|| {
        let detail = "the queue is full, and so many uploads are in progress";
        Problem::new(StatusCode::TOO_MANY_REQUESTS, "queue-full", detail).retry_after(5)
    })
}

/// Everything of an upload.
pub(super) struct Parts {
    /// The photo.
    pub photo: Option<Written>,
    /// Its depth map.
    pub depth: Option<Written>,
    /// Everything else.
    pub chosen: Chosen,
}

/// Options, each given once.
#[derive(Default)]
pub(super) struct Chosen {
    /// Options of the photo.
    pub options: Options,
    given: BTreeSet<String>,
    /// How urgent making the photo is.
    class: Class,
    /// With the title that the upload names.
    pub settings: Settings,
    /// Name of the photo's file: the title, where the upload names none, and where a second eye is.
    pub of_file: Option<String>,
}

impl Chosen {
    /// Takes a field or parameter that is text.
    ///
    /// # Errors
    /// 400 that names it: it is wrong, or given a second time, in whatever spelling.
    pub fn set(&mut self, name: &str, value: &str) -> Result<(), Problem> {
        if name == VISIBILITY {
            self.settings = std::mem::take(&mut self.settings).seen_by(value)?;
        } else if name == CLASS {
            self.class = class_of(value).ok_or_else(|| Problem::parameter(CLASS, "must be interactive or batch"))?;
        } else if name == TITLE {
            self.settings = std::mem::take(&mut self.settings).titled(value)?;
        } else {
            photo_options::set(&mut self.options, name, value)?;
        }
        if self.given.insert(name.replace('_', "-")) { Ok(()) } else { Err(Problem::parameter(name, "is given twice")) }
    }
}

/// The class that clients name for a photo: `interactive` or `batch`.
#[must_use]
pub fn class_of(name: &str) -> Option<Class> {
    [Class::Interactive, Class::Batch].into_iter().find(|class| class.name() == name)
}

/// Names of the fields of the title, and of who may see the photo.
const TITLE: &str = "title";
const VISIBILITY: &str = "visibility";
/// Name of the field of how urgent making the photo is.
const CLASS: &str = "class";

/// Refuses what is neither one of these nor an option, before its value is read.
pub(super) fn known(name: &str, kinds: &str) -> Result<(), Problem> {
    if matches!(name, TITLE | VISIBILITY | CLASS) || photo_options::NAMES.contains(&name.replace('_', "-").as_str()) {
        return Ok(());
    }
    Err(Problem::parameter(name, format!("there is no such {kinds}, {}", photo_options::NAMES.join(", "))))
}

/// Takes an upload of `owner`, where there are such; when this returns, it is on disk.
///
/// # Errors
/// 400 that names a wrong field, 408, 413, 415, 429, 500, 507.
pub async fn take(app: &App, query: &[(String, String)], request: Request, owner: Option<Owner>) -> Result<Photo, Problem> {
    // what is wrong is told first
    let chosen = chosen(query)?;
    let _leave = leave(app).await?;
    take_chosen(app, chosen, request, owner).await
}

/// The options of a query.
///
/// # Errors
/// 400 that names a wrong one.
pub(super) fn chosen(query: &[(String, String)]) -> Result<Chosen, Problem> {
    let mut chosen = Chosen::default();
    for (name, value) in query {
        known(name, "option; there are title, visibility, class")?;
        chosen.set(name, value)?;
    }
    Ok(chosen)
}

async fn take_chosen(app: &App, chosen: Chosen, request: Request, owner: Option<Owner>) -> Result<Photo, Problem> {
    let mut parts = Parts { photo: None, depth: None, chosen };
    if is_multipart(request.headers()) {
        read_multipart(app, &mut parts, request).await?;
    } else {
        let stream = request.into_body().into_data_stream();
        let (mut head, options) = (UploadHead::new(&app.maker), &parts.chosen.options);
        let look = |bytes: &[u8]| head.see(bytes, HeadOf::Photo(options));
        parts.photo = Some(write(app, stream, |e| request_body::problem(&e), look).await?);
    }
    accept(app, parts, owner).await
}

/// Checks an upload and has it accepted.
pub(super) async fn accept(app: &App, parts: Parts, owner: Option<Owner>) -> Result<Photo, Problem> {
    let Parts { photo, depth, chosen } = parts;
    let Chosen { mut options, class, settings: told, of_file, .. } = chosen;
    let title = told.title.clone().or_else(|| of_file.as_deref().and_then(title_of_file));
    let settings = Settings { title, ..told.clone() };
    if options.stereo == Stereo::Auto {
        options.stereo = of_file.map_or(Ok(Stereo::Auto), |name| Stereo::of_name(&name)).map_err(|e| Problem::from(&e))?;
    }
    let photo = photo.ok_or_else(|| Problem::parameter("photo", "is missing, or its file is empty"))?;
    if photo.bytes == 0 {
        return Err(Problem::parameter("photo", "is empty"));
    }
    let text = photo_options::to_text(&options);
    let depth_digest = depth.as_ref().map(|depth| &depth.digest);
    let content = PhotoId::of_content(&photo.digest, depth_digest, &photo_options::canonical(&text), app.maker.identity());
    let id = app.guard.as_ref().zip(owner.as_ref()).map_or(content, |(guard, owner)| guard.id(owner, content));
    let bytes = photo.bytes + depth.as_ref().map_or(0, |depth| depth.bytes);
    let (photo, depth) = if app.library.find(id).await?.is_some() { (photo, depth) } else { check(app, photo, depth, options).await? };
    let upload = Upload {
        id,
        asker: Shared::asker(owner),
        class,
        options: text,
        settings: settings.to_value(),
        photo: photo.content(),
        depth: depth.as_ref().map(Written::content),
        reservation: None,
    };
    let accepted = app.library.accept(upload).await?;
    match accepted.outcome {
        Outcome::New => app.telemetry.uploaded(bytes),
        Outcome::Known | Outcome::Retried | Outcome::Healed => return told_again(app, accepted.photo, &told).await,
    }
    Ok(accepted.photo)
}

/// A photo that was known, with the title and the visibility that its upload names.
pub(super) async fn told_again(app: &App, mut photo: Photo, told: &Settings) -> Result<Photo, Problem> {
    loop {
        let (before, id) = (Settings::of(&photo), photo.id);
        let settings = before.told_again(told);
        if settings == before {
            return Ok(photo);
        }
        match app.library.set_settings(&photo, &settings.to_value()).await {
            // somebody was quicker
            Err(LibraryError::Changed) => photo = app.library.get(id).await?,
            changed => return Ok(changed?),
        }
    }
}

/// Reads an upload whole, and refuses what could not be made: a few at a time.
async fn check(app: &App, photo: Written, depth: Option<Written>, options: Options) -> Result<(Written, Option<Written>), Problem> {
    let maker = Arc::clone(&app.maker);
    let read = |written: &Written| std::fs::read(&written.file.0).map_err(|e| Problem::store(&e));
    let checked = app.change(move || {
        let (bytes, map) = (read(&photo)?, depth.as_ref().map(read).transpose()?);
        maker.check(&bytes, map.as_deref(), &options).map_err(|e| Problem::from(&e))?;
        Ok((photo, depth))
    });
    checked.await?
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
    while let Some(mut field) = form.next_field().await.map_err(|e| request_body::problem(&e))? {
        let name = field.name().unwrap_or_default().to_owned();
        if name.len() > MAX_NAME {
            return Err(Problem::parameter(name, format!("the name of a field is longer than {MAX_NAME} bytes")));
        }
        let slot = match name.as_str() {
            "photo" => &mut parts.photo,
            "depth" | "second" => &mut parts.depth,
            _ => {
                known(&name, "field; there are photo, depth, second, title, visibility, class")?;
                let value = text(&name, field).await?;
                if !value.trim().is_empty() {
                    parts.chosen.set(&name, &value)?;
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
            parts.chosen.set("stereo", &photo_options::chosen(&Stereo::Beside))?;
        }
        let file = futures_util::stream::iter([Ok(first)]).chain(field);
        let (mut head, options) = (UploadHead::new(&app.maker), &parts.chosen.options);
        let of = match name.as_str() {
            "depth" => HeadOf::Depth,
            "second" => HeadOf::Second,
            _ => HeadOf::PhotoSoFar(options),
        };
        let look = |bytes: &[u8]| head.see(bytes, of);
        *slot = Some(write(app, file, |e| request_body::problem(&e), look).await?);
        if name == "photo" {
            parts.chosen.of_file = file_name;
        }
    }
    Ok(())
}

/// The first bytes of a field; none where it is empty.
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

/// A new file that only its owner may read.
async fn create(path: &Path) -> std::io::Result<File> {
    let mut options = std::fs::OpenOptions::new();
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options.create_new(true).write(true);
    tokio::fs::OpenOptions::from(options).open(path).await
}

/// Writes a stream to a file, each piece once `look` has seen it and refused nothing.
pub(super) async fn write<S, E>(
    app: &App,
    mut stream: S,
    problem: impl Fn(E) -> Problem,
    mut look: impl FnMut(&[u8]) -> Result<(), Problem>,
) -> Result<Written, Problem>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
{
    let disk = |e: std::io::Error| Problem::store(&e);
    app.library.blobs().room_for(0)?;
    let fresh = Fresh::within(app.library.incoming());
    let mut file = tokio::io::BufWriter::with_capacity(BUFFER, create(&fresh.0).await.map_err(disk)?);
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
    Ok(Written { file: fresh, digest: Digest::from_bytes(&hash.finalize().into()), bytes })
}

#[cfg(test)]
mod tests {
    use super::*;

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
