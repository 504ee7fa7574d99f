//! Follows a photo's progress by server-sent events.

use std::time::Duration;

use reqwest::header::ACCEPT;
use reqwest::{Method, Response};
use tokio::time::{Instant, sleep};

use crate::photos::photo_path;
use crate::request::{Call, read_answer};
use crate::{Client, Error, PhotoState, Progress, State};

/// Pause before the client reads the state again after the event stream ends.
const PAUSE: Duration = Duration::from_millis(500);
/// Largest accepted event in bytes; the server's events are far smaller.
const MAX_EVENT_BYTES: usize = 1 << 20;

/// An event's name and data.
type Event = (String, String);

/// Splits a stream into events.
#[derive(Default)]
struct Reader {
    buffer: Vec<u8>,
}

impl Reader {
    /// Appends `bytes` and returns the events that are now complete.
    fn take(&mut self, bytes: &[u8]) -> Result<Vec<Event>, Error> {
        self.buffer.extend_from_slice(bytes);
        let mut events = Vec::new();
        while let Some(end) = self.buffer.windows(2).position(|w| w == b"\n\n") {
            let text = String::from_utf8_lossy(&self.buffer[..end]).into_owned();
            self.buffer.drain(..end + 2);
            let field = |name: &str| {
                let lines = text.lines().filter_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
                lines.map(|value| value.strip_prefix(' ').unwrap_or(value)).collect::<Vec<_>>().join("\n")
            };
            let (name, data) = (field("event"), field("data"));
            // comments have no event name; the server sends them to keep the connection alive
            if !name.is_empty() {
                events.push((name, data));
            }
        }
        if self.buffer.len() > MAX_EVENT_BYTES { Err(Error::Answer("an event is too long".into())) } else { Ok(events) }
    }
}

impl Client {
    /// Waits until the server has processed a photo, and calls `progress` at each stage. Waits as long as the server works on it; if the
    /// server cannot be reached, gives up after [`Client::patience`].
    ///
    /// # Errors
    /// [`Error::Photo`] if the photo failed or is damaged; otherwise [`Error`].
    pub async fn finished(&self, id: &str, mut progress: impl FnMut(&Progress)) -> Result<PhotoState, Error> {
        let mut last_contact = Instant::now();
        loop {
            let followed = match self.send(&Call::new(Method::GET, photo_path(id, "/events")).header(ACCEPT, "text/event-stream")?).await {
                Ok(response) if response.status().is_success() => self.follow(response, &mut progress).await,
                // too many listeners, or the photo was deleted: the state below tells which
                Ok(response) => read_answer(response).await.map(drop),
                Err(error) => Err(error),
            };
            if followed.is_ok() {
                last_contact = Instant::now();
            }
            let state = self.photo(id).await?.sound()?;
            if state.state == State::Done {
                return Ok(state);
            }
            if let Err(error) = followed
                && last_contact.elapsed() > self.patience
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
    fn events_do_not_depend_on_chunk_sizes() {
        let text = ": hello\n\nevent: queued\ndata: {\"position\": 3}\n\nevent:stage\ndata:a\ndata: b\n\n:\n\nevent: done\ndata: {}\n\n";
        let whole = Reader::default().take(text.as_bytes()).unwrap();
        let named = |n: &str, d: &str| (n.to_owned(), d.to_owned());
        assert_eq!(whole, [named("queued", "{\"position\": 3}"), named("stage", "a\nb"), named("done", "{}")]);
        for size in 1..text.len() {
            let mut reader = Reader::default();
            let cut: Vec<Event> = text.as_bytes().chunks(size).flat_map(|piece| reader.take(piece).unwrap()).collect();
            assert_eq!(cut, whole, "in chunks of {size}");
        }
        assert!(Reader::default().take(&vec![b'x'; MAX_EVENT_BYTES + 1]).is_err());
    }
}
