//! Progress of a photo as server-sent events.

use std::convert::Infallible;
use std::time::Duration;

use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::{StreamExt as _, stream};
use serde::Serialize;
use tmpi_library::{Event as Happened, Kind, Photo, PhotoId, PhotoState as Phase, Subscription};
use tokio::time::Instant;

use super::query::NoQuery;
use super::state::{PhotoState, Progress};
use crate::server::access::{Guard, Pass};
use crate::server::app::App;
use crate::server::conditional::insert;
use crate::server::problem::Problem;
use crate::server::share::{Place, asker};

/// Pause between two looks at the queue, and at who may listen.
const QUEUE_LOOK: Duration = Duration::from_secs(1);

/// Where a photo stands in the queue.
#[derive(Serialize)]
struct Position {
    position: u64,
}

/// What one listener has been told.
struct Listener {
    app: App,
    id: PhotoId,
    subscription: Subscription,
    /// False until the photo was read.
    seen: bool,
    /// When it is looked next at the queue, and at who may listen.
    look: Instant,
    /// The stage that was told last.
    stage: Option<Progress>,
    /// Place in the queue that was told last, and nothing since.
    queued: Option<u64>,
    ended: bool,
    /// What the listener was let in by, where the server asks who comes.
    pass: Option<Pass>,
    _place: Place,
}

impl Listener {
    /// The next events; none at the end.
    async fn next(&mut self) -> Option<Vec<Event>> {
        while !self.ended {
            let news = if self.seen { self.news().await } else { Some(News::Photo) };
            self.seen = true;
            let events = match news? {
                News::Nothing => continue,
                News::Stage(progress) if self.is_allowed(None).await => {
                    self.queued = None;
                    self.stage_events(progress)
                }
                News::Stage(_) => return None,
                News::Photo => self.fresh().await?,
                News::Deleted => self.end("deleted", &serde_json::json!({})),
            };
            if !events.is_empty() {
                return Some(events);
            }
        }
        None
    }

    /// What has happened; none where the server stops: the client comes back by itself.
    async fn news(&mut self) -> Option<News> {
        let looks = self.queued.is_some() || self.pass.is_some();
        tokio::select! {
            biased;
            // the queue moves without a word to those who wait in it; others' events must not put this off
            () = tokio::time::sleep_until(self.look), if looks => {
                self.look = Instant::now() + QUEUE_LOOK;
                Some(News::Photo)
            }
            happened = self.subscription.next() => Some(News::of(self.id, happened?)),
            () = self.app.stop.cancelled() => None,
        }
    }

    /// False once the listener would not be let in again.
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

    /// How the photo fares now; none where the listener may not be told.
    async fn fresh(&mut self) -> Option<Vec<Event>> {
        let Some(photo) = self.app.library.find(self.id).await.ok()? else { return Some(self.end("deleted", &serde_json::json!({}))) };
        if !self.is_allowed(Some(&photo)).await {
            return None;
        }
        if photo.state == Phase::Queued {
            let position = self.app.library.position(Kind::Make, self.id, None).await.ok()?.map_or(0, |position| position.ahead);
            let moved = self.queued.replace(position) != Some(position);
            return Some(if moved { vec![event("queued", &Position { position })] } else { Vec::new() });
        }
        self.queued = None;
        if photo.state == Phase::Working {
            return Some(Vec::new());
        }
        // stages that were told before the end
        let mut events = Vec::new();
        while let Some(happened) = self.subscription.try_next() {
            if let News::Stage(progress) = News::of(self.id, happened) {
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

    /// A stage, unless it was told already.
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

/// What concerns a listener.
enum News {
    Nothing,
    Stage(Progress),
    Photo,
    Deleted,
}

impl News {
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
    let photo = app.photo(&id).await?;
    let Some(place) = app.streams.take(asker()) else {
        let detail = "as many event streams are open as may, or as one address may have";
        return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", detail).retry_after(5));
    };
    let keep_alive = KeepAlive::new().interval(app.limits.keep_alive);
    let subscription = app.library.subscribe();
    // the last that was said of it, then everything
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
        pass: Guard::pass(),
        _place: place,
    };
    let batches = stream::unfold(listener, async |mut listener| listener.next().await.map(|events| (events, listener)));
    let events = batches.flat_map(stream::iter);
    let mut response = Sse::new(stream::iter(last).chain(events).map(Ok::<_, Infallible>)).keep_alive(keep_alive).into_response();
    // proxies that gather an answer before they pass it on would hold the events back
    insert(&mut response, header::HeaderName::from_static("x-accel-buffering"), "no");
    Ok(response)
}
