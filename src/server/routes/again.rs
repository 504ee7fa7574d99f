//! The answer to what has a photo made again.

use axum::Json;
use axum::http::header::LOCATION;
use axum::http::{HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};

use super::photos::{prefer_wait, wait_for};
use super::state::PhotoState;
use crate::server::app::App;
use crate::server::clock::Clock;
use crate::server::conditional::insert;
use crate::server::problem::Problem;
use tmpi_library::{Photo, PhotoState as Phase};

/// The state of a photo that is in the queue: 200 once it is made, within the time that `Prefer: wait` gives and the request has; its problem where
/// it could not be made; else 202.
pub(super) async fn answer(app: &App, photo: Photo, headers: &HeaderMap, clock: &Clock) -> Result<Response, Problem> {
    // nobody asks for the version of before any more
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
