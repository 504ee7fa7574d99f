//! Streams whose peer must read at a minimum rate.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::{Instant, Sleep};

/// Send buffer for live data in bytes, of which the system uses as much again for itself: two seconds of video as the publishing page sends
/// it, and 10 Mbit/s at a round-trip time of 100 ms.
const SEND_BUFFER: usize = 128 << 10;

/// Limits the system's send buffer to [`SEND_BUFFER`].
pub fn limit_send_buffer(stream: &TcpStream) {
    if let Err(error) = socket2::SockRef::from(stream).set_send_buffer_size(SEND_BUFFER) {
        tracing::debug!(%error, "cannot limit the send buffer of a connection");
    }
}

/// A stream whose writes fail once the peer reads nothing for too long, or too little over the time spent waiting for it.
pub struct MinimumRate<S> {
    stream: S,
    limit: Duration,
    /// Least bytes a second that the peer reads while there is data.
    rate: u64,
    timer: Option<Pin<Box<Sleep>>>,
    /// Since when it waits for the peer.
    since: Option<Instant>,
    /// Total time of waiting, and bytes read in it.
    waited: Duration,
    taken: usize,
    small_buffer: SmallBuffer<S>,
}

/// Whether to limit the send buffer, and how.
pub struct SmallBuffer<S> {
    pub wanted: Arc<AtomicBool>,
    pub keep: fn(&S),
}

impl<S> MinimumRate<S> {
    /// The peer must read at least a byte within `limit`, and `rate` bytes a second over it.
    pub fn new(stream: S, limit: Duration, rate: u64, small_buffer: SmallBuffer<S>) -> Self {
        Self { stream, limit, rate, timer: None, since: None, waited: Duration::ZERO, taken: 0, small_buffer }
    }

    fn limit_send_buffer(&self) {
        if self.small_buffer.wanted.swap(false, Ordering::Relaxed) {
            (self.small_buffer.keep)(&self.stream);
        }
    }

    fn check<T>(&mut self, cx: &mut Context<'_>, result: Poll<io::Result<T>>, bytes: impl Fn(&T) -> usize) -> Poll<io::Result<T>> {
        if let Poll::Ready(done) = &result {
            self.timer = None;
            self.taken += done.as_ref().map_or(0, bytes);
            self.waited += self.since.take().map_or(Duration::ZERO, |since| since.elapsed());
            if self.waited >= self.limit {
                let slow = (self.taken as f64) < self.waited.as_secs_f64() * self.rate as f64;
                (self.waited, self.taken) = (Duration::ZERO, 0);
                if slow {
                    return Poll::Ready(Err(io::Error::new(io::ErrorKind::TimedOut, "the client takes data too slowly")));
                }
            }
            return result;
        }
        self.since.get_or_insert_with(Instant::now);
        let limit = self.limit;
        let timer = self.timer.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(Instant::now() + limit)));
        match timer.as_mut().poll(cx) {
            Poll::Ready(()) => Poll::Ready(Err(io::Error::new(io::ErrorKind::TimedOut, "the client takes no data"))),
            Poll::Pending => Poll::Pending,
        }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for MinimumRate<S> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for MinimumRate<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        self.limit_send_buffer();
        let result = Pin::new(&mut self.stream).poll_write(cx, buf);
        self.check(cx, result, |n| *n)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let result = Pin::new(&mut self.stream).poll_flush(cx);
        self.check(cx, result, |()| 0)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let result = Pin::new(&mut self.stream).poll_shutdown(cx);
        self.check(cx, result, |()| 0)
    }

    fn poll_write_vectored(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bufs: &[io::IoSlice<'_>]) -> Poll<io::Result<usize>> {
        self.limit_send_buffer();
        let result = Pin::new(&mut self.stream).poll_write_vectored(cx, bufs);
        self.check(cx, result, |n| *n)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    #[cfg(target_os = "linux")]
    use tokio::net::TcpListener;

    use super::*;

    fn usual<S>() -> SmallBuffer<S> {
        SmallBuffer { wanted: Arc::default(), keep: |_| panic!("not requested") }
    }

    #[cfg(target_os = "linux")]
    #[tokio::test]
    async fn the_send_buffer_is_limited_from_the_next_write_on() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let theirs = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (ours, _) = listener.accept().await.unwrap();
        let wanted = Arc::<AtomicBool>::default();
        let mut timed =
            MinimumRate::new(ours, Duration::from_secs(30), 1, SmallBuffer { wanted: Arc::clone(&wanted), keep: limit_send_buffer });
        let size = |timed: &MinimumRate<TcpStream>| socket2::SockRef::from(&timed.stream).send_buffer_size().unwrap();
        timed.write_all(b"a").await.unwrap();
        assert_ne!(size(&timed), 2 * SEND_BUFFER);
        wanted.store(true, Ordering::Relaxed);
        timed.write_all(b"b").await.unwrap();
        assert_eq!(size(&timed), 2 * SEND_BUFFER);
        // a peer that reads nothing gets no more than both sides buffer
        let mut sent = 0;
        while let Ok(Ok(n)) = tokio::time::timeout(Duration::from_secs(1), timed.write(&[0; 4096])).await {
            sent += n;
        }
        let kept = socket2::SockRef::from(&theirs).recv_buffer_size().unwrap();
        assert!(sent <= 2 * SEND_BUFFER + kept, "{sent} bytes");
    }

    #[tokio::test]
    async fn a_peer_that_reads_nothing_is_cut_off_and_a_slow_one_is_not() {
        let (ours, mut theirs) = tokio::io::duplex(10);
        let mut timed = MinimumRate::new(ours, Duration::from_millis(200), 1, usual());
        let slow = tokio::spawn(async move {
            let mut one = [0; 1];
            for _ in 0..40 {
                tokio::time::sleep(Duration::from_millis(10)).await;
                theirs.read_exact(&mut one).await.unwrap();
            }
            theirs
        });
        timed.write_all(&[0; 50]).await.unwrap();
        let _theirs = slow.await.unwrap();
        let before = Instant::now();
        let error = timed.write_all(&[0; 50]).await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        assert!(before.elapsed() >= Duration::from_millis(200));
    }

    #[tokio::test]
    async fn a_peer_that_reads_single_bytes_is_cut_off() {
        let (ours, mut theirs) = tokio::io::duplex(10);
        let mut timed = MinimumRate::new(ours, Duration::from_millis(200), 10_000, usual());
        tokio::spawn(async move {
            let mut one = [0; 1];
            // never long without a byte
            while theirs.read_exact(&mut one).await.is_ok() {
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        });
        let error = timed.write_all(&vec![0; 100_000]).await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        assert!(error.to_string().contains("too slowly"), "{error}");
    }
}
