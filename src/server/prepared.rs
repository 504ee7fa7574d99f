//! Answers that are given again. The head of the answer to a plain question for a file of a finished photo is kept beside the file; the next
//! who asks so is answered from there, with the same checks, counts and line in the log, but without a way through all layers. Whoever asks
//! otherwise – for a range, with a tag, a cookie or a key, by a method that is not GET – goes that way.

use std::net::IpAddr;
use std::sync::{Arc, OnceLock};
use std::time::Instant;

use axum::body::{Body, HttpBody};
use axum::http::{HeaderMap, HeaderName, Method, Request, StatusCode, Version, header};
use axum::response::Response;

use super::app::App;
use super::conditional::{IMMUTABLE, REVALIDATE};
use super::id::PhotoId;
use super::kept::Derived;
use super::middleware::{self, REQUEST_ID, SERVER_TIMING};
use super::part::Part;
use super::rates::{Asker, POLICY, RATE_LIMIT};
use super::sendfile::InFile;
use super::settings::Visibility;
use super::source::Source;
use super::telemetry::Counted;
use tmpi_core::container::LEVELS;

/// Last part of the address, route and file.
const ROUTES: [(&str, &str, Part); 3] = [
    ("atlas", "/v1/photos/{id}/atlas", Part::Atlas),
    ("thumbnail", "/v1/photos/{id}/thumbnail", Part::Thumbnail),
    ("depth", "/v1/photos/{id}/depth", Part::Disparity),
];

/// Headers of requests on which no answer of these routes depends; a request with any other is not plain.
static IDLE: [HeaderName; 21] = [
    header::HOST,
    header::USER_AGENT,
    header::ACCEPT,
    header::ACCEPT_ENCODING,
    header::ACCEPT_LANGUAGE,
    header::CONNECTION,
    header::REFERER,
    header::ORIGIN,
    header::CACHE_CONTROL,
    header::PRAGMA,
    header::DNT,
    header::UPGRADE_INSECURE_REQUESTS,
    HeaderName::from_static("priority"),
    HeaderName::from_static("sec-ch-ua"),
    HeaderName::from_static("sec-ch-ua-mobile"),
    HeaderName::from_static("sec-ch-ua-platform"),
    HeaderName::from_static("sec-fetch-dest"),
    HeaderName::from_static("sec-fetch-mode"),
    HeaderName::from_static("sec-fetch-site"),
    HeaderName::from_static("sec-fetch-user"),
    HeaderName::from_static("sec-gpc"),
];

/// A plain question for a file of a photo.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Question {
    id: PhotoId,
    /// Place in [`ROUTES`].
    route: usize,
    level: u8,
    version: Option<String>,
}

impl Question {
    /// That of a request; none where it asks for something else, or for more.
    #[must_use]
    pub fn of<B: HttpBody>(request: &Request<B>) -> Option<Self> {
        let plain = request.method() == Method::GET
            && request.version() == Version::HTTP_11
            && request.uri().authority().is_none()
            && request.body().is_end_stream();
        let (id, last) = request.uri().path().strip_prefix("/v1/photos/").filter(|_| plain)?.split_once('/')?;
        let route = ROUTES.iter().position(|(name, ..)| *name == last)?;
        let id = id.parse().ok()?;
        let (mut level, mut version) = (None, None);
        for pair in request.uri().query().into_iter().flat_map(|query| query.split('&')) {
            // what is written in another way means the same, perhaps
            match pair.split_once('=')? {
                ("v", value) if version.is_none() && value.bytes().all(|b| b.is_ascii_alphanumeric()) => version = Some(value.to_owned()),
                ("level", digit) if level.is_none() && route == 0 && digit.len() == 1 => level = Some(digit.parse().ok()?),
                _ => return None,
            }
        }
        let level = level.unwrap_or(0);
        let idle = request.headers().keys().all(|name| IDLE.contains(name));
        (idle && level <= LEVELS).then_some(Self { id, route, level, version })
    }
}

/// Heads of answers that hold one file whole.
#[derive(Debug, Default)]
pub struct Heads {
    /// To who does not say which version is wanted.
    usual: OnceLock<HeaderMap>,
    /// To who names the version that it is.
    versioned: OnceLock<(String, HeaderMap)>,
}

impl Heads {
    fn of(&self, version: Option<&str>) -> Option<&HeaderMap> {
        match version {
            None => self.usual.get(),
            Some(asked) => self.versioned.get().filter(|(named, _)| named == asked).map(|(_, head)| head),
        }
    }

    /// Keeps the head of the answer to `question`, where the next one may have the same.
    pub fn keep(&self, question: Question, response: &Response) {
        let headers = response.headers();
        let of_one =
            [header::VARY, header::SET_COOKIE, header::CONNECTION, header::CONTENT_ENCODING].iter().any(|n| headers.contains_key(n));
        let own = [REQUEST_ID, SERVER_TIMING].iter().all(|name| headers.get_all(name).iter().count() == 1);
        let lasts = headers.get(header::CACHE_CONTROL).and_then(|v| v.to_str().ok());
        if response.status() != StatusCode::OK || of_one || !own || self.of(question.version.as_deref()).is_some() {
            return;
        }
        let mut head = headers.clone();
        head.remove(&RATE_LIMIT);
        head.remove(&POLICY);
        // who was here first has set the same
        match (question.version, lasts) {
            (None, Some(REVALIDATE)) => drop(self.usual.set(head)),
            (Some(version), Some(IMMUTABLE)) => drop(self.versioned.set((version, head))),
            _ => {}
        }
    }
}

/// Answers from what is kept.
#[derive(Clone)]
pub struct Prepared {
    app: App,
    counted: Arc<[OnceLock<Counted>; ROUTES.len()]>,
}

impl Prepared {
    /// Of a server's photos.
    #[must_use]
    pub fn new(app: App) -> Self {
        Self { app, counted: Arc::default() }
    }

    /// The answer to a request that asks `question`, and where its bytes lie in a file; none where it is to go the usual way.
    pub fn answer<B>(&self, request: &Request<B>, question: &Question, peer: IpAddr) -> Option<(Response, Option<InFile>)> {
        let (start, app) = (Instant::now(), &self.app);
        if app.jobs.cluster.is_some() || app.telemetry.traces().is_some() || app.hosts.check(request).is_err() {
            return None;
        }
        let entry = app.jobs.get(question.id)?;
        // what is everybody's needs no caller
        if app.guard.is_some() && entry.settings().visibility != Some(Visibility::Link) {
            return None;
        }
        let version = (question.id, entry.done_at()?);
        let (_, route, part) = ROUTES[question.route];
        let stored = match question.level {
            0 => app.files.at_hand(&(version, part)),
            level => app.levels.at_hand(&(version, Derived { level, tiles: None, sections: None })),
        }?;
        let head = stored.heads.of(question.version.as_deref())?;
        let in_file = stored.source.in_file(0..stored.source.len());
        let (Source::Memory(bytes) | Source::Both(bytes, _)) = stored.source else { return None };
        // last: who goes the usual way is counted there
        let asker = Some(peer).filter(|ip| !ip.to_canonical().is_loopback());
        let (told, taken) = app.rates.take(Asker::of(None, asker), &Method::GET, route);
        taken.ok()?;
        let _in_flight = app.telemetry.in_flight();
        entry.look(super::time::now_ms());
        let id = middleware::request_id(request.headers());
        let span = middleware::span(&id, Some(peer), request.method(), request.uri().path());
        let mut response = Response::new(Body::from(bytes));
        *response.headers_mut() = head.clone();
        // of the one whose head it was
        response.headers_mut().remove(SERVER_TIMING);
        told.put(&mut response);
        let took = start.elapsed();
        middleware::put_own(&mut response, &id, took);
        self.counted[question.route].get_or_init(|| app.telemetry.counted("GET", route, StatusCode::OK.as_u16())).request(took);
        middleware::log(&span, StatusCode::OK, took);
        Some((response, in_file))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ID: &str = "0123456789abcdef0123456789abcdef";

    fn asked(target: &str, headers: &[(&str, &str)]) -> Option<Question> {
        let request = Request::builder().uri(target);
        let request = headers.iter().fold(request, |request, (name, value)| request.header(*name, *value));
        Question::of(&request.body(Body::empty()).unwrap())
    }

    #[test]
    fn plain_questions_and_others() {
        let photo = format!("/v1/photos/{ID}");
        let of = |rest: &str| asked(&format!("{photo}/{rest}"), &[("host", "localhost"), ("accept-encoding", "gzip")]);
        let question = |route, level, version: Option<&str>| {
            Some(Question { id: ID.parse().unwrap(), route, level, version: version.map(str::to_owned) })
        };
        assert_eq!(of("atlas"), question(0, 0, None));
        assert_eq!(of("atlas?level=2&v=a0"), question(0, 2, Some("a0")));
        assert_eq!(of("thumbnail?v=a0"), question(1, 0, Some("a0")));
        assert_eq!(of("depth"), question(2, 0, None));
        let others =
            ["atlas?", "atlas?level=9", "atlas?level=01", "atlas?level=1&level=1", "atlas?v=%61", "atlas?fit=9", "atlas?sections=photo"];
        for other in
            others.into_iter().chain(["thumbnail?level=1", "report", "atlas/", "view", "atlas?v=a&v=a", "atlas?expires=1&signature=a"])
        {
            assert_eq!(of(other), None, "{other}");
        }
        for (name, value) in
            [("range", "bytes=0-1"), ("if-none-match", "\"a\""), ("if-match", "\"a\""), ("cookie", "a=b"), ("authorization", "Bearer a")]
        {
            assert_eq!(asked(&format!("{photo}/atlas"), &[(name, value)]), None, "{name}");
        }
        for name in ["x-request-id", "traceparent", "expect", "forwarded", "via", "x-forwarded-for", "upgrade", "content-length", "prefer"]
        {
            assert_eq!(asked(&format!("{photo}/atlas"), &[(name, "1")]), None, "{name}");
        }
        assert_eq!(asked(&format!("http://localhost{photo}/atlas"), &[]), None);
        for (method, version) in [(Method::HEAD, Version::HTTP_11), (Method::POST, Version::HTTP_11), (Method::GET, Version::HTTP_10)] {
            let request = Request::builder().method(method).version(version).uri(format!("{photo}/atlas"));
            assert_eq!(Question::of(&request.body(Body::empty()).unwrap()), None);
        }
        let request = Request::builder().uri(format!("{photo}/atlas"));
        assert_eq!(Question::of(&request.body(Body::from("a body")).unwrap()), None);
    }

    #[test]
    fn heads_that_the_next_may_have_are_kept() {
        let answer = |status: u16, headers: &[(&str, &str)]| {
            let own = [("x-request-id", "1"), ("server-timing", "total;dur=1"), ("ratelimit", "1")];
            let builder = own.iter().chain(headers).fold(Response::builder().status(status), |b, (name, value)| b.header(*name, *value));
            builder.body(Body::empty()).unwrap()
        };
        let kept = |version: Option<&str>, status, headers: &[(&str, &str)]| {
            let heads = Heads::default();
            let question = Question { id: ID.parse().unwrap(), route: 0, level: 0, version: version.map(str::to_owned) };
            heads.keep(question, &answer(status, headers));
            let head = heads.of(version).cloned();
            assert!(heads.of(Some("b")).is_none(), "another version");
            head
        };
        let (usual, lasting) = (("cache-control", REVALIDATE), ("cache-control", IMMUTABLE));
        assert!(kept(None, 200, &[usual]).is_some_and(|head| !head.contains_key(RATE_LIMIT) && head.contains_key(REQUEST_ID)));
        assert!(kept(Some("a"), 200, &[lasting]).is_some());
        assert!(kept(Some("a"), 200, &[usual]).is_none(), "a version that is none");
        for (status, headers) in [
            (206, &[usual][..]),
            (304, &[usual]),
            (200, &[]),
            (200, &[("cache-control", "private, no-store")]),
            (200, &[usual, ("vary", "accept-encoding")]),
            (200, &[usual, ("set-cookie", "a=b")]),
            (200, &[usual, ("server-timing", "draw;dur=1")]),
        ] {
            assert!(kept(None, status, headers).is_none(), "{status} {headers:?}");
        }
    }
}
