//! The addresses of rooms.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use axum::body::Body;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Router};
use bytes::Bytes;
use futures_util::stream;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use tmpi_core::container::{self, Carried, Carries, MEDIA_TYPE};
use tmpi_core::{Scene, Texels};

use super::access::{PROTOCOL, Role, check_origin, is_good, token_of};
use super::gops::{Group, Part};
use super::room::{Room, Still};
use super::{COME_BACK, FRAME_BYTES, Rooms, invite, is_name, publisher, viewer};
use crate::server::{Held, Pairs, Problem};

/// Bytes that wait to be written for a viewer, at most: the largest message, and nothing beside it.
const WRITE_BUFFER: usize = 2 << 20;
/// Quality of the picture of a frame that is asked for by itself.
const QUALITY: u8 = 90;
/// Time for which the next group of pictures is waited for.
const NEXT_GROUP: Duration = Duration::from_secs(5);
/// Messages of a room one after the other, each after its length in four bytes, little endian.
const MESSAGES: &str = "application/vnd.tmpi.live";

/// What the handlers need of the server.
#[derive(Clone)]
pub struct Here {
    /// The rooms.
    pub rooms: Arc<Rooms>,
    /// Set when the server stops.
    pub stop: CancellationToken,
    /// Whether a request comes from this machine's own user.
    pub own: Arc<dyn Fn(&HeaderMap) -> bool + Send + Sync>,
}

/// Addresses of rooms, and what is said of them.
pub fn api() -> OpenApiRouter<Here> {
    OpenApiRouter::new()
        .routes(routes!(invite::state))
        .routes(routes!(invite::link))
        .routes(routes!(publish))
        .routes(routes!(subscribe))
        .routes(routes!(frame))
        .routes(routes!(latest_group))
        .routes(routes!(group))
}

/// Routes of rooms.
pub fn router(here: Here) -> Router {
    api().split_for_parts().0.with_state(here)
}

impl Here {
    /// Checks name, origin, query and leave.
    pub(super) fn check(&self, room: &str, role: Role, uri: &Uri, headers: &HeaderMap) -> Result<(), Problem> {
        check_origin(headers)?;
        let asked = Pairs::read(uri, &["token"])?;
        let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
        let good = match (&self.rooms.config.key, asked.get("token").or_else(|| token_of(headers))) {
            (Some(key), Some(token)) => is_good(key, role, room, token, now),
            _ => (self.own)(headers),
        };
        if !good {
            return Err(Problem::new(StatusCode::FORBIDDEN, "token", "a token for this room is needed").field("token"));
        }
        if !is_name(room) {
            return Err(Problem::not_found("a room's name has letters, digits, - and _"));
        }
        Ok(())
    }

    /// A room whose publisher is here.
    fn room(&self, name: &str) -> Result<Arc<Room>, Problem> {
        let room = self.rooms.get(name);
        if room.as_ref().is_none_or(|r| r.is_empty()) && self.rooms.is_elsewhere(name) {
            let detail = "the room's publisher is at another node, which alone has this";
            return Err(Problem::new(StatusCode::MISDIRECTED_REQUEST, "elsewhere", detail));
        }
        room.ok_or_else(none_publishes)
    }
}

fn none_publishes() -> Problem {
    Problem::not_found("nobody publishes in this room")
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
        (status = 400, description = "A parameter is unknown", body = Problem, content_type = "application/problem+json"),
        (status = 403, description = "A page of another site, or no token", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "No room has such a name, or there are none here", body = Problem, content_type = "application/problem+json"),
        (status = 426, description = "This is a WebSocket", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "There are as many rooms as may be", body = Problem, content_type = "application/problem+json"),
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
    here.check(&name, Role::Publish, &uri, &headers)?;
    // what a message has beside its frame
    let upgrade = bounded(upgrade, FRAME_BYTES + 1024)?;
    let busy = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", "there are as many rooms as may be").retry_after(5);
    let room = here.rooms.enter(&name).ok_or_else(busy)?;
    Ok(upgrade.on_upgrade(async move |socket| {
        let _held = held;
        publisher::serve(socket, (&name, Arc::clone(&room)), &here.rooms, here.stop.clone()).await;
        tokio::select! {
            () = tokio::time::sleep(COME_BACK) => {}
            () = here.stop.cancelled() => {}
        }
        here.rooms.leave(&name, &room);
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
        (status = 400, description = "A parameter is unknown", body = Problem, content_type = "application/problem+json"),
        (status = 403, description = "A page of another site, or no token", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "Nobody publishes in such a room", body = Problem, content_type = "application/problem+json"),
        (status = 426, description = "This is a WebSocket", body = Problem, content_type = "application/problem+json"),
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
    here.check(&name, Role::Watch, &uri, &headers)?;
    let upgrade = bounded(upgrade, 1024)?;
    let room = here.rooms.visit(&name).ok_or_else(none_publishes)?;
    Ok(upgrade.on_upgrade(async move |socket| {
        let _held = held;
        viewer::serve(socket, room, here.stop).await;
    }))
}

/// A frame of a room as a container.
///
/// The newest whose planes are done; `x-tmpi-frame` tells its number.
#[utoipa::path(
    get, path = "/v1/live/{room}/frames/{frame}/atlas", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room"),
        ("frame" = String, Path, description = "`latest`, or its number, as long as no newer one is kept"),
        ("token" = Option<String>, Query, description = "Token for who watches or publishes here; this machine's own user needs none"),
    ),
    responses(
        (status = 200, description = "The container, as that of a photo", body = String, content_type = "application/vnd.tmpi",
            headers(("x-tmpi-frame" = u64, description = "Number of the frame"))),
        (status = 400, description = "A parameter is unknown", body = Problem, content_type = "application/problem+json"),
        (status = 403, description = "A page of another site, or no token", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "Nobody publishes there, or the frame is not kept", body = Problem, content_type = "application/problem+json"),
        (status = 421, description = "The room's publisher is at another node", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn frame(
    State(here): State<Here>,
    Path((name, number)): Path<(String, String)>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    here.check(&name, Role::Watch, &uri, &headers)?;
    let still = here.room(&name)?.still().ok_or_else(|| Problem::not_found("no frame is done yet"))?;
    if number != "latest" && number.parse() != Ok(still.tiles.frame) {
        return Err(Problem::not_found(format!("the frame that is kept is {}", still.tiles.frame)));
    }
    // once for all who ask
    let made = still.atlas.get_or_try_init(|| {
        let still = Arc::clone(&still);
        async move {
            let made = tokio::task::spawn_blocking(move || contained(&still)).await;
            made.map_err(|e| e.to_string())?.map(Bytes::from).map_err(|e| e.to_string())
        }
    });
    let made = made.await.map_err(|e| Problem::internal("writing a container", &e))?.clone();
    let mut response = made.into_response();
    response.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE));
    response.headers_mut().insert("x-tmpi-frame", HeaderValue::from(still.tiles.frame));
    Ok(response)
}

/// Where the newest group of pictures lies.
#[utoipa::path(
    get, path = "/v1/live/{room}/gops/latest", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room"),
        ("token" = Option<String>, Query, description = "Token for who watches or publishes here; this machine's own user needs none"),
    ),
    responses(
        (status = 307, description = "The group that is under way",
            headers(("Location" = String, description = "Its address, relative to this one"))),
        (status = 400, description = "A parameter is unknown", body = Problem, content_type = "application/problem+json"),
        (status = 403, description = "A page of another site, or no token", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "Nobody publishes there, or nothing has come yet", body = Problem, content_type = "application/problem+json"),
        (status = 421, description = "The room's publisher is at another node", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn latest_group(State(here): State<Here>, Path(name): Path<String>, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    here.check(&name, Role::Watch, &uri, &headers)?;
    let place = here.room(&name)?.last_group().ok_or_else(|| Problem::not_found("nothing has come yet"))?;
    let query = uri.query().map_or(String::new(), |q| format!("?{q}"));
    let location = HeaderValue::try_from(format!("{place}{query}")).map_err(|e| Problem::internal("an address", &e))?;
    Ok((StatusCode::TEMPORARY_REDIRECT, [(header::LOCATION, location)]).into_response())
}

/// A group of pictures.
///
/// The messages of `proto/live.proto` from a key frame to the next, after HELLO and a SNAPSHOT of the tiles as they were, each after its
/// length in four bytes, little endian. It comes as it grows; once it is whole it never changes. The last few are kept, and the next one is
/// waited for.
#[utoipa::path(
    get, path = "/v1/live/{room}/gops/{group}", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room"),
        ("group" = String, Path, description = "`EPOCH-N`: the epoch of HELLO and the number of the group, from 0 on"),
        ("token" = Option<String>, Query, description = "Token for who watches or publishes here; this machine's own user needs none"),
    ),
    responses(
        (status = 200, description = "Messages, as they come", body = String, content_type = "application/vnd.tmpi.live"),
        (status = 400, description = "A parameter is unknown", body = Problem, content_type = "application/problem+json"),
        (status = 403, description = "A page of another site, or no token", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "There is no such group, or none any more", body = Problem, content_type = "application/problem+json"),
        (status = 421, description = "The room's publisher is at another node", body = Problem, content_type = "application/problem+json"),
    )
)]
async fn group(
    State(here): State<Here>,
    Path((name, group)): Path<(String, String)>,
    Extension(held): Extension<Held>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    here.check(&name, Role::Watch, &uri, &headers)?;
    let none = || Problem::not_found("a group of pictures that is not kept");
    let place: Group = group.parse().map_err(|()| none())?;
    let room = here.room(&name)?;
    let mut changes = room.watch();
    let begun = async {
        while matches!(room.group(place, 0), Part::NotYet) {
            // whoever is at the end asks for the next one before it begins
            if changes.changed().await.is_err() {
                break;
            }
        }
    };
    // what has not begun by then is not there
    let _ = timeout(NEXT_GROUP, begun).await;
    if matches!(room.group(place, 0), Part::NotYet | Part::Gone) {
        return Err(none().retry_after(1));
    }
    let stop = here.stop;
    let messages = stream::try_unfold((room, changes, 0, held), move |(room, mut changes, at, held)| {
        let stop = stop.clone();
        async move {
            loop {
                changes.mark_unchanged();
                match room.group(place, at) {
                    Part::Message(bytes) => {
                        let framed = [&(bytes.len() as u32).to_le_bytes()[..], &bytes].concat();
                        return Ok(Some((framed, (room, changes, at + 1, held))));
                    }
                    Part::End => return Ok(None),
                    // a cut that caches see: this is not the whole group
                    Part::Gone | Part::NotYet => return Err(std::io::Error::other("the group is not kept any more")),
                    Part::Wait => {}
                }
                tokio::select! {
                    changed = changes.changed() => changed.map_err(std::io::Error::other)?,
                    () = stop.cancelled() => return Err(std::io::Error::other("the server stops")),
                }
            }
        }
    });
    // only who shows a token may share with others what it got, under an address that has the token
    let shared = if uri.query().is_some() { "public" } else { "private" };
    let cache_control = format!("{shared}, max-age=31536000, immutable");
    let headers = [(header::CONTENT_TYPE, MESSAGES.to_owned()), (header::CACHE_CONTROL, cache_control)];
    Ok((headers, Body::from_stream(messages)).into_response())
}

/// A frame as a container.
fn contained(still: &Still) -> Result<Vec<u8>, container::ContainerError> {
    let (geometry, photo) = (&still.tiles.geometry, still.photo.clone());
    let carried = Carried::from_photo(&photo, QUALITY)?;
    let (grid, intrinsics, view_box) = (geometry.grid, geometry.intrinsics, geometry.view_box);
    let scene = Scene { grid, intrinsics, view_box, photo, layers: Vec::new(), texels: Texels::default() };
    container::encode(geometry, &scene, &carried, Carries::default()).map(|(bytes, _)| bytes)
}
