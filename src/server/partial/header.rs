//! What requests and answers say of uploads in parts, by draft-ietf-httpbis-resumable-upload.

use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::Response;

use super::extent::{Extent, Refused, Said};
use crate::server::problem::Problem;

/// The whole ends with this request.
pub const COMPLETE: HeaderName = HeaderName::from_static("upload-complete");
/// Where the part begins, or how much is there.
pub const OFFSET: HeaderName = HeaderName::from_static("upload-offset");
/// Bytes of the whole.
pub const LENGTH: HeaderName = HeaderName::from_static("upload-length");
/// What may be sent.
pub const LIMIT: HeaderName = HeaderName::from_static("upload-limit");
/// Version of the draft that a client speaks.
const VERSION: HeaderName = HeaderName::from_static("upload-draft-interop-version");
/// Media type of a part.
pub const MEDIA_TYPE: &str = "application/partial-upload";
/// The first version of the draft (-05) that has parts as they are read here.
const FIRST_VERSION: u64 = 6;

/// The one value of a header that is an item of RFC 9651 without parameters; none where it is not there.
fn item<T>(headers: &HeaderMap, name: &HeaderName, what: &str, read: impl Fn(&str) -> Option<T>) -> Result<Option<T>, Problem> {
    let mut all = headers.get_all(name).iter();
    let Some(value) = all.next() else { return Ok(None) };
    let value = value.to_str().ok().filter(|_| all.next().is_none()).and_then(|text| read(text.trim()));
    value.map(Some).ok_or_else(|| Problem::parameter(name.as_str(), format!("must be {what}, once")))
}

fn whole(headers: &HeaderMap, name: &HeaderName) -> Result<Option<u64>, Problem> {
    // fifteen digits are the most that an integer of RFC 9651 has
    let digits = |text: &str| (1..=15).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_digit());
    item(headers, name, "a whole number", |text| text.parse().ok().filter(|_| digits(text)))
}

/// Whether the whole ends with a request; none where it is no upload in parts.
///
/// # Errors
/// 400 where that cannot be read, or the request speaks a version of the draft that is not understood.
pub fn complete(headers: &HeaderMap) -> Result<Option<bool>, Problem> {
    let complete = item(headers, &COMPLETE, "?0 or ?1", |text| match text {
        "?0" => Some(false),
        "?1" => Some(true),
        _ => None,
    })?;
    if complete.is_some() && whole(headers, &VERSION)?.is_some_and(|version| version < FIRST_VERSION) {
        let detail = format!("uploads in parts are those of version {FIRST_VERSION} of the draft or later");
        return Err(Problem::bad_request(detail).field(VERSION.as_str()));
    }
    Ok(complete)
}

/// What a request says of its part, which begins at `at` where it does not say so.
///
/// # Errors
/// 400 that names a header that cannot be read or is missing.
pub fn said(headers: &HeaderMap, at: Option<u64>) -> Result<Said, Problem> {
    let missing = |name: &HeaderName| Problem::parameter(name.as_str(), "is missing");
    let complete = complete(headers)?.ok_or_else(|| missing(&COMPLETE))?;
    let at = match at {
        Some(at) => at,
        None => whole(headers, &OFFSET)?.ok_or_else(|| missing(&OFFSET))?,
    };
    Ok(Said { at, content: whole(headers, &header::CONTENT_LENGTH)?, length: whole(headers, &LENGTH)?, complete })
}

/// Bytes of an upload that is sent at once, as far as it is told.
///
/// # Errors
/// 400 where the request does not agree with itself.
pub fn length_at_once(headers: &HeaderMap) -> Result<Option<u64>, Problem> {
    let said = said(headers, Some(0))?;
    let mut extent = Extent::NOTHING;
    // how long it may be is told as to all uploads
    extent.begin(&said, u64::MAX).map_err(|e| refusal(e, &Extent::NOTHING))?;
    Ok(extent.length)
}

fn put(response: &mut Response, name: HeaderName, value: u64) {
    response.headers_mut().insert(name, value.into());
}

/// Says how far an upload is.
pub fn tell(response: &mut Response, extent: &Extent, complete: bool) {
    put(response, OFFSET, extent.offset);
    // a client that knows the length takes all of it being there for its being accepted: it has to ask for that once more
    if let Some(length) = extent.length.filter(|length| complete || *length > extent.offset) {
        put(response, LENGTH, length);
    }
    response.headers_mut().insert(COMPLETE, HeaderValue::from_static(if complete { "?1" } else { "?0" }));
}

/// Says how large an upload may be, in bytes, and for how many seconds it is kept.
pub fn limit(response: &mut Response, most: u64, seconds: u64) {
    if let Ok(value) = HeaderValue::try_from(format!("max-size={most}, max-age={seconds}")) {
        response.headers_mut().insert(LIMIT, value);
    }
}

/// The answer to a part that is refused, where so much is there.
#[must_use]
pub fn refusal(refused: Refused, now: &Extent) -> Problem {
    match refused {
        Refused::Offset { expected, provided } => {
            Problem::registered(StatusCode::CONFLICT, "mismatching-upload-offset", refused.to_string()).offsets(expected, provided)
        }
        Refused::Length => Problem::registered(StatusCode::BAD_REQUEST, "inconsistent-upload-length", {
            let length = now.length.map_or_else(String::new, |bytes| format!(" of {bytes} bytes"));
            format!("the part, behind {} bytes, does not agree with the length of the upload{length}", now.offset)
        }),
        Refused::TooLarge(limit) => Problem::too_large(usize::try_from(limit).unwrap_or(usize::MAX)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(&'static str, &str)]) -> HeaderMap {
        let mut all = HeaderMap::new();
        for (name, value) in pairs {
            all.append(HeaderName::from_static(name), HeaderValue::from_str(value).unwrap());
        }
        all
    }

    #[test]
    fn requests_say_what_they_bring() {
        let all = headers(&[("upload-complete", "?1"), ("upload-offset", "7"), ("content-length", "3"), ("upload-length", "10")]);
        assert_eq!(said(&all, None).unwrap(), Said { at: 7, content: Some(3), length: Some(10), complete: true });
        assert_eq!(complete(&headers(&[])).unwrap(), None);
        for wrong in ["?2", "1", "true", "", "?1, ?1"] {
            assert_eq!(complete(&headers(&[("upload-complete", wrong)])).unwrap_err().field.as_deref(), Some("upload-complete"));
        }
        for wrong in ["-1", "+1", "1.0", "", "1234567890123456", "9 9"] {
            let all = headers(&[("upload-complete", "?0"), ("upload-offset", wrong)]);
            assert_eq!(said(&all, None).unwrap_err().field.as_deref(), Some("upload-offset"), "{wrong}");
        }
        let twice = headers(&[("upload-complete", "?0"), ("upload-complete", "?0")]);
        assert!(complete(&twice).is_err());
        assert_eq!(said(&headers(&[("upload-complete", "?0")]), None).unwrap_err().field.as_deref(), Some("upload-offset"));
    }

    #[test]
    fn older_drafts_are_refused_and_later_ones_are_taken() {
        let with = |version| complete(&headers(&[("upload-complete", "?0"), ("upload-draft-interop-version", version)]));
        assert_eq!((with("6").unwrap(), with("8").unwrap()), (Some(false), Some(false)));
        assert!(with("5").is_err() && with("x").is_err());
    }

    #[test]
    fn an_upload_at_once_agrees_with_itself() {
        let of = |content, length| {
            length_at_once(&headers(&[("upload-complete", "?1"), ("content-length", content), ("upload-length", length)]))
        };
        assert_eq!(of("5", "5").unwrap(), Some(5));
        let wrong = of("5", "6").unwrap_err();
        assert_eq!((wrong.status, &*wrong.kind), (400, "https://iana.org/assignments/http-problem-types#inconsistent-upload-length"));
    }
}
