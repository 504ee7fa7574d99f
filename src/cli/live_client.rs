//! What `tmpi live publish` and `tmpi live watch` share: the program as a client of a room.

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

/// Time that an address has to answer.
const ANSWER: Duration = Duration::from_secs(3);
/// What a page's address has before a token.
const FRAGMENT: &str = "#token=";

/// Addresses of a room, at one node or several, of which one is tried after the other.
pub(super) struct Addresses<'a> {
    all: &'a [String],
    token: Option<&'a str>,
    at: usize,
}

impl<'a> Addresses<'a> {
    /// Of a room's pages, or of the room itself; a token may stand behind `#token=` in them.
    pub(super) const fn new(all: &'a [String], token: Option<&'a str>) -> Self {
        Self { all, token, at: 0 }
    }

    /// Whether there are several.
    pub(super) const fn are_several(&self) -> bool {
        self.all.len() > 1
    }

    /// Leaves the one that was tried last for the end.
    pub(super) fn go_on(&mut self) {
        self.at = (self.at + 1) % self.all.len().max(1);
    }

    /// Connects to the first that lets in.
    ///
    /// # Errors
    /// [`Unreached`], where none does.
    pub(super) async fn connect(&mut self, what: &str) -> Result<Socket, Unreached> {
        let mut unreached = Unreached { nobody: true, error: anyhow::anyhow!("there is no address") };
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

/// Why no address of a room lets in.
pub(super) struct Unreached {
    /// All of them know of no publisher.
    pub(super) nobody: bool,
    /// What the last one said.
    pub(super) error: anyhow::Error,
}

impl From<anyhow::Error> for Unreached {
    fn from(error: anyhow::Error) -> Self {
        Self { nobody: false, error }
    }
}

/// Connects to a room by the address of its page or of the room itself. A token goes into a header: addresses are written into logs.
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
        request.headers_mut().insert(AUTHORIZATION, format!("Bearer {token}").parse().context("a token that is none")?);
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

/// This machine's clock in microseconds.
pub(super) fn micros() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_micros() as u64)
}
