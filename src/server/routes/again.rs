//! The answer to what has a photo made again.

use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::http::header::LOCATION;
use axum::http::{HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};

use super::photos::{ANSWER, prefer_wait, wait_for};
use super::state::PhotoState;
use crate::server::app::App;
use crate::server::clock::Clock;
use crate::server::conditional::insert;
use crate::server::entry::{Entry, Status};
use crate::server::problem::Problem;

/// The state of a photo that is in the queue: 200 once it is made, within the time that `Prefer: wait` gives and the request has; its problem where
/// it could not be made; else 202.
pub(super) async fn answer(app: &App, entry: &Arc<Entry>, headers: &HeaderMap, clock: &Clock) -> Result<Response, Problem> {
    // nobody asks for the version of before any more
    app.forget(entry.id).await;
    let wait = prefer_wait(headers);
    let mut ready = false;
    if let Some(seconds) = wait {
        let left = clock.deadline().map_or(Duration::ZERO, |at| at.saturating_duration_since(tokio::time::Instant::now()));
        let until = tokio::time::Instant::now() + left.saturating_sub(ANSWER).min(Duration::from_secs(seconds));
        ready = wait_for(app, entry, until).await;
    }
    if let (true, Status::Failed(failed) | Status::Damaged(failed)) = (ready, entry.status()) {
        return Ok(failed.problem.into_response());
    }
    let mut response = state(app, entry, if ready { StatusCode::OK } else { StatusCode::ACCEPTED })?;
    insert(&mut response, LOCATION, &format!("/v1/photos/{}", entry.id));
    if let Some(seconds) = wait {
        insert(&mut response, HeaderName::from_static("preference-applied"), &format!("wait={seconds}"));
    }
    Ok(response)
}

/// The state of a photo as an answer.
pub(super) fn state(app: &App, entry: &Arc<Entry>, status: StatusCode) -> Result<Response, Problem> {
    let state = PhotoState::of(app, entry).ok_or_else(|| Problem::not_found("the photo was deleted meanwhile"))?;
    Ok((status, Json(state)).into_response())
}
