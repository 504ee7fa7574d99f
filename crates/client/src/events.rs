//! Progress of a photo as server-sent events.

use std::time::Duration;

use reqwest::{Method, Response};
use serde::Deserialize;

use crate::client::within;
use crate::{Client, Error, PhotoState, Problem, Progress};

/// Bytes of one event, at most.
const EVENT: usize = 1 << 20;

/// What happens to a photo.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Event {
    /// It waits.
    Queued {
        /// Photos that are made before it.
        position: usize,
    },
    /// It enters a stage.
    Stage(Progress),
    /// It is made.
    Done(Box<PhotoState>),
    /// It could not be made.
    Failed(Box<Problem>),
    /// It is no longer on disk as it was.
    Damaged(Box<Problem>),
    /// It was deleted.
    Deleted,
}

#[derive(Deserialize)]
struct Position {
    position: usize,
}

/// A stream of events, until the photo is made or will not be.
#[derive(Debug)]
pub struct Events {
    response: Response,
    parser: Parser,
    patience: Duration,
}

impl Events {
    /// The next event; none where the stream ends – after the last, or before it where the server stops.
    ///
    /// # Errors
    /// The connection broke, was silent for too long, or brought what is no event.
    pub async fn next(&mut self) -> Result<Option<Event>, Error> {
        loop {
            while let Some((name, data)) = self.parser.next() {
                if let Some(event) = understood(&name, &data)? {
                    return Ok(Some(event));
                }
            }
            let Some(chunk) = within(self.patience, self.response.chunk()).await?? else { return Ok(None) };
            self.parser.buffer.extend_from_slice(&chunk);
            if self.parser.buffer.len() > EVENT {
                return Err(Error::TooLarge(EVENT));
            }
        }
    }
}

/// Blocks that end with an empty line, with line ends as this server writes them (LF) or CRLF.
#[derive(Debug, Default)]
struct Parser {
    buffer: Vec<u8>,
}

impl Parser {
    /// Name and data of the next whole event; comments have neither.
    fn next(&mut self) -> Option<(String, String)> {
        let (mut line_start, mut name, mut data) = (0, String::new(), Vec::new());
        loop {
            let end = line_start + self.buffer[line_start..].iter().position(|b| *b == b'\n')?;
            let line = String::from_utf8_lossy(&self.buffer[line_start..end]);
            let line = line.strip_suffix('\r').unwrap_or(&line);
            let (field, value) = line.split_once(':').unwrap_or((line, ""));
            let value = value.strip_prefix(' ').unwrap_or(value);
            match field {
                "event" => value.clone_into(&mut name),
                "data" => data.push(value.to_owned()),
                _ => {}
            }
            let last = line.is_empty();
            line_start = end + 1;
            if last {
                self.buffer.drain(..line_start);
                return Some((name, data.join("\n")));
            }
        }
    }
}

/// The event of this name; none for comments and those of later servers.
fn understood(name: &str, data: &str) -> Result<Option<Event>, Error> {
    fn read<T: serde::de::DeserializeOwned>(data: &str) -> Result<T, Error> {
        serde_json::from_str(data).map_err(|e| Error::Answer(format!("an event: {e}")))
    }
    Ok(match name {
        "queued" => Some(Event::Queued { position: read::<Position>(data)?.position }),
        "stage" => Some(Event::Stage(read(data)?)),
        "done" => Some(Event::Done(Box::new(read(data)?))),
        "failed" => Some(Event::Failed(Box::new(read(data)?))),
        "damaged" => Some(Event::Damaged(Box::new(read(data)?))),
        "deleted" => Some(Event::Deleted),
        _ => None,
    })
}

impl Client {
    /// Progress of a photo. Whoever comes late is told the last event first.
    ///
    /// # Errors
    /// [`Error::Refused`]: there is no such photo (404), too many streams are open (503).
    pub async fn events(&self, id: &str) -> Result<Events, Error> {
        let call = self.photo(Method::GET, id, "/events")?;
        Ok(Events { response: self.open(&call).await?, parser: Parser::default(), patience: call.patience })
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "test")]
mod tests {
    use super::*;

    #[test]
    fn events_come_whole_however_they_are_cut() {
        let text =
            ": hello\n\nevent: queued\ndata: {\"position\":\ndata: 3}\n\nevent: \u{e4}\r\ndata:x\r\n\r\nevent: deleted\ndata: {}\n\n";
        for cut in 1..text.len() {
            let mut parser = Parser::default();
            let mut seen = Vec::new();
            for part in text.as_bytes().chunks(cut) {
                parser.buffer.extend_from_slice(part);
                seen.extend(std::iter::from_fn(|| parser.next()));
            }
            let pair = |name: &str, data: &str| (name.to_owned(), data.to_owned());
            assert_eq!(seen, [pair("", ""), pair("queued", "{\"position\":\n3}"), pair("ä", "x"), pair("deleted", "{}")], "cut at {cut}");
            let events: Vec<_> = seen.iter().filter_map(|(name, data)| understood(name, data).unwrap()).collect();
            assert_eq!(events, [Event::Queued { position: 3 }, Event::Deleted]);
        }
        assert!(understood("queued", "3").is_err());
    }
}
