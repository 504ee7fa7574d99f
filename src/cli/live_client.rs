//! The client of a room, which `tmpi live publish` and `tmpi live watch` share.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::Context as _;
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::http::StatusCode;
use tokio_tungstenite::tungstenite::http::header::AUTHORIZATION;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async_with_config};

use tmpi_core::live::MAX_MESSAGE;

pub(super) type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

/// Timeout for connecting to one address.
const ANSWER: Duration = Duration::from_secs(3);
/// Precedes the token in the URL of a page.
const FRAGMENT: &str = "#token=";

/// The URLs of a room at one or several nodes, tried one after another.
pub(super) struct Addresses<'a> {
    all: &'a [String],
    token: Option<&'a str>,
    at: usize,
}

impl<'a> Addresses<'a> {
    /// Takes the URLs of the room's pages, or of the room itself. Each may end in `#token=` and a token.
    pub(super) const fn new(all: &'a [String], token: Option<&'a str>) -> Self {
        Self { all, token, at: 0 }
    }

    pub(super) const fn are_several(&self) -> bool {
        self.all.len() > 1
    }

    /// Moves on to the next URL; the current one comes last.
    pub(super) fn go_on(&mut self) {
        self.at = (self.at + 1) % self.all.len().max(1);
    }

    /// Connects to the first URL that accepts the connection.
    ///
    /// # Errors
    /// [`Unreached`] if none does.
    pub(super) async fn connect(&mut self, what: &str) -> Result<Socket, Unreached> {
        let mut unreached = Unreached { nobody: true, error: anyhow::anyhow!("no address") };
        for _ in 0..self.all.len() {
            match timeout(ANSWER, connect(&self.all[self.at], what, self.token)).await {
                Ok(Ok(socket)) => return Ok(socket),
                Ok(Err(Unreached { nobody, error })) => unreached = Unreached { nobody: nobody && unreached.nobody, error },
                Err(_) => unreached = Unreached { nobody: false, error: anyhow::anyhow!("{} does not answer", self.all[self.at]) },
            }
            self.go_on();
        }
        Err(unreached)
    }
}

/// Why no URL accepted the connection.
pub(super) struct Unreached {
    /// Every node answered that the room has no publisher.
    pub(super) nobody: bool,
    /// The error of the last URL.
    pub(super) error: anyhow::Error,
}

impl From<anyhow::Error> for Unreached {
    fn from(error: anyhow::Error) -> Self {
        Self { nobody: false, error }
    }
}

/// Connects to a room by the URL of its page or of the room itself. The token goes into a header, because servers log URLs.
async fn connect(room: &str, what: &str, token: Option<&str>) -> Result<Socket, Unreached> {
    let (room, own) = room.split_once(FRAGMENT).map_or((room, None), |(room, token)| (room, Some(token)));
    let (socket, address) = match room.strip_prefix("https://") {
        Some(address) => ("wss", Some(address)),
        None => ("ws", room.strip_prefix("http://")),
    };
    let (host, path) = address.and_then(|a| a.split_once('/')).context("a room's address is https://HOST/live/ROOM, or http://")?;
    let path = path.trim_end_matches('/');
    let name = path.strip_suffix("/publish").unwrap_or(path).rsplit('/').next().unwrap_or_default();
    let mut request = format!("{socket}://{host}/v1/live/{name}/{what}").into_client_request().context("a room's address")?;
    if let Some(token) = token.or(own) {
        request.headers_mut().insert(AUTHORIZATION, format!("Bearer {token}").parse().context("the token is malformed")?);
    }
    let mut config = WebSocketConfig::default();
    config.max_message_size = Some(MAX_MESSAGE);
    config.max_frame_size = Some(MAX_MESSAGE);
    match connect_async_with_config(request, Some(config), true).await {
        Ok((socket, _)) => Ok(socket),
        Err(tungstenite::Error::Http(answer)) => {
            let body = answer.body().as_deref().map(String::from_utf8_lossy).unwrap_or_default().into_owned();
            let nobody = answer.status() == StatusCode::NOT_FOUND;
            Err(Unreached { nobody, error: anyhow::anyhow!("the server answers {}: {body}", answer.status()) })
        }
        Err(error) => Err(anyhow::Error::from(error).context("connecting to the room").into()),
    }
}

/// Unix time in microseconds.
pub(super) fn micros() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_micros() as u64)
}
