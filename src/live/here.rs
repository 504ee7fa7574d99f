//! Who may do what in the rooms of this node.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use axum::http::{HeaderMap, StatusCode, Uri};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::access::{Role, check_origin, end_of, token_of};
use super::{Rooms, is_name};
use crate::server::{Pairs, Problem};

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

impl Here {
    /// Checks query, leave and name. A token lets pages of other sites watch; without one they have no leave, as what a browser sends by itself
    /// says nothing of who wants it, and none of them publishes.
    pub(super) async fn check(&self, room: &str, role: Role, uri: &Uri, headers: &HeaderMap) -> Result<Leave, Problem> {
        let asked = Pairs::read(uri, &["token"])?;
        let same_site = check_origin(headers);
        if role == Role::Publish {
            same_site.clone()?;
        }
        let token = asked.get("token").or_else(|| token_of(headers));
        let leave = match (&self.rooms.config.key, token, self.rooms.nodes.get()) {
            (_, Some(token), Some(nodes)) if role == Role::Watch && nodes.admits(room, token).await => Some(Leave::Node),
            (Some(key), Some(token), _) => end_of(key, role, room, token, seconds()).map(|ends| Leave::Until(deadline(ends))),
            _ => (same_site.is_ok() && (self.own)(headers)).then_some(Leave::Until(None)),
        };
        let leave = leave.ok_or_else(|| Problem::new(StatusCode::FORBIDDEN, "token", "a token for this room is needed").field("token"))?;
        if !is_name(room) {
            return Err(Problem::not_found("a room's name has letters, digits, - and _"));
        }
        Ok(leave)
    }
}

/// What lets a request in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Leave {
    /// It is this machine's own user's, or has a token that ends then.
    Until(Option<Instant>),
    /// It is another node's.
    Node,
}

/// Seconds since 1970.
pub(super) fn seconds() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

/// When a token ends; none where that is never.
fn deadline(ends: u64) -> Option<Instant> {
    Instant::now().checked_add(Duration::from_secs(ends.saturating_sub(seconds())))
}

/// Why a socket ends with the token that it was opened by.
pub(super) const ENDED: &str = "the invitation has ended";

/// Ready at that time; never without one.
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
    Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", "there are as many rooms as may be").retry_after(5)
}
