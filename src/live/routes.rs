//! The routes of rooms: the WebSocket upgrade, and tokens that a publisher hands out to viewers.

use std::time::Duration;

use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::Response;
use axum::{Extension, Json};
use serde::Serialize;
use utoipa::ToSchema;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::request_access::{RoomAccess, RoomsContext, busy, none_publishes};
use super::room::ViewerKind;
use super::signed_token::{PROTOCOL, room_token, token_expiry, token_in_headers};
use super::{Grant, frames_over_http, publisher, room_status, viewer};
use crate::server::{ConnectionGuard, EmptyBody, Pairs, Problem, since_1970};

/// Write buffer of a viewer: the largest message and nothing else.
const WRITE_BUFFER: usize = 2 << 20;
/// `Retry-After` of a full room, in seconds.
const FULL_AGAIN: u64 = 10;
/// Lifetime of a token to watch that this machine's own user requests.
const TOKEN_LIFETIME: Duration = Duration::from_hours(24);

/// Routes for viewers. Pages of other sites may use them with a token.
pub fn watching_api() -> OpenApiRouter<RoomsContext> {
    OpenApiRouter::new()
        .routes(routes!(room_status::state))
        .routes(routes!(subscribe))
        .routes(routes!(frames_over_http::newest))
        .routes(routes!(frames_over_http::group))
}

pub fn publishing_api() -> OpenApiRouter<RoomsContext> {
    OpenApiRouter::new().routes(routes!(watch_token)).routes(routes!(publish))
}

type Upgrade = Result<WebSocketUpgrade, WebSocketUpgradeRejection>;

fn bounded(upgrade: Upgrade, most: usize) -> Result<WebSocketUpgrade, Problem> {
    let upgrade = upgrade.map_err(|e| Problem::new(StatusCode::UPGRADE_REQUIRED, "upgrade", e.to_string()))?;
    Ok(upgrade.protocols([PROTOCOL]).max_message_size(most).max_frame_size(most).max_write_buffer_size(WRITE_BUFFER))
}

/// Publish in a room.
///
/// A WebSocket with messages of `proto/live.proto`: HELLO, then VIDEO and SOUND as CREDIT allows. The room exists until ten seconds after
/// its publisher has gone.
#[utoipa::path(
    get, path = "/v1/live/{room}/publish", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room: up to 64 letters, digits, - and _"),
        ("token" = Option<String>, Query, description = "Token to publish here; this machine's own user needs none"),
    ),
    responses(
        (status = 101, description = "The socket is open"),
        (status = 403, description = "The request comes from a page of another site, or has no valid token"),
        (status = 426, description = "The request is not a WebSocket upgrade"),
        (status = 503, description = "The limit of rooms is reached"),
    )
)]
async fn publish(
    State(here): State<RoomsContext>,
    Path(name): Path<String>,
    Extension(held): Extension<ConnectionGuard>,
    uri: Uri,
    headers: HeaderMap,
    upgrade: Upgrade,
) -> Result<Response, Problem> {
    let RoomAccess::Until(ends) = here.check(&name, Grant::Publish, &uri, &headers).await? else { return Err(none_publishes()) };
    // room for the other fields; a frame of up to twice the limit is read and refused with its size
    let bounds = here.rooms.bounds;
    let upgrade = bounded(upgrade, 2 * bounds.frame.max(bounds.sound) + 1024)?;
    let entry = here.rooms.open(&name).ok_or_else(busy)?;
    Ok(upgrade.on_upgrade(async move |socket| {
        held.limit_send_buffer();
        publisher::serve(socket, entry, &here, ends).await;
        drop(held);
    }))
}

/// Watch a room.
///
/// A WebSocket with messages of `proto/live.proto`: HELLO, a SNAPSHOT of all tiles, VIDEO since the last key frame, then VIDEO, GEOMETRY
/// and SOUND as they come, and STATISTICS after a second without other messages.
#[utoipa::path(
    get, path = "/v1/live/{room}/subscribe", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room"),
        ("token" = Option<String>, Query, description = "Token to watch or publish here; this machine's own user needs none"),
    ),
    responses(
        (status = 101, description = "The socket is open"),
        (status = 404, description = "The room has no publisher"),
        (status = 426, description = "The request is not a WebSocket upgrade"),
        (status = 503, description = "The limit of viewers of the room at this node is reached, or that of rooms"),
    )
)]
async fn subscribe(
    State(here): State<RoomsContext>,
    Path(name): Path<String>,
    Extension(held): Extension<ConnectionGuard>,
    uri: Uri,
    headers: HeaderMap,
    upgrade: Upgrade,
) -> Result<Response, Problem> {
    let access = here.check(&name, Grant::Watch, &uri, &headers).await?;
    let upgrade = bounded(upgrade, 1024)?;
    let (room, ends, kind) = match access {
        RoomAccess::Until(ends) => (here.rooms.watch_room(&name).await?, ends, ViewerKind::Local),
        // only the origin serves edges
        RoomAccess::Node => (here.rooms.get(&name).filter(|room| !room.is_edge()).ok_or_else(none_publishes)?, None, ViewerKind::Edge(0)),
    };
    if kind == ViewerKind::Local && room.is_full() {
        return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", viewer::FULL).retry_after(FULL_AGAIN));
    }
    Ok(upgrade.on_upgrade(async move |socket| {
        held.limit_send_buffer();
        viewer::serve(socket, (room, kind), here.stop, ends).await;
        drop(held);
    }))
}

/// A token to watch.
#[derive(Serialize, ToSchema)]
struct WatchToken {
    /// Null if the server has no key for tokens: only this machine's own user may watch then.
    token: Option<String>,
}

/// Create a token to watch.
///
/// For callers that may publish. The token expires with the caller's own, or after a day if the caller needs none.
#[utoipa::path(
    post, path = "/v1/live/{room}/token", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room"),
        ("token" = Option<String>, Query, description = "Token to publish here, unless sent as a bearer token; this machine's own user needs none"),
    ),
    responses(
        (status = 200, description = "The token", body = WatchToken),
        (status = 400, description = "A parameter is unknown, or the request has a body"),
        (status = 403, description = "The request comes from a page of another site, or has no valid token"),
    )
)]
async fn watch_token(
    State(here): State<RoomsContext>,
    Path(name): Path<String>,
    uri: Uri,
    headers: HeaderMap,
    _: EmptyBody,
) -> Result<Json<WatchToken>, Problem> {
    here.check(&name, Grant::Publish, &uri, &headers).await?;
    let query = Pairs::read(&uri, &["token"])?;
    let token = here.rooms.key.as_ref().map(|key| {
        let (given, now) = (query.get("token").or_else(|| token_in_headers(&headers)), since_1970().as_secs());
        let end = given.and_then(|given| token_expiry(key, Grant::Publish, &name, given, now)).unwrap_or(now + TOKEN_LIFETIME.as_secs());
        room_token(key, Grant::Watch, &name, end)
    });
    Ok(Json(WatchToken { token }))
}
