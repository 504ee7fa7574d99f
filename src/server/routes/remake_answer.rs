//! The answer of routes that make a photo again.

use axum::Json;
use axum::http::header::LOCATION;
use axum::http::{HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};

use super::photos::{prefer_wait, wait_for};
use super::state::PhotoState;
use crate::server::app_state::App;
use crate::server::conditional::insert;
use crate::server::problem::Problem;
use crate::server::time_limit::TimeLimit;
use tmpi_library::{Photo, PhotoState as Phase};

/// The state of a queued photo: 200 if it is made within the time of `Prefer: wait` and of the request, its problem if it fails, else 202.
pub(super) async fn answer(app: &App, photo: Photo, headers: &HeaderMap, clock: &TimeLimit) -> Result<Response, Problem> {
    // drop cache entries of the old version
    app.forget(photo.id).await;
    let wait = prefer_wait(headers);
    let photo = wait_for(app, photo, clock, wait).await?;
    let ready = photo.state.is_final();
    if ready && photo.state != Phase::Done {
        return Ok(Problem::of_photo(&photo).into_response());
    }
    let mut response = state(app, &photo, if ready { StatusCode::OK } else { StatusCode::ACCEPTED }).await?;
    insert(&mut response, LOCATION, &format!("/v1/photos/{}", photo.id));
    if let Some(seconds) = wait {
        insert(&mut response, HeaderName::from_static("preference-applied"), &format!("wait={seconds}"));
    }
    Ok(response)
}

/// The state of a photo as an answer.
pub(super) async fn state(app: &App, photo: &Photo, status: StatusCode) -> Result<Response, Problem> {
    Ok((status, Json(PhotoState::of(app, photo).await?)).into_response())
}
