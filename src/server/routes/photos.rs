//! Upload, state, list and deletion of photos.

use std::time::Duration;

use axum::Json;
use axum::extract::{Extension, Path, Request, State};
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE, ETAG, LOCATION};
use axum::http::{HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;

use super::path_photo::PathPhoto;
use super::photo_state::{PhotoList, PhotoState};
use super::query::{NoQuery, Pairs, decode};
use crate::server::access::Guard;
use crate::server::app_state::{App, StoredFile};
use crate::server::conditional::{Entity, check_if_match, insert, respond, respond_uncached};
use crate::server::limits::Limits;
use crate::server::problem::Problem;
use crate::server::program_digest::short;
use crate::server::time_limit::TimeLimit;
use crate::server::upload_by_address::SourceOrder;
use crate::server::viewer_settings::{PATCH_BYTES, Settings};
use crate::server::{request_body, upload, upload_by_address};
use tmpi_library::{Cursor, Event, LibraryError, Page, Part, Photo, PhotoState as Phase};
use tmpi_pipeline::networks::models::registry::better_than;

/// Part of the time limit of a request that is left to answer it.
pub(super) const ANSWER: Duration = Duration::from_millis(500);
/// Photos on a page of the list, if the client does not say.
const DEFAULT_PAGE: usize = 50;

/// Form of an upload.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "describes the form in the OpenAPI document")]
pub struct UploadForm {
    /// JPEG, PNG or WebP; recognised by its content.
    #[schema(value_type = String, format = Binary)]
    photo: Vec<u8>,
    /// Depth map, a grey picture (PNG of 8 or 16 bits, JPEG, WebP; or in colour with channels that are alike), PFM or OpenEXR; replaces the
    /// estimated depth.
    #[schema(value_type = Option<String>, format = Binary)]
    depth: Option<Vec<u8>>,
    /// The same scene by the other eye, from beside the photo (JPEG, PNG, WebP): depth is measured against it. It comes in place of a depth map.
    #[schema(value_type = Option<String>, format = Binary)]
    second: Option<Vec<u8>>,
    /// What to call the photo, 1 to 200 characters; else the name of the photo's file without its ending, and a photo that is there already
    /// keeps its title.
    title: Option<String>,
    /// Who may see the photo where the server asks who comes: `private` or `link`.
    visibility: Option<String>,
    /// Name of a preset of the server (`--preset`), whose options are added to those here.
    preset: Option<String>,
    /// `batch` for a photo of many, which gives way to those of others and to files that are written; else `interactive`. It is no part of what
    /// makes the photo the same.
    class: Option<String>,
    /// How the depth map is meant: `disparity` (white is near), `inverted` (white is far) or `metric` (distances).
    depth_kind: Option<String>,
    /// Depth that the photo brings along within its file: `auto`, `off`, or `on` to fail without.
    photo_depth: Option<String>,
    /// Where the picture of a second eye is: `auto` behind the first in the file (MPO), or as the name of the photo's file says; `left-right` or
    /// `top-bottom` in its halves, `rgbd` if the right half is the depth map, `beside` in the field `second`, `none` nowhere.
    stereo: Option<String>,
    /// Horizontal field of view in degrees.
    fov_x: Option<f64>,
    /// Planes a tile: `auto` or a number.
    planes: Option<String>,
    /// `linear`, `lloyd`, `optimal` or `slanted`.
    plane_method: Option<String>,
    /// Tile size in pixels, or `full`.
    tile: Option<String>,
    /// Blurred edges of the depth: `auto` snaps them where there are any, and widens what a depth network draws too small; `on` always
    /// snaps, and widens nothing.
    snap: Option<String>,
    /// Edges of the network's depth drawn to the photo's.
    refine: Option<String>,
    /// Noise of the depth: `auto` takes it away where there is any, `theta` by a network, `classic` without.
    denoise: Option<String>,
    /// Longest side in pixels; larger photos are reduced.
    max_size: Option<u32>,
    /// Picture quality, 1 to 100.
    quality: Option<u8>,
    /// Parallax error that planes may leave, in pixels between where views from the corners of the view box show a point and where they should.
    max_error: Option<f64>,
    /// Half extents of the view box, `X,Y,Z`.
    view_box: Option<String>,
    /// Milliseconds that making the photo may take: size and parallax error are chosen for it.
    budget_ms: Option<f64>,
}

/// Upload a photo.
///
/// Multipart form, or the raw bytes of a picture with the options of the form as query parameters (names with `-` or `_`), or a JSON object that
/// names a `source` from which the server fetches the picture, if its operator permits that.
/// Once this answers, the photo is on disk and is made even if the server is restarted. Photo, depth map and options give
/// the id: the same upload again is the same photo and costs nothing; if it had failed, it is tried again. It takes the title and the visibility that
/// the upload names.
#[utoipa::path(
    post, path = "/v1/photos", tag = "photos",
    params(
        ("Prefer" = Option<String>, Header, description = "`wait=SECONDS`: answer once the photo is done, or after that time"),
        ("title" = Option<String>, Query, min_length = 1, max_length = 200, description = "What to call the photo, 1 to 200 characters"),
        ("planes" = Option<String>, Query, description = "As in the form; so are all other options"),
    ),
    request_body(description = "The photo", content(
        (UploadForm = "multipart/form-data"),
        (SourceOrder = "application/json"),
        (String = "image/jpeg"),
        (String = "image/png"),
        (String = "image/webp"),
        (String = "application/octet-stream"),
    )),
    responses(
        (status = 201, description = "Done in the time that `Prefer: wait` gave", body = PhotoState, headers(
            ("Location" = String, description = "Address of the photo"),
            ("Preference-Applied" = String, description = "`wait=SECONDS`"),
        )),
        (status = 202, description = "Accepted: it is on disk and waits, or is being made, or was done before", body = PhotoState,
            headers(("Location" = String, description = "Address of the photo"))),
        (status = 400, description = "A field or an option is wrong; `field` names it"),
        (status = 403, description = "The owner has as many photos, or as many bytes, as one may have; or the key may not upload; or the server does not fetch from that source"),
        (status = 408, description = "The body came too slowly"),
        (status = 413, description = "Body or photo is too large"),
        (status = 415, description = "Not a JPEG, PNG or WebP picture"),
        (status = 422, description = "The picture is damaged, or its source refuses it"),
        (status = 429, description = "Too many photos wait; `Retry-After` says when to come back"),
        (status = 502, description = "The source is at fault"),
        (status = 503, description = "The server is stopping"),
        (status = 504, description = "The source is too slow"),
        (status = 507, description = "The disk is full"),
    )
)]
pub async fn upload(State(app): State<App>, Extension(clock): Extension<TimeLimit>, request: Request) -> Result<Response, Problem> {
    let wait = prefer_wait(request.headers());
    let query = decode(request.uri())?;
    let uploader = app.guard.as_ref().map(|_| Guard::uploader()).transpose()?;
    let (owner, is_new) = uploader.map_or((None, false), |(owner, is_new)| (Some(owner), is_new));
    // before the body comes
    if let Some(owner) = &owner {
        app.library.check_quota(owner, length_told(request.headers())).await?;
    }
    let photo = if upload_by_address::is_address(request.headers()) {
        upload_by_address::fetch_upload(&app, &query, request, owner, &clock).await?
    } else {
        upload::upload(&app, &query, request, owner).await?
    };
    answer(&app, photo, (&clock, wait), StatusCode::CREATED, is_new).await
}

/// Bytes of the body, as far as that is told.
fn length_told(headers: &HeaderMap) -> u64 {
    headers.get(CONTENT_LENGTH).and_then(|v| v.to_str().ok()).and_then(|v| v.parse().ok()).unwrap_or_default()
}

/// The state of a queued photo with the status `done` if it is made within the time of `Prefer: wait` and of the request, its problem if it
/// fails, else 202. A new owner gets a link with the photo's token, without which they cannot see the photo.
pub(super) async fn answer(
    app: &App,
    photo: Photo,
    (clock, wait): (&TimeLimit, Option<u64>),
    done: StatusCode,
    is_new: bool,
) -> Result<Response, Problem> {
    let photo = wait_for(app, photo, clock, wait).await?;
    let ready = wait.is_some() && photo.state.is_final();
    if ready && photo.state != Phase::Done {
        let mut response = Problem::of_photo(&photo).into_response();
        insert(&mut response, LOCATION, &app.base.at(&format!("/v1/photos/{}", photo.id)));
        return Ok(response);
    }
    let mut state = PhotoState::of(app, &photo).await?;
    state.links.manage = app.guard.as_ref().filter(|_| is_new).map(|guard| guard.manage_link(&photo));
    let status = if ready { done } else { StatusCode::ACCEPTED };
    let location = state.links.this.clone();
    let mut response = (status, Json(state)).into_response();
    insert(&mut response, LOCATION, &location);
    if let Some(seconds) = wait {
        insert(&mut response, HeaderName::from_static("preference-applied"), &format!("wait={seconds}"));
    }
    Ok(response)
}

/// The photo once nothing follows, or so many seconds are over, or the request's time nearly is, or the server stops.
async fn wait_for(app: &App, photo: Photo, clock: &TimeLimit, wait: Option<u64>) -> Result<Photo, Problem> {
    let Some(seconds) = wait else { return Ok(photo) };
    // counted from the end of the body; the longest wait is what the request has left
    let left = clock.deadline().map_or(Duration::ZERO, |at| at.saturating_duration_since(tokio::time::Instant::now()));
    let until = tokio::time::Instant::now() + left.saturating_sub(ANSWER).min(Duration::from_secs(seconds));
    let (id, mut events) = (photo.id, app.library.subscribe());
    loop {
        let photo = app.library.find(id).await?.ok_or_else(|| Problem::not_found("the photo was deleted meanwhile"))?;
        if photo.state.is_final() {
            return Ok(photo);
        }
        let news = async {
            loop {
                match events.next().await {
                    Some(Event::Photo(of) | Event::Deleted(of)) if of == id => break,
                    Some(Event::Gap) | None => break,
                    Some(_) => {}
                }
            }
        };
        tokio::select! {
            () = news => {}
            () = tokio::time::sleep_until(until) => return Ok(photo),
            () = app.stop.cancelled() => return Ok(photo),
        }
    }
}

/// Seconds of `Prefer: wait=SECONDS` (RFC 7240).
pub(super) fn prefer_wait(headers: &HeaderMap) -> Option<u64> {
    let mut all = headers.get_all("prefer").iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split(','));
    all.find_map(|preference| {
        let (name, value) = preference.split(';').next()?.split_once('=')?;
        let value = value.trim().trim_matches('"');
        name.trim().eq_ignore_ascii_case("wait").then(|| value.parse().ok()).flatten()
    })
}

/// List photos, newest first.
///
/// Only for this machine's own user: where the server is bound beyond loopback, is asked under another name than loopback's, or a proxy
/// passes the request on, the list is closed unless the server was started with `--access public`. With `--access private` it shows one's own.
#[utoipa::path(
    get, path = "/v1/photos", tag = "photos",
    params(
        ("limit" = Option<usize>, Query, minimum = 1, maximum = 200, description = "Photos on this page, at most 200; 50 if it is not given"),
        ("after" = Option<String>, Query, description = "Id of the last photo of the page before"),
    ),
    responses(
        (status = 200, description = "A page of the list", body = PhotoList),
        (status = 400, description = "A parameter is wrong"),
        (status = 403, description = "The list is closed"),
    )
)]
pub async fn list(State(app): State<App>, request: Request) -> Result<Response, Problem> {
    if app.guard.is_none() && !app.public_list && !app.hosts.is_own(request.headers()) {
        let detail =
            "only this machine's own user, at a loopback address, may list photos; tmpi serve --access public opens the list to all";
        return Err(Problem::new(StatusCode::FORBIDDEN, "list-closed", detail));
    }
    let pairs = Pairs::read(request.uri(), &["limit", "after"])?;
    let limit = pairs.number("limit", &(1..=Limits::PAGE))?.unwrap_or(DEFAULT_PAGE);
    let after = match pairs.get("after") {
        Some(text) => Some(cursor(&app, text).await.ok_or_else(|| Problem::parameter("after", format!("there is no photo {text:?}")))?),
        None => None,
    };
    let page = match app.guard.as_ref().filter(|_| !Guard::is_admin()).map(|_| Guard::owner()) {
        // a stranger has none
        Some(None) => Page { photos: Vec::new(), next: None },
        Some(owner) => app.library.list(owner.as_ref(), after, limit).await?,
        None => app.library.list(None, after, limit).await?,
    };
    let next = page.next.map(|next| app.base.at(&format!("/v1/photos?limit={limit}&after={next}")));
    let mut photos = Vec::with_capacity(page.photos.len());
    for photo in &page.photos {
        photos.push(PhotoState::of(&app, photo).await?);
    }
    let list = serde_json::to_vec(&PhotoList { photos, next }).map_err(|e| Problem::internal("writing the list", &e))?;
    Ok(respond_uncached(request.headers(), list.into(), "application/json"))
}

/// A place in the list: that of a page before, or of a photo.
async fn cursor(app: &App, text: &str) -> Option<Cursor> {
    match text.parse() {
        Ok(cursor) => Some(cursor),
        Err(_) => app.photo(text).await.ok().map(|photo| Cursor::from(&photo)),
    }
}

/// State, sizes and settings of a photo.
#[utoipa::path(
    get, path = "/v1/photos/{id}", tag = "photos",
    responses(
        (status = 200, description = "State, sizes and settings", body = PhotoState,
            headers(("ETag" = String, description = "Version of all this; `If-Match` goes by its first half, that of the settings"))),
        (status = 304, description = "The client has it"),
    )
)]
pub async fn state(State(app): State<App>, Path(id): Path<String>, _: NoQuery, headers: HeaderMap) -> Result<Response, Problem> {
    let photo = app.photo(&id).await?;
    let better = better_depth(&app, &photo).await;
    // a report that is lost has taken the photo out of service
    let photo = if photo.state == Phase::Done { app.photo(&id).await? } else { photo };
    let state = state_now(&app, &photo, better).await?;
    Ok(respond(&headers, Entity::json(state.source, &state.etag)))
}

/// What the owner of a photo wants of its viewers.
///
/// Any site may read it: it is what an element on another site's page needs besides the container.
#[utoipa::path(
    get, path = "/v1/photos/{id}/settings", tag = "photos",
    responses(
        (status = 200, description = "The settings", body = Settings),
        (status = 304, description = "The client has it"),
    )
)]
pub async fn settings(_: NoQuery, PathPhoto(photo): PathPhoto, headers: HeaderMap) -> Result<Response, Problem> {
    let settings = Settings::of(&photo);
    let bytes = serde_json::to_vec(&settings).map_err(|e| Problem::internal("writing a photo's settings", &e))?;
    let file = StoredFile::new(bytes);
    Ok(respond(&headers, Entity::json(file.source, &file.etag)))
}

/// What a report says of its photo's depth.
#[derive(serde::Deserialize)]
struct DepthReport {
    depth_model: String,
}

/// Name of this node's network, if it is better than the one that estimated the photo's depth and the caller may have the photo made again.
/// `None` if the depth was uploaded or came with the photo, or if the report cannot be read.
async fn better_depth(app: &App, photo: &Photo) -> Option<String> {
    let network = app.maker.network().to_owned();
    let worse = better_than(&network);
    if worse.is_empty() || app.guard.as_ref().is_some_and(|guard| !guard.may_change(photo)) {
        return None;
    }
    // a request for the report itself answers with the error
    let StoredFile { source, .. } = app.file(photo, Part::Report).await.ok()?;
    let DepthReport { depth_model } = serde_json::from_slice(&source.head(source.len()).await.ok()?).ok()?;
    worse.iter().any(|kind| depth_model.starts_with(kind)).then_some(network)
}

/// The state as it is sent. The first half of its tag names the settings, which alone can be changed, the second half all of it.
async fn state_now(app: &App, photo: &Photo, better_depth: Option<String>) -> Result<StoredFile, Problem> {
    let state = PhotoState { better_depth, ..PhotoState::of(app, photo).await? };
    let wrong = |e| Problem::internal("writing a photo's state", &e);
    let (settings, all) = (serde_json::to_string(&state.settings).map_err(wrong)?, serde_json::to_vec(&state).map_err(wrong)?);
    Ok(StoredFile::derived_in_memory(&short(&settings), all))
}

/// Change the settings of a photo.
///
/// A JSON merge patch (RFC 7396) of `settings`: what it names is changed, null removes, the rest stays. Viewers honour them from
/// their next start on; they stay with the photo when the server is restarted.
#[utoipa::path(
    patch, path = "/v1/photos/{id}", tag = "photos",
    params(("If-Match" = Option<String>, Header, description = "Change only these settings, by the tag of a state")),
    request_body(content((Settings = "application/merge-patch+json"), (Settings = "application/json"))),
    responses(
        (status = 200, description = "State, sizes and settings", body = PhotoState),
        (status = 400, description = "A setting is wrong; `field` names it"),
        (status = 412, description = "It was changed meanwhile"),
        (status = 413, description = "The patch is too large"),
        (status = 415, description = "Not JSON"),
    )
)]
pub async fn change(State(app): State<App>, Path(id): Path<String>, _: NoQuery, request: Request) -> Result<Response, Problem> {
    let mut photo = app.photo(&id).await?;
    let (headers, patch) = merge_patch(request, PATCH_BYTES, "settings").await?;
    let changed = loop {
        check_if_match(&headers, &state_now(&app, &photo, None).await?.etag)?;
        let settings = Settings::of(&photo).patched(&patch)?;
        match app.library.set_settings(&photo, &settings.to_value()).await {
            // somebody was quicker: it is looked at again
            Err(LibraryError::Changed) => photo = app.photo(&id).await?,
            changed => break changed?,
        }
    };
    let state = state_now(&app, &changed, None).await?;
    let length = state.source.len();
    let mut response = Response::new(state.source.body(0..length));
    insert(&mut response, CONTENT_TYPE, "application/json");
    insert(&mut response, ETAG, &state.etag);
    Ok(response)
}

/// The headers and the body of a request that is a merge patch of `what`, in at most `most` bytes.
pub(super) async fn merge_patch(request: Request, most: usize, what: &str) -> Result<(HeaderMap, Bytes), Problem> {
    let (parts, body) = request.into_parts();
    if !matches!(request_body::media_type(parts.headers.get(CONTENT_TYPE)).as_str(), "application/json" | "application/merge-patch+json") {
        let detail = format!("{what} are application/merge-patch+json or application/json");
        return Err(Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported-patch", detail).field("Content-Type"));
    }
    Ok((parts.headers, request_body::read(body, most).await?))
}

/// Delete a photo and everything that was made of it.
///
/// A job under way is stopped.
#[utoipa::path(
    delete, path = "/v1/photos/{id}", tag = "photos",
    params(("If-Match" = Option<String>, Header, description = "Delete it only with these settings, by the tag of a state")),
    responses(
        (status = 204, description = "Gone"),
        (status = 412, description = "It was changed meanwhile"),
    )
)]
pub async fn delete(State(app): State<App>, _: NoQuery, PathPhoto(photo): PathPhoto, headers: HeaderMap) -> Result<StatusCode, Problem> {
    check_if_match(&headers, &state_now(&app, &photo, None).await?.etag)?;
    let deleted = app.library.delete(photo.id, Some(photo.accepted_at)).await?;
    app.evict_photo(photo.id).await;
    if deleted { Ok(StatusCode::NO_CONTENT) } else { Err(Problem::not_found("the photo was deleted already")) }
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn accept_preferences_follow_rfc_9110() {
        let with =
            |text: &str| prefer_wait(&[(HeaderName::from_static("prefer"), HeaderValue::from_str(text).unwrap())].into_iter().collect());
        assert_eq!(with("wait=10"), Some(10));
        assert_eq!(with("respond-async, wait=\"10\"; foo=bar"), Some(10));
        assert_eq!(with("WAIT = 3"), Some(3));
        for none in ["wait", "wait=-1", "wait=soon", "await=3", ""] {
            assert_eq!(with(none), None, "{none}");
        }
    }
}
