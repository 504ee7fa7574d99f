//! The newest frame and groups of pictures by plain HTTP, at whichever node one asks: what another node has is asked of it.

use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures_util::stream;
use tokio::sync::watch;
use tokio::time::timeout;

use super::Rooms;
use super::access::Role;
use super::gops::{Group, Part};
use super::nodes::{Borrower, Silent};
use super::room::{Newest, Room};
use super::routes::{Here, none_publishes};
use crate::server::{Coding, Entity, Held, Pairs, Problem, respond};
use tmpi_core::container::MEDIA_TYPE;

/// Time for which the next group of pictures is waited for.
const NEXT_GROUP: Duration = Duration::from_secs(5);
/// Headers of a frame's number, and of the epoch that it is of.
const FRAME: &str = "x-tmpi-frame";
const EPOCH: &str = "x-tmpi-epoch";
/// Messages of a room one after the other, each after its length in four bytes, little endian.
const MESSAGES: &str = "application/vnd.tmpi.live";

/// Where the publisher of a room is.
enum Source {
    /// At this node, or it was here last.
    Here(Arc<Room>),
    /// At another one.
    There(Borrower),
}

impl Source {
    fn of(rooms: &Rooms, name: &str) -> Result<Self, Problem> {
        let room = rooms.get(name);
        let there = || rooms.nodes.get().and_then(|nodes| Borrower::of(nodes, name));
        match room {
            Some(room) if !room.is_empty() => Ok(Self::Here(room)),
            room => there().map(Self::There).or(room.map(Self::Here)).ok_or_else(none_publishes),
        }
    }
}

impl From<Silent> for Problem {
    fn from(Silent: Silent) -> Self {
        let detail = "the node that has the room's publisher does not answer";
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "elsewhere", detail).retry_after(1)
    }
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
    here.check(&name, Role::Watch, &uri, &headers)?;
    let newest = match Source::of(&here.rooms, &name)? {
        Source::Here(room) => room.newest().await?,
        Source::There(owner) => owner.newest().await?,
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
    here.check(&name, Role::Watch, &uri, &headers)?;
    let newest = match Source::of(&here.rooms, &name)? {
        Source::Here(room) => room.last_group(),
        Source::There(owner) => owner.latest().await?,
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
    here.check(&name, Role::Watch, &uri, &headers)?;
    let none = || Problem::not_found("a group of pictures that is not kept");
    let place: Group = group.parse().map_err(|()| none())?;
    let mut pieces = Pieces::new(Source::of(&here.rooms, &name)?, place);
    // whoever is at the end asks for the next one before it begins; what has not begun by then is not there
    let first = timeout(NEXT_GROUP, pieces.next()).await.map_err(|_| none().retry_after(1))??;
    let Some(first) = first else { return Err(none().retry_after(1)) };
    let stop = here.stop;
    let messages = stream::try_unfold((Some(first), pieces, held), move |(first, mut pieces, held)| {
        let stop = stop.clone();
        async move {
            if let Some(first) = first {
                return Ok(Some((first, (None, pieces, held))));
            }
            let next = tokio::select! {
                next = pieces.next() => next.map_err(|_| std::io::Error::other("the node that has the group does not answer"))?,
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
    // only who shows a token may share with others what it got, under an address that has the token
    let shared = if Pairs::read(&uri, &["token"])?.get("token").is_some() { "public" } else { "private" };
    let cache_control = format!("{shared}, max-age=31536000, immutable");
    let headers = [(header::CONTENT_TYPE, MESSAGES.to_owned()), (header::CACHE_CONTROL, cache_control)];
    Ok((headers, Body::from_stream(messages)).into_response())
}

/// The messages of a group, from the first on.
struct Pieces {
    source: Source,
    /// Told of what comes to the room, where it is here.
    changes: Option<watch::Receiver<u64>>,
    group: Group,
    /// Number of the next message.
    at: u64,
    /// It has ended, and all of it was given.
    whole: bool,
}

impl Pieces {
    fn new(source: Source, group: Group) -> Self {
        let changes = if let Source::Here(room) = &source { Some(room.watch()) } else { None };
        Self { source, changes, group, at: 0, whole: false }
    }

    /// The next messages, each after its length, as soon as there are some; none at the end, or where the group is not kept.
    async fn next(&mut self) -> Result<Option<Bytes>, Problem> {
        loop {
            if let Some(changes) = &mut self.changes {
                changes.mark_unchanged();
            }
            let (part, next) = match &self.source {
                Source::Here(room) => match room.group(self.group, self.at as usize) {
                    Part::Message(bytes) => {
                        let framed = [&(bytes.len() as u32).to_le_bytes()[..], &bytes].concat();
                        (Part::Message(framed.into()), self.at + 1)
                    }
                    part => (part, self.at),
                },
                Source::There(owner) => owner.group(self.group, self.at).await?,
            };
            self.at = next;
            match (part, &mut self.changes) {
                (Part::Message(bytes), _) => return Ok(Some(bytes)),
                (Part::End, _) => {
                    self.whole = true;
                    return Ok(None);
                }
                (Part::Gone, _) => return Ok(None),
                // the room is held by the source
                (Part::Wait | Part::NotYet, Some(changes)) => {
                    let _ = changes.changed().await;
                }
                // its owner has waited
                (Part::Wait | Part::NotYet, None) => {}
            }
        }
    }
}
