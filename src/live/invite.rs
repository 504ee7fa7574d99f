//! What a room's pages ask before they come in, and how others are let in.

use std::time::Duration;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, Uri};
use serde::{Deserialize, Serialize};
use tmpi_core::live::wire::bye::Cause;
use utoipa::ToSchema;

use super::access::{Role, end_of, token, token_of};
use super::here::{Here, Leave, seconds};
use crate::server::{NoBody, Pairs, Problem};

/// How long a token to watch is good where this machine's own user asks for it.
const LINK: Duration = Duration::from_hours(24);
/// Bytes of what an origin says of a room, at most.
const MOST_STATE: usize = 4096;

/// What is known of a room from outside.
#[derive(Default, Deserialize, Serialize, ToSchema)]
pub(super) struct RoomState {
    /// Somebody publishes.
    publishing: bool,
    /// How many watch.
    viewers: u32,
    /// As many watch at this node as may: whoever comes finds no place.
    full: bool,
    /// Whoever asked may publish.
    may_publish: bool,
    /// Why the server has disconnected the last publisher, for some seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    ended: Option<String>,
}

/// State of a room.
///
/// For pages, which cannot see why a WebSocket is refused. There need not be anybody in it.
#[utoipa::path(
    get, path = "/v1/live/{room}", tag = "live", operation_id = "room",
    params(
        ("room" = String, Path, description = "Name of the room: up to 64 letters, digits, - and _"),
        ("token" = Option<String>, Query, description = "Token for who watches or publishes here, if not as a bearer; this machine's own user needs none"),
    ),
    responses(
        (status = 200, description = "Whether anybody publishes", body = RoomState),
        (status = 400, description = "A parameter is unknown"),
        (status = 403, description = "No token that is good: a page of another site always needs one"),
        (status = 404, description = "No room has such a name, or there are none here"),
    )
)]
pub(super) async fn state(
    State(here): State<Here>,
    Path(name): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Json<RoomState>, Problem> {
    let leave = here.check(&name, Role::Watch, &uri, &headers).await?;
    let may_publish = here.check(&name, Role::Publish, &uri, &headers).await.is_ok();
    let room = here.rooms.get(&name);
    let full = room.as_ref().is_some_and(|room| room.is_full());
    let state = match room.filter(|room| !room.is_edge()) {
        Some(room) => RoomState { publishing: room.is_publishing(), viewers: room.everyone(), ..RoomState::default() },
        None if leave == Leave::Node => RoomState::default(),
        None => at_origin(&here, &name).await?.unwrap_or_default(),
    };
    let ended = here
        .rooms
        .get(&name)
        .and_then(|room| room.farewell())
        .filter(|bye| bye.cause() == Cause::Rejected)
        .map(|bye| bye.reason)
        .or(state.ended);
    Ok(Json(RoomState { full, may_publish, ended, ..state }))
}

/// State of a room as its origin knows it; none where no other node has the room, or the one that does does not answer.
async fn at_origin(here: &Here, name: &str) -> Result<Option<RoomState>, Problem> {
    let Some((nodes, origin)) = here.rooms.elsewhere(name).await? else { return Ok(None) };
    let Ok(answer) = nodes.fetch(&origin, name, "", HeaderMap::new()).await else { return Ok(None) };
    let body = axum::body::to_bytes(answer.into_body(), MOST_STATE).await.unwrap_or_default();
    Ok(serde_json::from_slice(&body).ok())
}

/// A token for who watches.
#[derive(Serialize, ToSchema)]
pub(super) struct Link {
    /// None where rooms are for this machine's own user.
    token: Option<String>,
}

/// Let others watch.
///
/// Whoever may publish gets a token for those who watch, good for as long as their own; where they need none, for a day.
#[utoipa::path(
    post, path = "/v1/live/{room}/token", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room"),
        ("token" = Option<String>, Query, description = "Token for who publishes here, if not as a bearer; this machine's own user needs none"),
    ),
    responses(
        (status = 200, description = "The token", body = Link),
        (status = 400, description = "A parameter is unknown, or there is a body"),
        (status = 403, description = "A page of another site, or no token"),
        (status = 404, description = "No room has such a name, or there are none here"),
    )
)]
pub(super) async fn link(
    State(here): State<Here>,
    Path(name): Path<String>,
    uri: Uri,
    headers: HeaderMap,
    _: NoBody,
) -> Result<Json<Link>, Problem> {
    here.check(&name, Role::Publish, &uri, &headers).await?;
    let asked = Pairs::read(&uri, &["token"])?;
    let token = here.rooms.config.key.as_ref().and_then(|key| {
        let (given, now) = (asked.get("token").or_else(|| token_of(&headers)), seconds());
        let end = given.and_then(|given| end_of(key, Role::Publish, &name, given, now)).unwrap_or(now + LINK.as_secs());
        token(key, Role::Watch, &name, end)
    });
    Ok(Json(Link { token }))
}
