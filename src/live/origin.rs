//! Which node has a room: its origin, the node that its publisher is connected to, as a row of the library with a lease.
//!
//! A publisher that comes to another node takes the room there at once, with a higher epoch; the lease only tells how long a node counts that has
//! died. Leases and credentials go by the database's clock, never by a node's.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use axum::body::Body;
use axum::http::uri::{Scheme, Uri};
use axum::http::{HeaderMap, Response, StatusCode, header};
use tmpi_library::{Claim, Grant, Library, LibraryError, Link, Origin, Subject};
use tokio::time::{sleep, timeout};
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async_with_config};
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

use tmpi_core::live::MAX_MESSAGE;

use super::edge::EdgeError;
use super::here::none_publishes;
use crate::server::Problem;

/// How long a room is a node's that says nothing more, and how often a node says that it has it.
const LEASE: Duration = Duration::from_secs(5);
const RENEW: Duration = Duration::from_secs(1);
/// How long a credential of a node is good, which is for opening a connection at once.
const CREDENTIAL: Duration = Duration::from_mins(1);
/// Time that an origin has to answer, and longest silence while it does.
const CONNECT: Duration = Duration::from_secs(1);
const READ: Duration = Duration::from_secs(15);

/// Address at which other nodes reach this one: `http://HOST[:PORT]`, or `https://`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeAddress {
    url: String,
    host: String,
}

impl FromStr for NodeAddress {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let read = || {
            let uri: Uri = text.parse().ok()?;
            let scheme = uri.scheme().filter(|s| **s == Scheme::HTTP || **s == Scheme::HTTPS)?;
            let authority = uri.authority().filter(|a| !a.as_str().contains('@') && !a.host().is_empty())?;
            let alone = uri.path_and_query().is_none_or(|p| p.as_str() == "/");
            alone.then(|| Self { url: format!("{scheme}://{authority}"), host: authority.host().to_owned() })
        };
        read().ok_or("an address is http://HOST:PORT or https://HOST:PORT")
    }
}

impl fmt::Display for NodeAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.url)
    }
}

impl NodeAddress {
    /// Its host, as other nodes say it in `Host`.
    #[must_use]
    pub fn host(&self) -> &str {
        &self.host
    }
}

/// A socket to an origin.
pub type Socket = WebSocketStream<MaybeTlsStream<tokio::net::TcpStream>>;

/// This node among others.
pub struct Nodes {
    library: Library,
    address: NodeAddress,
    http: reqwest::Client,
    /// Set when the server stops.
    pub stop: CancellationToken,
}

impl Nodes {
    /// This node, which others reach at `address`.
    ///
    /// # Errors
    /// The system's certificates cannot be read.
    pub fn new(library: Library, address: NodeAddress, stop: CancellationToken) -> Result<Self, reqwest::Error> {
        // one that a program has chosen already stays
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::Client::builder().no_proxy().redirect(reqwest::redirect::Policy::none());
        let http = http.connect_timeout(CONNECT).read_timeout(READ).build()?;
        Ok(Self { library, address, http, stop })
    }

    /// Takes a room for this node, from whichever node has it.
    ///
    /// # Errors
    /// The database cannot be reached.
    pub async fn claim(&self, room: &str) -> Result<Lease, LibraryError> {
        let origin = self.library.claim_room(room, &self.address.url, Claim::TakeOver, LEASE).await?;
        let (library, room, lost) = (self.library.clone(), room.to_owned(), CancellationToken::new());
        let renewal = tokio::spawn(renew(library.clone(), room.clone(), origin.clone(), lost.clone()));
        Ok(Lease { library, room, origin, lost, renewal: AbortOnDropHandle::new(renewal) })
    }

    /// The other node that has a room; none where there is none.
    ///
    /// # Errors
    /// The database cannot be reached.
    pub async fn origin(&self, room: &str) -> Result<Option<Origin>, LibraryError> {
        Ok(self.library.room(room).await?.filter(|origin| origin.address != self.address.url))
    }

    /// Whether a token is another node's for a room.
    pub async fn admits(&self, room: &str, token: &str) -> bool {
        let Ok(link) = token.parse::<Link>() else { return false };
        match self.library.now().await {
            Ok(now) => self.library.secret().allows(Grant::Relay, Subject::Room(room), &link, now),
            Err(error) => {
                tracing::warn!(%error, "another node cannot be told from a stranger");
                false
            }
        }
    }

    /// What this node shows to the origin of a room.
    async fn bearer(&self, room: &str) -> Result<String, LibraryError> {
        let expires = self.library.now().await?.max(0) as u64 / 1000 + CREDENTIAL.as_secs();
        Ok(format!("Bearer {}", self.library.secret().sign(Grant::Relay, Subject::Room(room), expires)))
    }

    /// Subscribes to a room at its origin, as a viewer does.
    ///
    /// # Errors
    /// It does not let in.
    pub async fn subscribe(&self, origin: &Origin, room: &str) -> Result<Socket, EdgeError> {
        let address = origin.address.strip_prefix("http").ok_or(EdgeError::Address)?;
        let mut request = format!("ws{address}/v1/live/{room}/subscribe").into_client_request()?;
        let bearer = self.bearer(room).await?.parse().map_err(|_| EdgeError::Address)?;
        request.headers_mut().insert(header::AUTHORIZATION, bearer);
        let config = WebSocketConfig::default().max_message_size(Some(MAX_MESSAGE)).max_frame_size(Some(MAX_MESSAGE));
        let (socket, _) =
            timeout(CONNECT, connect_async_with_config(request, Some(config), true)).await.map_err(|_| EdgeError::Silent)??;
        Ok(socket)
    }

    /// The origin's answer to a request by plain HTTP, by a path below the room's.
    ///
    /// # Errors
    /// 404 where the origin says so, 503 where it does not answer.
    pub async fn fetch(&self, origin: &Origin, room: &str, path: &str, headers: HeaderMap) -> Result<Response<Body>, Problem> {
        let silent = |error: &dyn fmt::Display| {
            tracing::warn!(%error, origin = origin.address, room, "the origin of a room");
            let detail = "the node that has the room's publisher does not answer";
            Problem::new(StatusCode::SERVICE_UNAVAILABLE, "elsewhere", detail).retry_after(1)
        };
        let bearer = self.bearer(room).await.map_err(|e| silent(&e))?;
        let request =
            self.http.get(format!("{}/v1/live/{room}{path}", origin.address)).headers(headers).header(header::AUTHORIZATION, bearer);
        let answer = request.send().await.map_err(|e| silent(&e))?;
        match answer.status() {
            StatusCode::NOT_FOUND => Err(none_publishes()),
            status if status.is_client_error() || status.is_server_error() => Err(silent(&status)),
            _ => Ok(Response::from(answer).map(Body::new)),
        }
    }
}

/// Renews the lease of a room until it is lost.
async fn renew(library: Library, room: String, origin: Origin, lost: CancellationToken) {
    loop {
        sleep(RENEW).await;
        match library.renew_room(&room, &origin, LEASE).await {
            Ok(()) => {}
            Err(LibraryError::LeaseLost) => return lost.cancel(),
            // the room goes on: nobody takes it but for a publisher
            Err(error) => tracing::warn!(%error, room, "the lease of a room is not renewed"),
        }
    }
}

/// A room that is this node's.
pub struct Lease {
    library: Library,
    room: String,
    origin: Origin,
    /// Set when another node has taken it.
    lost: CancellationToken,
    renewal: AbortOnDropHandle<()>,
}

impl Lease {
    /// Higher than that of whichever node had the room before: milliseconds of the database, which go on faster than the epochs that a change of
    /// the pictures' size begins.
    pub const fn epoch(&self) -> u64 {
        self.origin.epoch.cast_unsigned()
    }

    /// Gives the room back, unless it is another's already.
    pub async fn release(self) {
        self.renewal.abort();
        match self.library.release_room(&self.room, &self.origin).await {
            Ok(()) | Err(LibraryError::LeaseLost) => {}
            Err(error) => tracing::warn!(%error, room = self.room, "a room is not given back"),
        }
    }
}

/// Ready when a lease is lost; never without one.
pub async fn lost(lease: Option<&Lease>) {
    match lease {
        Some(lease) => lease.lost.cancelled().await,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_has_a_host_and_nothing_behind_it() {
        let of = |text: &str| text.parse::<NodeAddress>().ok().map(|a| (a.to_string(), a.host().to_owned()));
        let known = |url: &str, host: &str| Some((url.to_owned(), host.to_owned()));
        assert_eq!(of("http://10.0.0.3:8080"), known("http://10.0.0.3:8080", "10.0.0.3"));
        assert_eq!(of("https://node-1.tmpi/"), known("https://node-1.tmpi", "node-1.tmpi"));
        assert_eq!(of("http://[fd00::1]:8080"), known("http://[fd00::1]:8080", "[fd00::1]"));
        for wrong in ["", "10.0.0.3:8080", "ftp://a", "http://", "http://me:secret@a", "http://a/path", "http://a?b", "http://a b"] {
            assert_eq!(of(wrong), None, "{wrong}");
        }
    }
}
