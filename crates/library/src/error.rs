//! What can go wrong, in the terms of a caller that answers requests.

use std::io;
use std::time::Duration;

use crate::photo::Part;

/// Whose places in the queue are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Share {
    /// Those of all.
    All,
    /// The half that one owner may have.
    Owner,
    /// The half that one address may have.
    Address,
}

/// What an owner has too much of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quota {
    /// Photos.
    Photos,
    /// Bytes of uploads and containers.
    Bytes,
}

/// What does not answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Service {
    /// The database.
    Database,
    /// The blob store.
    Blobs,
}

/// Why the library does not do what it is asked.
#[derive(Debug, thiserror::Error)]
pub enum LibraryError {
    /// There is no such thing: it was deleted, or never existed.
    #[error("there is no such {0}")]
    NotFound(&'static str),
    /// The photo waits or is being made.
    #[error("the photo is being made")]
    NotReady,
    /// Somebody else changed it since the caller read it.
    #[error("it was changed meanwhile")]
    Changed,
    /// No place in the queue is free.
    #[error("{waiting} jobs wait, and {share:?} may have {places} places")]
    QueueFull {
        /// Jobs that wait.
        waiting: u64,
        /// Places of that share.
        places: u64,
        /// Whose places are taken.
        share: Share,
        /// When a place is likely to be free.
        retry_after: Duration,
    },
    /// The owner has as much as one owner may.
    #[error("the owner has {used} {quota:?} and asks for {asked} more, and {limit} is the limit")]
    QuotaExceeded {
        /// Of what.
        quota: Quota,
        /// What the owner has.
        used: u64,
        /// What this upload would add.
        asked: u64,
        /// What one owner may have.
        limit: u64,
    },
    /// The job belongs to somebody else by now, or to nobody. What the caller made is discarded.
    #[error("the lease is lost")]
    LeaseLost,
    /// Another node has the room.
    #[error("the room's origin is {origin}")]
    RoomTaken {
        /// Its address.
        origin: String,
    },
    /// A value that cannot be accepted.
    #[error("{0}")]
    Invalid(String),
    /// A blob is not as it was written.
    #[error("{part} is damaged: {detail}")]
    Damaged {
        /// Which blob.
        part: Part,
        /// What is wrong with it.
        detail: String,
    },
    /// The disk has no room beyond its reserve.
    #[error("the storage is full")]
    StorageFull,
    /// The database or the blob store does not answer now.
    #[error("{service:?} cannot be reached: {reason}")]
    Unavailable {
        /// Which of them.
        service: Service,
        /// What it said.
        reason: String,
    },
    /// The database refuses a statement of this program, or holds what this program did not write.
    #[error("the database: {0}")]
    Internal(String),
}

impl LibraryError {
    pub(crate) fn blobs(error: &io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Self::StorageFull,
            _ => Self::Unavailable { service: Service::Blobs, reason: error.to_string() },
        }
    }

    pub(crate) fn stored(what: &str, error: impl std::fmt::Display) -> Self {
        Self::Internal(format!("{what}: {error}"))
    }
}

impl From<sqlx::Error> for LibraryError {
    fn from(error: sqlx::Error) -> Self {
        let away = |reason: String| Self::Unavailable { service: Service::Database, reason };
        match &error {
            sqlx::Error::Database(database) => match database.code().as_deref() {
                // SQLITE_FULL, and PostgreSQL's disk_full
                Some("13" | "53100") => Self::StorageFull,
                // SQLITE_BUSY and its extended codes, SQLITE_IOERR; PostgreSQL: too many connections, shutdown, deadlock, serialisation
                Some("5" | "261" | "517" | "10" | "53300" | "57P01" | "57P02" | "57P03" | "40001" | "40P01") => away(error.to_string()),
                Some(code) if code.starts_with("08") => away(error.to_string()),
                _ => Self::Internal(error.to_string()),
            },
            sqlx::Error::Io(_)
            | sqlx::Error::Tls(_)
            | sqlx::Error::PoolTimedOut
            | sqlx::Error::PoolClosed
            | sqlx::Error::WorkerCrashed
            | sqlx::Error::Protocol(_) => away(error.to_string()),
            _ => Self::Internal(error.to_string()),
        }
    }
}

/// What the library answers.
pub type Result<T> = std::result::Result<T, LibraryError>;
