//! The addresses of rooms.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Extension, Json, Router};
use serde::{Deserialize, Serialize};
use tokio_util::sync::CancellationToken;

use tmpi_core::container::{self, Carried, Carries, MEDIA_TYPE};
use tmpi_core::{Scene, Texels};

use super::access::{PROTOCOL, Role, check_origin, end_of, is_good, token, token_of};
use super::room::Still;
use super::{FRAME_BYTES, Rooms, is_name, publisher, viewer};
use crate::server::{Held, Problem};

/// Time that a room waits for its publisher to come back.
const COME_BACK: Duration = Duration::from_secs(10);
/// Bytes that wait to be written for a viewer, at most: the largest message, and nothing beside it.
const WRITE_BUFFER: usize = 2 << 20;
/// Quality of the picture of a frame that is asked for by itself.
const QUALITY: u8 = 90;

/// How long a link to watch is good where this machine's own user asks for it.
const LINK: Duration = Duration::from_hours(24);

/// What the handlers need of the server.
#[derive(Clone)]
struct Here {
    rooms: Arc<Rooms>,
    stop: CancellationToken,
    /// Whether a request comes from this machine's own user.
    own: Arc<dyn Fn(&HeaderMap) -> bool + Send + Sync>,
}

#[derive(Deserialize)]
struct Asked {
    token: Option<String>,
}

/// Routes of rooms. `own` tells this machine's own user.
pub fn router(rooms: Arc<Rooms>, stop: CancellationToken, own: Arc<dyn Fn(&HeaderMap) -> bool + Send + Sync>) -> Router {
    Router::new()
        .route("/v1/live/{room}", get(state))
        .route("/v1/live/{room}/token", post(link))
        .route("/v1/live/{room}/publish", get(publish))
        .route("/v1/live/{room}/subscribe", get(subscribe))
        .route("/v1/live/{room}/frames/{frame}/atlas", get(atlas))
        .with_state(Here { rooms, stop, own })
}

impl Here {
    /// Checks name, origin and leave.
    fn check(&self, room: &str, role: Role, asked: &Asked, headers: &HeaderMap) -> Result<(), Problem> {
        if !is_name(room) {
            return Err(Problem::not_found("a room's name has letters, digits, - and _"));
        }
        check_origin(headers)?;
        let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
        let good = match (&self.rooms.config.key, asked.token.as_deref().or_else(|| token_of(headers))) {
            (Some(key), Some(token)) => is_good(key, role, room, token, now),
            _ => (self.own)(headers),
        };
        if good { Ok(()) } else { Err(Problem::new(StatusCode::FORBIDDEN, "token", "a token for this room is needed").field("token")) }
    }
}

type Upgrade = Result<WebSocketUpgrade, WebSocketUpgradeRejection>;

/// The upgrade with its bounds.
fn bounded(upgrade: Upgrade, most: usize) -> Result<WebSocketUpgrade, Problem> {
    let upgrade = upgrade.map_err(|e| Problem::new(StatusCode::UPGRADE_REQUIRED, "upgrade", e.to_string()))?;
    Ok(upgrade.protocols([PROTOCOL]).max_message_size(most).max_frame_size(most).max_write_buffer_size(WRITE_BUFFER))
}

/// What is known of a room from outside.
#[derive(Serialize)]
struct RoomState {
    /// Somebody publishes.
    publishing: bool,
    /// Those who watch.
    viewers: u32,
    /// Who asked may publish.
    may_publish: bool,
}

/// `GET /v1/live/{room}`: for pages, which cannot see why a web socket is refused.
async fn state(
    State(here): State<Here>,
    Path(name): Path<String>,
    Query(asked): Query<Asked>,
    headers: HeaderMap,
) -> Result<Json<RoomState>, Problem> {
    here.check(&name, Role::Watch, &asked, &headers)?;
    let room = here.rooms.get(&name);
    let may_publish = here.check(&name, Role::Publish, &asked, &headers).is_ok();
    let (publishing, viewers) = room.map_or((false, 0), |room| (!room.is_empty(), room.viewers()));
    Ok(Json(RoomState { publishing, viewers, may_publish }))
}

/// A token for who watches.
#[derive(Serialize)]
struct Link {
    /// None where rooms are for this machine's own user.
    token: Option<String>,
}

/// `POST /v1/live/{room}/token`: whoever may publish lets others watch, for as long.
async fn link(
    State(here): State<Here>,
    Path(name): Path<String>,
    Query(asked): Query<Asked>,
    headers: HeaderMap,
) -> Result<Json<Link>, Problem> {
    here.check(&name, Role::Publish, &asked, &headers)?;
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let token = here.rooms.config.key.as_ref().and_then(|key| {
        let given = asked.token.as_deref().or_else(|| token_of(&headers));
        let end = given.and_then(|given| end_of(key, &name, given, now)).unwrap_or(now + LINK.as_secs());
        token(key, Role::Watch, &name, end)
    });
    Ok(Json(Link { token }))
}

async fn publish(
    State(here): State<Here>,
    Path(name): Path<String>,
    Query(asked): Query<Asked>,
    Extension(held): Extension<Held>,
    headers: HeaderMap,
    upgrade: Upgrade,
) -> Result<Response, Problem> {
    here.check(&name, Role::Publish, &asked, &headers)?;
    // what a message has beside its frame
    let upgrade = bounded(upgrade, FRAME_BYTES + 1024)?;
    let busy = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", "there are as many rooms as may be").retry_after(5);
    let room = here.rooms.enter(&name).ok_or_else(busy)?;
    Ok(upgrade.on_upgrade(async move |socket| {
        let _held = held;
        publisher::serve(socket, Arc::clone(&room), here.rooms.config.clone(), here.stop.clone()).await;
        tokio::select! {
            () = tokio::time::sleep(COME_BACK) => {}
            () = here.stop.cancelled() => {}
        }
        here.rooms.leave(&name, &room);
    }))
}

async fn subscribe(
    State(here): State<Here>,
    Path(name): Path<String>,
    Query(asked): Query<Asked>,
    Extension(held): Extension<Held>,
    headers: HeaderMap,
    upgrade: Upgrade,
) -> Result<Response, Problem> {
    here.check(&name, Role::Watch, &asked, &headers)?;
    let upgrade = bounded(upgrade, 1024)?;
    let room = here.rooms.get(&name).ok_or_else(|| Problem::not_found("nobody publishes in this room"))?;
    Ok(upgrade.on_upgrade(async move |socket| {
        let _held = held;
        viewer::serve(socket, room, here.stop).await;
    }))
}

async fn atlas(
    State(here): State<Here>,
    Path((name, frame)): Path<(String, String)>,
    Query(asked): Query<Asked>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    here.check(&name, Role::Watch, &asked, &headers)?;
    let nobody = || Problem::not_found("nobody publishes in this room, or no frame is done yet");
    let still = here.rooms.get(&name).and_then(|room| room.still()).ok_or_else(nobody)?;
    if frame != "latest" && frame.parse() != Ok(still.frame) {
        return Err(Problem::not_found(format!("the frame that is kept is {}", still.frame)));
    }
    let number = still.frame;
    let made = tokio::task::spawn_blocking(move || contained(&still)).await.map_err(|e| Problem::internal("writing a container", &e))?;
    let mut response = made.map_err(|e| Problem::internal("writing a container", &e))?.into_response();
    response.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE));
    response.headers_mut().insert("x-tmpi-frame", HeaderValue::from(number));
    Ok(response)
}

/// A frame as a container.
fn contained(still: &Still) -> Result<Vec<u8>, container::ContainerError> {
    let (geometry, photo) = (&still.geometry, still.photo.clone());
    let carried = Carried::from_photo(&photo, QUALITY)?;
    let (grid, intrinsics, view_box) = (geometry.grid, geometry.intrinsics, geometry.view_box);
    let scene = Scene { grid, intrinsics, view_box, photo, layers: Vec::new(), texels: Texels::default() };
    container::encode(geometry, &scene, &carried, Carries::default()).map(|(bytes, _)| bytes)
}
