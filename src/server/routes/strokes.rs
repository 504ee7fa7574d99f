//! Touch-up of a photo's depth.

use axum::Json;
use axum::extract::{Extension, Request, State};
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse as _, Response};

use super::path_photo::PathPhoto;
use super::photo_state::PhotoState;
use super::photos::merge_patch;
use super::query::NoQuery;
use super::remake;
use crate::server::app_state::{App, AppState, StoredFile};
use crate::server::conditional::{Entity, check_if_match, insert, respond};
use crate::server::problem::Problem;
use crate::server::time_limit::TimeLimit;
use tmpi_library::Content;
use tmpi_pipeline::strokes::{BYTES, Stroke, patch, write};

/// Strokes as JSON, with an entity tag of its bytes.
fn stored(strokes: &[Stroke]) -> StoredFile {
    StoredFile::new(write(strokes))
}

/// Strokes over a photo.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "describes the body in the OpenAPI document; strokes are read by hand so that errors name their field")]
pub struct Strokes {
    /// 1.
    #[schema(example = 1, minimum = 1, maximum = 1, required = false)]
    version: u32,
    /// Strokes in order: at most 100, with at most 8192 points in all. Each changes its region in one way: `by`, `like` or `to`.
    strokes: Vec<Stroke>,
}

/// A change of a photo's strokes.
#[derive(utoipa::ToSchema)]
#[allow(dead_code, reason = "describes the body in the OpenAPI document; strokes are read by hand so that errors name their field")]
pub struct StrokesPatch {
    /// 1.
    #[schema(example = 1, minimum = 1, maximum = 1, required = false)]
    version: u32,
    /// All strokes in order: at most 100, with at most 8192 points in all. Null removes them; without this field they stay as they are.
    #[schema(nullable)]
    strokes: Option<Vec<Stroke>>,
}

/// The strokes that touch up a photo's depth.
#[utoipa::path(
    get, path = "/v1/photos/{id}/strokes", tag = "photos",
    responses(
        (status = 200, description = "All strokes", body = Strokes, headers(("ETag" = String, description = "Version of the strokes"))),
        (status = 304, description = "The client has it"),
    )
)]
pub async fn strokes(State(app): State<App>, _: NoQuery, PathPhoto(photo): PathPhoto, headers: HeaderMap) -> Result<Response, Problem> {
    let file = stored(&app.strokes(&photo).await?);
    Ok(respond(&headers, Entity::json(file.source, &file.etag)))
}

/// Touch up a photo's depth.
///
/// A JSON merge patch (RFC 7396): `strokes` replaces all strokes, null removes them, and without it nothing changes. The photo is made
/// again and keeps its id, but gets a new version. Its results answer 409 until it is done; if it fails, changing the strokes retries. A
/// stroke covers the area of its brush, out to the edges of the photo around it: see `radius`.
#[utoipa::path(
    patch, path = "/v1/photos/{id}/strokes", tag = "photos",
    params(
        ("If-Match" = Option<String>, Header, description = "Change the strokes only if they have this tag"),
        ("Prefer" = Option<String>, Header, description = "`wait=SECONDS`: answer once the photo is done, or after that time"),
    ),
    request_body(content((StrokesPatch = "application/merge-patch+json"), (StrokesPatch = "application/json"))),
    responses(
        (status = 200, description = "The photo has these strokes: already, or within the time of `Prefer: wait`", body = PhotoState,
            headers(("ETag" = String, description = "Version of the strokes"))),
        (status = 202, description = "The strokes are stored, and the photo waits to be made again", body = PhotoState,
            headers(("ETag" = String, description = "Version of the strokes"))),
        (status = 400, description = "A stroke is wrong; `field` names it"),
        (status = 409, description = "The photo is being made"),
        (status = 412, description = "The strokes changed meanwhile"),
        (status = 413, description = "The patch is too large"),
        (status = 415, description = "Not JSON"),
        (status = 429, description = "Too many photos wait; `Retry-After` says when to come back"),
        (status = 507, description = "The disk is full"),
    )
)]
pub async fn touch_up(
    State(app): State<App>,
    Extension(clock): Extension<TimeLimit>,
    _: NoQuery,
    PathPhoto(photo): PathPhoto,
    request: Request,
) -> Result<Response, Problem> {
    let (headers, body) = merge_patch(request, BYTES, "strokes").await?;
    let before = app.strokes(&photo).await?;
    let wanted = patch(&body).map_err(|e| Problem::from(&e))?.unwrap_or_else(|| before.clone());
    check_if_match(&headers, &stored(&before).etag)?;
    let answer = if before == wanted {
        PhotoState::of(&app, &photo).await.map(|state| Json(state).into_response())
    } else {
        let requester = AppState::requester(photo.owner.clone());
        let queued = app.library.touch_up(&photo, Content::of_bytes(write(&wanted)), &requester).await?;
        remake::answer(&app, queued, &headers, &clock).await
    };
    let etag = stored(&wanted).etag;
    let mut response = answer?;
    if response.status().is_success() {
        insert(&mut response, header::ETAG, &etag);
    }
    Ok(response)
}
