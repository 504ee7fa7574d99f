//! Progress of a photo as server-sent events.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use serde::Serialize;
use tokio::sync::watch;

use super::query::NoQuery;
use super::state::{PhotoState, Progress};
use crate::server::access::{Guard, Pass};
use crate::server::app::App;
use crate::server::conditional::insert;
use crate::server::entry::{Entry, Live, Status};
use crate::server::problem::Problem;
use crate::server::share::{Place, asker};

/// Pause between two looks at the queue, and at who may listen.
const QUEUE_LOOK: Duration = Duration::from_secs(1);

/// Where a photo stands in the queue.
#[derive(Serialize)]
struct Position {
    position: usize,
}

/// What one listener has been told.
struct Listener {
    app: App,
    entry: Arc<Entry>,
    watch: watch::Receiver<Live>,
    /// Stages told so far.
    stages: usize,
    /// Place in the queue that was told last, and nothing since.
    queued: Option<usize>,
    ended: bool,
    /// What the listener was let in by, where the server asks who comes.
    pass: Option<Pass>,
    _place: Place,
}

impl Listener {
    /// The next events; none at the end.
    async fn next(&mut self) -> Option<Vec<Event>> {
        while !self.ended {
            if !self.is_allowed() {
                return None;
            }
            let events = self.fresh();
            if !events.is_empty() {
                return Some(events);
            }
            let stop = self.app.stop.clone();
            tokio::select! {
                changed = self.watch.changed() => self.ended |= changed.is_err(),
                // the queue moves without a word to those who wait in it
                () = tokio::time::sleep(QUEUE_LOOK), if self.queued.is_some() || self.pass.is_some() => {}
                // the client comes back by itself
                () = stop.cancelled() => self.ended = true,
            }
        }
        None
    }

    /// False once the listener would not be let in again.
    fn is_allowed(&self) -> bool {
        self.app.guard.as_ref().is_none_or(|guard| self.pass.as_ref().is_some_and(|pass| guard.still_allows(pass, &self.entry)))
    }

    fn fresh(&mut self) -> Vec<Event> {
        let live = self.watch.borrow_and_update().clone();
        // fewer than before: another run of the job
        self.stages = self.stages.min(live.stages.len());
        let mut events: Vec<Event> = live.stages[self.stages..].iter().map(|s| event("stage", &Progress::from(s))).collect();
        self.stages = live.stages.len();
        match &live.status {
            Status::Queued => {
                let position = self.app.jobs.position(self.entry.id).unwrap_or(0);
                if self.queued.replace(position) != Some(position) {
                    events.push(event("queued", &Position { position }));
                }
                return events;
            }
            Status::Working => {}
            Status::Done(_) => {
                events.extend(PhotoState::from_live(&self.app, &self.entry, live).map(|s| event("done", &s)));
                self.ended = true;
            }
            Status::Failed(failed) => {
                events.push(event("failed", &failed.problem));
                self.ended = true;
            }
            Status::Damaged(damaged) => {
                events.push(event("damaged", &damaged.problem));
                self.ended = true;
            }
            Status::Deleted => {
                events.push(event("deleted", &serde_json::json!({})));
                self.ended = true;
            }
        }
        self.queued = None;
        events
    }
}

fn event<T: Serialize>(name: &'static str, data: &T) -> Event {
    // maps with text keys and finite numbers always are JSON
    Event::default().event(name).data(serde_json::to_string(data).unwrap_or_default())
}

/// Progress of a photo as server-sent events.
///
/// Events: `queued` (`{"position": N}`, again when it moves up), `stage` (a `Progress`), and at the end one of `done` (a `PhotoState`), `failed` or
/// `damaged` (a `Problem`) or `deleted`; then the stream ends. A client that connects late is told the last event first. Whoever would no longer
/// be let in is told nothing more: the stream ends.
#[utoipa::path(
    get, path = "/v1/photos/{id}/events", tag = "photos", params(("id" = String, Path, description = "Id of the photo")),
    responses(
        (status = 200, description = "Events until the photo is done, has failed or is deleted", body = Progress, content_type = "text/event-stream"),
        (status = 400, description = "There are no parameters here"),
        (status = 404, description = "There is no such photo"),
        (status = 503, description = "Too many streams are open"),
    )
)]
pub async fn events(State(app): State<App>, Path(id): Path<String>, _: NoQuery) -> Result<Response, Problem> {
    let entry = app.photo(&id)?;
    let Some(place) = app.streams.take(asker()) else {
        let detail = "as many event streams are open as may, or as one address may have";
        return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", detail).retry_after(5));
    };
    let watch = entry.watch();
    // the last state alone, then everything
    let seen = entry.live();
    let stages = if seen.status.is_final() { seen.stages.len() } else { seen.stages.len().saturating_sub(1) };
    let keep_alive = KeepAlive::new().interval(app.limits.keep_alive);
    let listener = Listener { app, entry, watch, stages, queued: None, ended: false, pass: Guard::pass(), _place: place };
    let batches = stream::unfold(listener, async |mut listener| listener.next().await.map(|events| (events, listener)));
    let events = futures_util::StreamExt::flat_map(batches, |events| stream::iter(events.into_iter().map(Ok::<_, Infallible>)));
    let mut response = Sse::new(events).keep_alive(keep_alive).into_response();
    // proxies that gather an answer before they pass it on would hold the events back
    insert(&mut response, header::HeaderName::from_static("x-accel-buffering"), "no");
    Ok(response)
}
