//! How a node reaches the origin of a room, the node to which its publisher is connected.
//!
//! Credentials use the database's clock, never a node's.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use axum::http::uri::{Scheme, Uri};
use axum::http::{HeaderMap, Response, StatusCode, header};
use tmpi_library::{Grant, Library, LibraryError, Link, Origin, Subject};
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async_with_config};
use tokio_util::sync::CancellationToken;

use tmpi_core::live::MAX_MESSAGE;

use super::edge::EdgeError;
use super::gop_store::Group;
use super::group_relay::GroupRelay;
use super::request_access::none_publishes;
use crate::server::Problem;

/// Lifetime of a node's credential, which opens one connection.
const CREDENTIAL: Duration = Duration::from_mins(1);
/// Timeout for connecting to an origin, and for reading from it.
const CONNECT: Duration = Duration::from_secs(1);
const READ: Duration = Duration::from_secs(15);

/// URL at which other nodes reach this one: `http://HOST[:PORT]`, or `https://`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeAddress {
    pub(super) url: String,
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
    /// Its host, as in the `Host` header of other nodes.
    pub fn host(&self) -> &str {
        &self.host
    }
}

pub type Socket = WebSocketStream<MaybeTlsStream<tokio::net::TcpStream>>;

/// This node's access to the other nodes.
pub struct Nodes {
    pub(super) library: Library,
    pub(super) address: NodeAddress,
    http: reqwest::Client,
    groups: Arc<GroupRelay>,
    pub stop: CancellationToken,
}

impl Nodes {
    pub fn new(library: Library, address: NodeAddress, stop: CancellationToken) -> Result<Self, reqwest::Error> {
        // fails if the program has installed one already
        let _ = rustls::crypto::ring::default_provider().install_default();
        let http = reqwest::Client::builder().no_proxy().redirect(reqwest::redirect::Policy::none());
        let http = http.connect_timeout(CONNECT).read_timeout(READ).build()?;
        Ok(Self { library, address, http, groups: Arc::default(), stop })
    }

    /// Whether a token is another node's credential for a room.
    pub async fn admits(&self, room: &str, token: &str) -> bool {
        let Ok(link) = token.parse::<Link>() else { return false };
        let allows = |now| self.library.secret().allows(Grant::Relay, Subject::Room(room), &link, now);
        // a forged one must not cost a look at the database's clock
        if !allows(0) {
            return false;
        }
        match self.library.now().await {
            Ok(now) => allows(now),
            Err(error) => {
                tracing::warn!(%error, "cannot check another node's credential");
                false
            }
        }
    }

    /// This node's credential for the origin of a room.
    async fn bearer(&self, room: &str) -> Result<String, LibraryError> {
        let expires = self.library.now().await?.max(0) as u64 / 1000 + CREDENTIAL.as_secs();
        Ok(format!("Bearer {}", self.library.secret().sign(Grant::Relay, Subject::Room(room), expires)))
    }

    /// Subscribes to a room at its origin, as a viewer does.
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

    /// A group of pictures of a room from its origin, as it arrives. Viewers that want the same group share one request.
    ///
    /// # Errors
    /// As [`Self::fetch`].
    pub async fn group(self: Arc<Self>, origin: Origin, room: String, group: Group) -> Result<Body, Problem> {
        let (relay, key) = (Arc::clone(&self.groups), (room.clone(), group));
        let fetch = async move { self.fetch(&origin, &room, &format!("/gops/{group}"), HeaderMap::new()).await };
        relay.get(key, fetch).await
    }

    /// Sends an HTTP request to the origin, with a path relative to the room's.
    ///
    /// # Errors
    /// 404 if the origin answers so, with its `Retry-After`; 503 if it does not answer.
    pub async fn fetch(&self, origin: &Origin, room: &str, path: &str, headers: HeaderMap) -> Result<Response<Body>, Problem> {
        let silent = |error: &dyn fmt::Display| {
            tracing::warn!(%error, origin = origin.address, room, "the origin of a room does not answer");
            let detail = "the node that has the room's publisher does not answer";
            Problem::new(StatusCode::SERVICE_UNAVAILABLE, "elsewhere", detail).retry_after(1)
        };
        let bearer = self.bearer(room).await.map_err(|e| silent(&e))?;
        let request =
            self.http.get(format!("{}/v1/live/{room}{path}", origin.address)).headers(headers).header(header::AUTHORIZATION, bearer);
        let answer = request.send().await.map_err(|e| silent(&e))?;
        match answer.status() {
            StatusCode::NOT_FOUND => Err(not_there(answer.headers())),
            status if status.is_client_error() || status.is_server_error() => Err(silent(&status)),
            _ => Ok(Response::from(answer).map(Body::new)),
        }
    }
}

/// An origin's answer that it does not have something. If it may have it soon, it says when to ask again.
fn not_there(headers: &HeaderMap) -> Problem {
    let again = headers.get(header::RETRY_AFTER).and_then(|value| value.to_str().ok()?.parse().ok());
    again.map_or_else(none_publishes, |seconds| Problem::not_found("the room's node does not have it").retry_after(seconds))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_origin_says_when_to_ask_again() {
        let after = |text: &'static str| not_there(&HeaderMap::from_iter([(header::RETRY_AFTER, text.parse().unwrap())]));
        assert_eq!((after("3").status, after("3").retry_after), (404, Some(3)));
        for none in [after("soon"), after("-1"), not_there(&HeaderMap::new())] {
            assert_eq!(none, none_publishes());
        }
    }

    #[test]
    fn a_node_address_has_a_host_and_no_path() {
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
