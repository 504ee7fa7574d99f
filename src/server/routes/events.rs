//! Progress of a photo as server-sent events.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::{StreamExt as _, stream};
use serde::Serialize;
use serde_json::json;
use tmpi_library::{Event as Happened, Photo, PhotoId, PhotoState as Phase, Subscription};
use tokio::time::Instant;

use super::path_photo::PathPhoto;
use super::photo_state::{PhotoState, Progress};
use super::query::NoQuery;
use crate::server::access::{self, Admission};
use crate::server::app_state::App;
use crate::server::client_slots::{ClientSlot, client_address};
use crate::server::conditional::insert;
use crate::server::problem::Problem;

/// Interval of the checks of the queue and of the client's access.
const QUEUE_LOOK: Duration = Duration::from_secs(1);

/// One open event stream.
struct Listener {
    app: App,
    id: PhotoId,
    subscription: Subscription,
    /// False until the photo was read.
    seen: bool,
    /// Time of the next check of the queue and of the client's access.
    look: Instant,
    /// The stage that was sent last.
    stage: Option<Progress>,
    /// The queue position that was sent last, if no other event followed.
    queued: Option<u64>,
    ended: bool,
    /// The client's rights, with private access.
    pass: Option<Arc<Admission>>,
    _place: ClientSlot,
}

impl Listener {
    /// The next events; `None` at the end.
    async fn next(&mut self) -> Option<Vec<Event>> {
        while !self.ended {
            let update = if self.seen { self.next_update().await } else { Some(PhotoUpdate::Photo) };
            self.seen = true;
            let events = match update? {
                PhotoUpdate::Nothing => continue,
                PhotoUpdate::Stage(progress) if self.is_allowed(None).await => {
                    self.queued = None;
                    self.stage_events(progress)
                }
                PhotoUpdate::Stage(_) => return None,
                PhotoUpdate::Photo => self.fresh().await?,
                PhotoUpdate::Deleted => self.end("deleted", &json!({})),
            };
            if !events.is_empty() {
                return Some(events);
            }
        }
        None
    }

    /// Waits for an update; `None` if the server stops (the client then reconnects).
    async fn next_update(&mut self) -> Option<PhotoUpdate> {
        let looks = self.queued.is_some() || self.pass.is_some();
        tokio::select! {
            biased;
            // the queue moves without an event to those waiting; other photos' events must not delay this check
            () = tokio::time::sleep_until(self.look), if looks => {
                self.look = Instant::now() + QUEUE_LOOK;
                Some(PhotoUpdate::Photo)
            }
            happened = self.subscription.next() => Some(PhotoUpdate::of(self.id, happened?)),
            () = self.app.stop.cancelled() => None,
        }
    }

    async fn is_allowed(&self, photo: Option<&Photo>) -> bool {
        let (Some(guard), Some(pass)) = (&self.app.guard, &self.pass) else { return self.app.guard.is_none() };
        match photo {
            Some(photo) => guard.still_allows(pass, photo).await,
            None => match self.app.library.find(self.id).await {
                Ok(Some(photo)) => guard.still_allows(pass, &photo).await,
                Ok(None) | Err(_) => false,
            },
        }
    }

    /// Events for the photo's current state; `None` if the client has lost access.
    async fn fresh(&mut self) -> Option<Vec<Event>> {
        let Some(photo) = self.app.library.find(self.id).await.ok()? else { return Some(self.end("deleted", &json!({}))) };
        if !self.is_allowed(Some(&photo)).await {
            return None;
        }
        if photo.state == Phase::Queued {
            let position = self.app.library.position(self.id).await.ok()?.unwrap_or_default();
            let moved = self.queued.replace(position) != Some(position);
            return Some(if moved { vec![event("queued", &json!({"position": position}))] } else { Vec::new() });
        }
        self.queued = None;
        if photo.state == Phase::Working {
            return Some(Vec::new());
        }
        // stages that came before the end
        let mut events = Vec::new();
        while let Some(happened) = self.subscription.try_next() {
            if let PhotoUpdate::Stage(progress) = PhotoUpdate::of(self.id, happened) {
                events.extend(self.stage_events(progress));
            }
        }
        events.extend(match photo.state {
            Phase::Done => self.end("done", &PhotoState::of(&self.app, &photo).await.ok()?),
            Phase::Damaged => self.end("damaged", &Problem::of_photo(&photo)),
            _ => self.end("failed", &Problem::of_photo(&photo)),
        });
        Some(events)
    }

    /// A stage, unless it was sent already.
    fn stage_events(&mut self, progress: Progress) -> Vec<Event> {
        if self.stage.as_ref() == Some(&progress) {
            return Vec::new();
        }
        let told = vec![event("stage", &progress)];
        self.stage = Some(progress);
        told
    }

    fn end<T: Serialize>(&mut self, name: &'static str, data: &T) -> Vec<Event> {
        self.ended = true;
        vec![event(name, data)]
    }
}

/// What an event means for one photo.
enum PhotoUpdate {
    Nothing,
    Stage(Progress),
    Photo,
    Deleted,
}

impl PhotoUpdate {
    fn of(id: PhotoId, happened: Happened) -> Self {
        match happened {
            Happened::Progress { photo, progress } if photo == id => serde_json::from_value(progress).map_or(Self::Nothing, Self::Stage),
            Happened::Photo(photo) if photo == id => Self::Photo,
            Happened::Deleted(photo) if photo == id => Self::Deleted,
            Happened::Revoked | Happened::Gap => Self::Photo,
            _ => Self::Nothing,
        }
    }
}

fn event<T: Serialize>(name: &'static str, data: &T) -> Event {
    // maps with text keys and finite numbers always are JSON
    Event::default().event(name).data(serde_json::to_string(data).unwrap_or_default())
}

/// Progress of a photo as server-sent events.
///
/// Events: `queued` (`{"position": N}`, again when it moves up), `stage` (a `Progress`), and at the end one of `done` (a `PhotoState`),
/// `failed` or `damaged` (a `Problem`) or `deleted`; then the stream ends. A client that connects late gets the last stage first. The
/// stream also ends when the client loses access.
#[utoipa::path(
    get, path = "/v1/photos/{id}/events", tag = "photos",
    responses(
        (status = 200, description = "Events until the photo is done, has failed or is deleted", body = Progress, content_type = "text/event-stream"),
        (status = 503, description = "Too many streams are open"),
    )
)]
pub async fn events(State(app): State<App>, _: NoQuery, PathPhoto(photo): PathPhoto) -> Result<Response, Problem> {
    let Some(place) = app.streams.take(client_address()) else {
        let detail = "too many event streams are open, in all or from your address";
        return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", detail).retry_after(5));
    };
    let keep_alive = KeepAlive::new().interval(app.limits.keep_alive);
    let subscription = app.library.subscribe();
    // send the last stage first
    let last = app.library.progress_of(photo.id).and_then(|said| serde_json::from_value::<Progress>(said).ok());
    let stage = last.filter(|_| photo.state == Phase::Working);
    let last = stage.as_ref().map(|stage| event("stage", stage));
    let listener = Listener {
        id: photo.id,
        app,
        subscription,
        seen: false,
        look: Instant::now() + QUEUE_LOOK,
        stage,
        queued: None,
        ended: false,
        pass: access::admission(),
        _place: place,
    };
    let batches = stream::unfold(listener, async |mut listener| listener.next().await.map(|events| (events, listener)));
    let events = batches.flat_map(stream::iter);
    let mut response = Sse::new(stream::iter(last).chain(events).map(Ok::<_, Infallible>)).keep_alive(keep_alive).into_response();
    // keeps proxies from buffering the events
    insert(&mut response, header::HeaderName::from_static("x-accel-buffering"), "no");
    Ok(response)
}
