//! What can go wrong.

use serde::Deserialize;

/// The server's reason for refusing a request (RFC 9457).
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[non_exhaustive]
pub struct Problem {
    /// Kind of the problem, a URI that stays the same: `urn:tmpi:problem:…`.
    #[serde(rename = "type")]
    pub kind: String,
    /// What this kind of problem is.
    pub title: String,
    /// HTTP status.
    pub status: u16,
    /// What is wrong with this request.
    #[serde(default)]
    pub detail: String,
    /// Field, parameter or option that is at fault.
    #[serde(default)]
    pub field: Option<String>,
    /// Id of the request, as in the server's log.
    #[serde(default)]
    pub request_id: Option<String>,
    /// Seconds after which another try may succeed.
    #[serde(default)]
    pub retry_after: Option<u64>,
}

/// Why a call failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A URL is invalid.
    #[error("the address {address:?}: {why}")]
    Address {
        /// The address.
        address: String,
        /// What is wrong with it.
        why: String,
    },
    /// A key cannot be sent, or made.
    #[error("the key cannot be sent")]
    Key,
    /// The server refuses.
    #[error("{} {}: {}{}", .0.status, .0.title, .0.detail, .0.field.as_ref().map(|f| format!(" ({f})")).unwrap_or_default())]
    Problem(Box<Problem>),
    /// The photo could not be made, or is damaged.
    #[error("the photo {id}: {}", .problem.detail)]
    Photo {
        /// Id of the photo.
        id: String,
        /// Why.
        problem: Box<Problem>,
    },
    /// The server cannot be reached, or broke off.
    #[error("the server cannot be reached")]
    Network(#[source] reqwest::Error),
    /// The answer is not what it should be.
    #[error("the server's answer is not understood: {0}")]
    Answer(String),
    /// The container cannot be decoded.
    #[error("the container")]
    Container(#[from] tmpi_core::container::ContainerError),
}

impl Error {
    /// HTTP status of what the server refused; none where it was not the server.
    #[must_use]
    pub fn status(&self) -> Option<u16> {
        if let Self::Problem(problem) | Self::Photo { problem, .. } = self { Some(problem.status) } else { None }
    }
}
