//! Progress of a photo, as server-sent events.

use std::time::Duration;

use reqwest::header::ACCEPT;
use reqwest::{Method, Response};
use tokio::time::{Instant, sleep};

use crate::answer::{Call, take};
use crate::photos::part;
use crate::{Client, Error, PhotoState, Progress, State};

/// Pause before reading the state after events broke off.
const PAUSE: Duration = Duration::from_millis(500);
/// Bytes of an event; the server's are far smaller.
const MOST: usize = 1 << 20;

/// An event: its name and its data.
type Event = (String, String);

/// Splits a stream into events.
#[derive(Default)]
struct Reader {
    kept: Vec<u8>,
}

impl Reader {
    /// The events that `bytes` complete.
    fn take(&mut self, bytes: &[u8]) -> Result<Vec<Event>, Error> {
        self.kept.extend_from_slice(bytes);
        let mut events = Vec::new();
        while let Some(end) = self.kept.windows(2).position(|w| w == b"\n\n") {
            let text = String::from_utf8_lossy(&self.kept[..end]).into_owned();
            self.kept.drain(..end + 2);
            let field = |name: &str| {
                let lines = text.lines().filter_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
                lines.map(|value| value.strip_prefix(' ').unwrap_or(value)).collect::<Vec<_>>().join("\n")
            };
            let (name, data) = (field("event"), field("data"));
            // a comment keeps the connection alive
            if !name.is_empty() {
                events.push((name, data));
            }
        }
        if self.kept.len() > MOST { Err(Error::Answer("an event has no end".into())) } else { Ok(events) }
    }
}

impl Client {
    /// Waits until a photo is made; calls `progress` at each stage. Waits as long as the server works on it; if the server cannot be
    /// reached, for [`Client::patience`].
    ///
    /// # Errors
    /// [`Error::Photo`] if it could not be made; else [`Error`].
    pub async fn finished(&self, id: &str, mut progress: impl FnMut(&Progress)) -> Result<PhotoState, Error> {
        let mut heard = Instant::now();
        loop {
            let followed = match self.send(&Call::new(Method::GET, part(id, "/events")).header(ACCEPT, "text/event-stream")?).await {
                Ok(response) if response.status().is_success() => self.follow(response, &mut progress).await,
                // the server has too many listeners, or the photo was deleted: the state tells
                Ok(response) => take(response).await.map(drop),
                Err(error) => Err(error),
            };
            if followed.is_ok() {
                heard = Instant::now();
            }
            let state = self.photo(id).await?.sound()?;
            if state.state == State::Done {
                return Ok(state);
            }
            if let Err(error) = followed
                && heard.elapsed() > self.patience
            {
                return Err(error);
            }
            sleep(PAUSE).await;
        }
    }

    /// Reads events until the last one.
    async fn follow(&self, mut response: Response, progress: &mut impl FnMut(&Progress)) -> Result<(), Error> {
        let mut reader = Reader::default();
        while let Some(piece) = response.chunk().await.map_err(Error::Network)? {
            for (name, data) in reader.take(&piece)? {
                match name.as_str() {
                    "stage" => progress(&serde_json::from_str(&data).map_err(|e| Error::Answer(e.to_string()))?),
                    "done" | "failed" | "damaged" | "deleted" => return Ok(()),
                    _ => {}
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_the_same_however_they_are_cut() {
        let text = ": hello\n\nevent: queued\ndata: {\"position\": 3}\n\nevent:stage\ndata:a\ndata: b\n\n:\n\nevent: done\ndata: {}\n\n";
        let whole = Reader::default().take(text.as_bytes()).unwrap();
        let named = |n: &str, d: &str| (n.to_owned(), d.to_owned());
        assert_eq!(whole, [named("queued", "{\"position\": 3}"), named("stage", "a\nb"), named("done", "{}")]);
        for size in 1..text.len() {
            let mut reader = Reader::default();
            let cut: Vec<Event> = text.as_bytes().chunks(size).flat_map(|piece| reader.take(piece).unwrap()).collect();
            assert_eq!(cut, whole, "in pieces of {size}");
        }
        assert!(Reader::default().take(&vec![b'x'; MOST + 1]).is_err());
    }
}
