//! Bodies of requests, bounded in size and in the pauses between their pieces.

use std::error::Error;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use anyhow::Chain;
use axum::body::{Body, HttpBody};
use axum::http::{HeaderValue, StatusCode};
use bytes::Bytes;
use futures_util::TryStreamExt as _;
use http_body_util::{BodyExt, LengthLimitError, Limited};
use hyper::body::{Frame, SizeHint};
use serde_json::{Map, Value};
use tokio::time::{Instant, Sleep};

use super::limits::Limits;
use super::problem::Problem;
use super::time_limit::TimeLimit;

/// Longest time to read the rest of a refused body, so that the client sees the answer.
const LINGER: Duration = Duration::from_secs(2);

/// Why a body was cut off.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CutOff {
    /// It is larger than this many bytes.
    #[error("the request's body is over the limit of {0} bytes")]
    TooLarge(usize),
    /// Nothing came for that long.
    #[error("no bytes of the request's body arrived for {0:?}")]
    TooSlow(Duration),
    /// It came with fewer bytes a second.
    #[error("the request's body arrived at less than {0} bytes a second")]
    BelowRate(u64),
}

impl CutOff {
    /// The [`CutOff`] in the chain of causes of `error`.
    pub fn find(error: &(dyn Error + 'static)) -> Option<Self> {
        Chain::new(error).find_map(|cause| cause.downcast_ref::<Self>()).copied()
    }
}

/// The answer to a body that cannot be read.
pub fn problem(error: &(dyn Error + 'static)) -> Problem {
    match CutOff::find(error) {
        Some(CutOff::TooLarge(limit)) => Problem::too_large(limit),
        Some(slow @ (CutOff::TooSlow(_) | CutOff::BelowRate(_))) => {
            Problem::new(StatusCode::REQUEST_TIMEOUT, "body-too-slow", slow.to_string())
        }
        None => {
            // the root cause says most
            let root = Chain::new(error).next_back().unwrap_or(error);
            Problem::bad_request(format!("the request's body cannot be read: {root}"))
        }
    }
}

/// Reads a body of at most `most` bytes.
///
/// # Errors
/// 413 if it is larger, or [`problem`].
pub async fn read(body: Body, most: usize) -> Result<Bytes, Problem> {
    let body = Limited::new(body, most).collect().await.map_err(|error| match error.downcast_ref::<LengthLimitError>() {
        Some(_) => Problem::too_large(most),
        None => problem(&*error),
    })?;
    Ok(body.to_bytes())
}

/// Parses a JSON object.
///
/// # Errors
/// 400.
pub fn json_object(body: &[u8]) -> Result<Map<String, Value>, Problem> {
    serde_json::from_slice(body).map_err(|e| Problem::bad_request(format!("the body must be a JSON object: {e}")))
}

/// Parameters in a JSON object: text and numbers as text, without those that are null.
///
/// # Errors
/// 400, also if one is neither text nor a number.
pub fn json_parameters(body: &[u8]) -> Result<Vec<(String, String)>, Problem> {
    let text_of = |(name, value): (String, Value)| match value {
        Value::Null => None,
        Value::String(text) => Some(Ok((name, text))),
        Value::Number(number) => Some(Ok((name, number.to_string()))),
        _ => Some(Err(Problem::parameter(name, "must be text or a number"))),
    };
    json_object(body)?.into_iter().filter_map(text_of).collect()
}

/// The media type in a `Content-Type` in lower case, without its parameters; empty if there is none.
pub fn media_type(content_type: Option<&HeaderValue>) -> String {
    let text = content_type.and_then(|value| value.to_str().ok()).unwrap_or_default();
    text.split(';').next().unwrap_or_default().trim().to_ascii_lowercase()
}

/// The unread rest of a body.
#[derive(Clone, Default)]
pub struct UnreadBody {
    inner: Arc<Mutex<Option<Body>>>,
    polled: Arc<AtomicBool>,
    ended: Arc<AtomicBool>,
}

impl UnreadBody {
    /// Whether the whole body has arrived.
    pub fn ended(&self) -> bool {
        self.ended.load(Ordering::Acquire)
    }

    /// Reads and drops the rest, up to `limit` bytes and for a short while: a client that writes into a closed connection never sees the
    /// answer. `awaited`: the client waits for `100 Continue`.
    pub async fn drain(self, limit: usize, awaited: bool) {
        let body = self.inner.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some(body) = body.filter(|_| !awaited || self.polled.load(Ordering::Acquire)) else { return };
        let rest = Limited::new(body, limit).into_data_stream().try_for_each(|_| std::future::ready(Ok(())));
        let _ = tokio::time::timeout(LINGER, rest).await;
    }
}

pub struct LimitedBody {
    inner: Option<Body>,
    rest: UnreadBody,
    limit: usize,
    left: usize,
    pause: Duration,
    rate: u64,
    started: Instant,
    timer: Pin<Box<Sleep>>,
    clock: TimeLimit,
}

impl LimitedBody {
    /// Bounds `inner` by `limits`; starts `clock` when the body ends or is dropped.
    pub fn new(inner: Body, limits: &Limits, clock: TimeLimit) -> (Self, UnreadBody) {
        let rest = UnreadBody::default();
        if inner.is_end_stream() {
            rest.ended.store(true, Ordering::Release);
            clock.start();
        }
        let Limits { body: limit, body_read: pause, body_rate: rate, .. } = *limits;
        let timer = Box::pin(tokio::time::sleep(pause));
        let started = Instant::now();
        (Self { inner: Some(inner), rest: rest.clone(), limit, left: limit, pause, rate, started, timer, clock }, rest)
    }

    /// Whether it arrives too slowly on average; the first while does not count.
    fn is_below_rate(&self) -> bool {
        let over = self.started.elapsed().saturating_sub(self.pause).as_secs_f64();
        ((self.limit - self.left) as f64) < over * self.rate as f64
    }
}

impl HttpBody for LimitedBody {
    type Data = Bytes;
    type Error = Box<dyn Error + Send + Sync>;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Self::Error>>> {
        let this = &mut *self;
        let Some(inner) = this.inner.as_mut() else { return Poll::Ready(None) };
        // refuse a body with a declared size before its first byte
        if inner.size_hint().lower() > this.left as u64 {
            return Poll::Ready(Some(Err(CutOff::TooLarge(this.limit).into())));
        }
        if !this.rest.polled.swap(true, Ordering::AcqRel) {
            this.started = Instant::now();
            this.timer.as_mut().reset(this.started + this.pause);
        }
        let frame = match Pin::new(inner).poll_frame(cx) {
            Poll::Ready(frame) => frame,
            Poll::Pending if this.timer.as_mut().poll(cx).is_ready() => {
                return Poll::Ready(Some(Err(CutOff::TooSlow(this.pause).into())));
            }
            Poll::Pending => return Poll::Pending,
        };
        this.timer.as_mut().reset(Instant::now() + this.pause);
        Poll::Ready(match frame {
            None => {
                this.rest.ended.store(true, Ordering::Release);
                this.inner = None;
                this.clock.start();
                None
            }
            Some(Err(error)) => Some(Err(error.into())),
            Some(Ok(frame)) => {
                let bytes = frame.data_ref().map_or(0, Bytes::len);
                if bytes > this.left {
                    return Poll::Ready(Some(Err(CutOff::TooLarge(this.limit).into())));
                }
                this.left -= bytes;
                if this.is_below_rate() {
                    return Poll::Ready(Some(Err(CutOff::BelowRate(this.rate).into())));
                }
                Some(Ok(frame))
            }
        })
    }

    fn is_end_stream(&self) -> bool {
        self.inner.as_ref().is_none_or(HttpBody::is_end_stream)
    }

    fn size_hint(&self) -> SizeHint {
        self.inner.as_ref().map_or_else(SizeHint::default, HttpBody::size_hint)
    }
}

impl Drop for LimitedBody {
    fn drop(&mut self) {
        self.clock.start();
        let rest = self.inner.take().filter(|b| !b.is_end_stream());
        if rest.is_none() {
            self.rest.ended.store(true, Ordering::Release);
        }
        *self.rest.inner.lock().unwrap_or_else(PoisonError::into_inner) = rest;
    }
}
