//! The accept loop: `axum::serve` sets no timer for the header of a request and none for writing, this one does.

use std::io;
use std::net::IpAddr;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, Sleep};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tokio_util::task::task_tracker::TaskTrackerToken;

use super::limits::Limits;
use super::share::{Share, Shares};
use super::telemetry::{Present, Telemetry};

/// Pause after the system has refused a connection, for example because no file descriptor is left.
const BACK_OFF: Duration = Duration::from_millis(100);

/// Serves connections until `stop`, then gives those that are open until `limits.drain` to end.
pub async fn serve(listener: TcpListener, router: Router, limits: &Limits, telemetry: &Arc<Telemetry>, stop: &CancellationToken) {
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(limits.header_read).max_header_size(Limits::HEADER_BYTES);
    let room = Arc::new(Semaphore::new(limits.connections));
    let shares = Shares::new(limits.connections_per_address);
    let open = TaskTracker::new();
    loop {
        let accepted = tokio::select! {
            biased;
            () = stop.cancelled() => break,
            accepted = next(&listener, &room) => accepted,
        };
        let (stream, peer, permit) = match accepted {
            Ok(accepted) => accepted,
            // that client has gone already; the next one is as welcome
            Err(error) if is_of_the_client(&error) => continue,
            Err(error) => {
                tracing::warn!(%error, "accepting a connection");
                tokio::time::sleep(BACK_OFF).await;
                continue;
            }
        };
        let Some(share) = shares.take(Some(peer)) else {
            tracing::debug!(%peer, "an address has as many connections as it may");
            continue;
        };
        let io = TokioIo::new(Timed::new(stream, limits.write, limits.write_rate));
        let inner = TowerToHyperService::new(router.clone());
        let held = Held(Arc::new((permit, share, telemetry.connection(), open.token())));
        let given = held.clone();
        let service = service_fn(move |mut request: Request<Incoming>| {
            request.extensions_mut().insert(Peer(peer));
            request.extensions_mut().insert(given.clone());
            inner.call(request)
        });
        let (connection, stop) = (http.serve_connection(io, service).with_upgrades(), stop.clone());
        tokio::spawn(async move {
            let mut connection = pin!(connection);
            let ended = tokio::select! {
                ended = connection.as_mut() => ended,
                () = stop.cancelled() => {
                    connection.as_mut().graceful_shutdown();
                    connection.await
                }
            };
            if let Err(error) = ended {
                tracing::debug!(%error, "connection");
            }
            drop(held);
        });
    }
    drop(listener);
    open.close();
    if tokio::time::timeout(limits.drain, open.wait()).await.is_err() {
        tracing::warn!(open = open.len(), "connections are still open at the end of the drain time");
    }
}

/// Who sends a request: the address at the other end of the connection, which is a proxy's where there is one.
#[derive(Clone, Copy, Debug)]
pub struct Peer(pub IpAddr);

/// What a connection holds of what there is a bounded number of: who goes on with it as a WebSocket holds this on.
#[derive(Clone)]
pub struct Held(#[expect(dead_code, reason = "held until it is dropped")] Arc<(OwnedSemaphorePermit, Share, Present, TaskTrackerToken)>);

/// Errors of one connection, not of the system.
fn is_of_the_client(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionAborted, ConnectionRefused, ConnectionReset, NotConnected};
    matches!(error.kind(), ConnectionAborted | ConnectionRefused | ConnectionReset | NotConnected)
}

async fn next(listener: &TcpListener, room: &Arc<Semaphore>) -> io::Result<(TcpStream, IpAddr, tokio::sync::OwnedSemaphorePermit)> {
    let permit = Arc::clone(room).acquire_owned().await.map_err(io::Error::other)?;
    let (stream, peer) = listener.accept().await?;
    // answers are written in one go: waiting for more to send only adds delay
    // where that is not to be had, the client has gone: no reason to keep the next one waiting
    let _ = stream.set_nodelay(true);
    Ok((stream, peer.ip(), permit))
}

/// A stream of which a write fails once the other side takes nothing for too long, or too little in all the time that was waited for it.
struct Timed<S> {
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
}

impl<S> Timed<S> {
    fn new(stream: S, limit: Duration, rate: u64) -> Self {
        Self { stream, limit, rate, timer: None, since: None, waited: Duration::ZERO, taken: 0 }
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

    use super::*;

    #[tokio::test]
    async fn a_client_that_takes_nothing_is_cut_off_and_a_slow_one_is_not() {
        let (ours, mut theirs) = tokio::io::duplex(10);
        let mut timed = Timed::new(ours, Duration::from_millis(200), 1);
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
        let mut timed = Timed::new(ours, Duration::from_millis(200), 10_000);
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

    #[test]
    fn what_a_client_did_is_no_reason_to_pause() {
        assert!(is_of_the_client(&io::ErrorKind::ConnectionAborted.into()) && is_of_the_client(&io::ErrorKind::ConnectionReset.into()));
        assert!(!is_of_the_client(&io::Error::from_raw_os_error(24)), "no descriptor is left");
    }
}
