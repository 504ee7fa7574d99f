//! Making a photo again.

use axum::extract::{Extension, State};
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::Response;

use super::path_photo::PathPhoto;
use super::photo_state::PhotoState;
use super::photos::{self, prefer_wait};
use super::query::{EmptyBody, Pairs};
use crate::server::app_state::{App, AppState};
use crate::server::problem::Problem;
use crate::server::time_limit::TimeLimit;
use crate::server::upload_fields::class_of;
use tmpi_library::Photo;

/// Make a photo again.
///
/// Uses the current program and network. The photo keeps its id, settings and strokes and gets a new version. Its results answer 409 until
/// it is done.
#[utoipa::path(
    post, path = "/v1/photos/{id}/remake", tag = "photos",
    params(
        ("class" = Option<String>, Query, pattern = "^(interactive|batch)$", description = "`batch` for bulk work, which gives way to others; else `interactive`"),
        ("Prefer" = Option<String>, Header, description = "`wait=SECONDS`: answer once the photo is done, or after that time"),
    ),
    responses(
        (status = 200, description = "Made within the time of `Prefer: wait`", body = PhotoState),
        (status = 202, description = "In the queue", body = PhotoState, headers(("Location" = String, description = "Address of the photo"))),
        (status = 400, description = "A parameter is wrong, or there is a body"),
        (status = 409, description = "The photo is being made"),
        (status = 429, description = "Too many photos wait; `Retry-After` says when to come back"),
        (status = 507, description = "The disk is full"),
    )
)]
pub async fn remake(
    State(app): State<App>,
    PathPhoto(photo): PathPhoto,
    Extension(clock): Extension<TimeLimit>,
    uri: Uri,
    headers: HeaderMap,
    _: EmptyBody,
) -> Result<Response, Problem> {
    let class = Pairs::read(&uri, &["class"])?.parse("class", "interactive or batch", class_of)?.unwrap_or_default();
    let queued = app.library.remake(&photo, class, &AppState::requester(photo.owner.clone())).await?;
    answer(&app, queued, &headers, &clock).await
}

/// As [`photos::answer`], for a photo that is made again.
pub(super) async fn answer(app: &App, photo: Photo, headers: &HeaderMap, clock: &TimeLimit) -> Result<Response, Problem> {
    // drop cache entries of the old version
    app.evict_photo(photo.id).await;
    photos::answer(app, photo, (clock, prefer_wait(headers)), StatusCode::OK, false).await
}
