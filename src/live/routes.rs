//! The addresses of rooms.

use axum::Extension;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::Response;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::access::{PROTOCOL, Role};
use super::here::{Here, Leave, busy, none_publishes};
use super::room::Watches;
use super::{fetch, invite, publisher, viewer};
use crate::server::{Held, Problem};

/// Bytes that wait to be written for a viewer, at most: the largest message, and nothing beside it.
const WRITE_BUFFER: usize = 2 << 20;
/// Seconds after which one may look for a place again in a room that is full.
const FULL_AGAIN: u64 = 10;

/// What whoever watches asks for, on pages of other sites, too, where these have a token.
pub fn watching_api() -> OpenApiRouter<Here> {
    OpenApiRouter::new()
        .routes(routes!(invite::state))
        .routes(routes!(subscribe))
        .routes(routes!(fetch::newest))
        .routes(routes!(fetch::latest_group))
        .routes(routes!(fetch::group))
}

/// What whoever publishes asks for.
pub fn publishing_api() -> OpenApiRouter<Here> {
    OpenApiRouter::new().routes(routes!(invite::link)).routes(routes!(publish))
}

type Upgrade = Result<WebSocketUpgrade, WebSocketUpgradeRejection>;

/// The upgrade with its bounds.
fn bounded(upgrade: Upgrade, most: usize) -> Result<WebSocketUpgrade, Problem> {
    let upgrade = upgrade.map_err(|e| Problem::new(StatusCode::UPGRADE_REQUIRED, "upgrade", e.to_string()))?;
    Ok(upgrade.protocols([PROTOCOL]).max_message_size(most).max_frame_size(most).max_write_buffer_size(WRITE_BUFFER))
}

/// Publish in a room.
///
/// A WebSocket with messages of `proto/live.proto`: HELLO, then VIDEO and SOUND as CREDIT allows. The room is there from then on, and for ten
/// seconds after its publisher has gone.
#[utoipa::path(
    get, path = "/v1/live/{room}/publish", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room: up to 64 letters, digits, - and _"),
        ("token" = Option<String>, Query, description = "Token for who publishes here; this machine's own user needs none"),
    ),
    responses(
        (status = 101, description = "The socket is open"),
        (status = 400, description = "A parameter is unknown"),
        (status = 403, description = "A page of another site, or no token"),
        (status = 404, description = "No room has such a name, or there are none here"),
        (status = 426, description = "This is a WebSocket"),
        (status = 503, description = "There are as many rooms as may be"),
    )
)]
async fn publish(
    State(here): State<Here>,
    Path(name): Path<String>,
    Extension(held): Extension<Held>,
    uri: Uri,
    headers: HeaderMap,
    upgrade: Upgrade,
) -> Result<Response, Problem> {
    let Leave::Until(ends) = here.check(&name, Role::Publish, &uri, &headers).await? else { return Err(none_publishes()) };
    // what a message has beside its frame; a frame that is too large by less than another one is read, and refused with its size
    let bounds = here.rooms.bounds;
    let upgrade = bounded(upgrade, 2 * bounds.frame.max(bounds.sound) + 1024)?;
    let entry = here.rooms.enter(&name).ok_or_else(busy)?;
    Ok(upgrade.on_upgrade(async move |socket| {
        held.keep_little();
        publisher::serve(socket, entry, &here, ends).await;
        drop(held);
    }))
}

/// Watch a room.
///
/// A WebSocket with messages of `proto/live.proto`: HELLO, a SNAPSHOT of all tiles, VIDEO since the last key frame, then VIDEO, GEOMETRY and
/// SOUND as they come, and STATISTICS each second in which nothing else is to be said.
#[utoipa::path(
    get, path = "/v1/live/{room}/subscribe", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room"),
        ("token" = Option<String>, Query, description = "Token for who watches or publishes here; this machine's own user needs none"),
    ),
    responses(
        (status = 101, description = "The socket is open"),
        (status = 400, description = "A parameter is unknown"),
        (status = 403, description = "No token that is good: a page of another site always needs one"),
        (status = 404, description = "Nobody publishes in such a room"),
        (status = 426, description = "This is a WebSocket"),
        (status = 503, description = "As many watch the room at this node as may, or there are as many rooms"),
    )
)]
async fn subscribe(
    State(here): State<Here>,
    Path(name): Path<String>,
    Extension(held): Extension<Held>,
    uri: Uri,
    headers: HeaderMap,
    upgrade: Upgrade,
) -> Result<Response, Problem> {
    let leave = here.check(&name, Role::Watch, &uri, &headers).await?;
    let upgrade = bounded(upgrade, 1024)?;
    let (room, ends, kind) = match leave {
        Leave::Until(ends) => (here.rooms.visit(&name).await?, ends, Watches::Itself),
        // the origin serves edges, and edges do not
        Leave::Node => (here.rooms.get(&name).filter(|room| !room.is_edge()).ok_or_else(none_publishes)?, None, Watches::Edge(0)),
    };
    if kind == Watches::Itself && room.is_full() {
        return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", viewer::FULL).retry_after(FULL_AGAIN));
    }
    Ok(upgrade.on_upgrade(async move |socket| {
        held.keep_little();
        viewer::serve(socket, (room, kind), here.stop, ends).await;
        drop(held);
    }))
}
