//! Errors, in terms of a caller that answers requests.

use std::io;
use std::time::Duration;

use crate::photo::Part;

/// The limit of the queue that is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum QueueLimit {
    /// That of the whole queue.
    All,
    /// That of one owner: half of the queue.
    Owner,
    /// That of one address: half of the queue.
    Address,
}

/// A quota of an owner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quota {
    /// Photos.
    Photos,
    /// Bytes of uploads and containers.
    Bytes,
}

/// An external service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Service {
    /// The database.
    Database,
    /// The blob store.
    Blobs,
}

/// An error of the library.
#[derive(Debug, thiserror::Error)]
pub enum LibraryError {
    /// It was deleted, or never existed.
    #[error("there is no such {0}")]
    NotFound(&'static str),
    /// The photo is queued or being made.
    #[error("the photo is being made")]
    NotReady,
    /// It has changed since the caller read it.
    #[error("it has changed meanwhile")]
    Changed,
    /// The queue is full.
    #[error("{waiting} jobs wait; the limit ({share:?}) is {places}")]
    QueueFull {
        /// Number of waiting jobs.
        waiting: u64,
        /// Size of that share.
        places: u64,
        /// Which limit is reached.
        share: QueueLimit,
        /// When a place is likely to be free.
        retry_after: Duration,
    },
    /// The owner's quota is exceeded.
    #[error("the owner has {used} {quota:?} and asks for {asked} more; the limit is {limit}")]
    QuotaExceeded {
        /// Which quota.
        quota: Quota,
        /// Current use.
        used: u64,
        /// What this upload would add.
        asked: u64,
        /// The limit.
        limit: u64,
    },
    /// The owner has as many webhooks as one may have.
    #[error("the limit of {limit} webhooks is reached")]
    TooManyWebhooks {
        /// The limit.
        limit: u64,
    },
    /// The caller no longer holds the job. Its result is discarded.
    #[error("the lease is lost")]
    LeaseLost,
    /// A value that cannot be accepted.
    #[error("{0}")]
    Invalid(String),
    /// A blob differs from what was written.
    #[error("{part} is damaged: {detail}")]
    Damaged {
        /// Which blob.
        part: Part,
        /// What is wrong with it.
        detail: String,
    },
    /// The disk has no space beyond its reserve.
    #[error("the storage is full")]
    StorageFull,
    /// The database or the blob store does not answer now.
    #[error("{service:?} cannot be reached: {reason}")]
    Unavailable {
        /// Which of them.
        service: Service,
        /// Its error.
        reason: String,
    },
    /// The database refuses a statement, or holds invalid data.
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

/// Result of the library.
pub type Result<T> = std::result::Result<T, LibraryError>;
