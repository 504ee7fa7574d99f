//! Sends requests, retries them when that is safe, and reads the answers.

use std::time::Duration;

use bytes::{Bytes, BytesMut};
use reqwest::header::{HeaderMap, HeaderName, HeaderValue, RETRY_AFTER};
use reqwest::{Method, Response, StatusCode};
use serde::de::DeserializeOwned;
use tokio::time::{Instant, sleep};

use crate::{Client, Error, MAX_ANSWER_BYTES, Problem};

/// Pause after the first network failure. It doubles after each failure, up to [`MAX_PAUSE`].
const PAUSE: Duration = Duration::from_millis(200);
const MAX_PAUSE: Duration = Duration::from_secs(10);

/// A request.
pub(crate) struct Call {
    pub method: Method,
    pub path: String,
    pub headers: Vec<(HeaderName, HeaderValue)>,
    pub body: Bytes,
    pub idempotent: bool,
}

impl Call {
    /// An idempotent call without a body.
    pub fn new(method: Method, path: impl Into<String>) -> Self {
        Self { method, path: path.into(), headers: Vec::new(), body: Bytes::new(), idempotent: true }
    }

    pub fn header(mut self, name: HeaderName, value: &str) -> Result<Self, Error> {
        let value = HeaderValue::from_str(value).map_err(|_| Error::Answer(format!("{value:?} cannot be sent as {name}")))?;
        self.headers.push((name, value));
        Ok(self)
    }

    pub fn body(self, body: impl Into<Bytes>) -> Self {
        Self { body: body.into(), ..self }
    }
}

/// An answer with its whole body.
pub(crate) struct Answer {
    pub status: StatusCode,
    pub headers: HeaderMap,
    pub body: Bytes,
}

impl Answer {
    pub fn json<T: DeserializeOwned>(&self) -> Result<T, Error> {
        serde_json::from_slice(&self.body).map_err(|e| Error::Answer(e.to_string()))
    }

    pub fn problem(&self) -> Error {
        let plain = || Problem {
            kind: "about:blank".into(),
            title: self.status.canonical_reason().unwrap_or("Error").into(),
            status: self.status.as_u16(),
            // a proxy's page
            detail: String::from_utf8_lossy(&self.body[..self.body.len().min(200)]).into_owned(),
            field: None,
            request_id: None,
            retry_after: None,
        };
        Error::Problem(Box::new(serde_json::from_slice(&self.body).unwrap_or_else(|_| plain())))
    }
}

impl Client {
    /// Sends a call, with retries, and reads the whole answer.
    pub(crate) async fn request(&self, call: Call) -> Result<Answer, Error> {
        let until = Instant::now() + self.patience;
        let mut pause = PAUSE;
        loop {
            let tried = match self.send(&call).await {
                Ok(response) => read_answer(response).await,
                Err(error) => Err(error),
            };
            let wait = match &tried {
                Ok(answer) if refused_for_now(answer.status, call.idempotent) => retry_after(&answer.headers).unwrap_or(pause),
                Ok(answer) if answer.status.is_client_error() || answer.status.is_server_error() => return Err(answer.problem()),
                // the connection failed, so the server has not seen the call
                Err(Error::Network(error)) if call.idempotent || error.is_connect() => pause,
                _ => return tried,
            };
            if Instant::now() + wait > until {
                return tried.and_then(|answer| Err(answer.problem()));
            }
            sleep(wait).await;
            pause = (pause * 2).min(MAX_PAUSE);
        }
    }

    /// Sends a call once, without reading the answer's body.
    pub(crate) async fn send(&self, call: &Call) -> Result<Response, Error> {
        let mut request = self.http.request(call.method.clone(), self.address(&call.path)?).headers(self.headers.clone());
        for (name, value) in &call.headers {
            request = request.header(name, value);
        }
        if !call.body.is_empty() || call.method == Method::POST {
            request = request.body(call.body.clone());
        }
        request.send().await.map_err(Error::Network)
    }
}

/// Whether a retry is useful and safe. The server sends 429 before it does any work, but may send 503 after it has started.
fn refused_for_now(status: StatusCode, idempotent: bool) -> bool {
    status == StatusCode::TOO_MANY_REQUESTS || idempotent && status == StatusCode::SERVICE_UNAVAILABLE
}

fn retry_after(headers: &HeaderMap) -> Option<Duration> {
    headers.get(RETRY_AFTER)?.to_str().ok()?.parse().ok().map(Duration::from_secs)
}

/// Reads a whole answer.
pub(crate) async fn read_answer(mut response: Response) -> Result<Answer, Error> {
    let too_large = || Error::Answer(format!("more than {MAX_ANSWER_BYTES} bytes"));
    let length = response.content_length().unwrap_or(0);
    if length > MAX_ANSWER_BYTES as u64 {
        return Err(too_large());
    }
    let mut body = BytesMut::with_capacity(length as usize);
    while let Some(piece) = response.chunk().await.map_err(Error::Network)? {
        if body.len() + piece.len() > MAX_ANSWER_BYTES {
            return Err(too_large());
        }
        body.extend_from_slice(&piece);
    }
    Ok(Answer { status: response.status(), headers: response.headers().clone(), body: body.freeze() })
}
