//! Middleware around every request: id, time limit, log line, counters, and common headers.

use std::net::IpAddr;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use axum::body::{Body, HttpBody as _};
use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, Version, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures_util::FutureExt as _;
use opentelemetry::Context;
use opentelemetry::context::FutureExt as _;
use tracing::{Instrument, Span};

use super::accept_loop::{Peer, Secure};
use super::access::{self, Guard};
use super::app_state::App;
use super::client_slots::{CLIENT, client_address};
use super::conditional::insert;
use super::hosts::{Hosts, SECURE};
use super::limits::Limits;
use super::pages::RESOURCE_POLICY;
use super::problem::Problem;
use super::proxies::Proxies;
use super::rate_limit::{RateHeaders, RateKey, RateLimiter};
use super::request_body::LimitedBody;
use super::time_limit::TimeLimit;
use super::traces;

/// Header of the id of a request.
const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
/// Header with the times of a request.
const SERVER_TIMING: HeaderName = HeaderName::from_static("server-timing");
/// Longest id to accept from a client.
const MAX_ID: usize = 64;

/// Wraps a request.
pub async fn around(State(app): State<App>, request: Request, next: Next) -> Response {
    wrap(&app, Checks { hosts: &app.hosts, proxies: Some(&app.proxies), guard: app.guard.as_ref(), rates: Some(&app.rates) }, request, next)
        .await
}

/// Wraps a request at the admin listener, which has no authentication.
pub async fn around_admin(State((app, hosts)): State<(App, Arc<Hosts>)>, request: Request, next: Next) -> Response {
    wrap(&app, Checks { hosts: &hosts, proxies: None, guard: None, rates: None }, request, next).await
}

/// The listener of a request.
#[derive(Clone, Copy)]
struct Checks<'a> {
    hosts: &'a Hosts,
    proxies: Option<&'a Proxies>,
    guard: Option<&'a Guard>,
    rates: Option<&'a RateLimiter>,
}

/// Wraps a request.
async fn wrap(app: &App, checks: Checks<'_>, request: Request, next: Next) -> Response {
    let start = Instant::now();
    let _in_flight = app.telemetry.in_flight();
    let id = request_id(request.headers());
    let method = request.method().clone();
    let matched = request.extensions().get::<MatchedPath>().cloned();
    let route = matched.as_ref().map_or("none", MatchedPath::as_str);
    let peer = request.extensions().get::<Peer>().map(|p| p.0);
    let peer = peer.map(|peer| checks.proxies.map_or(peer, |proxies| proxies.client(peer, request.headers())));
    let mut client = peer.filter(|ip| !ip.to_canonical().is_loopback());
    let asked_by_node = app.rooms.get().and_then(|rooms| rooms.asked_by_node(request.uri().path(), request.headers()));
    // another node asks for many viewers, whose requests it has counted
    if let Some(is_node) = asked_by_node
        && is_node.await
    {
        client = None;
    }
    let trace = app.telemetry.traces().map_or_else(Context::new, |to| to.request(known_method(&method), route, request.headers(), peer));
    let span = span(&id, peer, &method, request.uri().path());
    if let Some(id) = traces::trace_id(&trace) {
        span.record("trace", id);
    }
    let secure = request.extensions().get::<Secure>().is_some();
    let answered = answer(app, checks, request, next).instrument(span.clone()).with_context(trace.clone());
    let mut response = CLIENT.scope(client, SECURE.scope(secure, answered)).await;
    response = finish(response, &id).await;
    if secure {
        put_secure(&mut response, &app.limits);
    }
    let took = start.elapsed();
    put_own(&mut response, &id, took);
    let status = response.status().as_u16();
    app.telemetry.request(known_method(&method), route, status, took);
    traces::answered(&trace, status);
    log(&span, response.status(), took);
    response
}

fn span(id: &str, peer: Option<IpAddr>, method: &Method, path: &str) -> Span {
    tracing::info_span!("request", id, peer = peer.map(tracing::field::display), %method, path, trace = tracing::field::Empty)
}

fn log(span: &Span, status: StatusCode, took: Duration) {
    span.in_scope(|| {
        let (ms, is_ours, status) = ((took.as_secs_f64() * 1e5).round() / 1e2, status.is_server_error(), status.as_u16());
        if is_ours { tracing::warn!(status, ms) } else { tracing::info!(status, ms) }
    });
}

/// Sets Strict-Transport-Security on answers over TLS.
fn put_secure(response: &mut Response, limits: &Limits) {
    let seconds = limits.hsts.as_secs();
    if seconds > 0 {
        insert(response, header::STRICT_TRANSPORT_SECURITY, &format!("max-age={seconds}"));
    }
}

/// Adds the request's id and its total time to the answer.
fn put_own(response: &mut Response, id: &str, took: Duration) {
    insert(response, REQUEST_ID, id);
    if let Ok(total) = HeaderValue::try_from(format!("total;dur={:.2}", took.as_secs_f64() * 1e3)) {
        response.headers_mut().append(SERVER_TIMING, total);
    }
}

/// The handler's answer, or a problem if it takes too long or panics.
async fn answer(app: &App, checks: Checks<'_>, request: Request, next: Next) -> Response {
    let limits = Arc::clone(&app.limits);
    let clock = TimeLimit::new(limits.request);
    let awaited = request.headers().contains_key(header::EXPECT);
    let mut rest = None;
    let mut request = if request.body().is_end_stream() {
        // no body to wait for
        clock.start();
        request
    } else {
        request.map(|body| {
            let (guarded, left) = LimitedBody::new(body, &limits, clock.clone());
            rest = Some(left);
            Body::new(guarded)
        })
    };
    if *request.method() != Method::GET {
        // ranges apply only to GET (RFC 9110, section 14.2)
        request.headers_mut().remove(header::RANGE);
    }
    request.extensions_mut().insert(clock.clone());
    // HTTP/2 streams end individually
    let closes = request.version() < Version::HTTP_2;
    let handled = async {
        match checks.hosts.check(&request).and_then(|()| only_chunked(request.headers())) {
            Ok(()) => asked(checks, request, next).await,
            Err(refused) => refused.into_response(),
        }
    };
    let mut response = tokio::select! {
        // no timer if the answer is ready at once
        biased;
        handled = AssertUnwindSafe(handled).catch_unwind() => match handled {
            Ok(response) => response,
            Err(_) => Problem::internal("the request's handler panicked", &"see above").into_response(),
        },
        limit = clock.expired() => {
            let detail = format!("there was no answer within {limit:?}");
            Problem::new(StatusCode::SERVICE_UNAVAILABLE, "timeout", detail).retry_after(5).into_response()
        }
    };
    if let Some(rest) = rest.filter(|rest| !rest.ended()) {
        // in the background, so that the answer does not wait
        tokio::spawn(rest.drain(limits.body, awaited));
        if closes {
            response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
        }
    }
    response
}

/// Checks host, access and rate limits, then calls the handler.
async fn asked(checks: Checks<'_>, mut request: Request, next: Next) -> Response {
    let (told, come) = match (checks.guard.zip(checks.proxies), checks.rates) {
        (Some((guard, proxies)), Some(rates)) => {
            let (told, pass) = guard.admit((checks.hosts, proxies), rates, &mut request).await;
            (told, pass.map(|pass| Some((guard, pass))))
        }
        (None, Some(rates)) => {
            // signed links must still work after a change to open access
            access::drop_link(&mut request);
            let (told, taken) = rates.count(RateKey::of(None, client_address()), &request);
            (told, taken.map(|()| None))
        }
        (_, None) => (RateHeaders::default(), Ok(None)),
    };
    let mut response = match come {
        Ok(Some((guard, pass))) => guard.answer(pass, request, next).await,
        Ok(None) => next.run(request).await,
        Err(refused) => refused.into_response(),
    };
    told.put(&mut response);
    response
}

/// Refuses transfer codings other than chunked, which would be misread (RFC 9112, section 6.1).
fn only_chunked(headers: &HeaderMap) -> Result<(), Problem> {
    let mut all = headers.get_all(header::TRANSFER_ENCODING).iter();
    if all.all(|v| v.as_bytes().eq_ignore_ascii_case(b"chunked")) {
        return Ok(());
    }
    let detail = "bodies must be sent plain or chunked, not in another transfer coding";
    Err(Problem::new(StatusCode::NOT_IMPLEMENTED, "transfer-coding", detail).field("Transfer-Encoding"))
}

/// Turns every error into a problem with the request's id.
async fn finish(response: Response, id: &str) -> Response {
    let status = response.status();
    // keep error pages for people
    let is_page = response.headers().get(header::CONTENT_TYPE).is_some_and(|t| t.as_bytes().starts_with(b"text/html"));
    let mut response = if !is_page && (status.is_client_error() || status.is_server_error()) {
        let (parts, body) = response.into_parts();
        let mut problem = if let Some(problem) = parts.extensions.get::<Problem>() {
            problem.clone()
        } else {
            // errors of the framework are one short line of text
            let text = axum::body::to_bytes(body, 4096).await.unwrap_or_default();
            Problem::new(status, "request", String::from_utf8_lossy(&text))
        };
        problem.request_id = Some(id.to_owned().into());
        let mut response = problem.into_response();
        for (name, value) in &parts.headers {
            if name != header::CONTENT_TYPE && name != header::CONTENT_LENGTH {
                response.headers_mut().insert(name, value.clone());
            }
        }
        response
    } else {
        response
    };
    let headers = response.headers_mut();
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.entry(header::REFERRER_POLICY).or_insert(HeaderValue::from_static("no-referrer"));
    headers.entry(header::CONTENT_SECURITY_POLICY).or_insert(HeaderValue::from_static("default-src 'none'; frame-ancestors 'none'"));
    headers.entry(RESOURCE_POLICY).or_insert(HeaderValue::from_static("same-origin"));
    if !headers.contains_key(header::CACHE_CONTROL) {
        insert(&mut response, header::CACHE_CONTROL, "no-store");
    }
    response
}

/// The client's request id if it is harmless, else a new one.
fn request_id(headers: &HeaderMap) -> String {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let harmless = |v: &&str| !v.is_empty() && v.len() <= MAX_ID && v.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_.".contains(&b));
    headers
        .get(REQUEST_ID)
        .and_then(|v| v.to_str().ok())
        .filter(harmless)
        .map_or_else(|| format!("{:x}-{:x}", super::since_1970().as_millis(), NEXT.fetch_add(1, Ordering::Relaxed)), str::to_owned)
}

/// Method label from a closed set, so that clients cannot create new counters.
fn known_method(method: &Method) -> &'static str {
    match *method {
        Method::GET => "GET",
        Method::HEAD => "HEAD",
        Method::POST => "POST",
        Method::DELETE => "DELETE",
        Method::PATCH => "PATCH",
        Method::OPTIONS => "OPTIONS",
        _ => "other",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_harmless_request_ids_are_kept() {
        let with = |id: &str| request_id(&[(REQUEST_ID, HeaderValue::from_str(id).unwrap())].into_iter().collect());
        assert_eq!(with("abc-1_2.3"), "abc-1_2.3");
        assert_eq!(with(&"x".repeat(MAX_ID)).len(), MAX_ID);
        for bad in ["", "a b", "<b>", &"x".repeat(MAX_ID + 1)] {
            assert_ne!(with(bad), bad);
        }
        assert_ne!(request_id(&HeaderMap::new()), request_id(&HeaderMap::new()));
    }
}
