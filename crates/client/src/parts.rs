//! Uploads in parts (draft-ietf-httpbis-resumable-upload): what came through before the network failed is not sent again.

use bytes::Bytes;
use reqwest::header::{CONTENT_TYPE, COOKIE, HeaderMap, HeaderName, LOCATION, SET_COOKIE};
use reqwest::{Method, StatusCode};
use serde::Deserialize;
use tokio::time::{Instant, sleep};

use crate::answer::{Answer, Call, MOST_PAUSE, PAUSE, retry_after, take};
use crate::photos::{PREFER, Request};
use crate::{Client, Error, PhotoState, Upload};

const COMPLETE: HeaderName = HeaderName::from_static("upload-complete");
const OFFSET: HeaderName = HeaderName::from_static("upload-offset");
const LENGTH: HeaderName = HeaderName::from_static("upload-length");
/// Media type of a part.
const PART: &str = "application/partial-upload";

/// How far an upload is.
#[derive(Deserialize)]
struct Extent {
    offset: usize,
    /// Address of the photo that it became.
    photo: Option<String>,
}

/// An upload that was begun.
struct Begun {
    address: String,
    /// By which a proxy keeps all of its requests at one node.
    cookies: String,
}

impl Begun {
    fn call(&self, method: Method) -> Result<Call, Error> {
        let call = Call::new(method, self.address.clone());
        if self.cookies.is_empty() { Ok(call) } else { call.header(COOKIE, &self.cookies) }
    }
}

impl Client {
    /// Uploads a photo in parts of at most `part` bytes, a few MiB. Where the network or the server fails, it asks how much is there and goes on
    /// with that, until nothing more has come through for [`Client::patience`]. `progress` is told how many bytes are there, of how many. When
    /// this returns, the photo is on the server's disk, as after [`Client::upload`]; that is also what it does where the server takes no parts.
    ///
    /// # Errors
    /// As [`Client::upload`]. What came through is removed then, as far as the server can be told.
    pub async fn upload_in_parts(&self, upload: Upload, part: usize, mut progress: impl FnMut(usize, usize)) -> Result<PhotoState, Error> {
        let Request { path, kind, body, prefer } = upload.clone().request()?;
        let begin = Call::new(Method::POST, path).header(CONTENT_TYPE, &kind)?.header(COMPLETE, "?0")?;
        // of one that was begun twice, the other goes when its time is over
        let answer = match self.ask(begin.header(LENGTH, &body.len().to_string())?).await {
            Err(error) if error.status() == Some(StatusCode::NOT_IMPLEMENTED.as_u16()) => return self.upload(upload).await,
            answer => answer?,
        };
        let address = answer.headers.get(LOCATION).and_then(|v| v.to_str().ok()).map(str::to_owned);
        let address = address.ok_or_else(|| Error::Answer("an upload in parts without an address".into()))?;
        let begun = Begun { address, cookies: cookies(&answer.headers) };
        let sent = self.send_parts(&begun, &body, part.max(1), prefer.as_deref(), &mut progress).await;
        if sent.is_err() {
            // its place is for others; where that fails, it goes when its time is over
            let _ = self.send(&begun.call(Method::DELETE)?).await;
        }
        sent
    }

    async fn send_parts(
        &self,
        begun: &Begun,
        body: &Bytes,
        part: usize,
        prefer: Option<&str>,
        progress: &mut impl FnMut(usize, usize),
    ) -> Result<PhotoState, Error> {
        let (mut offset, mut until, mut pause) = (0, Instant::now() + self.patience, PAUSE);
        loop {
            progress(offset, body.len());
            let end = body.len().min(offset.saturating_add(part));
            let last = end == body.len();
            let mut call = begun.call(Method::PATCH)?.header(CONTENT_TYPE, PART)?.header(OFFSET, &offset.to_string())?;
            call = call.header(COMPLETE, if last { "?1" } else { "?0" })?;
            if let Some(prefer) = prefer.filter(|_| last) {
                call = call.header(PREFER, prefer)?;
            }
            let tried = match self.send(&call.body(body.slice(offset..end))).await {
                Ok(response) => take(response).await,
                Err(error) => Err(error),
            };
            let wait = match &tried {
                Ok(answer) if answer.status.is_success() && last => {
                    progress(end, body.len());
                    return answer.json();
                }
                Ok(answer) if answer.status.is_success() => {
                    (offset, until, pause) = (end, Instant::now() + self.patience, PAUSE);
                    continue;
                }
                Ok(answer) if goes_on(answer.status) => retry_after(&answer.headers).unwrap_or(pause),
                Err(Error::Network(_)) => pause,
                _ => return Err(failure(tried)),
            };
            if Instant::now() + wait > until {
                return Err(failure(tried));
            }
            sleep(wait).await;
            pause = (pause * 2).min(MOST_PAUSE);
            let now: Extent = self.ask(begun.call(Method::GET)?).await?.json()?;
            if let Some(photo) = now.photo {
                // the answer got lost
                progress(body.len(), body.len());
                return self.ask(Call::new(Method::GET, photo)).await?.json();
            }
            if now.offset > body.len() {
                return Err(Error::Answer(format!("an upload in parts that is at {} of {} bytes", now.offset, body.len())));
            }
            if now.offset > offset {
                (until, pause) = (Instant::now() + self.patience, PAUSE);
            }
            offset = now.offset;
        }
    }
}

/// What went wrong with a part that was not taken.
fn failure(tried: Result<Answer, Error>) -> Error {
    match tried {
        Ok(answer) => answer.problem(),
        Err(error) => error,
    }
}

/// Whether what is there may tell how to go on: a part came too slowly, another byte is next, another request is at it, there is no room, or
/// a proxy reached no server.
fn goes_on(status: StatusCode) -> bool {
    matches!(status.as_u16(), 408 | 409 | 423 | 429 | 502..=504)
}

/// The cookies of an answer as a request sends them.
fn cookies(headers: &HeaderMap) -> String {
    let all = headers.get_all(SET_COOKIE).iter().filter_map(|v| v.to_str().ok()).filter_map(|text| text.split(';').next());
    all.map(str::trim).collect::<Vec<_>>().join("; ")
}
