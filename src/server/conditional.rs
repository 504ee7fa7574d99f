//! Entity tags, conditional requests and ranges (RFC 9110, sections 8.8, 13 and 14).

use std::ops::Range;

use super::body_source::Source;
use super::compress;
use super::problem::Problem;
use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use flate2::Compression;

/// Cached for a year without revalidation: only for addresses with the version.
pub const IMMUTABLE: &str = "public, max-age=31536000, immutable";
/// Capacity of an answer's header table, with those that layers add, so that it grows once.
const HEADERS: usize = 20;
/// Cached, but revalidated each time.
pub const REVALIDATE: &str = "no-cache";

/// `Cache-Control` of the answer to a request for version `asked`, if `version` is sent.
pub fn cache_control_for(asked: Option<&str>, version: impl FnOnce() -> String) -> &'static str {
    if asked.is_some_and(|asked| asked == version()) { IMMUTABLE } else { REVALIDATE }
}

/// The representation to send.
pub struct Entity<'a> {
    /// All bytes.
    pub source: Source,
    /// Strong entity tag with its quotes.
    pub etag: &'a str,
    pub content_type: &'a str,
    pub cache_control: &'a str,
    /// Whether gzip is possible.
    pub coding: ContentCoding,
}

impl<'a> Entity<'a> {
    /// JSON that clients revalidate.
    pub const fn json(source: Source, etag: &'a str) -> Self {
        Self { source, etag, content_type: "application/json", cache_control: REVALIDATE, coding: ContentCoding::Gzip }
    }
}

/// Whether an answer may be compressed.
#[derive(Clone, Debug)]
pub enum ContentCoding {
    /// No: it is compressed already.
    Plain,
    /// Yes, on request.
    Gzip,
    /// Yes, with the bytes prepared; `None` if it is not worth it.
    Coded(Option<Bytes>),
}

impl ContentCoding {
    /// The compressed bytes, if the client accepts them.
    fn for_client(self, headers: &HeaderMap, source: &Source) -> Option<Bytes> {
        // ranges apply to the plain answer
        if matches!(self, Self::Plain) || headers.contains_key(header::RANGE) || !compress::accepts_gzip(headers) {
            return None;
        }
        match (self, source) {
            (Self::Coded(coded), _) => coded,
            (Self::Gzip, Source::Memory(bytes)) => compress::gzip(bytes, Compression::default()),
            _ => None,
        }
    }
}

#[derive(Debug, PartialEq, Eq)]
pub enum RequestedRange {
    All,
    Part(Range<usize>),
    /// A range outside the content.
    Unsatisfiable,
}

/// The tags of a condition.
fn tags(headers: &HeaderMap, name: header::HeaderName) -> impl Iterator<Item = &str> {
    headers.get_all(name).into_iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split(',')).map(str::trim)
}

fn without_weakness(tag: &str) -> &str {
    tag.strip_prefix("W/").unwrap_or(tag)
}

/// Whether the client has this version (`If-None-Match`, weak comparison).
pub fn matches_etag(headers: &HeaderMap, etag: &str) -> bool {
    tags(headers, header::IF_NONE_MATCH).map(without_weakness).any(|tag| tag == "*" || tag == etag)
}

/// The client's tag that begins with `made`, the name of the inputs; such tags end with a digest of the bytes. So the server can answer 304
/// without making the bytes again.
pub fn known_etag<'a>(headers: &'a HeaderMap, made: &str) -> Option<&'a str> {
    tags(headers, header::IF_NONE_MATCH).map(without_weakness).find(|tag| {
        let digest = tag.strip_prefix('"').and_then(|t| t.strip_suffix('"')?.strip_prefix(made)?.strip_prefix('-'));
        digest.is_some_and(|d| d.len() == 16 && d.bytes().all(|b| b.is_ascii_hexdigit()))
    })
}

/// 304 for a client that has the version `etag`.
pub fn not_modified(etag: &str, cache_control: &str) -> Response {
    let mut response = StatusCode::NOT_MODIFIED.into_response();
    insert(&mut response, header::ETAG, etag);
    insert(&mut response, header::CACHE_CONTROL, cache_control);
    response
}

/// Reads `Range` and `If-Range` for `length` bytes; ignores malformed headers, other units and multiple ranges.
pub fn requested_range(headers: &HeaderMap, etag: &str, length: usize) -> RequestedRange {
    if headers.get(header::IF_RANGE).is_some_and(|v| v.as_bytes() != etag.as_bytes()) {
        return RequestedRange::All;
    }
    let range = headers.get(header::RANGE).and_then(|v| v.to_str().ok()?.split_once('='));
    let range = range.filter(|(unit, _)| unit.trim().eq_ignore_ascii_case("bytes")).and_then(|(_, range)| range.trim().split_once('-'));
    let Some((first, last)) = range else { return RequestedRange::All };
    let digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
    if !digits(first) || !digits(last) || (first.is_empty() && last.is_empty()) {
        return RequestedRange::All;
    }
    // a number that overflows is beyond any length
    let number = |s: &str| s.parse::<usize>().unwrap_or(usize::MAX);
    if first.is_empty() {
        let suffix = number(last).min(length);
        return if suffix == 0 { RequestedRange::Unsatisfiable } else { RequestedRange::Part(length - suffix..length) };
    }
    let start = number(first);
    let end = if last.is_empty() { length } else { number(last).saturating_add(1).min(length) };
    if !last.is_empty() && number(last) < start {
        return RequestedRange::All;
    }
    if start >= length { RequestedRange::Unsatisfiable } else { RequestedRange::Part(start..end) }
}

/// Whether `If-Match` allows a version by its tag (strong comparison: a weak one matches nothing). Nothing here has a date, so
/// `If-Unmodified-Since` does not apply (RFC 9110, section 13.1.4).
fn is_wanted(headers: &HeaderMap, matches: impl Fn(&str) -> bool) -> bool {
    !headers.contains_key(header::IF_MATCH) || tags(headers, header::IF_MATCH).any(|tag| tag == "*" || matches(tag))
}

/// Checks that the client saw the current version (`If-Match`, RFC 9110, section 13.1.1).
///
/// # Errors
/// 412 if `If-Match` names other versions than `etag`. In a tag of two parts with a dash between them only the first counts: it covers
/// what clients can change.
pub fn check_if_match(headers: &HeaderMap, etag: &str) -> Result<(), Problem> {
    fn part(tag: &str) -> Option<&str> {
        tag.strip_prefix('"')?.strip_suffix('"')?.split('-').next()
    }
    if is_wanted(headers, |tag| part(tag).is_some_and(|p| Some(p) == part(etag))) {
        return Ok(());
    }
    let detail = format!("the photo was changed meanwhile; it is {etag} now");
    Err(Problem::new(StatusCode::PRECONDITION_FAILED, "changed", detail).field("If-Match"))
}

/// Answers a GET or HEAD: 200, 206, 304, 412 or 416.
pub fn respond(headers: &HeaderMap, entity: Entity<'_>) -> Response {
    let Entity { source, etag, content_type, cache_control, coding } = entity;
    let length = source.len();
    let coded_tag = compress::gzip_etag(etag);
    let coded = !matches!(coding, ContentCoding::Plain);
    if !is_wanted(headers, |tag| tag == etag || coded && tag == coded_tag) {
        let detail = format!("the current version is {etag}");
        return Problem::new(StatusCode::PRECONDITION_FAILED, "changed", detail).field("If-Match").into_response();
    }
    // a tag of either coding is known
    if let Some(known) = [etag, &coded_tag].into_iter().take(1 + usize::from(coded)).find(|tag| matches_etag(headers, tag)) {
        return vary(not_modified(known, cache_control), coded);
    }
    if let Some(bytes) = coding.for_client(headers, &source) {
        let mut response = Response::new(Body::from(bytes));
        insert(&mut response, header::CONTENT_ENCODING, "gzip");
        insert(&mut response, header::CONTENT_TYPE, content_type);
        insert(&mut response, header::ETAG, &coded_tag);
        insert(&mut response, header::CACHE_CONTROL, cache_control);
        return vary(response, true);
    }
    let (status, range) = match requested_range(headers, etag, length) {
        RequestedRange::All => (StatusCode::OK, 0..length),
        RequestedRange::Part(range) => (StatusCode::PARTIAL_CONTENT, range),
        RequestedRange::Unsatisfiable => {
            let detail = format!("the content has {length} bytes");
            let mut response = Problem::new(StatusCode::RANGE_NOT_SATISFIABLE, "range", detail).field("Range").into_response();
            insert(&mut response, header::CONTENT_RANGE, &format!("bytes */{length}"));
            return response;
        }
    };
    let mut response = Response::new(source.body(range.clone()));
    response.headers_mut().reserve(HEADERS);
    *response.status_mut() = status;
    if status == StatusCode::PARTIAL_CONTENT {
        insert(&mut response, header::CONTENT_RANGE, &format!("bytes {}-{}/{length}", range.start, range.end - 1));
    }
    response.headers_mut().insert(header::CONTENT_LENGTH, range.len().into());
    insert(&mut response, header::CONTENT_TYPE, content_type);
    insert(&mut response, header::ACCEPT_RANGES, "bytes");
    insert(&mut response, header::ETAG, etag);
    insert(&mut response, header::CACHE_CONTROL, cache_control);
    vary(response, coded)
}

/// Answers with text without an entity tag, in gzip if the client accepts it.
pub fn respond_uncached(headers: &HeaderMap, bytes: Bytes, content_type: &str) -> Response {
    let coded = ContentCoding::Gzip.for_client(headers, &bytes.clone().into());
    let is_coded = coded.is_some();
    let mut response = Response::new(Body::from(coded.unwrap_or(bytes)));
    if is_coded {
        insert(&mut response, header::CONTENT_ENCODING, "gzip");
    }
    insert(&mut response, header::CONTENT_TYPE, content_type);
    vary(response, true)
}

/// Sets `Vary` if the answer depends on the accepted codings.
fn vary(mut response: Response, coded: bool) -> Response {
    if coded {
        response.headers_mut().append(header::VARY, HeaderValue::from_static("accept-encoding"));
    }
    response
}

/// Sets a header; skips an invalid value.
pub fn insert(response: &mut Response, name: header::HeaderName, value: &str) {
    if let Ok(value) = HeaderValue::from_str(value) {
        response.headers_mut().insert(name, value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(header::HeaderName, &str)]) -> HeaderMap {
        pairs.iter().map(|(k, v)| (k.clone(), HeaderValue::from_str(v).unwrap())).collect()
    }

    fn range(text: &str, length: usize) -> RequestedRange {
        requested_range(&headers(&[(header::RANGE, text)]), "\"e\"", length)
    }

    #[test]
    fn ranges_follow_rfc_9110() {
        assert_eq!(range("bytes=0-499", 1000), RequestedRange::Part(0..500));
        assert_eq!(range("bytes=500-", 1000), RequestedRange::Part(500..1000));
        assert_eq!(range("bytes=-500", 1000), RequestedRange::Part(500..1000));
        assert_eq!(range("bytes=-5000", 1000), RequestedRange::Part(0..1000));
        assert_eq!(range("bytes=999-5000", 1000), RequestedRange::Part(999..1000));
        assert_eq!(range("Bytes=0-0", 1000), RequestedRange::Part(0..1));
        assert_eq!(range("bytes=0-99999999999999999999999", 1000), RequestedRange::Part(0..1000));
        for none in ["bytes=1000-", "bytes=1000-1001", "bytes=-0", "bytes=99999999999999999999999-"] {
            assert_eq!(range(none, 1000), RequestedRange::Unsatisfiable, "{none}");
        }
        for ignored in ["bytes", "bytes=", "bytes=-", "bytes=5-4", "bytes=a-b", "bytes=0-1,3-4", "items=0-1", "bytes=+1-2", "bytes=--1"] {
            assert_eq!(range(ignored, 1000), RequestedRange::All, "{ignored}");
        }
        assert_eq!(range("bytes=0-", 0), RequestedRange::Unsatisfiable);
    }

    #[test]
    fn if_range_needs_the_same_strong_etag() {
        let with = |tag| requested_range(&headers(&[(header::RANGE, "bytes=0-1"), (header::IF_RANGE, tag)]), "\"e\"", 9);
        assert_eq!(with("\"e\""), RequestedRange::Part(0..2));
        for other in ["\"f\"", "W/\"e\"", "Sat, 29 Oct 1994 19:43:31 GMT"] {
            assert_eq!(with(other), RequestedRange::All);
        }
    }

    #[test]
    fn if_none_match_takes_lists_and_weak_tags() {
        for known in ["\"e\"", "W/\"e\"", "*", "\"a\", \"e\""] {
            assert!(matches_etag(&headers(&[(header::IF_NONE_MATCH, known)]), "\"e\""), "{known}");
        }
        assert!(!matches_etag(&headers(&[(header::IF_NONE_MATCH, "\"a\", e")]), "\"e\""));
        assert!(!matches_etag(&HeaderMap::new(), "\"e\""));
    }

    #[test]
    fn if_match_with_another_version_is_412() {
        let with = |tag| {
            let entity = Entity {
                source: Bytes::from_static(b"abc").into(),
                etag: "\"e\"",
                content_type: "a/b",
                cache_control: REVALIDATE,
                coding: ContentCoding::Plain,
            };
            respond(&headers(&[(header::IF_MATCH, tag), (header::RANGE, "bytes=0-1")]), entity).status().as_u16()
        };
        assert_eq!((with("\"e\""), with("*"), with("\"a\", \"e\"")), (206, 206, 206));
        assert_eq!((with("\"a\""), with("W/\"e\""), with("")), (412, 412, 412));
    }

    #[test]
    fn each_coding_has_its_own_etag_and_length() {
        let plain = Bytes::from(b"text and more text, ".repeat(100));
        let get = |pairs: &[(header::HeaderName, &str)], coding| {
            respond(
                &headers(pairs),
                Entity { source: plain.clone().into(), etag: "\"e\"", content_type: "text/plain", cache_control: REVALIDATE, coding },
            )
        };
        let shown = |response: &Response, name: header::HeaderName| response.headers().get(name).map(|v| v.to_str().unwrap().to_owned());
        let gzip = (header::ACCEPT_ENCODING, "gzip");
        let coded = get(std::slice::from_ref(&gzip), ContentCoding::Gzip);
        let expected = [("gzip", header::CONTENT_ENCODING), ("\"e-gzip\"", header::ETAG), ("accept-encoding", header::VARY)];
        for (value, name) in expected {
            assert_eq!(shown(&coded, name).as_deref(), Some(value));
        }
        assert_eq!(shown(&coded, header::ACCEPT_RANGES), None);
        for (takes, coding) in [(false, ContentCoding::Gzip), (true, ContentCoding::Plain), (true, ContentCoding::Coded(None))] {
            let got = get(std::slice::from_ref(&gzip).get(..usize::from(takes)).unwrap(), coding);
            assert_eq!((shown(&got, header::CONTENT_ENCODING), shown(&got, header::ETAG).as_deref()), (None, Some("\"e\"")));
        }
        let part = get(&[gzip.clone(), (header::RANGE, "bytes=0-1")], ContentCoding::Gzip);
        assert_eq!((part.status().as_u16(), shown(&part, header::CONTENT_ENCODING)), (206, None));
        for tag in ["\"e\"", "\"e-gzip\"", "W/\"e-gzip\""] {
            let known = get(&[gzip.clone(), (header::IF_NONE_MATCH, tag)], ContentCoding::Gzip);
            assert_eq!((known.status().as_u16(), shown(&known, header::VARY).is_some()), (304, true), "{tag}");
            assert!(tag.ends_with(&shown(&known, header::ETAG).unwrap()));
        }
        assert_eq!(get(&[(header::IF_NONE_MATCH, "\"e-gzip\"")], ContentCoding::Plain).status().as_u16(), 200);
    }

    #[test]
    fn etags_of_derived_bytes_begin_with_a_hash_of_their_inputs() {
        let with = |tags: &str| known_etag(&headers(&[(header::IF_NONE_MATCH, tags)]), "cafe").map(str::to_owned);
        assert_eq!(with("\"a\", W/\"cafe-0123456789abcdef\"").as_deref(), Some("\"cafe-0123456789abcdef\""));
        for other in ["*", "\"cafe\"", "\"cafe-\"", "\"cafe-0123456789abcdeg\"", "\"cafes-0123456789abcdef\"", "cafe-0123456789abcdef"] {
            assert_eq!(with(other), None, "{other}");
        }
    }

    #[test]
    fn if_match_protects_changes() {
        let with = |tags: &str| headers(&[(header::IF_MATCH, tags)]);
        assert!(check_if_match(&HeaderMap::new(), "\"a\"").is_ok());
        assert!(check_if_match(&with("\"b\", \"a\""), "\"a\"").is_ok() && check_if_match(&with("*"), "\"a\"").is_ok());
        assert!(check_if_match(&with("\"a-1\""), "\"a-2\"").is_ok(), "only the second part of the tag has changed");
        for other in ["\"b\"", "W/\"a\"", "a", "\"a", "\"b-1\""] {
            assert_eq!(check_if_match(&with(other), "\"a-1\"").unwrap_err().status, 412, "{other}");
        }
    }
}
