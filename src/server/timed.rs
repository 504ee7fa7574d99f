//! Streams whose other side has to take what it asked for, at a least rate.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::{Instant, Sleep};

/// Bytes that the system keeps of what is live until the other side has them, of which it takes as many again for itself: two seconds of video
/// as the publishing page sends it, and 10 Mbit/s to whoever is 100 ms away.
const LITTLE: usize = 128 << 10;

/// Has the system keep [`LITTLE`] of what is sent.
pub fn keep_little(stream: &TcpStream) {
    if let Err(error) = socket2::SockRef::from(stream).set_send_buffer_size(LITTLE) {
        tracing::debug!(%error, "bounding what the system keeps for a connection");
    }
}

/// A stream of which a write fails once the other side takes nothing for too long, or too little in all the time that was waited for it.
pub struct Timed<S> {
    stream: S,
    limit: Duration,
    /// Bytes a second that are taken at least, while there are any to take.
    rate: u64,
    timer: Option<Pin<Box<Sleep>>>,
    /// Since when the other side is waited for.
    since: Option<Instant>,
    /// How long it was waited for, and what it took.
    waited: Duration,
    taken: usize,
    little: Little<S>,
}

/// Whether the system is to keep little of what is written, and how it is told to.
pub struct Little<S> {
    /// Set where it is.
    pub wanted: Arc<AtomicBool>,
    /// Tells it.
    pub keep: fn(&S),
}

impl<S> Timed<S> {
    /// Of which some byte is taken each `limit`, and `rate` bytes a second over it.
    pub fn new(stream: S, limit: Duration, rate: u64, little: Little<S>) -> Self {
        Self { stream, limit, rate, timer: None, since: None, waited: Duration::ZERO, taken: 0, little }
    }

    fn keep_little(&self) {
        if self.little.wanted.swap(false, Ordering::Relaxed) {
            (self.little.keep)(&self.stream);
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

impl<S: AsyncRead + Unpin> AsyncRead for Timed<S> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Timed<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        self.keep_little();
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
        self.keep_little();
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

    fn usual<S>() -> Little<S> {
        Little { wanted: Arc::default(), keep: |_| panic!("nobody asked for it") }
    }

    #[cfg(target_os = "linux")]
    #[tokio::test]
    async fn a_connection_keeps_little_from_the_next_write_on_once_that_is_wanted() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let theirs = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (ours, _) = listener.accept().await.unwrap();
        let wanted = Arc::<AtomicBool>::default();
        let mut timed = Timed::new(ours, Duration::from_secs(30), 1, Little { wanted: Arc::clone(&wanted), keep: keep_little });
        let size = |timed: &Timed<TcpStream>| socket2::SockRef::from(&timed.stream).send_buffer_size().unwrap();
        timed.write_all(b"a").await.unwrap();
        assert_ne!(size(&timed), 2 * LITTLE);
        wanted.store(true, Ordering::Relaxed);
        timed.write_all(b"b").await.unwrap();
        assert_eq!(size(&timed), 2 * LITTLE);
        // whoever reads nothing is sent no more than both sides keep
        let mut sent = 0;
        while let Ok(Ok(n)) = tokio::time::timeout(Duration::from_secs(1), timed.write(&[0; 4096])).await {
            sent += n;
        }
        let kept = socket2::SockRef::from(&theirs).recv_buffer_size().unwrap();
        assert!(sent <= 2 * LITTLE + kept, "{sent} bytes");
    }

    #[tokio::test]
    async fn a_client_that_takes_nothing_is_cut_off_and_a_slow_one_is_not() {
        let (ours, mut theirs) = tokio::io::duplex(10);
        let mut timed = Timed::new(ours, Duration::from_millis(200), 1, usual());
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
    async fn a_client_that_takes_a_byte_now_and_then_is_cut_off() {
        let (ours, mut theirs) = tokio::io::duplex(10);
        let mut timed = Timed::new(ours, Duration::from_millis(200), 10_000, usual());
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
