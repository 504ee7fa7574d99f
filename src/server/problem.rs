//! Problem details (RFC 9457), and the mapping from library errors to HTTP statuses.

use axum::Json;
use axum::http::{HeaderName, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use tmpi_core::container::ContainerError;
use tmpi_library::{LibraryError, QueueLimit, Quota, Service};
use tmpi_pipeline::depth::DepthError;
use tmpi_pipeline::photo::PhotoError;
use tmpi_pipeline::strokes::StrokeError;
use tmpi_pipeline::{MakeError, StageError};
use tmpi_render::{AnimationError, EncodeError, RenderError};

/// Media type of a problem.
pub const MEDIA_TYPE: &str = "application/problem+json";

/// Prefix of problem types.
const KINDS: &str = "urn:tmpi:problem:";
/// Most bytes of foreign text that a problem repeats: of a name, and in all.
const MAX_NAME: usize = 64;
const MAX_DETAIL: usize = 1024;

/// The first `most` bytes of `text`.
fn clipped(mut text: String, most: usize) -> String {
    if text.len() > most {
        text.truncate(text.floor_char_boundary(most));
        text.push('…');
    }
    text
}

/// Problem details (RFC 9457).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Problem {
    /// Type of the problem, a stable URI: `urn:tmpi:problem:…`.
    #[serde(rename = "type")]
    #[schema(value_type = String)]
    pub kind: Box<str>,
    /// Short summary of the problem type.
    #[schema(value_type = String)]
    pub title: Box<str>,
    /// HTTP status.
    pub status: u16,
    /// What is wrong with this request.
    #[schema(value_type = String)]
    pub detail: Box<str>,
    /// Field, parameter or option at fault.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    pub field: Option<Box<str>>,
    /// Id of the request, as in the response header `x-request-id` and in the server's log.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    pub request_id: Option<Box<str>>,
    /// Seconds after which another try may succeed; as in the header `Retry-After`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retry_after: Option<u64>,
    /// A header to send with it.
    #[serde(skip)]
    #[schema(ignore)]
    pub header: Option<Box<(HeaderName, HeaderValue)>>,
}

impl Problem {
    /// A problem of `kind` (the last part of its URI) with `status`; the title is the status's.
    pub fn new(status: StatusCode, kind: &str, detail: impl Into<String>) -> Self {
        Self {
            kind: format!("{KINDS}{kind}").into(),
            title: status.canonical_reason().unwrap_or("Error").into(),
            status: status.as_u16(),
            detail: clipped(detail.into(), MAX_DETAIL).into(),
            field: None,
            request_id: None,
            retry_after: None,
            header: None,
        }
    }

    /// A problem of a type that IANA registers, <https://www.iana.org/assignments/http-problem-types>.
    pub fn registered(status: StatusCode, kind: &str, detail: impl Into<String>) -> Self {
        Self { kind: format!("https://iana.org/assignments/http-problem-types#{kind}").into(), ..Self::new(status, "", detail) }
    }

    /// Names the field at fault.
    pub fn field(mut self, name: impl Into<String>) -> Self {
        self.field = Some(clipped(name.into(), MAX_NAME).into());
        self
    }

    /// Adds a header, if `value` is valid.
    pub fn header(mut self, name: HeaderName, value: &str) -> Self {
        self.header = HeaderValue::from_str(value).ok().map(|value| Box::new((name, value)));
        self
    }

    /// Sets `Retry-After`.
    pub fn retry_after(mut self, seconds: u64) -> Self {
        self.retry_after = Some(seconds);
        self
    }

    /// A parameter, option or form field is wrong.
    pub fn parameter(name: impl Into<String>, detail: impl std::fmt::Display) -> Self {
        let name = name.into();
        let name = clipped(name, MAX_NAME);
        Self::new(StatusCode::BAD_REQUEST, "parameter", format!("{name}: {detail}")).field(name)
    }

    /// The request itself is malformed.
    pub fn bad_request(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "bad-request", detail)
    }

    /// The resource does not exist.
    pub fn not_found(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::NOT_FOUND, "not-found", detail)
    }

    /// The route does not have the method. `allow` lists those that it has, unless the router does.
    pub fn no_method(method: &Method, allow: Option<&str>) -> Self {
        let problem = Self::new(StatusCode::METHOD_NOT_ALLOWED, "method", format!("{method} is not possible at this address"));
        if let Some(allow) = allow { problem.header(header::ALLOW, allow) } else { problem }
    }

    /// The body is larger than `limit` bytes.
    pub fn too_large(limit: usize) -> Self {
        Self::new(
            StatusCode::PAYLOAD_TOO_LARGE,
            "body-too-large",
            format!("the request's body is over the limit of {limit} bytes, {:.1} MiB", limit as f64 / f64::from(1 << 20)),
        )
    }

    /// An internal error; its details go to the log, not into the answer.
    pub fn internal(what: &str, error: &dyn std::fmt::Display) -> Self {
        tracing::error!(%error, "{what}");
        Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", format!("{what}: the server's log says more"))
    }

    /// The disk is full.
    pub fn full() -> Self {
        Self::new(StatusCode::INSUFFICIENT_STORAGE, "storage-full", "the data directory has no room left")
    }

    /// An I/O error of the data directory.
    pub fn store(error: &std::io::Error) -> Self {
        if matches!(error.kind(), std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded) {
            tracing::error!(%error, "data directory");
            return Self::full();
        }
        Self::internal("data directory", error)
    }

    /// The library's record of a failed job.
    pub fn to_library(&self) -> tmpi_library::Problem {
        let kind = self.kind.strip_prefix(KINDS).unwrap_or(&self.kind);
        tmpi_library::Problem { kind: kind.to_owned(), detail: self.detail.to_string(), field: self.field.as_deref().map(str::to_owned) }
    }

    /// The problem of a failed job, from the library's record.
    pub fn of_library(kept: &tmpi_library::Problem) -> Self {
        let status = match kept.kind.as_str() {
            "parameter" | "bad-request" => StatusCode::BAD_REQUEST,
            "not-found" => StatusCode::NOT_FOUND,
            "photo-too-large" => StatusCode::PAYLOAD_TOO_LARGE,
            "unsupported-photo" => StatusCode::UNSUPPORTED_MEDIA_TYPE,
            "broken-photo"
            | "broken-depth-map"
            | "broken-second-picture"
            | "beyond-readers"
            | "gave-up"
            | "export-too-large"
            | "view-too-large" => StatusCode::UNPROCESSABLE_ENTITY,
            "no-animations" => StatusCode::NOT_IMPLEMENTED,
            "late" | "busy" | "cancelled" => StatusCode::SERVICE_UNAVAILABLE,
            "storage-full" => StatusCode::INSUFFICIENT_STORAGE,
            _ => StatusCode::INTERNAL_SERVER_ERROR,
        };
        let problem = Self::new(status, &kept.kind, kept.detail.clone());
        if let Some(field) = &kept.field { problem.field(field) } else { problem }
    }

    /// Why a photo failed, or which part is damaged.
    pub fn of_photo(photo: &tmpi_library::Photo) -> Self {
        photo.problem.as_ref().map_or_else(|| Self::internal("a photo", &"it failed without a reason"), Self::of_library)
    }

    /// The HTTP status.
    pub fn status(&self) -> StatusCode {
        StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR)
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let retry = self.retry_after;
        let mut response = (self.status(), Json(&self)).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE));
        headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
        if let Some(seconds) = retry {
            headers.insert(header::RETRY_AFTER, seconds.into());
        }
        if let Some((name, value)) = self.header.as_deref().cloned() {
            headers.insert(name, value);
        }
        // request log and middleware, which sets `request_id`, read it from here
        response.extensions_mut().insert(self);
        response
    }
}

impl From<LibraryError> for Problem {
    fn from(error: LibraryError) -> Self {
        let text = error.to_string();
        match error {
            LibraryError::NotFound(what) => Self::not_found(format!("there is no such {what} any more")),
            LibraryError::NotReady => {
                let detail = "the photo is being made; it can be made again once it is done";
                Self::new(StatusCode::CONFLICT, "not-ready", detail).retry_after(1)
            }
            LibraryError::Changed => Self::new(StatusCode::PRECONDITION_FAILED, "changed", "it has changed meanwhile").field("If-Match"),
            LibraryError::QueueFull { waiting, share, retry_after, .. } => {
                let detail = match share {
                    QueueLimit::All => format!("{waiting} photos are waiting already"),
                    QueueLimit::Owner => "your photos already take half of the queue".to_owned(),
                    QueueLimit::Address => "photos from your address already take half of the queue".to_owned(),
                };
                let seconds = retry_after.as_secs_f64().ceil() as u64;
                Self::new(StatusCode::TOO_MANY_REQUESTS, "queue-full", detail).retry_after(seconds.max(1))
            }
            LibraryError::QuotaExceeded { quota, used, asked, limit } => {
                let detail = match quota {
                    Quota::Photos => format!("you have {used} photos; the limit is {limit} (quotas.photos). Delete one to upload another"),
                    Quota::Bytes => format!(
                        "your photos take {used} bytes and this one {asked}; the limit is {limit} (quotas.size). Delete some to upload it"
                    ),
                };
                Self::new(StatusCode::FORBIDDEN, "quota", detail)
            }
            LibraryError::StorageFull => Self::full(),
            LibraryError::Damaged { .. } => {
                let detail = format!("{text}: upload the photo again to repair it");
                Self::new(StatusCode::INTERNAL_SERVER_ERROR, "damaged", detail)
            }
            LibraryError::Invalid(detail) => Self::bad_request(detail),
            LibraryError::Unavailable { service, reason } => {
                tracing::warn!(?service, reason, "the library");
                let what = match service {
                    Service::Database => "the database cannot be reached now",
                    Service::Blobs => "the blob store cannot be reached now",
                };
                Self::new(StatusCode::SERVICE_UNAVAILABLE, "store-unreachable", what).retry_after(5)
            }
            LibraryError::TooManyWebhooks { .. } => Self::new(StatusCode::FORBIDDEN, "too-many-webhooks", text),
            LibraryError::LeaseLost | LibraryError::Internal(_) => Self::internal("the library", &text),
        }
    }
}

impl From<&PhotoError> for Problem {
    fn from(error: &PhotoError) -> Self {
        let (status, kind) = match error {
            PhotoError::Unsupported | PhotoError::Heic => (StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported-photo"),
            PhotoError::TooManyBytes { .. }
            | PhotoError::TooManyPixels { .. }
            | PhotoError::SideTooLong { .. }
            | PhotoError::TooMuchMemory { .. }
            | PhotoError::TooMuchWork { .. } => (StatusCode::PAYLOAD_TOO_LARGE, "photo-too-large"),
            PhotoError::Broken(_) => (StatusCode::UNPROCESSABLE_ENTITY, "broken-photo"),
        };
        Self::new(status, kind, error.to_string()).field("photo")
    }
}

impl From<&MakeError> for Problem {
    fn from(error: &MakeError) -> Self {
        match error {
            MakeError::Photo(e) => e.into(),
            MakeError::Depth(DepthError::Map(_) | DepthError::Embedded(_) | DepthError::NotEmbedded) => {
                Self::new(StatusCode::UNPROCESSABLE_ENTITY, "broken-depth-map", error.to_string()).field("depth")
            }
            MakeError::Depth(DepthError::Second(_)) => {
                Self::new(StatusCode::UNPROCESSABLE_ENTITY, "broken-second-picture", error.to_string()).field("second")
            }
            MakeError::Depth(e @ (DepthError::NoSecond | DepthError::Sphere)) => e.into(),
            MakeError::Generate(
                e @ (StageError::Option { field, .. } | StageError::Bound { field, .. } | StageError::Network { field, .. }),
            ) => Self::new(StatusCode::BAD_REQUEST, "parameter", e.to_string()).field(*field),
            MakeError::Generate(StageError::Stroke(e)) => e.into(),
            MakeError::Atlas(e @ ContainerError::Bound(_)) => e.into(),
            MakeError::Cancelled => Self::new(StatusCode::SERVICE_UNAVAILABLE, "cancelled", "the job was cancelled"),
            MakeError::Late { .. } => Self::new(StatusCode::SERVICE_UNAVAILABLE, "late", error.to_string()),
            MakeError::Depth(_) | MakeError::Generate(_) | MakeError::Atlas(_) | MakeError::Render(_) => {
                Self::internal("making the photo", error)
            }
        }
    }
}

impl From<&DepthError> for Problem {
    fn from(error: &DepthError) -> Self {
        match error {
            DepthError::NoSecond | DepthError::Sphere => Self::parameter("stereo", error.to_string()),
            _ => Self::internal("finding the depth", error),
        }
    }
}

impl From<&StrokeError> for Problem {
    fn from(error: &StrokeError) -> Self {
        match &error.field {
            Some(field) => Self::parameter(field, &error.detail),
            None => Self::bad_request(error.to_string()),
        }
    }
}

impl From<&ContainerError> for Problem {
    fn from(error: &ContainerError) -> Self {
        match error {
            ContainerError::Bound(_) => Self::new(StatusCode::UNPROCESSABLE_ENTITY, "beyond-readers", error.to_string()),
            _ => Self::internal("reading the container", error),
        }
    }
}

impl From<&RenderError> for Problem {
    fn from(error: &RenderError) -> Self {
        match error {
            RenderError::Camera(_) => Self::new(StatusCode::BAD_REQUEST, "parameter", error.to_string()),
            RenderError::Adapter(_) | RenderError::Scene(_) => Self::internal("drawing the view", error),
            // the client has gone
            RenderError::Cancelled => Self::new(StatusCode::SERVICE_UNAVAILABLE, "cancelled", error.to_string()).retry_after(1),
            RenderError::TooLarge(_) => Self::new(StatusCode::UNPROCESSABLE_ENTITY, "view-too-large", error.to_string()),
        }
    }
}

impl From<&AnimationError> for Problem {
    fn from(error: &AnimationError) -> Self {
        match error {
            AnimationError::Missing => Self::new(StatusCode::NOT_IMPLEMENTED, "no-animations", error.to_string()).field("path"),
            AnimationError::Size(..) | AnimationError::Failed(_) => Self::internal("writing an animation", error),
        }
    }
}

impl From<&EncodeError> for Problem {
    fn from(error: &EncodeError) -> Self {
        Self::parameter("format", error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_photo_that_failed_keeps_its_status_and_field() {
        let depth = |e: DepthError| MakeError::Depth(e);
        let option = StageError::Option { field: "quality", range: "1 to 100", value: "0".into() };
        for error in [
            MakeError::from(PhotoError::Broken("x".into())),
            PhotoError::TooManyPixels { width: 2, height: 1, limit: 1 }.into(),
            PhotoError::Unsupported.into(),
            depth(DepthError::Map("x".into())),
            depth(DepthError::NotEmbedded),
            depth(DepthError::Second("x".into())),
            depth(DepthError::NoSecond),
            depth(DepthError::Sphere),
            ContainerError::Bound("x".into()).into(),
            option.into(),
        ] {
            let told = Problem::from(&error);
            let kept = Problem::of_library(&told.to_library());
            assert_eq!((kept.status, &kept.field), (told.status, &told.field), "{error}");
        }
    }

    #[test]
    fn internal_errors_are_not_disclosed() {
        let p = Problem::from(&MakeError::Atlas(ContainerError::Encode("secret path".into())));
        assert_eq!(p.status, 500);
        assert!(!p.detail.contains("secret"));
    }

    #[test]
    fn errors_quote_only_part_of_long_input() {
        let p = Problem::parameter("ä".repeat(1 << 20), "ö".repeat(1 << 20));
        assert!(p.field.as_ref().unwrap().len() <= MAX_NAME + 3 && p.detail.len() <= MAX_DETAIL + 3);
        assert!(p.field.unwrap().starts_with('ä'));
    }

    #[test]
    fn a_full_disk_is_507() {
        assert_eq!(Problem::store(&std::io::Error::from(std::io::ErrorKind::StorageFull)).status, 507);
    }
}
