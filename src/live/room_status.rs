//! The state of a room, for its pages.

use axum::Json;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, Uri};
use serde::{Deserialize, Serialize};
use tmpi_core::live::schema::bye::Cause;
use utoipa::ToSchema;

use super::Grant;
use super::request_access::{RoomAccess, RoomsContext};
use crate::server::Problem;

/// Longest state of a room from its origin, in bytes.
const MAX_STATE: usize = 4096;

/// State of a room.
#[derive(Default, Deserialize, Serialize, ToSchema)]
pub(super) struct RoomState {
    /// Whether the room has a publisher.
    publishing: bool,
    /// Number of viewers.
    viewers: u32,
    /// Whether the room accepts no more viewers at this node.
    full: bool,
    /// Whether the caller may publish.
    may_publish: bool,
    /// Why the server has disconnected the last publisher. Present for some seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    ended: Option<String>,
}

/// State of a room.
///
/// For pages, which cannot see why a WebSocket is refused. The room may be empty.
#[utoipa::path(
    get, path = "/v1/live/{room}", tag = "live", operation_id = "room",
    params(
        ("room" = String, Path, description = "Name of the room: up to 64 letters, digits, - and _"),
        ("token" = Option<String>, Query, description = "Token to watch or publish here, unless sent as a bearer token; this machine's own user needs none"),
    ),
    responses(
        (status = 200, description = "The state", body = RoomState),
    )
)]
pub(super) async fn state(
    State(here): State<RoomsContext>,
    Path(name): Path<String>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Json<RoomState>, Problem> {
    let access = here.check(&name, Grant::Watch, &uri, &headers).await?;
    let may_publish = here.check(&name, Grant::Publish, &uri, &headers).await.is_ok();
    let room = here.rooms.get(&name);
    let full = room.as_ref().is_some_and(|room| room.is_full());
    let state = match room.filter(|room| !room.is_edge()) {
        Some(room) => RoomState { publishing: room.is_publishing(), viewers: room.all_viewers(), ..RoomState::default() },
        None if access == RoomAccess::Node => RoomState::default(),
        None => at_origin(&here, &name).await?.unwrap_or_default(),
    };
    let farewell = here.rooms.get(&name).and_then(|room| room.farewell()).filter(|bye| bye.cause() == Cause::Rejected);
    let ended = farewell.map(|bye| bye.reason).or(state.ended);
    Ok(Json(RoomState { full, may_publish, ended, ..state }))
}

/// State of a room from its origin; `None` if no other node has the room, or the origin does not answer.
async fn at_origin(here: &RoomsContext, name: &str) -> Result<Option<RoomState>, Problem> {
    let Some((nodes, origin)) = here.rooms.remote_origin(name).await? else { return Ok(None) };
    let Ok(answer) = nodes.fetch(&origin, name, "", HeaderMap::new()).await else { return Ok(None) };
    let body = axum::body::to_bytes(answer.into_body(), MAX_STATE).await.unwrap_or_default();
    Ok(serde_json::from_slice(&body).ok())
}
