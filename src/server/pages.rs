//! The pages and scripts of the viewer: embedded in the program, or read from a directory during development.

use std::path::{Component, Path, PathBuf};
use std::sync::{LazyLock, OnceLock};

use axum::extract::{self, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::response::Response;
use axum::routing::{MethodRouter, get};
use bytes::Bytes;
use sha2::{Digest, Sha256};

use super::app_state::App;
use super::compress;
use super::conditional::{ContentCoding, Entity, REVALIDATE, insert, respond};
use super::link_preview::PreviewCard;
use super::problem::Problem;
use crate::assets::{FILES, content_type};
use tmpi_library::hex;

/// Which sites may embed an answer (Fetch standard, section 3.7).
pub const RESOURCE_POLICY: HeaderName = HeaderName::from_static("cross-origin-resource-policy");

/// Which resources a page may embed (HTML standard, section 7.1.4). A cross-origin isolated page can frame only pages, and start only
/// workers, that set this header.
const EMBEDDER_POLICY: HeaderName = HeaderName::from_static("cross-origin-embedder-policy");

/// Which sites may frame a page or embed a file.
#[derive(Clone, Copy)]
pub enum Frames {
    /// This site: the page has buttons that change things, which another site could cover with its own (clickjacking).
    Own,
    Anybody,
}

/// Answers with the file `name`, whatever the address.
pub fn fixed(name: &'static str, frames: Frames) -> MethodRouter<App> {
    get(move |State(app): State<App>, headers: HeaderMap| async move { page(&app, &headers, name, frames).await })
}

/// `GET /view/{id}`, with the photo's preview card. If the photo is missing, or the browser has yet to send its credentials, the answer is
/// the same page with status 404; the page itself explains it.
pub async fn view(State(app): State<App>, extract::Path(id): extract::Path<String>, headers: HeaderMap) -> Result<Response, Problem> {
    let name = "app/view-page.html";
    let Ok(photo) = app.photo(&id).await else { return missing_page(&app, name, Frames::Own).await };
    let mut file = load(&app, name).await?;
    let card = app.address(&headers).map(|base| PreviewCard::of(&app, &photo, base));
    if let Some(card) = card {
        let page = card.insert_tags(&String::from_utf8_lossy(&file.bytes));
        file = File { etag: etag_of(page.as_bytes()), bytes: page.into(), coding: ContentCoding::Gzip };
    }
    Ok(send(file, &headers, name, Frames::Own))
}

/// `GET /embed/{id}`: only the viewer, for frames of other sites; it can change nothing.
pub async fn embed(State(app): State<App>, extract::Path(id): extract::Path<String>, headers: HeaderMap) -> Result<Response, Problem> {
    let name = "app/embed-page.html";
    // the access check also makes a link set its cookie
    if app.photo(&id).await.is_err() {
        return missing_page(&app, name, Frames::Anybody).await;
    }
    page(&app, &headers, name, Frames::Anybody).await
}

/// Fallback for unknown addresses: a page for people, a problem for programs.
pub async fn not_found(State(app): State<App>, method: Method, headers: HeaderMap) -> Result<Response, Problem> {
    // browsers declare a navigation; for other clients, the preferred type decides
    let dest = headers.get("sec-fetch-dest").map(HeaderValue::as_bytes);
    let accepts = headers.get(header::ACCEPT).and_then(|a| a.to_str().ok());
    let person = dest.map_or_else(|| accepts.is_some_and(|a| a.trim_start().starts_with("text/html")), |d| d == b"document");
    if !person || !matches!(method, Method::GET | Method::HEAD) {
        return Err(Problem::not_found("there is nothing at this address"));
    }
    missing_page(&app, "app/missing-page.html", Frames::Own).await
}

/// A page with status 404.
async fn missing_page(app: &App, name: &str, frames: Frames) -> Result<Response, Problem> {
    // without the request's headers: no ranges and no 304
    let mut response = page(app, &HeaderMap::new(), name, frames).await?;
    *response.status_mut() = StatusCode::NOT_FOUND;
    for name in [header::ETAG, header::ACCEPT_RANGES, header::CACHE_CONTROL] {
        response.headers_mut().remove(name);
    }
    Ok(response)
}

/// `GET /static/{name}`: except pages, which any site could frame at this address.
pub async fn file(State(app): State<App>, extract::Path(name): extract::Path<String>, headers: HeaderMap) -> Result<Response, Problem> {
    if Path::new(&name).extension().is_some_and(|e| e.eq_ignore_ascii_case("html")) {
        return Err(missing(&name));
    }
    page(&app, &headers, &name, Frames::Anybody).await
}

async fn page(app: &App, headers: &HeaderMap, name: &str, frames: Frames) -> Result<Response, Problem> {
    Ok(send(load(app, name).await?, headers, name, frames))
}

/// For each of the embedded files, its tag, and its bytes in gzip, compressed on first use.
static EMBEDDED: LazyLock<Vec<(String, OnceLock<Option<Bytes>>)>> =
    LazyLock::new(|| FILES.iter().map(|(_, bytes)| (etag_of(bytes), OnceLock::new())).collect());

struct File {
    bytes: Bytes,
    etag: String,
    coding: ContentCoding,
}

/// A file; pages with the server's own path before their addresses, which all begin with `/`.
async fn load(app: &App, name: &str) -> Result<File, Problem> {
    let file = read(app, name).await?;
    if app.base.is_empty() || !content_type(name).starts_with("text/html") {
        return Ok(file);
    }
    let page = String::from_utf8_lossy(&file.bytes).replace("=\"/", &format!("=\"{}/", app.base));
    Ok(File { etag: etag_of(page.as_bytes()), bytes: page.into(), coding: ContentCoding::Gzip })
}

async fn read(app: &App, name: &str) -> Result<File, Problem> {
    if let Some(dir) = &app.pages {
        let path = within(dir, name).ok_or_else(|| missing(name))?;
        let bytes = tokio::fs::read(path).await.map_err(|_| missing(name))?;
        let etag = etag_of(&bytes);
        return Ok(File { bytes: bytes.into(), etag, coding: if is_text(name) { ContentCoding::Gzip } else { ContentCoding::Plain } });
    }
    let at = FILES.binary_search_by_key(&name, |f| f.0).map_err(|_| missing(name))?;
    let (bytes, (etag, coded)) = (FILES[at].1, &EMBEDDED[at]);
    let gzip = || compress::gzip(bytes, flate2::Compression::best());
    let coding = if is_text(name) { ContentCoding::Coded(coded.get_or_init(gzip).clone()) } else { ContentCoding::Plain };
    Ok(File { bytes: Bytes::from_static(bytes), etag: etag.clone(), coding })
}

fn send(File { bytes, etag, coding }: File, headers: &HeaderMap, name: &str, frames: Frames) -> Response {
    let content_type = content_type(name);
    let mut response = respond(headers, Entity { source: bytes.into(), etag: &etag, content_type, cache_control: REVALIDATE, coding });
    let (ancestors, takers) = match frames {
        Frames::Own => ("'self'", "same-origin"),
        Frames::Anybody => ("*", "cross-origin"),
    };
    // these show photos of other servers; a worker has its own policy, and reads their containers and rooms, too
    let is_open = matches!(name, "app/demo-page.html" | "decode/worker.js" | "live/worker.js");
    let servers = if is_open { "*" } else { "'self'" };
    // the viewer's decoder needs blobs
    let policy = format!(
        "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; img-src {servers} blob: data:; media-src 'self' blob:; \
         connect-src {servers} blob: data:; style-src 'self' 'unsafe-inline'; worker-src 'self' blob:; object-src 'none'; \
         base-uri 'none'; form-action 'self'; frame-ancestors {ancestors}"
    );
    insert(&mut response, header::CONTENT_SECURITY_POLICY, &policy);
    response.headers_mut().insert(RESOURCE_POLICY, HeaderValue::from_static(takers));
    if matches!(name, "app/embed-page.html" | "decode/worker.js" | "live/worker.js") {
        response.headers_mut().insert(EMBEDDER_POLICY, HeaderValue::from_static("require-corp"));
    }
    response
}

fn missing(name: &str) -> Problem {
    Problem::not_found(format!("there is no file {name:?}"))
}

/// `name` below `dir`, never outside it.
fn within(dir: &Path, name: &str) -> Option<PathBuf> {
    let name = Path::new(name);
    name.components().all(|c| matches!(c, Component::Normal(_))).then(|| dir.join(name))
}

fn etag_of(bytes: &[u8]) -> String {
    format!("\"{}\"", hex(&Sha256::digest(bytes)[..16]))
}

/// Whether compression reduces a file.
fn is_text(name: &str) -> bool {
    let kind = content_type(name);
    kind.starts_with("text/") || matches!(kind, "application/json" | "application/wasm" | "image/svg+xml")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_name_escapes_the_folder() {
        let dir = Path::new("/pages");
        assert_eq!(within(dir, "a/b.js"), Some("/pages/a/b.js".into()));
        for bad in ["../x", "a/../../x", "/etc/passwd", "./x/../../y"] {
            assert_eq!(within(dir, bad), None, "{bad}");
        }
    }
}
