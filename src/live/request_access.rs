//! Access checks of the rooms' handlers: this machine's own user and holders of a token may publish or watch.

use std::sync::Arc;
use std::time::Duration;

use axum::http::{HeaderMap, StatusCode, Uri};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::signed_token::{token_expiry, token_in_headers};
use super::{Grant, Rooms, is_name};
use crate::server::{Pairs, Problem, check_origin, since_1970};

/// State of the handlers.
#[derive(Clone)]
pub struct RoomsContext {
    pub rooms: Arc<Rooms>,
    pub stop: CancellationToken,
    /// Whether a request comes from this machine's own user.
    pub own: Arc<dyn Fn(&HeaderMap) -> bool + Send + Sync>,
}

impl RoomsContext {
    /// Checks query, access and name. Pages of other sites may watch only with a token, because a browser sends requests for any page; they
    /// never publish.
    pub(super) async fn check(&self, room: &str, grant: Grant, uri: &Uri, headers: &HeaderMap) -> Result<RoomAccess, Problem> {
        let query = Pairs::read(uri, &["token"])?;
        let same_site = check_origin(headers);
        if grant == Grant::Publish {
            same_site.clone()?;
        }
        let token = query.get("token").or_else(|| token_in_headers(headers));
        let access = match (&self.rooms.key, token, self.rooms.nodes.get()) {
            (_, Some(token), Some(nodes)) if grant == Grant::Watch && nodes.admits(room, token).await => Some(RoomAccess::Node),
            (Some(key), Some(token), _) => {
                token_expiry(key, grant, room, token, since_1970().as_secs()).map(|ends| RoomAccess::Until(deadline(ends)))
            }
            _ => (same_site.is_ok() && (self.own)(headers)).then_some(RoomAccess::Until(None)),
        };
        let access = access.ok_or_else(|| Problem::new(StatusCode::FORBIDDEN, "token", "this room requires a token").field("token"))?;
        if !is_name(room) {
            return Err(Problem::not_found("a room's name has letters, digits, - and _"));
        }
        Ok(access)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RoomAccess {
    /// Until a token ends; `None` for this machine's own user.
    Until(Option<Instant>),
    Node,
}

impl RoomAccess {
    /// When it ends. Other nodes have their access for as long as they read, because they check their own viewers.
    pub fn ends(self) -> Option<Instant> {
        match self {
            Self::Until(ends) => ends,
            Self::Node => None,
        }
    }
}

/// The instant at which a token ends; `None` if it is too far in the future.
fn deadline(ends: u64) -> Option<Instant> {
    Instant::now().checked_add(Duration::from_secs(ends.saturating_sub(since_1970().as_secs())))
}

/// Reason for closing a socket whose token has ended.
pub(super) const ENDED: &str = "the token has expired";

/// Completes at `at`; never without one.
pub(super) async fn ended(at: Option<Instant>) {
    match at {
        Some(at) => tokio::time::sleep_until(at).await,
        None => std::future::pending().await,
    }
}

pub(super) fn none_publishes() -> Problem {
    Problem::not_found("the room has no publisher")
}

pub(super) fn busy() -> Problem {
    Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", "the limit of rooms is reached").retry_after(5)
}
