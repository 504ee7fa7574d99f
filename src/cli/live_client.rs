//! What `tmpi live publish` and `tmpi live watch` share: the program as a client of a room.

use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, bail};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async_with_config};

use tmpi_core::live::MAX_MESSAGE;

pub(super) type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

/// Connects to a room by the address of its page or of the room itself.
pub(super) async fn connect(room: &str, what: &str, token: Option<&str>) -> anyhow::Result<Socket> {
    let (host, path) = room.strip_prefix("http://").and_then(|r| r.split_once('/')).context("a room's address is http://HOST/live/ROOM")?;
    let name = path.trim_end_matches('/').rsplit('/').next().unwrap_or_default();
    let token = token.map_or(String::new(), |t| format!("?token={t}"));
    let mut config = WebSocketConfig::default();
    config.max_message_size = Some(MAX_MESSAGE);
    config.max_frame_size = Some(MAX_MESSAGE);
    match connect_async_with_config(format!("ws://{host}/v1/live/{name}/{what}{token}"), Some(config), true).await {
        Ok((socket, _)) => Ok(socket),
        Err(tungstenite::Error::Http(answer)) => {
            let body = answer.body().as_deref().map(String::from_utf8_lossy).unwrap_or_default().into_owned();
            bail!("the server answers {}: {body}", answer.status())
        }
        Err(error) => Err(error).context("connecting to the room"),
    }
}

/// This machine's clock in microseconds.
pub(super) fn micros() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_micros() as u64)
}
