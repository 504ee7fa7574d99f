//! What several nodes share, as ports: blobs and a ledger, which are the truth, and a queue, which only says whose turn it is.
//!
//! All of it blocks and is called from threads that may. A store that cannot be reached is told as [`unreachable`].

use std::fmt::Debug;
use std::io;
use std::ops::Range;
use std::time::{Duration, Instant};

pub use crate::server::telemetry::Figure;

/// Names of a page of a list.
const PAGE: usize = 1000;

/// Files by name, written once and whole.
pub trait Blobs: Debug + Send + Sync + 'static {
    /// Keeps a blob, in place of one of that name; it is durable when this returns.
    ///
    /// # Errors
    /// The store cannot be reached, or refuses.
    fn put(&self, name: &str, bytes: Vec<u8>) -> io::Result<()>;

    /// The bytes of a blob.
    ///
    /// # Errors
    /// There is none ([`io::ErrorKind::NotFound`]), or the store cannot be reached.
    fn read(&self, name: &str) -> io::Result<Vec<u8>>;

    /// The bytes of a blob within `range`, counted from its first: fewer where it ends before, none where it ends before the first of them.
    ///
    /// # Errors
    /// As [`Blobs::read`].
    fn read_range(&self, name: &str, range: Range<u64>) -> io::Result<Vec<u8>> {
        let mut bytes = self.read(name)?;
        let within = |at: u64| usize::try_from(at).unwrap_or(usize::MAX).min(bytes.len());
        let (from, to) = (within(range.start), within(range.end));
        bytes.truncate(to.max(from));
        Ok(bytes.split_off(from))
    }

    /// Removes a blob; one that is not there is removed already.
    ///
    /// # Errors
    /// The store cannot be reached.
    fn discard(&self, name: &str) -> io::Result<()>;

    /// Removes folders that have been empty for longer than `age`, where the store has such, and gives their count.
    ///
    /// # Errors
    /// The store cannot be reached.
    fn tidy(&self, _age: Duration) -> io::Result<usize> {
        Ok(0)
    }
}

/// Which content of a record was read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tag(pub String);

/// Small records by name, each changed only by who has seen what it holds.
pub trait Ledger: Debug + Send + Sync + 'static {
    /// Writes a record where there is none; false where there is one. Of any number who try at a time one succeeds.
    ///
    /// # Errors
    /// The store cannot be reached; whether the record is there then is unknown.
    fn create(&self, name: &str, bytes: &[u8]) -> io::Result<bool>;

    /// A record with its tag.
    ///
    /// # Errors
    /// The store cannot be reached.
    fn get(&self, name: &str) -> io::Result<Option<(Vec<u8>, Tag)>>;

    /// Writes a record in place of what was read as `seen`, and gives its tag; none where it is another by now, or gone. A store that
    /// lost its answer on the way may have written, and say none.
    ///
    /// # Errors
    /// As [`Ledger::create`].
    fn swap(&self, name: &str, seen: &Tag, bytes: &[u8]) -> io::Result<Option<Tag>>;

    /// Removes a record; one that is not there is removed already.
    ///
    /// # Errors
    /// The store cannot be reached.
    fn remove(&self, name: &str) -> io::Result<()>;

    /// At most `limit` names of records or blobs within a folder (`folder/`), in order of their bytes, those after `after`. Where that
    /// is a name that an earlier page gave, the page may be of the same moment as that one, some seconds ago.
    ///
    /// # Errors
    /// The store cannot be reached.
    fn page(&self, folder: &str, after: Option<&str>, limit: usize) -> io::Result<Vec<String>>;

    /// All names within a folder, in order of their bytes.
    ///
    /// # Errors
    /// The store cannot be reached.
    fn all(&self, folder: &str) -> io::Result<Vec<String>> {
        let mut names: Vec<String> = Vec::new();
        loop {
            let more = self.page(folder, names.last().map(String::as_str), PAGE)?;
            let last = more.len() < PAGE;
            names.extend(more);
            if last {
                return Ok(names);
            }
        }
    }
}

/// A photo that waits, as queues carry it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Hint {
    /// Name of its marker among what is pending.
    pub marker: String,
}

/// Whose turn it is. It may lose hints and give them twice.
pub trait Queue: Debug + Send + Sync + 'static {
    /// Tells of a photo that was accepted: it is for whichever node comes first.
    fn offer(&self, hint: &Hint);

    /// Puts a photo behind those that wait at this node.
    fn push(&self, hint: &Hint);

    /// True where it waits here or is worked on already.
    fn has(&self, hint: &Hint) -> bool;

    /// Forgets what waited here before `listed` and is not among the sorted names of what was `pending` then.
    fn keep(&self, pending: &[String], listed: Instant);

    /// The next one; none where there is none within `wait`.
    fn lease(&self, wait: Duration) -> Option<Box<dyn Lease>>;

    /// Names, meanings and values of what is counted.
    fn counts(&self) -> Vec<Figure> {
        Vec::new()
    }
}

/// A hint that was taken from a queue, which gives it to others where nothing is heard of it.
pub trait Lease: Send + Sync {
    /// The photo.
    fn hint(&self) -> &Hint;
    /// It is still worked on.
    fn extend(&self);
    /// It is done.
    fn acknowledge(self: Box<Self>);
    /// It is for others, after a while.
    fn give_back(self: Box<Self>, delay: Duration);
}

/// The error of a store that cannot be reached now.
pub fn unreachable(why: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> io::Error {
    io::Error::new(io::ErrorKind::HostUnreachable, why)
}
