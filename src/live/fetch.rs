//! The newest frame and groups of pictures by plain HTTP: an edge asks the room's origin for them.

use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures_util::stream;
use tmpi_library::Origin;
use tokio::sync::watch;
use tokio::time::timeout;

use super::access::Role;
use super::gops::{Group, Part};
use super::here::{Here, Leave, none_publishes};
use super::origin::Nodes;
use super::room::{Newest, Room};
use crate::server::{Coding, Entity, Held, Pairs, Problem, respond};
use tmpi_core::container::MEDIA_TYPE;

/// Time for which the next group of pictures is waited for.
const NEXT_GROUP: Duration = Duration::from_secs(5);
/// Headers of a frame's number, and of the epoch that it is of.
const FRAME: &str = "x-tmpi-frame";
const EPOCH: &str = "x-tmpi-epoch";
/// Messages of a room one after the other, each after its length in four bytes, little endian.
const MESSAGES: &str = "application/vnd.tmpi.live";

/// Where the frames of a room are.
enum Source {
    /// At this node.
    Here(Arc<Room>),
    /// At the room's origin.
    Origin(Arc<Nodes>, Origin),
}

impl Source {
    /// Where the frames of a room are for who has this leave: other nodes ask the origin alone.
    async fn of(here: &Here, name: &str, leave: Leave) -> Result<Self, Problem> {
        if let Some(room) = here.rooms.get(name).filter(|room| !room.is_edge()) {
            return Ok(Self::Here(room));
        }
        let elsewhere = if leave == Leave::Node { None } else { here.rooms.elsewhere(name).await? };
        elsewhere.map(|(nodes, origin)| Self::Origin(nodes, origin)).ok_or_else(none_publishes)
    }
}

/// Headers of an origin's answer that are handed on.
const HANDED_ON: [HeaderName; 3] = [header::CONTENT_TYPE, header::ETAG, header::CACHE_CONTROL];

/// An origin's answer, as this node's.
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
/// It is the newest whose planes are done. `x-tmpi-frame` is its number, and `x-tmpi-epoch` the epoch of the HELLO that it follows.
#[utoipa::path(
    get, path = "/v1/live/{room}/frames/latest/atlas", tag = "live",
    params(
        ("room" = String, Path, description = "Name of the room"),
        ("token" = Option<String>, Query, description = "Token for who watches or publishes here; this machine's own user needs none"),
    ),
    responses(
        (status = 200, description = "The container, as that of a photo", body = String, content_type = "application/vnd.tmpi",
            headers(
                ("x-tmpi-frame" = u64, description = "Number of the frame"),
                ("x-tmpi-epoch" = u64, description = "Epoch that it is of"),
            )),
        (status = 304, description = "The client has it"),
        (status = 400, description = "A parameter is unknown"),
        (status = 403, description = "No token that is good: a page of another site always needs one"),
        (status = 404, description = "Nobody publishes there, or no frame is done yet"),
        (status = 503, description = "The node that has the room's publisher does not answer"),
    )
)]
pub async fn newest(State(here): State<Here>, Path(name): Path<String>, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    let leave = here.check(&name, Role::Watch, &uri, &headers).await?;
    let newest = match Source::of(&here, &name, leave).await? {
        Source::Here(room) => room.newest().await?,
        Source::Origin(nodes, origin) => {
            let known = headers.get(header::IF_NONE_MATCH).map(|value| (header::IF_NONE_MATCH, value.clone()));
            return nodes.fetch(&origin, &name, "/frames/latest/atlas", known.into_iter().collect()).await.map(handed_on);
        }
    };
    let Newest { epoch, number, container } = newest.ok_or_else(|| Problem::not_found("no frame is done yet"))?;
    let etag = format!("\"{epoch}-{number}\"");
    let entity =
        Entity { source: container.into(), etag: &etag, content_type: MEDIA_TYPE, cache_control: "no-store", coding: Coding::Plain };
    let mut response = respond(&headers, entity);
    response.headers_mut().insert(FRAME, HeaderValue::from(number));
    response.headers_mut().insert(EPOCH, HeaderValue::from(epoch));
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
        (status = 400, description = "A parameter is unknown"),
        (status = 403, description = "No token that is good: a page of another site always needs one"),
        (status = 404, description = "Nobody publishes there, or nothing has come yet"),
        (status = 503, description = "The node that has the room's publisher does not answer"),
    )
)]
pub async fn latest_group(State(here): State<Here>, Path(name): Path<String>, uri: Uri, headers: HeaderMap) -> Result<Response, Problem> {
    let leave = here.check(&name, Role::Watch, &uri, &headers).await?;
    let newest = match Source::of(&here, &name, leave).await? {
        Source::Here(room) => room.last_group().map(|group| group.to_string()),
        Source::Origin(nodes, origin) => {
            let answer = nodes.fetch(&origin, &name, "/gops/latest", HeaderMap::new()).await?;
            answer.headers().get(header::LOCATION).and_then(|place| place.to_str().ok()).map(str::to_owned)
        }
    };
    let place = newest.ok_or_else(|| Problem::not_found("nothing has come yet"))?;
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
        (status = 400, description = "A parameter is unknown"),
        (status = 403, description = "No token that is good: a page of another site always needs one"),
        (status = 404, description = "There is no such group, or none any more"),
        (status = 503, description = "The node that has the room's publisher does not answer"),
    )
)]
pub async fn group(
    State(here): State<Here>,
    Path((name, group)): Path<(String, String)>,
    Extension(held): Extension<Held>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let leave = here.check(&name, Role::Watch, &uri, &headers).await?;
    let none = || Problem::not_found("a group of pictures that is not kept");
    let group: Group = group.parse().map_err(|()| none())?;
    // only who shows a token may share with others what it got, under an address that has the token
    let shared = if Pairs::read(&uri, &["token"])?.get("token").is_some() { "public" } else { "private" };
    let cache_control = [(header::CACHE_CONTROL, format!("{shared}, max-age=31536000, immutable"))];
    let room = match Source::of(&here, &name, leave).await? {
        Source::Here(room) => room,
        Source::Origin(nodes, origin) => {
            let answer = nodes.fetch(&origin, &name, &format!("/gops/{group}"), HeaderMap::new()).await?;
            return Ok((cache_control, handed_on(answer)).into_response());
        }
    };
    let mut pieces = Pieces::new(room, group);
    // whoever is at the end asks for the next one before it begins; what has not begun by then is not there
    let first = timeout(NEXT_GROUP, pieces.next()).await.map_err(|_| none().retry_after(1))?;
    let Some(first) = first else { return Err(none().retry_after(1)) };
    let stop = here.stop;
    let messages = stream::try_unfold((Some(first), pieces, held), move |(first, mut pieces, held)| {
        let stop = stop.clone();
        async move {
            if let Some(first) = first {
                return Ok(Some((first, (None, pieces, held))));
            }
            let next = tokio::select! {
                next = pieces.next() => next,
                () = stop.cancelled() => return Err(std::io::Error::other("the server stops")),
            };
            match next {
                Some(piece) => Ok(Some((piece, (None, pieces, held)))),
                None if pieces.whole => Ok(None),
                // a cut that caches see: this is not the whole group
                None => Err(std::io::Error::other("the group is not kept any more")),
            }
        }
    });
    Ok((cache_control, [(header::CONTENT_TYPE, MESSAGES)], Body::from_stream(messages)).into_response())
}

/// The messages of a group, from the first on.
struct Pieces {
    room: Arc<Room>,
    /// Told of what comes to the room.
    changes: watch::Receiver<u64>,
    group: Group,
    /// Number of the next message.
    at: usize,
    /// It has ended, and all of it was given.
    whole: bool,
}

impl Pieces {
    fn new(room: Arc<Room>, group: Group) -> Self {
        Self { changes: room.watch(), room, group, at: 0, whole: false }
    }

    /// The next message, after its length, as soon as there is one; none at the end, or where the group is not kept.
    async fn next(&mut self) -> Option<Bytes> {
        loop {
            self.changes.mark_unchanged();
            match self.room.group(self.group, self.at) {
                Part::Message(bytes) => {
                    self.at += 1;
                    return Some([&(bytes.len() as u32).to_le_bytes()[..], &bytes].concat().into());
                }
                Part::End => {
                    self.whole = true;
                    return None;
                }
                Part::Gone => return None,
                // the room is held by this
                Part::Wait | Part::NotYet => drop(self.changes.changed().await),
            }
        }
    }
}
