//! The accept loop: `axum::serve` sets no timer for the header of a request and none for writing, this one does.

use std::io;
use std::net::IpAddr;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::Router;
use hyper::Request;
use hyper::body::Incoming;
use hyper::header::{HOST, HeaderValue};
use hyper::server::conn::{http1, http2};
use hyper::service::{Service as _, service_fn};
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, MissedTickBehavior};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tokio_util::task::task_tracker::TaskTrackerToken;

use super::limits::Limits;
use super::proxies::{self, Proxies};
use super::share::{Share, Shares};
use super::streams::{Look, PIECE, Streams, Watched};
use super::telemetry::{Present, Telemetry};
use super::timed::{Little, Timed, keep_little};
use super::tls::{self, Tls};

/// Pause after the system has refused a connection, for example because no file descriptor is left.
const BACK_OFF: Duration = Duration::from_millis(100);

/// Bytes of a body, and of all of a connection, that may come before they are read.
const WINDOWS: (u32, u32) = (256 << 10, 1 << 20);
/// Pause after which it is asked whether a silent client is there, and time that it has to say so.
const PING: (Duration, Duration) = (Duration::from_secs(30), Duration::from_secs(20));
/// Pause between two looks at the streams of a connection.
const LOOK: Duration = Duration::from_secs(1);

/// Where connections come in.
pub struct Door {
    /// What listens.
    pub listener: TcpListener,
    /// What is spoken there, if not plain HTTP.
    pub tls: Option<Tls>,
    /// Proxies that say whose connections they pass on.
    pub proxies: Proxies,
}

/// How requests are read, by what was agreed on.
#[derive(Clone)]
struct Http {
    one: http1::Builder,
    two: http2::Builder<TokioExecutor>,
}

impl Http {
    fn new(limits: &Limits) -> Self {
        let (mut one, mut two) = (http1::Builder::new(), http2::Builder::new(TokioExecutor::new()));
        one.timer(TokioTimer::new()).header_read_timeout(limits.header_read).max_header_size(Limits::HEADER_BYTES);
        two.timer(TokioTimer::new()).max_header_list_size(Limits::HEADER_BYTES as u32).max_concurrent_streams(limits.streams_at_once);
        two.initial_stream_window_size(WINDOWS.0).initial_connection_window_size(WINDOWS.1);
        two.keep_alive_interval(PING.0).keep_alive_timeout(PING.1);
        Self { one, two }
    }
}

/// Serves connections until `stop`, then gives those that are open until `limits.drain` to end.
pub async fn serve(door: Door, router: Router, limits: &Arc<Limits>, telemetry: &Arc<Telemetry>, stop: &CancellationToken) {
    let Door { listener, tls, proxies } = door;
    let http = Http::new(limits);
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
        // a trusted proxy has those of all who come by it; whose they are it says itself
        let Some(share) = shares.take((!proxies.trusts(peer)).then_some(peer)) else {
            tracing::debug!(%peer, "an address has as many connections as it may");
            continue;
        };
        let says = proxies.announces(peer).then(|| shares.clone());
        let taken = Taken { stream, from: Peer(peer), announced: false, permit, share };
        let present = (telemetry.connection(), open.token());
        let (http, router, limits, stop) = (http.clone(), router.clone(), Arc::clone(limits), stop.clone());
        let acceptor = tls.as_ref().map(Tls::acceptor);
        tokio::spawn(async move {
            let taken = match says {
                Some(shares) => taken.announced(&shares, limits.header_read).await,
                None => Some(taken),
            };
            let Some(Taken { stream, from, announced, permit, share }) = taken else { return };
            let little = Arc::new(AtomicBool::new(false));
            let held = Held { little: Arc::clone(&little), all: Arc::new((permit, share, present)) };
            let stream = Timed::new(stream, limits.write, limits.write_rate, Little { wanted: little, keep: keep_little });
            let connection = Connection { http, router, limits, from, announced, held, stop };
            let Some(acceptor) = acceptor else { return connection.one(stream, None).await };
            match tokio::time::timeout(connection.limits.header_read, acceptor.accept(stream)).await {
                Ok(Ok(stream)) if stream.get_ref().1.alpn_protocol() == Some(tls::HTTP_2) => connection.two(stream).await,
                Ok(Ok(stream)) => connection.one(stream, Some(Secure)).await,
                Ok(Err(error)) => tracing::debug!(%error, peer = %from.0, "handshake"),
                Err(_) => tracing::debug!(peer = %from.0, "a handshake takes too long"),
            }
        });
    }
    drop(listener);
    open.close();
    if tokio::time::timeout(limits.drain, open.wait()).await.is_err() {
        tracing::warn!(open = open.len(), "connections are still open at the end of the drain time");
    }
}

/// A connection as it comes in.
struct Taken {
    stream: TcpStream,
    from: Peer,
    /// Whether a proxy said at its start that it passes it on.
    announced: bool,
    permit: OwnedSemaphorePermit,
    share: Share,
}

impl Taken {
    /// Whose it is by what a trusted proxy says at its start; none where it says nothing within `limit`, or its client has as many as it may.
    async fn announced(mut self, shares: &Shares, limit: Duration) -> Option<Self> {
        let said = tokio::time::timeout(limit, proxies::announced(&mut self.stream)).await;
        let said = said.unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()));
        let client = said.inspect_err(|error| tracing::debug!(%error, proxy = %self.from.0, "no PROXY protocol")).ok()?;
        // also where it does not say whose it is: it may be anybody's
        self.announced = true;
        if let Some(client) = client {
            self.share = shares.take(Some(client))?;
            self.from = Peer(client);
        }
        Some(self)
    }
}

/// A connection that was taken.
struct Connection {
    http: Http,
    router: Router,
    limits: Arc<Limits>,
    from: Peer,
    announced: bool,
    held: Held,
    stop: CancellationToken,
}

impl Connection {
    /// Speaks HTTP/1.1.
    async fn one<S: AsyncRead + AsyncWrite + Unpin + Send + 'static>(self, stream: S, secure: Option<Secure>) {
        let inner = TowerToHyperService::new(self.router);
        let (from, announced, given) = (self.from, self.announced, self.held.clone());
        let service = service_fn(move |mut request: Request<Incoming>| {
            from.put(announced, &mut request);
            request.extensions_mut().insert(given.clone());
            if let Some(secure) = secure {
                request.extensions_mut().insert(secure);
            }
            inner.call(request)
        });
        let mut connection = pin!(self.http.one.serve_connection(TokioIo::new(stream), service).with_upgrades());
        let ended = tokio::select! {
            ended = connection.as_mut() => ended,
            () = self.stop.cancelled() => {
                connection.as_mut().graceful_shutdown();
                connection.await
            }
        };
        if let Err(error) = ended {
            tracing::debug!(%error, "connection");
        }
        drop(self.held);
    }

    /// Speaks HTTP/2, within TLS alone.
    async fn two<S: AsyncRead + AsyncWrite + Unpin + Send + 'static>(self, stream: S) {
        let streams = Streams::new();
        let inner = TowerToHyperService::new(self.router);
        let (from, announced, given, opened) = (self.from, self.announced, self.held.clone(), Arc::clone(&streams));
        let service = service_fn(move |mut request: Request<Incoming>| {
            let open = opened.open();
            from.put(announced, &mut request);
            request.extensions_mut().insert(given.clone());
            request.extensions_mut().insert(Secure);
            name_host(&mut request);
            let answer = inner.call(request);
            async move { answer.await.map(|response| response.map(|body| Watched::new(body, open))) }
        });
        let mut connection = pin!(self.http.two.serve_connection(TokioIo::new(stream), service));
        let mut look = tokio::time::interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        // what the transport may still have of answers that were given to it whole
        let rest = Duration::from_secs_f64((2 * PIECE) as f64 / self.limits.write_rate.max(1) as f64);
        let mut leaving = None;
        let ended = loop {
            tokio::select! {
                ended = connection.as_mut() => break ended,
                () = self.stop.cancelled(), if leaving.is_none() => {
                    leaving = Some(Instant::now());
                    connection.as_mut().graceful_shutdown();
                }
                _ = look.tick() => match (streams.look(std::time::Instant::now(), self.limits.write, self.limits.write_rate, self.limits.header_read), leaving) {
                    (Look::Idle, None) => {
                        leaving = Some(Instant::now());
                        connection.as_mut().graceful_shutdown();
                    }
                    (Look::Idle, Some(since)) if since.elapsed() <= self.limits.write + rest => {}
                    (Look::Stalled | Look::Idle, _) => {
                        tracing::debug!(peer = %from.0, "the client does not take what it asked for");
                        break Ok(());
                    }
                    (Look::Fine, _) => {}
                }
            }
        };
        if let Err(error) = ended {
            tracing::debug!(%error, "connection");
        }
        drop(self.held);
    }
}

/// Says the host of a request of HTTP/2 where those of HTTP/1.1 do.
fn name_host(request: &mut Request<Incoming>) {
    let named = request.uri().authority().and_then(|authority| HeaderValue::from_str(authority.as_str()).ok());
    if let Some(named) = named
        && !request.headers().contains_key(HOST)
    {
        request.headers_mut().insert(HOST, named);
    }
}

/// A request that came by TLS.
#[derive(Clone, Copy, Debug)]
pub struct Secure;

/// Whose a connection is: the address at its other end, which is a proxy's where there is one that says nothing at its start.
#[derive(Clone, Copy, Debug)]
pub struct Peer(pub IpAddr);

impl Peer {
    /// Says so to whoever answers a request, and by a header where a proxy `announced` it.
    fn put(self, announced: bool, request: &mut Request<Incoming>) {
        request.extensions_mut().insert(self);
        if announced {
            proxies::say(request.headers_mut(), self.0);
        }
    }
}

/// What a connection holds of what there is a bounded number of: who goes on with it as a WebSocket holds this on.
#[derive(Clone)]
pub struct Held {
    little: Arc<AtomicBool>,
    #[expect(dead_code, reason = "held until it is dropped")]
    all: Arc<(OwnedSemaphorePermit, Share, (Present, TaskTrackerToken))>,
}

impl Held {
    /// From the next write on the system keeps little of what is sent: what is live is of no use later.
    pub fn keep_little(&self) {
        self.little.store(true, Ordering::Relaxed);
    }
}

/// Bytes that the system keeps for a connection beyond what was sent: by itself it keeps up to 4 MB, which a viewer who stalls would be shown
/// before what is live.
#[cfg(target_os = "linux")]
const UNSENT: u32 = 256 << 10;

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
    #[cfg(target_os = "linux")]
    let _ = socket2::SockRef::from(&stream).set_tcp_notsent_lowat(UNSENT);
    Ok((stream, peer.ip(), permit))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_client_did_is_no_reason_to_pause() {
        assert!(is_of_the_client(&io::ErrorKind::ConnectionAborted.into()) && is_of_the_client(&io::ErrorKind::ConnectionReset.into()));
        assert!(!is_of_the_client(&io::Error::from_raw_os_error(24)), "no descriptor is left");
    }
}
