//! The accept loop. Unlike `axum::serve`, it limits the time for request headers and for writing.

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

use super::answer_memory::ANSWERS;
use super::base_path::BasePath;
use super::client_slots::{ClientSlot, ClientSlots};
use super::http2_streams::{PIECE, StreamHealth, Streams, TrackedBody};
use super::limits::Limits;
use super::metrics::{GaugeGuard, Telemetry};
use super::minimum_rate::{MinimumRate, SmallBuffer, limit_send_buffer};
use super::proxies::Proxies;
use super::tls::{self, Tls};

/// Pause after the system refuses to accept a connection, for example without free file descriptors.
const BACK_OFF: Duration = Duration::from_millis(100);

/// Receive windows of HTTP/2 in bytes: per stream and per connection.
const WINDOWS: (u32, u32) = (256 << 10, 1 << 20);
/// Interval of HTTP/2 pings to a silent client, and time to answer one.
const PING: (Duration, Duration) = (Duration::from_secs(30), Duration::from_secs(20));
/// Interval of the checks of a connection's streams.
const LOOK: Duration = Duration::from_secs(1);
/// How many times faster HTTP/2 clients must read while memory is short.
const FASTER: u32 = 8;

/// Where connections arrive.
pub struct Endpoint {
    pub listener: TcpListener,
    pub tls: Option<Tls>,
    pub proxies: Proxies,
    /// Path of the server, which is removed from the addresses of requests.
    pub base: BasePath,
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
        two.max_send_buf_size(PIECE);
        two.keep_alive_interval(PING.0).keep_alive_timeout(PING.1);
        Self { one, two }
    }
}

/// Serves connections until `stop`, then gives open ones `limits.drain` to end.
pub async fn serve(endpoint: Endpoint, router: Router, limits: &Arc<Limits>, telemetry: &Arc<Telemetry>, stop: &CancellationToken) {
    let Endpoint { listener, tls, proxies, base } = endpoint;
    let http = Http::new(limits);
    let room = Arc::new(Semaphore::new(limits.connections));
    let shares = ClientSlots::per_address(limits.connections_per_address);
    let open = TaskTracker::new();
    loop {
        let accepted = tokio::select! {
            biased;
            () = stop.cancelled() => break,
            accepted = next(&listener, &room) => accepted,
        };
        let (stream, peer, permit) = match accepted {
            Ok(accepted) => accepted,
            // only this client failed
            Err(error) if is_of_the_client(&error) => continue,
            Err(error) => {
                tracing::warn!(%error, "accepting a connection");
                tokio::time::sleep(BACK_OFF).await;
                continue;
            }
        };
        // a trusted proxy carries many clients' connections, and names each client itself
        let Some(share) = shares.take((!proxies.trusts(peer)).then_some(peer)) else {
            tracing::debug!(%peer, "an address has too many connections");
            continue;
        };
        let present = (telemetry.connection(), open.token());
        let (http, router, base, limits, stop) = (http.clone(), router.clone(), base.clone(), Arc::clone(limits), stop.clone());
        let acceptor = tls.as_ref().map(Tls::acceptor);
        tokio::spawn(async move {
            let limits_buffer = Arc::new(AtomicBool::new(false));
            let held = ConnectionGuard { limits_buffer: Arc::clone(&limits_buffer), all: Arc::new((permit, share, present)) };
            let stream =
                MinimumRate::new(stream, limits.write, limits.write_rate, SmallBuffer { wanted: limits_buffer, keep: limit_send_buffer });
            let connection = Connection { http, router, base, limits, from: Peer(peer), held, stop };
            let Some(acceptor) = acceptor else { return connection.one(stream, None).await };
            match tokio::time::timeout(connection.limits.header_read, acceptor.accept(stream)).await {
                Ok(Ok(stream)) if stream.get_ref().1.alpn_protocol() == Some(tls::HTTP_2) => connection.two(stream).await,
                Ok(Ok(stream)) => connection.one(stream, Some(Secure)).await,
                Ok(Err(error)) => tracing::debug!(%error, %peer, "handshake"),
                Err(_) => tracing::debug!(%peer, "a TLS handshake takes too long"),
            }
        });
    }
    drop(listener);
    open.close();
    if tokio::time::timeout(limits.drain, open.wait()).await.is_err() {
        tracing::warn!(open = open.len(), "connections are still open at the end of the drain time");
    }
}

struct Connection {
    http: Http,
    router: Router,
    base: BasePath,
    limits: Arc<Limits>,
    from: Peer,
    held: ConnectionGuard,
    stop: CancellationToken,
}

impl Connection {
    /// Serves HTTP/1.1.
    async fn one<S: AsyncRead + AsyncWrite + Unpin + Send + 'static>(self, stream: S, secure: Option<Secure>) {
        let inner = TowerToHyperService::new(self.router);
        let (from, held, base) = (self.from, self.held, self.base);
        let service = service_fn(move |mut request: Request<Incoming>| {
            base.strip(request.uri_mut());
            request.extensions_mut().insert(from);
            request.extensions_mut().insert(held.clone());
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
    }

    /// Serves HTTP/2, only over TLS.
    async fn two<S: AsyncRead + AsyncWrite + Unpin + Send + 'static>(self, stream: S) {
        let streams = Streams::new();
        let inner = TowerToHyperService::new(self.router.clone());
        let (from, held, opened, base) = (self.from, self.held.clone(), Arc::clone(&streams), self.base.clone());
        let service = service_fn(move |mut request: Request<Incoming>| {
            base.strip(request.uri_mut());
            let open = opened.open();
            request.extensions_mut().insert(from);
            request.extensions_mut().insert(held.clone());
            request.extensions_mut().insert(Secure);
            name_host(&mut request);
            let answer = inner.call(request);
            async move { answer.await.map(|response| response.map(|body| TrackedBody::new(body, open, &ANSWERS))) }
        });
        let mut connection = pin!(self.http.two.serve_connection(TokioIo::new(stream), service));
        let mut look = tokio::time::interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut leaving = None;
        let ended = loop {
            tokio::select! {
                ended = connection.as_mut() => break ended,
                () = self.stop.cancelled(), if leaving.is_none() => {
                    leaving = Some(Instant::now());
                    connection.as_mut().graceful_shutdown();
                }
                _ = look.tick() => match (self.health(&streams), leaving) {
                    (StreamHealth::Idle, None) => {
                        leaving = Some(Instant::now());
                        connection.as_mut().graceful_shutdown();
                    }
                    (StreamHealth::Idle, Some(since)) if since.elapsed() <= self.limits.write => {}
                    (StreamHealth::Stalled | StreamHealth::Idle, _) => {
                        tracing::debug!(peer = %from.0, "the client does not read its answers");
                        break Ok(());
                    }
                    (StreamHealth::Fine, _) => {}
                }
            }
        };
        if let Err(error) = ended {
            tracing::debug!(%error, "connection");
        }
    }

    /// Verdict on a connection of HTTP/2, whose client must read faster while memory is short.
    fn health(&self, streams: &Streams) -> StreamHealth {
        let faster = if ANSWERS.is_short() { FASTER } else { 1 };
        let Limits { write, write_rate, header_read, .. } = *self.limits;
        streams.check(std::time::Instant::now(), write / faster, write_rate.saturating_mul(faster.into()), header_read)
    }
}

/// Sets the `Host` header of an HTTP/2 request, as in HTTP/1.1.
fn name_host(request: &mut Request<Incoming>) {
    let named = request.uri().authority().and_then(|authority| HeaderValue::from_str(authority.as_str()).ok());
    if let Some(named) = named
        && !request.headers().contains_key(HOST)
    {
        request.headers_mut().insert(HOST, named);
    }
}

/// Marks a request that came over TLS.
#[derive(Clone, Copy, Debug)]
pub struct Secure;

/// The other end of a connection: a client, or a proxy.
#[derive(Clone, Copy, Debug)]
pub struct Peer(pub IpAddr);

/// Resources of a connection that are limited in number; a WebSocket keeps them after the upgrade.
#[derive(Clone)]
pub struct ConnectionGuard {
    limits_buffer: Arc<AtomicBool>,
    #[expect(dead_code, reason = "held until it is dropped")]
    all: Arc<(OwnedSemaphorePermit, ClientSlot, (GaugeGuard, TaskTrackerToken))>,
}

impl ConnectionGuard {
    /// Limits the send buffer from the next write on, since live data is soon stale.
    pub fn limit_send_buffer(&self) {
        self.limits_buffer.store(true, Ordering::Relaxed);
    }
}

/// Send buffer for live data in bytes. By default the system buffers up to 4 MB, which a viewer who stalls would see before live data.
#[cfg(target_os = "linux")]
const UNSENT: u32 = 256 << 10;

/// Errors of one connection, not of the system.
fn is_of_the_client(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionAborted, ConnectionRefused, ConnectionReset, NotConnected};
    matches!(error.kind(), ConnectionAborted | ConnectionRefused | ConnectionReset | NotConnected)
}

async fn next(listener: &TcpListener, room: &Arc<Semaphore>) -> io::Result<(TcpStream, IpAddr, OwnedSemaphorePermit)> {
    let permit = Arc::clone(room).acquire_owned().await.map_err(io::Error::other)?;
    let (stream, peer) = listener.accept().await?;
    // answers are written in one go, so delaying for more data only adds latency; if this fails, the client has gone
    let _ = stream.set_nodelay(true);
    #[cfg(target_os = "linux")]
    let _ = socket2::SockRef::from(&stream).set_tcp_notsent_lowat(UNSENT);
    Ok((stream, peer.ip(), permit))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_a_client_do_not_pause_accepting() {
        assert!(is_of_the_client(&io::ErrorKind::ConnectionAborted.into()) && is_of_the_client(&io::ErrorKind::ConnectionReset.into()));
        assert!(!is_of_the_client(&io::Error::from_raw_os_error(24)), "no descriptor is left");
    }
}
