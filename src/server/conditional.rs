//! Entity tags, conditional requests and ranges (RFC 9110, sections 8.8, 13 and 14).

use std::ops::Range;

use super::problem::Problem;
use super::source::Source;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};

/// A year, and never asked for again: only under an address that names the version.
const IMMUTABLE: &str = "public, max-age=31536000, immutable";
/// Kept, but asked for again each time.
pub const REVALIDATE: &str = "no-cache";

/// How long the answer to a request for version `asked` may be kept, where `version` is what is sent.
#[must_use]
pub fn kept(asked: Option<&str>, version: &str) -> &'static str {
    if asked == Some(version) { IMMUTABLE } else { REVALIDATE }
}

/// What a response is about.
pub struct Entity<'a> {
    /// All bytes.
    pub source: Source,
    /// Strong entity tag with its quotes.
    pub etag: &'a str,
    /// Media type.
    pub content_type: &'a str,
    /// `Cache-Control`.
    pub cache_control: &'a str,
}

/// Which bytes a request wants.
#[derive(Debug, PartialEq, Eq)]
pub enum Wanted {
    /// All.
    All,
    /// These.
    Part(Range<usize>),
    /// None that exist.
    Unsatisfiable,
}

/// True where the client has this very version (`If-None-Match`, weak comparison).
#[must_use]
pub fn is_known(headers: &HeaderMap, etag: &str) -> bool {
    headers.get_all(header::IF_NONE_MATCH).iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split(',')).any(|candidate| {
        let candidate = candidate.trim();
        candidate == "*" || candidate.strip_prefix("W/").unwrap_or(candidate) == etag
    })
}

/// The tag among those that the client has of which the bytes were made as `made` says: such tags begin with it and go on with a
/// digest of the bytes. So what is known need not be made again to say so.
#[must_use]
pub fn known_as<'a>(headers: &'a HeaderMap, made: &str) -> Option<&'a str> {
    let tags = headers.get_all(header::IF_NONE_MATCH).iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split(','));
    tags.map(str::trim).map(|tag| tag.strip_prefix("W/").unwrap_or(tag)).find(|tag| {
        let digest = tag.strip_prefix('"').and_then(|t| t.strip_suffix('"')?.strip_prefix(made)?.strip_prefix('-'));
        digest.is_some_and(|d| d.len() == 16 && d.bytes().all(|b| b.is_ascii_hexdigit()))
    })
}

/// The answer to a client that has the version `etag`.
#[must_use]
pub fn not_modified(etag: &str, cache_control: &str) -> Response {
    let mut response = StatusCode::NOT_MODIFIED.into_response();
    insert(&mut response, header::ETAG, etag);
    insert(&mut response, header::CACHE_CONTROL, cache_control);
    response
}

/// Reads `Range` and `If-Range` for `length` bytes. What is malformed, of another unit or of several ranges is ignored.
#[must_use]
pub fn wanted(headers: &HeaderMap, etag: &str, length: usize) -> Wanted {
    if headers.get(header::IF_RANGE).is_some_and(|v| v.as_bytes() != etag.as_bytes()) {
        return Wanted::All;
    }
    let Some(range) = headers.get(header::RANGE).and_then(|v| v.to_str().ok()) else { return Wanted::All };
    let Some((unit, range)) = range.split_once('=') else { return Wanted::All };
    let Some((first, last)) = range.trim().split_once('-').filter(|_| unit.trim().eq_ignore_ascii_case("bytes")) else {
        return Wanted::All;
    };
    let digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
    if !digits(first) || !digits(last) || (first.is_empty() && last.is_empty()) {
        return Wanted::All;
    }
    // more digits than fit are more than any length
    let number = |s: &str| s.parse::<usize>().unwrap_or(usize::MAX);
    if first.is_empty() {
        let suffix = number(last).min(length);
        return if suffix == 0 { Wanted::Unsatisfiable } else { Wanted::Part(length - suffix..length) };
    }
    let start = number(first);
    let end = if last.is_empty() { length } else { number(last).saturating_add(1).min(length) };
    if !last.is_empty() && number(last) < start {
        return Wanted::All;
    }
    if start >= length { Wanted::Unsatisfiable } else { Wanted::Part(start..end) }
}

/// Answers a GET or HEAD: 200, 206, 304 or 416.
#[must_use]
pub fn respond(headers: &HeaderMap, entity: Entity<'_>) -> Response {
    let Entity { source, etag, content_type, cache_control } = entity;
    let length = source.len();
    if is_known(headers, etag) {
        return not_modified(etag, cache_control);
    }
    let (status, range) = match wanted(headers, etag, length) {
        Wanted::All => (StatusCode::OK, 0..length),
        Wanted::Part(range) => (StatusCode::PARTIAL_CONTENT, range),
        Wanted::Unsatisfiable => {
            let detail = format!("there are {length} bytes");
            let mut response = Problem::new(StatusCode::RANGE_NOT_SATISFIABLE, "range", detail).field("Range").into_response();
            insert(&mut response, header::CONTENT_RANGE, &format!("bytes */{length}"));
            return response;
        }
    };
    let mut response = Response::new(source.body(range.clone()));
    *response.status_mut() = status;
    if status == StatusCode::PARTIAL_CONTENT {
        insert(&mut response, header::CONTENT_RANGE, &format!("bytes {}-{}/{length}", range.start, range.end - 1));
    }
    response.headers_mut().insert(header::CONTENT_LENGTH, range.len().into());
    insert(&mut response, header::CONTENT_TYPE, content_type);
    insert(&mut response, header::ACCEPT_RANGES, "bytes");
    insert(&mut response, header::ETAG, etag);
    insert(&mut response, header::CACHE_CONTROL, cache_control);
    response
}

/// Sets a header; a value that is none is left out.
pub fn insert(response: &mut Response, name: header::HeaderName, value: &str) {
    if let Ok(value) = HeaderValue::from_str(value) {
        response.headers_mut().insert(name, value);
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use proptest::prelude::*;

    fn headers(pairs: &[(header::HeaderName, &str)]) -> HeaderMap {
        pairs.iter().map(|(k, v)| (k.clone(), HeaderValue::from_str(v).unwrap())).collect()
    }

    fn range(text: &str, length: usize) -> Wanted {
        wanted(&headers(&[(header::RANGE, text)]), "\"e\"", length)
    }

    #[test]
    fn ranges_as_in_the_standard() {
        assert_eq!(range("bytes=0-499", 1000), Wanted::Part(0..500));
        assert_eq!(range("bytes=500-", 1000), Wanted::Part(500..1000));
        assert_eq!(range("bytes=-500", 1000), Wanted::Part(500..1000));
        assert_eq!(range("bytes=-5000", 1000), Wanted::Part(0..1000));
        assert_eq!(range("bytes=999-5000", 1000), Wanted::Part(999..1000));
        assert_eq!(range("Bytes=0-0", 1000), Wanted::Part(0..1));
        assert_eq!(range("bytes=0-99999999999999999999999", 1000), Wanted::Part(0..1000));
        for none in ["bytes=1000-", "bytes=1000-1001", "bytes=-0", "bytes=99999999999999999999999-"] {
            assert_eq!(range(none, 1000), Wanted::Unsatisfiable, "{none}");
        }
        for ignored in ["bytes", "bytes=", "bytes=-", "bytes=5-4", "bytes=a-b", "bytes=0-1,3-4", "items=0-1", "bytes=+1-2", "bytes=--1"] {
            assert_eq!(range(ignored, 1000), Wanted::All, "{ignored}");
        }
        assert_eq!(range("bytes=0-", 0), Wanted::Unsatisfiable);
    }

    #[test]
    fn if_range_needs_the_very_tag() {
        let with = |tag| wanted(&headers(&[(header::RANGE, "bytes=0-1"), (header::IF_RANGE, tag)]), "\"e\"", 9);
        assert_eq!(with("\"e\""), Wanted::Part(0..2));
        for other in ["\"f\"", "W/\"e\"", "Sat, 29 Oct 1994 19:43:31 GMT"] {
            assert_eq!(with(other), Wanted::All);
        }
    }

    #[test]
    fn if_none_match_takes_lists_and_weak_tags() {
        for known in ["\"e\"", "W/\"e\"", "*", "\"a\", \"e\""] {
            assert!(is_known(&headers(&[(header::IF_NONE_MATCH, known)]), "\"e\""), "{known}");
        }
        assert!(!is_known(&headers(&[(header::IF_NONE_MATCH, "\"a\", e")]), "\"e\""));
        assert!(!is_known(&HeaderMap::new(), "\"e\""));
    }

    #[test]
    fn tags_that_tell_how_the_bytes_were_made() {
        let with = |tags: &str| known_as(&headers(&[(header::IF_NONE_MATCH, tags)]), "cafe").map(str::to_owned);
        assert_eq!(with("\"a\", W/\"cafe-0123456789abcdef\"").as_deref(), Some("\"cafe-0123456789abcdef\""));
        for other in ["*", "\"cafe\"", "\"cafe-\"", "\"cafe-0123456789abcdeg\"", "\"cafes-0123456789abcdef\"", "cafe-0123456789abcdef"] {
            assert_eq!(with(other), None, "{other}");
        }
    }

    #[test]
    fn only_the_version_that_was_asked_for_is_kept_for_ever() {
        assert!(kept(Some("a"), "a").contains("immutable"));
        assert!(!kept(Some("b"), "a").contains("immutable") && !kept(None, "a").contains("immutable"));
    }

    proptest! {
        #[test]
        fn a_part_lies_within_and_is_never_empty(text in "bytes=[0-9]{0,4}-[0-9]{0,4}", length in 0usize..3000) {
            if let Wanted::Part(r) = range(&text, length) { prop_assert!(r.start < r.end && r.end <= length); }
        }

        #[test]
        fn no_header_panics(text in "\\PC{0,30}", length in 0usize..100) {
            if let Ok(value) = HeaderValue::from_str(&text) {
                let map: HeaderMap = [(header::RANGE, value)].into_iter().collect();
                let _ = respond(&map, Entity { source: Bytes::from(vec![0; length]).into(), etag: "\"e\"", content_type: "a/b", cache_control: REVALIDATE });
            }
        }
    }
}
