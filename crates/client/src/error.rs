//! What can go wrong, and the problem documents of the server.

use std::time::Duration;

use serde::Deserialize;
use tmpi_core::container::ContainerError;

/// A problem document (RFC 9457), as the server answers whatever it refuses.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, thiserror::Error)]
#[error("{status} {title}: {detail}")]
pub struct Problem {
    /// Kind of the problem, a URI that stays the same: `urn:tmpi:problem:…`.
    #[serde(rename = "type")]
    pub kind: String,
    /// What this kind of problem is, in a few words.
    pub title: String,
    /// HTTP status.
    pub status: u16,
    /// What is wrong with this very request.
    #[serde(default)]
    pub detail: String,
    /// Field, parameter or option that is at fault.
    pub field: Option<String>,
    /// Id of the request, as in the server's log.
    pub request_id: Option<String>,
    /// Seconds after which another try may succeed.
    pub retry_after: Option<u64>,
}

impl Problem {
    /// The last part of [`Problem::kind`]: `not-found`, `parameter`, `busy`, and so on.
    #[must_use]
    pub fn name(&self) -> &str {
        self.kind.rsplit(':').next().unwrap_or_default()
    }
}

/// Why there is no answer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The server refused the request.
    #[error("the server refuses: {0}")]
    Refused(Box<Problem>),
    /// The photo could not be made, or is damaged.
    #[error("the photo is not made: {0}")]
    NotMade(Box<Problem>),
    /// The photo was deleted meanwhile.
    #[error("the photo was deleted")]
    Deleted,
    /// An answer that is none of this interface's: another server's, or a proxy's.
    #[error("an answer that is not understood: {0}")]
    Answer(String),
    /// The answer is larger than this client was told to take.
    #[error("the answer has more than {0} bytes")]
    TooLarge(usize),
    /// Nothing came for so long.
    #[error("nothing came for {} s", .0.as_secs_f64())]
    Silence(Duration),
    /// The photo was not made in the time that was given.
    #[error("the photo is not made after {} s", .0.as_secs_f64())]
    Late(Duration),
    /// The connection could not be made, or broke.
    #[error("no connection: {0}")]
    Connection(#[from] reqwest::Error),
    /// The container is damaged or of a later version.
    #[error(transparent)]
    Container(#[from] ContainerError),
    /// What was asked for cannot be asked: an address, an id, a key.
    #[error("{0}")]
    Input(String),
    /// A file cannot be read.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: String,
        /// Why.
        source: std::io::Error,
    },
}

impl Error {
    /// The problem document, where the server gave one.
    #[must_use]
    pub fn problem(&self) -> Option<&Problem> {
        match self {
            Self::Refused(problem) | Self::NotMade(problem) => Some(problem),
            _ => None,
        }
    }

    /// HTTP status of the refusal, if it is one.
    #[must_use]
    pub fn status(&self) -> Option<u16> {
        if let Self::Refused(problem) = self { Some(problem.status) } else { None }
    }
}
