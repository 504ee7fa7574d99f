//! Tokens for viewers of a room, which its publisher hands out.

use std::time::Duration;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, Uri};
use serde::Serialize;
use utoipa::ToSchema;

use super::request_access::RoomsContext;
use super::room_token::{Role, room_token, token_expiry, token_in_headers};
use crate::server::{NoBody, Pairs, Problem, since_1970};

/// Lifetime of a token to watch that this machine's own user requests.
const LIFETIME: Duration = Duration::from_hours(24);

/// A token to watch.
#[derive(Serialize, ToSchema)]
pub(super) struct WatchToken {
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
        (status = 404, description = "The name is invalid, or rooms are disabled"),
    )
)]
pub(super) async fn watch_token(
    State(here): State<RoomsContext>,
    Path(name): Path<String>,
    uri: Uri,
    headers: HeaderMap,
    _: NoBody,
) -> Result<Json<WatchToken>, Problem> {
    here.check(&name, Role::Publish, &uri, &headers).await?;
    let query = Pairs::read(&uri, &["token"])?;
    let token = here.rooms.config.key.as_ref().and_then(|key| {
        let (given, now) = (query.get("token").or_else(|| token_in_headers(&headers)), since_1970().as_secs());
        let end = given.and_then(|given| token_expiry(key, Role::Publish, &name, given, now)).unwrap_or(now + LIFETIME.as_secs());
        room_token(key, Role::Watch, &name, end)
    });
    Ok(Json(WatchToken { token }))
}
