//! Uploads in parts: how far one is, its parts, and its end.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Extension, Path, Request, State};
use axum::http::header::{CONTENT_TYPE, LOCATION};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::photos::{accepted, prefer_wait, uploader};
use super::query::NoQuery;
use super::state::PhotoState;
use crate::server::access::Guard;
use crate::server::app::App;
use crate::server::clock::Clock;
use crate::server::conditional::insert;
use crate::server::partial::{self, Extent, Partial, Record, Turn, header};
use crate::server::problem::Problem;
use crate::server::time::{now_ms, rfc3339};
use crate::server::upload::{self, Ticket};

/// How far an upload in parts is.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub struct UploadState {
    /// Bytes that are there, and survive a restart of the server.
    offset: u64,
    /// Bytes of the whole, once they are known.
    #[serde(skip_serializing_if = "Option::is_none")]
    length: Option<u64>,
    /// Whether it has become a photo.
    complete: bool,
    /// When it is removed if nothing of it comes (RFC 3339, UTC).
    #[schema(format = DateTime)]
    expires: String,
    /// Address of the photo that it became.
    #[serde(skip_serializing_if = "Option::is_none")]
    photo: Option<String>,
}

impl UploadState {
    fn of(app: &App, record: &Record) -> Self {
        Self {
            offset: record.extent.offset,
            length: record.extent.length,
            complete: record.photo.is_some(),
            expires: rfc3339(app.partials.ends_ms(record)),
            photo: record.photo.as_ref().map(|id| format!("/v1/photos/{id}")),
        }
    }
}

/// What an upload brought about: a photo, or one in parts.
#[derive(Serialize, utoipa::ToSchema)]
#[serde(untagged)]
#[allow(dead_code, reason = "describes an answer in the OpenAPI document")]
pub enum Created {
    /// The photo, done.
    Photo(Box<PhotoState>),
    /// How far the upload in parts is.
    Upload(UploadState),
}

/// The kind of a body that is a part of something, or nothing, says nothing of the whole.
fn of_whole(headers: &HeaderMap) -> Option<String> {
    let kind = headers.get(CONTENT_TYPE)?.to_str().ok()?;
    (!is_part(kind)).then(|| kind.to_owned())
}

fn is_part(kind: &str) -> bool {
    kind.split(';').next().is_some_and(|kind| kind.trim().eq_ignore_ascii_case(header::MEDIA_TYPE))
}

/// The upload of a path, where whoever asks may go on with it.
fn find(app: &App, id: &str) -> Result<Arc<Partial>, Problem> {
    let mine = |partial: &Arc<Partial>| app.guard.is_none() || Guard::continues(partial.record().owner.as_ref());
    app.partials.get(id).filter(mine).ok_or_else(|| Problem::not_found("there is no such upload, or its time is over"))
}

/// Says all of an upload.
fn tell(app: &App, response: &mut Response, record: &Record) {
    header::tell(response, &record.extent, record.photo.is_some());
    header::limit(response, app.limits.body as u64, app.partials.ends_ms(record).saturating_sub(now_ms()) / 1000);
}

/// A refusal, which says how far the upload is.
fn refused(problem: Problem, partial: &Partial) -> Response {
    let record = partial.record();
    let mut response = problem.into_response();
    header::tell(&mut response, &record.extent, record.photo.is_some());
    response
}

/// Begins an upload in parts with what `request` brings of it.
pub(super) async fn begin(app: &App, query: Vec<(String, String)>, request: Request) -> Result<Response, Problem> {
    if app.limits.partials == 0 {
        return Err(
            Problem::new(StatusCode::NOT_IMPLEMENTED, "no-parts", "photos are uploaded at once here").field(header::COMPLETE.as_str())
        );
    }
    upload::options_of(&query)?;
    let said = header::said(request.headers(), Some(0))?;
    let most = app.limits.body as u64;
    // before anything of it is kept
    { Extent::NOTHING }.begin(&said, most).map_err(|e| header::refusal(e, &Extent::NOTHING))?;
    let _leave = Ticket::take(app)?;
    let owner = app.guard.as_ref().and_then(|_| Guard::owner());
    let bytes = said.length.or(said.content).unwrap_or_default();
    app.quota(owner.as_ref(), bytes).await?;
    let turn = partial::begin(app, query, of_whole(request.headers()), owner, bytes).await?;
    let (body, shared) = (request.into_body(), Arc::clone(app));
    let first = async move {
        let id = turn.partial().id.clone();
        let taken = turn.append(&shared, said, body).await;
        // nobody was told its address; nor will be, where the connection was lost and nobody waits here
        if taken.is_err()
            && let Some(partial) = shared.partials.get(&id)
        {
            partial.enter().await?.cancel(&shared).await;
        }
        taken
    };
    let (turn, _) = tokio::spawn(first).await.map_err(|e| Problem::internal("beginning an upload", &e))??;
    let record = turn.partial().record();
    let mut response = (StatusCode::CREATED, Json(UploadState::of(app, &record))).into_response();
    insert(&mut response, LOCATION, &format!("/v1/uploads/{}", turn.partial().id));
    tell(app, &mut response, &record);
    Ok(response)
}

/// How far an upload in parts is.
///
/// Headers say it, too, so that HEAD is enough. Another request of the same upload that is still under way ends.
#[utoipa::path(
    get, path = "/v1/uploads/{upload}", tag = "photos", params(("upload" = String, Path, description = "Id of the upload")),
    responses(
        (status = 200, description = "How far it is", body = UploadState, headers(
            ("Upload-Offset" = u64, description = "Bytes that are there"),
            ("Upload-Complete" = String, description = "`?1` once it has become a photo, else `?0`"),
            ("Upload-Length" = u64, description = "Bytes of the whole, while bytes are missing and once it is complete"),
            ("Upload-Limit" = String, description = "`max-size` in bytes, and for how many seconds it is kept, `max-age`"),
        )),
        (status = 404, description = "There is no such upload, or it is another's"),
        (status = 423, description = "It is being accepted"),
    )
)]
pub async fn progress(State(app): State<App>, Path(upload): Path<String>, _: NoQuery) -> Result<Response, Problem> {
    let turn = find(&app, &upload)?.enter().await?;
    let record = turn.partial().record();
    let mut response = Json(UploadState::of(&app, &record)).into_response();
    tell(&app, &mut response, &record);
    Ok(response)
}

/// Send a part of an upload.
///
/// It begins where the part before ended. What came of one that was interrupted is kept: HEAD tells how much. The last one, with
/// `Upload-Complete: ?1`, is answered as an upload at once is; it may be empty.
#[utoipa::path(
    patch, path = "/v1/uploads/{upload}", tag = "photos",
    params(
        ("upload" = String, Path, description = "Id of the upload"),
        ("Upload-Offset" = u64, Header, maximum = 999_999_999_999_999_i64, description = "Byte of the whole at which the part begins"),
        ("Upload-Complete" = String, Header, pattern = "^[?][01]$", description = "`?1` where the whole ends with it, else `?0`"),
        ("Upload-Length" = Option<u64>, Header, maximum = 999_999_999_999_999_i64, description = "Bytes of the whole"),
        ("Prefer" = Option<String>, Header, description = "`wait=SECONDS`: answer the last part once the photo is done, or after that time"),
    ),
    request_body(content((String = "application/partial-upload"))),
    responses(
        (status = 201, description = "The last part: the photo is done in the time that `Prefer: wait` gave", body = PhotoState),
        (status = 202, description = "The last part: the photo is accepted", body = PhotoState),
        (status = 204, description = "The part is there, and others follow", headers(("Upload-Offset" = u64, description = "Bytes that are there"))),
        (status = 400, description = "A header is wrong; or the part does not agree with the length of the whole; or the upload is complete"),
        (status = 403, description = "The owner has as many photos, or as many bytes, as one may have; or the key may not upload"),
        (status = 404, description = "There is no such upload, or it is another's"),
        (status = 408, description = "The part came too slowly; what came of it is kept"),
        (status = 409, description = "Another byte is next, `expected-offset` and the header `Upload-Offset` say which; or another request had this one end"),
        (status = 413, description = "Upload or photo is too large"),
        (status = 415, description = "Not a part; or the whole is no JPEG, PNG or WebP picture"),
        (status = 422, description = "The picture is damaged"),
        (status = 423, description = "It is being accepted"),
        (status = 429, description = "Too many photos wait; what is there of the upload is kept"),
        (status = 507, description = "The disk is full; what is there of the upload is kept"),
    )
)]
pub async fn append(
    State(app): State<App>,
    Path(id): Path<String>,
    _: NoQuery,
    Extension(clock): Extension<Clock>,
    request: Request,
) -> Result<Response, Problem> {
    let found = find(&app, &id)?;
    let headers = request.headers();
    if !headers.get(CONTENT_TYPE).and_then(|kind| kind.to_str().ok()).is_some_and(is_part) {
        let detail = format!("a part of an upload is {}", header::MEDIA_TYPE);
        return Err(Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported-part", detail).field("Content-Type"));
    }
    let (said, wait) = (header::said(headers, None)?, prefer_wait(headers));
    let turn = found.enter().await?;
    if turn.partial().record().photo.is_some() {
        let problem = Problem::registered(StatusCode::BAD_REQUEST, "completed-upload", "the upload is complete");
        return Ok(refused(problem, &found));
    }
    // for the whole of it, so that what is let in is also accepted
    let leave = Ticket::take(&app)?;
    let (turn, whole) = match turn.append(&app, said, request.into_body()).await {
        Ok(taken) => taken,
        // no part that follows would make a photo of it
        Err(problem) if app.partials.get(&id).is_none() => return Err(problem),
        Err(problem) => return Ok(refused(problem, &found)),
    };
    if whole {
        return finish(&app, turn, &leave, &clock, wait).await;
    }
    let mut response = StatusCode::NO_CONTENT.into_response();
    tell(&app, &mut response, &found.record());
    Ok(response)
}

/// Has an upload count as one again where it did not become a photo.
struct Counts<'a> {
    app: &'a App,
    upload: String,
}

impl Drop for Counts<'_> {
    fn drop(&mut self) {
        self.app.jobs.ends(&self.upload, false);
    }
}

/// Has an upload that is whole accepted.
async fn finish(app: &App, turn: Turn, leave: &Ticket<'_>, clock: &Clock, wait: Option<u64>) -> Result<Response, Problem> {
    let Record { extent, owner, .. } = turn.partial().record();
    let (owner, is_new) = match owner {
        // an admin may bring the last part of another's
        Some(owner) => (Some(owner), false),
        None => uploader(app)?,
    };
    let (request, query) = turn.whole(app).await?;
    // from here on it counts as the photo that it becomes, or goes on to count as an upload
    app.jobs.ends(&turn.partial().id, true);
    let _counts = Counts { app, upload: turn.partial().id.clone() };
    match upload::take_with(app, leave, &query, request, owner).await {
        Ok(submitted) => {
            turn.became(app, submitted.entry.id).await;
            let mut response = accepted(app, &submitted.entry, clock, wait, is_new).await?;
            header::tell(&mut response, &extent, true);
            Ok(response)
        }
        // it would be refused again
        Err(problem) if problem.status().is_client_error() && problem.status() != StatusCode::TOO_MANY_REQUESTS => {
            turn.cancel(app).await;
            Err(problem)
        }
        Err(problem) => Ok(refused(problem, turn.partial())),
    }
}

/// Give up an upload in parts.
#[utoipa::path(
    delete, path = "/v1/uploads/{upload}", tag = "photos", operation_id = "upload_cancel", params(("upload" = String, Path, description = "Id of the upload")),
    responses(
        (status = 204, description = "What was there of it is gone; a photo that it became is not"),
        (status = 404, description = "There is no such upload, or it is another's"),
        (status = 423, description = "It is being accepted"),
    )
)]
pub async fn cancel(State(app): State<App>, Path(upload): Path<String>, _: NoQuery) -> Result<StatusCode, Problem> {
    find(&app, &upload)?.enter().await?.cancel(&app).await;
    Ok(StatusCode::NO_CONTENT)
}
