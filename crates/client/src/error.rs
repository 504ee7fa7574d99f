//! Errors of the client.

use serde::Deserialize;

/// The server's reason for refusing a request (RFC 9457).
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[non_exhaustive]
pub struct Problem {
    /// Stable URI of this kind of problem: `urn:tmpi:problem:…`.
    #[serde(rename = "type")]
    pub kind: String,
    /// Short description of this kind of problem.
    pub title: String,
    /// HTTP status.
    pub status: u16,
    /// What is wrong with this request.
    #[serde(default)]
    pub detail: String,
    /// Field, parameter or option that caused the problem.
    pub field: Option<String>,
    /// Id of the request in the server's log.
    pub request_id: Option<String>,
    /// Seconds after which another try may succeed.
    pub retry_after: Option<u64>,
}

/// Why a call failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A URL is invalid.
    #[error("invalid address {address:?}: {why}")]
    Address {
        /// The address.
        address: String,
        /// What is wrong with it.
        why: String,
    },
    /// The key is not a valid header value, or no random key could be generated.
    #[error("the key is not valid or could not be generated")]
    Key,
    /// The server refused the request.
    #[error("{} {}: {}{}", .0.status, .0.title, .0.detail, .0.field.as_ref().map(|f| format!(" ({f})")).unwrap_or_default())]
    Problem(Box<Problem>),
    /// The server could not process the photo, or the stored result is damaged.
    #[error("photo {id}: {}", .problem.detail)]
    Photo {
        /// Id of the photo.
        id: String,
        /// What went wrong.
        problem: Box<Problem>,
    },
    /// The server cannot be reached, or it closed the connection.
    #[error("the server cannot be reached")]
    Network(#[source] reqwest::Error),
    /// The answer is malformed or too large.
    #[error("invalid answer from the server: {0}")]
    Answer(String),
    /// The container cannot be decoded.
    #[error("the container cannot be decoded")]
    Container(#[from] tmpi_core::container::ContainerError),
}

impl Error {
    /// HTTP status of the server's refusal, or `None` for all other errors.
    pub fn status(&self) -> Option<u16> {
        if let Self::Problem(problem) | Self::Photo { problem, .. } = self { Some(problem.status) } else { None }
    }
}
