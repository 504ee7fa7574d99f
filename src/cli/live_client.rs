//! The client of a room, which `tmpi live publish` and `tmpi live watch` share.

use std::time::{Duration, Instant};

use anyhow::Context as _;
use bytes::Bytes;
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::http::StatusCode;
use tokio_tungstenite::tungstenite::http::header::AUTHORIZATION;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{self, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async_with_config};

use tmpi_core::live::MAX_MESSAGE;

use super::note;
use crate::server::since_1970;

pub(super) type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

/// Timeout for connecting to one address.
const ANSWER: Duration = Duration::from_secs(3);
/// Pause before connecting again after the connection broke.
pub(super) const AGAIN: Duration = Duration::from_millis(200);
/// How long to try without a frame, and how long while every node says that the room has no publisher.
const PATIENCE: Duration = Duration::from_secs(30);
const COME_BACK: Duration = Duration::from_secs(10);
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

    /// Runs `session` on a connection for `what`; when it ends, on one to the next URL, until it returns `None`, it must not come back, or
    /// no frame has come for [`PATIENCE`].
    ///
    /// # Errors
    /// [`Unreached`] if the first connection fails or the time is over; the error of a session.
    pub(super) async fn sessions(
        &mut self,
        what: &str,
        mut session: impl AsyncFnMut(Socket) -> anyhow::Result<Option<SessionEnd>>,
    ) -> Result<(), Unreached> {
        // since when no frame has come, and the last reason, so that each is printed once
        let (mut since, mut told) = (None::<Instant>, String::new());
        loop {
            let (lost, again) = match self.connect(what).await {
                Ok(socket) => {
                    let Some(SessionEnd { error, again, progress }) = session(socket).await? else { return Ok(()) };
                    if progress {
                        since = None;
                        told.clear();
                    }
                    self.go_on();
                    (Unreached::from(error), again)
                }
                Err(unreached) if since.is_none() => return Err(unreached),
                Err(unreached) => (unreached, Some(AGAIN)),
            };
            let reason = format!("{:#}", lost.error);
            if reason != told {
                note(&format!("tmpi live: {reason}"));
                told = reason;
            }
            let Some(pause) = again else { return Ok(()) };
            let patience = if lost.no_publisher { COME_BACK } else { PATIENCE };
            if since.get_or_insert_with(Instant::now).elapsed() > patience {
                return Err(lost);
            }
            sleep(pause).await;
        }
    }

    fn go_on(&mut self) {
        self.at = (self.at + 1) % self.all.len().max(1);
    }

    /// Connects to the first URL that accepts the connection.
    async fn connect(&mut self, what: &str) -> Result<Socket, Unreached> {
        let mut unreached = Unreached { no_publisher: true, error: anyhow::anyhow!("no address") };
        for _ in 0..self.all.len() {
            match timeout(ANSWER, connect(&self.all[self.at], what, self.token)).await {
                Ok(Ok(socket)) => return Ok(socket),
                Ok(Err(other)) => unreached = Unreached { no_publisher: other.no_publisher && unreached.no_publisher, ..other },
                Err(_) => unreached = Unreached { no_publisher: false, error: anyhow::anyhow!("{} does not answer", self.all[self.at]) },
            }
            self.go_on();
        }
        Err(unreached)
    }
}

pub(super) struct SessionEnd {
    pub(super) error: anyhow::Error,
    /// Pause before the next session; `None` if there must be none.
    pub(super) again: Option<Duration>,
    /// Frames were sent or came.
    pub(super) progress: bool,
}

/// The bytes of a message; `None` if it is a ping.
pub(super) fn received(came: Option<Result<Message, tungstenite::Error>>) -> anyhow::Result<Option<Bytes>> {
    match came {
        Some(Ok(Message::Binary(bytes))) => Ok(Some(bytes)),
        Some(Ok(Message::Ping(_) | Message::Pong(_))) => Ok(None),
        Some(Err(error)) => Err(anyhow::Error::from(error).context("the connection broke")),
        _ => Err(anyhow::anyhow!("the server has closed the connection")),
    }
}

/// Why no URL accepted the connection.
pub(super) struct Unreached {
    /// Every node answered that the room has no publisher.
    pub(super) no_publisher: bool,
    pub(super) error: anyhow::Error,
}

impl From<anyhow::Error> for Unreached {
    fn from(error: anyhow::Error) -> Self {
        Self { no_publisher: false, error }
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
    let config = WebSocketConfig::default().max_message_size(Some(MAX_MESSAGE)).max_frame_size(Some(MAX_MESSAGE));
    match connect_async_with_config(request, Some(config), true).await {
        Ok((socket, _)) => Ok(socket),
        Err(tungstenite::Error::Http(answer)) => {
            let body = answer.body().as_deref().map(String::from_utf8_lossy).unwrap_or_default().into_owned();
            let no_publisher = answer.status() == StatusCode::NOT_FOUND;
            Err(Unreached { no_publisher, error: anyhow::anyhow!("the server answers {}: {body}", answer.status()) })
        }
        Err(error) => Err(anyhow::Error::from(error).context("connecting to the room").into()),
    }
}

/// Unix time in microseconds.
pub(super) fn micros() -> u64 {
    since_1970().as_micros() as u64
}
