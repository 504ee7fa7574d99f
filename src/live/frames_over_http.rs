//! The newest frame and groups of pictures by plain HTTP. An edge asks the room's origin for them.

use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures_util::{Stream, StreamExt as _, TryStreamExt as _, stream};
use tokio::sync::watch;
use tokio::time::{Instant, timeout};
use tokio_util::sync::CancellationToken;

use super::Grant;
use super::gop_store::{Group, GroupPart};
use super::origin_client::Nodes;
use super::request_access::{ENDED, RoomAccess, RoomsContext, ended, none_publishes};
use super::room::Room;
use crate::server::{ANSWERS, ConnectionGuard, ContentCoding, Entity, Pairs, Problem, respond};
use tmpi_core::container::MEDIA_TYPE;
use tmpi_library::Origin;

/// How long a request waits for the next group.
const NEXT_GROUP: Duration = Duration::from_secs(5);
/// Headers with a frame's number and epoch.
const FRAME: &str = "x-tmpi-frame";
const EPOCH: &str = "x-tmpi-epoch";
/// Media type of a room's messages, each preceded by its length in four bytes, little endian.
const MESSAGES: &str = "application/vnd.tmpi.live";

/// Where the frames of a room are.
enum Place {
    /// At this node.
    Here(Arc<Room>),
    /// At its origin.
    There(Arc<Nodes>, Origin),
}

/// Finds the frames of a room. Requests of other nodes are not forwarded.
async fn find(here: &RoomsContext, name: &str, access: RoomAccess) -> Result<Place, Problem> {
    if let Some(room) = here.rooms.get(name).filter(|room| !room.is_edge()) {
        return Ok(Place::Here(room));
    }
    let elsewhere = if access == RoomAccess::Node { None } else { here.rooms.remote_origin(name).await? };
    elsewhere.map(|(nodes, origin)| Place::There(nodes, origin)).ok_or_else(none_publishes)
}

/// The origin's answer to the same request.
async fn forward(nodes: &Nodes, origin: &Origin, name: &str, path: &str, headers: &HeaderMap) -> Result<Response, Problem> {
    let known = headers.get(header::IF_NONE_MATCH).map(|value| (header::IF_NONE_MATCH, value.clone()));
    nodes.fetch(origin, name, path, known.into_iter().collect()).await.map(handed_on)
}

/// Headers of an origin's answer that are passed on.
const HANDED_ON: [HeaderName; 4] = [header::CONTENT_TYPE, header::ETAG, header::CACHE_CONTROL, header::LOCATION];

/// Turns an origin's answer into this node's.
fn handed_on(answer: Response) -> Response {
    let (from, body) = answer.into_parts();
    let mut response = (from.status, body).into_response();
    for name in HANDED_ON.into_iter().chain([FRAME, EPOCH].map(HeaderName::from_static)) {
        if let Some(value) = from.headers.get(&name) {
            response.headers_mut().insert(name, value.clone());
        }
    }
    response
}

/// The newest frame of a room as a container.
///
/// The newest frame with finished planes. `x-tmpi-frame` has its number, and `x-tmpi-epoch` the epoch of its HELLO.
#[utoipa::path(
    get, path = "/v1/live/{room}/frames/latest/atlas", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room"),
        ("token" = Option<String>, Query, description = "Token to watch or publish here; this machine's own user needs none"),
    ),
    responses(
        (status = 200, description = "The container, like a photo's", body = String, content_type = "application/vnd.tmpi",
            headers(
                ("x-tmpi-frame" = u64, description = "Number of the frame"),
                ("x-tmpi-epoch" = u64, description = "Epoch of the frame"),
            )),
        (status = 304, description = "The client has it"),
        (status = 404, description = "The room has no publisher, or no finished frame yet"),
        (status = 503, description = "The node that has the room's publisher does not answer"),
    )
)]
pub async fn newest(State(here): State<RoomsContext>, Path(name): Path<String>, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    let access = here.check(&name, Grant::Watch, &uri, &headers).await?;
    let room = match find(&here, &name, access).await? {
        Place::Here(room) => room,
        Place::There(nodes, origin) => return forward(&nodes, &origin, &name, "/frames/latest/atlas", &headers).await,
    };
    let (epoch, frame) = room.newest_frame().ok_or_else(|| Problem::not_found("no frame is ready yet"))?;
    let (number, container) = (frame.tiles.frame, frame.container().await?);
    let etag = format!("\"{epoch}-{number}\"");
    // the client may hold it for longer than the room does
    let container = ANSWERS.count(container);
    let entity =
        Entity { source: container.into(), etag: &etag, content_type: MEDIA_TYPE, cache_control: "no-store", coding: ContentCoding::Plain };
    let mut response = respond(&headers, entity);
    response.headers_mut().insert(FRAME, HeaderValue::from(number));
    response.headers_mut().insert(EPOCH, HeaderValue::from(epoch));
    Ok(response)
}

/// A group of pictures.
///
/// HELLO, a SNAPSHOT of the tiles at that time, and the messages of `proto/live.proto` from a key frame to the next, each preceded by its
/// length in four bytes, little endian. The response streams while the group grows; a complete group never changes. The server keeps the
/// last few groups, and waits for the next one. `latest` redirects to the newest group.
#[utoipa::path(
    get, path = "/v1/live/{room}/gops/{group}", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room"),
        ("group" = String, Path, description = "`EPOCH-N`: the epoch of HELLO and the number of the group, from 0 on; or `latest`"),
        ("token" = Option<String>, Query, description = "Token to watch or publish here; this machine's own user needs none"),
    ),
    responses(
        (status = 200, description = "Messages, as they come", body = String, content_type = "application/vnd.tmpi.live"),
        (status = 307, description = "The newest group",
            headers(("Location" = String, description = "Its address, relative to this one"))),
        (status = 404, description = "The group does not exist yet, or not any more; ask again after `Retry-After`"),
        (status = 503, description = "The node that has the room's publisher does not answer"),
    )
)]
pub async fn group(
    State(here): State<RoomsContext>,
    Path((name, group)): Path<(String, String)>,
    Extension(held): Extension<ConnectionGuard>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let access = here.check(&name, Grant::Watch, &uri, &headers).await?;
    let none = || Problem::not_found("the server does not have this group of pictures");
    if group == "latest" {
        let place = match find(&here, &name, access).await? {
            Place::Here(room) => room.last_group().map(|group| group.to_string()),
            Place::There(nodes, origin) => {
                let answer = forward(&nodes, &origin, &name, "/gops/latest", &headers).await?;
                answer.headers().get(header::LOCATION).and_then(|place| place.to_str().ok()).map(str::to_owned)
            }
        };
        let place = place.ok_or_else(|| Problem::not_found("the room has no group of pictures yet"))?;
        let location = format!("{place}{}", uri.query().map_or(String::new(), |query| format!("?{query}")));
        return Ok((StatusCode::TEMPORARY_REDIRECT, [(header::LOCATION, location)]).into_response());
    }
    let group: Group = group.parse().map_err(|()| none())?;
    // shared caches may only store responses whose URL has the token
    let shared = if Pairs::read(&uri, &["token"])?.get("token").is_some() { "public" } else { "private" };
    let told = [(header::CACHE_CONTROL, format!("{shared}, max-age=31536000, immutable")), (header::CONTENT_TYPE, MESSAGES.to_owned())];
    let room = match find(&here, &name, access).await? {
        Place::Here(room) => room,
        Place::There(nodes, origin) => {
            let messages = nodes.group(origin, name, group).await?.into_data_stream().map_err(std::io::Error::other);
            return Ok((told, Body::from_stream(until(messages, access.ends()))).into_response());
        }
    };
    let mut pieces = Pieces::new(room, group);
    // a client that has read the last group may request the next one before it begins
    let first = timeout(NEXT_GROUP, pieces.next()).await.map_err(|_| none().retry_after(1))?;
    let Some(first) = first else { return Err(none().retry_after(1)) };
    let messages = stream::once(async { Ok(first) }).chain(rest(pieces, held, here.stop));
    let messages = messages.map_ok(|message| ANSWERS.count(message));
    Ok((told, Body::from_stream(until(messages, access.ends()))).into_response())
}

/// A stream that breaks off when its reader's token ends.
fn until<S>(messages: S, ends: Option<Instant>) -> impl Stream<Item = std::io::Result<Bytes>>
where
    S: Stream<Item = std::io::Result<Bytes>>,
{
    stream::try_unfold(Box::pin(messages), move |mut messages| async move {
        tokio::select! {
            biased;
            () = ended(ends) => Err(std::io::Error::other(ENDED)),
            next = messages.try_next() => Ok(next?.map(|message| (message, messages))),
        }
    })
}

/// The further messages of a group, as they come; holds the connection until the end.
fn rest(pieces: Pieces, held: ConnectionGuard, stop: CancellationToken) -> impl Stream<Item = std::io::Result<Bytes>> {
    stream::try_unfold((pieces, held, stop), async move |(mut pieces, held, stop)| {
        let next = tokio::select! {
            next = pieces.next() => next,
            () = stop.cancelled() => return Err(std::io::Error::other("the server stops")),
        };
        match next {
            Some(piece) => Ok(Some((piece, (pieces, held, stop)))),
            None if pieces.whole => Ok(None),
            // an error, so that caches see that the response is incomplete
            None => Err(std::io::Error::other("the group was dropped")),
        }
    })
}

/// Reads the messages of a group.
struct Pieces {
    room: Arc<Room>,
    changes: watch::Receiver<u64>,
    group: Group,
    at: usize,
    whole: bool,
}

impl Pieces {
    fn new(room: Arc<Room>, group: Group) -> Self {
        Self { changes: room.watch(), room, group, at: 0, whole: false }
    }

    /// Waits for the next message and prefixes its length; `None` at the end, or if the group was dropped.
    async fn next(&mut self) -> Option<Bytes> {
        loop {
            self.changes.mark_unchanged();
            match self.room.group(self.group, self.at) {
                GroupPart::Message(bytes) => {
                    self.at += 1;
                    return Some([&(bytes.len() as u32).to_le_bytes()[..], &bytes].concat().into());
                }
                GroupPart::End => {
                    self.whole = true;
                    return None;
                }
                GroupPart::Gone => return None,
                // cannot fail: `self.room` keeps the sender
                GroupPart::Wait | GroupPart::NotYet => drop(self.changes.changed().await),
            }
        }
    }
}
