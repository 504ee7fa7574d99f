//! Around every request: its id, its time limit, its line in the log, its counters, and the headers of every answer.

use std::panic::AssertUnwindSafe;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use axum::body::Body;
use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures_util::FutureExt;
use tracing::Instrument;

use super::app::App;
use super::body::Guarded;
use super::conditional::insert;
use super::problem::Problem;

/// Header of the id of a request.
pub const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
const SERVER_TIMING: HeaderName = HeaderName::from_static("server-timing");
/// Longest id that is taken from a client.
const MAX_ID: usize = 64;

/// Wraps a request.
pub async fn around(State(app): State<App>, request: Request, next: Next) -> Response {
    let start = Instant::now();
    let _in_flight = app.telemetry.in_flight();
    let id = request_id(request.headers());
    let method = request.method().clone();
    let path = request.uri().path().to_owned();
    let route = request.extensions().get::<MatchedPath>().map_or("none", MatchedPath::as_str).to_owned();
    let span = tracing::info_span!("request", id, %method, path);
    let mut response = answer(&app, request, next).instrument(span.clone()).await;
    let response_id = HeaderValue::from_str(&id);
    response = finish(response, id).await;
    let took = start.elapsed();
    if let Ok(id) = response_id {
        response.headers_mut().insert(REQUEST_ID, id);
    }
    if let Ok(total) = HeaderValue::from_str(&format!("total;dur={:.2}", took.as_secs_f64() * 1e3)) {
        response.headers_mut().append(SERVER_TIMING, total);
    }
    let status = response.status().as_u16();
    app.telemetry.request(known_method(&method), &route, status, took);
    span.in_scope(|| {
        let ms = (took.as_secs_f64() * 1e5).round() / 1e2;
        if response.status().is_server_error() { tracing::warn!(status, ms) } else { tracing::info!(status, ms) }
    });
    response
}

/// The handler's answer, or that its time is over, or that it panicked.
async fn answer(app: &App, request: Request, next: Next) -> Response {
    if let Some(refusal) = cross_site(&request) {
        return refusal.into_response();
    }
    let limits = &app.limits;
    let awaited = request.headers().contains_key(header::EXPECT);
    let mut rest = None;
    let request = request.map(|body| {
        let (guarded, left) = Guarded::new(body, limits.body, limits.body_read);
        rest = Some(left);
        Body::new(guarded)
    });
    let handled = tokio::time::timeout(limits.request, AssertUnwindSafe(next.run(request)).catch_unwind()).await;
    let ended = rest.as_ref().is_none_or(super::body::Rest::ended);
    let mut response = match handled {
        Ok(Ok(response)) => response,
        Ok(Err(_)) => Problem::internal("the request's handler panicked", &"see above").into_response(),
        Err(_) if ended => {
            let detail = format!("no answer within {:?}", limits.request);
            Problem::new(StatusCode::SERVICE_UNAVAILABLE, "timeout", detail).retry_after(5).into_response()
        }
        Err(_) => {
            let detail = format!("the request did not arrive within {:?}", limits.request);
            Problem::new(StatusCode::REQUEST_TIMEOUT, "request-too-slow", detail).into_response()
        }
    };
    if !ended && let Some(rest) = rest {
        rest.drain(limits.body, awaited).await;
        response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    response
}

/// Makes a problem of every error, and gives it the request's id.
async fn finish(response: Response, id: String) -> Response {
    let status = response.status();
    let mut response = if status.is_client_error() || status.is_server_error() {
        let (parts, body) = response.into_parts();
        let mut problem = if let Some(problem) = parts.extensions.get::<Problem>() {
            problem.clone()
        } else {
            // what the framework says itself is one short line of text
            let text = axum::body::to_bytes(body, 4096).await.unwrap_or_default();
            Problem::new(status, "request", String::from_utf8_lossy(&text))
        };
        problem.request_id = Some(id);
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
    if !headers.contains_key(header::CACHE_CONTROL) {
        insert(&mut response, header::CACHE_CONTROL, "no-store");
    }
    response
}

/// Other sites may read pictures but not upload or delete in a visitor's name.
fn cross_site(request: &Request) -> Option<Problem> {
    let changes = !matches!(*request.method(), Method::GET | Method::HEAD | Method::OPTIONS);
    let foreign = request.headers().get("sec-fetch-site").is_some_and(|v| v == "cross-site");
    (changes && foreign).then(|| Problem::new(StatusCode::FORBIDDEN, "cross-site", "a page of another site may not change anything here"))
}

/// The client's id of the request where it is harmless, else a fresh one.
fn request_id(headers: &HeaderMap) -> String {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let harmless = |v: &&str| !v.is_empty() && v.len() <= MAX_ID && v.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_.".contains(&b));
    headers
        .get(REQUEST_ID)
        .and_then(|v| v.to_str().ok())
        .filter(harmless)
        .map_or_else(|| format!("{:x}-{:x}", super::time::now_ms(), NEXT.fetch_add(1, Ordering::Relaxed)), str::to_owned)
}

/// A closed set, so that no client can fill the counters.
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
    fn ids_are_taken_only_where_harmless() {
        let with = |id: &str| request_id(&[(REQUEST_ID, HeaderValue::from_str(id).unwrap())].into_iter().collect());
        assert_eq!(with("abc-1_2.3"), "abc-1_2.3");
        assert_eq!(with(&"x".repeat(MAX_ID)).len(), MAX_ID);
        for bad in ["", "a b", "<b>", &"x".repeat(MAX_ID + 1)] {
            assert_ne!(with(bad), bad);
        }
        assert_ne!(request_id(&HeaderMap::new()), request_id(&HeaderMap::new()));
    }
}
