//! Tracks the streams of an HTTP/2 connection. The transport reports only on all streams together, so a client that answers pings could
//! keep one open forever.

use std::collections::BTreeMap;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use bytes::Bytes;
use hyper::body::{Body, Frame, SizeHint};

use super::answer_memory::{AnswerMemory, holding};

/// Requests of a connection.
#[derive(Debug)]
pub struct Streams(Mutex<State>);

#[derive(Debug)]
struct State {
    next: u64,
    /// Open requests. For those that wait for their client: since when, and for how many bytes.
    open: BTreeMap<u64, Option<(Instant, usize)>>,
    /// Since when no request is open.
    idle: Instant,
}

/// Verdict on a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StreamHealth {
    /// Keep it.
    Fine,
    /// No requests for a while.
    Idle,
    /// A client does not read its answers.
    Stalled,
}

/// An open request, until it is dropped.
#[derive(Debug)]
pub struct OpenStream {
    streams: Arc<Streams>,
    id: u64,
}

impl Streams {
    pub fn new() -> Arc<Self> {
        Arc::new(Self(Mutex::new(State { next: 0, open: BTreeMap::new(), idle: Instant::now() })))
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn open(self: &Arc<Self>) -> OpenStream {
        let mut state = self.lock();
        state.next += 1;
        let id = state.next;
        state.open.insert(id, None);
        drop(state);
        OpenStream { streams: Arc::clone(self), id }
    }

    /// State at `now`. A client may read nothing for `limit`, or longer if it reads `rate` bytes a second; a connection may have no request
    /// for `idle`.
    pub fn check(&self, now: Instant, limit: Duration, rate: u64, idle: Duration) -> StreamHealth {
        let state = self.lock();
        let for_longer_than = |since: &Instant, time| now.saturating_duration_since(*since) > time;
        let at_rate = |bytes: &usize| Duration::from_secs_f64(*bytes as f64 / rate.max(1) as f64);
        let stalled = |(since, bytes): &(Instant, usize)| for_longer_than(since, limit + at_rate(bytes));
        if state.open.values().flatten().any(stalled) {
            StreamHealth::Stalled
        } else if state.open.is_empty() && for_longer_than(&state.idle, idle) {
            StreamHealth::Idle
        } else {
            StreamHealth::Fine
        }
    }
}

impl OpenStream {
    /// The client has `bytes` to read; `None`: it waits for the server.
    fn turn(&self, bytes: Option<usize>) {
        self.streams.lock().open.insert(self.id, bytes.map(|bytes| (Instant::now(), bytes)));
    }
}

impl Drop for OpenStream {
    fn drop(&mut self) {
        let mut state = self.streams.lock();
        state.open.remove(&self.id);
        state.idle = Instant::now();
    }
}

/// Most bytes of a body to hand over at a time, and to buffer in the transport. The transport also requests a piece ahead.
pub const PIECE: usize = 32 << 10;

/// A response body that tracks its client, and the memory of an answer that was made for this client alone.
#[derive(Debug)]
pub struct TrackedBody<B> {
    body: B,
    open: Arc<OpenStream>,
    memory: &'static AnswerMemory,
    /// The length of the body is known, so that it is in memory as a whole. One that is read piece by piece has counted its pieces.
    whole: bool,
    /// The rest of a piece that was too large.
    left: Bytes,
    /// Whether a piece was handed over.
    begun: bool,
}

impl<B: Body> TrackedBody<B> {
    /// Wraps the body of the response to a request.
    pub fn new(body: B, open: OpenStream, memory: &'static AnswerMemory) -> Self {
        let whole = body.size_hint().exact().is_some();
        Self { body, open: Arc::new(open), memory, whole, left: Bytes::new(), begun: false }
    }
}

impl<B: Body<Data = Bytes> + Unpin> Body for TrackedBody<B> {
    type Data = Bytes;
    type Error = B::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Self::Error>>> {
        let whole = if self.left.is_empty() {
            Pin::new(&mut self.body).poll_frame(cx)
        } else {
            Poll::Ready(Some(Ok(Frame::data(std::mem::take(&mut self.left)))))
        };
        let polled = whole.map_ok(|frame| {
            frame.map_data(|mut data| {
                // caches count the bytes that they share
                if self.whole && !self.begun && data.is_unique() {
                    data = self.memory.count(data);
                }
                self.left = data.split_off(data.len().min(PIECE));
                // the request stays open until the transport has sent it
                holding(data, Arc::clone(&self.open))
            })
        });
        match &polled {
            // the client must read it, and what the transport has buffered
            Poll::Ready(Some(Ok(frame))) => self.open.turn(frame.data_ref().map(|data| data.len() + PIECE)),
            // the transport may still hold the last pieces
            Poll::Ready(None) => self.open.turn(Some(PIECE)),
            Poll::Ready(Some(Err(_))) | Poll::Pending => self.open.turn(None),
        }
        self.begun |= polled.is_ready();
        polled
    }

    fn is_end_stream(&self) -> bool {
        // the client must read the last piece, too: the end shows when more is requested
        !self.begun && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        let (rest, left) = (self.body.size_hint(), self.left.len() as u64);
        let mut hint = SizeHint::new();
        hint.set_lower(rest.lower() + left);
        if let Some(upper) = rest.upper() {
            hint.set_upper(upper + left);
        }
        hint
    }
}

#[cfg(test)]
mod tests {
    use axum::body::Body as Whole;
    use futures_util::{FutureExt as _, stream};
    use http_body_util::BodyExt as _;

    use super::*;

    const LIMIT: Duration = Duration::from_secs(30);
    const IDLE: Duration = Duration::from_secs(10);
    static MEMORY: AnswerMemory = AnswerMemory::new(0);

    #[tokio::test]
    async fn only_clients_that_do_not_read_are_stalled() {
        let streams = Streams::new();
        let look = |seconds| streams.check(Instant::now() + Duration::from_secs(seconds), LIMIT, 1000, IDLE);
        let open = streams.open();
        assert_eq!(look(1000), StreamHealth::Fine, "the answer is not there yet");
        let pieces = stream::iter([Ok::<_, std::convert::Infallible>(Bytes::from(vec![0; 5000])), Ok(Bytes::new())]);
        let mut body = TrackedBody::new(Whole::from_stream(pieces), open, &MEMORY);
        body.frame().await.unwrap().unwrap();
        // seconds at the least rate for it, and for what the transport has buffered, come on top
        let rest = (5000 + PIECE as u64) / 1000;
        assert_eq!([29, 31].map(|seconds| look(rest + seconds)), [StreamHealth::Fine, StreamHealth::Stalled]);
        let last = body.frame().await.unwrap().unwrap();
        assert!(body.frame().await.is_none());
        drop(body);
        assert_eq!(look(70), StreamHealth::Stalled, "the transport holds the last piece");
        drop(last);
        // the end comes some time after the last piece
        let (sender, receiver) = tokio::sync::mpsc::unbounded_channel();
        sender.send(Bytes::from(vec![0; 5000])).unwrap();
        let pieces =
            stream::unfold(receiver, |mut receiver| async { Some((Ok::<_, std::convert::Infallible>(receiver.recv().await?), receiver)) });
        let mut body = TrackedBody::new(Whole::from_stream(pieces), streams.open(), &MEMORY);
        let last = body.frame().await.unwrap().unwrap();
        assert!(body.frame().now_or_never().is_none());
        assert_eq!(look(1000), StreamHealth::Fine, "it waits for the server");
        drop(sender);
        assert!(body.frame().await.is_none());
        drop(body);
        assert_eq!(look(70), StreamHealth::Stalled, "the transport holds the last piece");
        drop(last);
        assert_eq!(look(5), StreamHealth::Fine);
        assert_eq!(look(20), StreamHealth::Idle);
        let _open = streams.open();
        assert_eq!(look(20), StreamHealth::Fine);
    }

    #[tokio::test]
    async fn large_pieces_are_split_without_loss() {
        let all: Vec<u8> = (0..3 * PIECE + 5).map(|i| (i % 251) as u8).collect();
        let mut body = TrackedBody::new(Whole::from(all.clone()), Streams::new().open(), &MEMORY);
        let mut came = Vec::new();
        assert!(!body.is_end_stream());
        while let Some(frame) = body.frame().await {
            let data = frame.unwrap().into_data().unwrap();
            assert!(data.len() <= PIECE);
            came.extend_from_slice(&data);
            assert_eq!(body.size_hint().exact(), Some((all.len() - came.len()) as u64));
        }
        assert_eq!(came, all);
        assert!(TrackedBody::new(Whole::empty(), Streams::new().open(), &MEMORY).is_end_stream());
    }

    #[tokio::test]
    async fn only_answers_made_for_one_client_count() {
        static COUNTED: AnswerMemory = AnswerMemory::new(0);
        let body = |whole: Whole| TrackedBody::new(whole, Streams::new().open(), &COUNTED);
        let mut own = body(Whole::from(vec![7; PIECE + 5]));
        let first = own.frame().await.unwrap().unwrap();
        assert_eq!(COUNTED.held(), PIECE + 5);
        drop((first, own));
        assert_eq!(COUNTED.held(), 0);
        let cached = Bytes::from(vec![7; PIECE + 5]);
        for uncounted in
            [Whole::from(cached.clone()), Whole::from_stream(stream::iter([Ok::<_, std::convert::Infallible>(cached.slice(9..))]))]
        {
            let mut body = body(uncounted);
            let _first = body.frame().await.unwrap().unwrap();
            assert_eq!(COUNTED.held(), 0);
        }
    }
}
