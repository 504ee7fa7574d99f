//! Memory that answers hold while their clients read them. A client on HTTP/2 may request many files and read none.

use std::sync::atomic::{AtomicUsize, Ordering};

use bytes::Bytes;

/// Answers that are being sent, on all connections together: pieces of files and of groups of pictures, and whole answers of HTTP/2 that were
/// made for one client. Beyond 16 MiB, pieces of files have [`LEAST`]. Each piece of an object store is a request of its own, so it has 64 KiB.
/// The transport holds up to 64 KiB of a request.
pub static ANSWERS: AnswerMemory = AnswerMemory::new(16 << 20);

/// Memory is short if answers hold this many times their bound: then clients of HTTP/2 that do not read are disconnected sooner.
const SHORT: usize = 4;

/// Whole files in memory: those of caches, and those that clients still read after they have left the caches. Further ones are read from disk
/// while they are sent.
pub static WHOLE: AnswerMemory = AnswerMemory::new(0);

/// Every piece of a file may have this many bytes, so no client waits for another that does not read.
pub const LEAST: usize = 4 << 10;

/// A bound of memory, and how much of it is held.
#[derive(Debug)]
pub struct AnswerMemory {
    most: AtomicUsize,
    held: AtomicUsize,
}

/// Memory of a piece, until it is dropped.
#[derive(Debug)]
pub struct Share {
    of: &'static AnswerMemory,
    pub bytes: usize,
}

struct Holding<T> {
    bytes: Bytes,
    #[expect(dead_code, reason = "held until it is dropped")]
    held: T,
}

impl<T> AsRef<[u8]> for Holding<T> {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

/// The same bytes, which hold something until all their clones are dropped.
pub fn holding(bytes: Bytes, held: impl Send + 'static) -> Bytes {
    Bytes::from_owner(Holding { bytes, held })
}

impl AnswerMemory {
    /// All answers may hold `most` bytes together.
    pub const fn new(most: usize) -> Self {
        Self { most: AtomicUsize::new(most), held: AtomicUsize::new(0) }
    }

    /// Raises the bound to `most` bytes.
    pub fn allow(&self, most: usize) {
        self.most.fetch_max(most, Ordering::Relaxed);
    }

    fn is_within(&self) -> bool {
        self.held() <= self.most.load(Ordering::Relaxed)
    }

    /// Bytes that are held.
    pub fn held(&self) -> usize {
        self.held.load(Ordering::Relaxed)
    }

    /// Whether answers hold far more than their bound.
    pub fn is_short(&self) -> bool {
        self.held() > self.most.load(Ordering::Relaxed).saturating_mul(SHORT)
    }

    /// Memory for a piece of up to `wanted` bytes; fewer if little is left, but at least `least`.
    pub fn take(&'static self, wanted: usize, least: usize) -> Share {
        let mut bytes = wanted;
        loop {
            let share = Share::new(self, bytes);
            if bytes <= least || self.is_within() {
                return share;
            }
            bytes = (bytes / 2).max(least);
        }
    }

    /// The same bytes with their share, whatever is left.
    pub fn count(&'static self, bytes: Bytes) -> Bytes {
        Share::new(self, bytes.len()).attach(bytes)
    }

    /// The same bytes with their share; `None` if too little is left.
    pub fn hold(&'static self, bytes: &Bytes) -> Option<Bytes> {
        let share = Share::new(self, bytes.len());
        self.is_within().then(|| share.attach(bytes.clone()))
    }
}

impl Share {
    fn new(of: &'static AnswerMemory, bytes: usize) -> Self {
        of.held.fetch_add(bytes, Ordering::Relaxed);
        Self { of, bytes }
    }

    /// The same bytes, which hold the share until all their clones are dropped.
    pub fn attach(self, bytes: Bytes) -> Bytes {
        holding(bytes, self)
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        self.of.held.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_get_smaller_when_little_memory_is_left_and_give_it_back() {
        static MEMORY: AnswerMemory = AnswerMemory::new(100 << 10);
        let first = MEMORY.take(64 << 10, LEAST);
        let second = MEMORY.take(64 << 10, LEAST);
        assert_eq!((first.bytes, second.bytes), (64 << 10, 32 << 10));
        let least: Vec<Share> = (0..9).map(|_| MEMORY.take(1 << 20, LEAST)).collect();
        assert!(least.iter().all(|share| share.bytes == LEAST));
        assert_eq!(MEMORY.take(9, LEAST).bytes, 9);
        assert!(!MEMORY.is_short());
        let large = MEMORY.count(Bytes::from(vec![7; 300 << 10]));
        assert!(large.len() == 300 << 10 && MEMORY.is_short());
        drop(large);
        assert_eq!(MEMORY.held(), (96 << 10) + 9 * LEAST);
        let mut sent = first.attach(Bytes::from(vec![7; 64 << 10]));
        let rest = sent.split_off(9);
        drop(sent);
        assert_eq!((rest.len(), MEMORY.held()), ((64 << 10) - 9, (96 << 10) + 9 * LEAST), "a part holds the whole");
        drop((rest, second, least));
        assert_eq!(MEMORY.held(), 0);
        assert_eq!(MEMORY.take(64 << 10, LEAST).bytes, 64 << 10);
    }

    #[test]
    fn whole_answers_are_held_as_long_as_they_fit() {
        static MEMORY: AnswerMemory = AnswerMemory::new(10);
        let six = Bytes::from_static(b"123456");
        let held = MEMORY.hold(&six).unwrap();
        assert_eq!((&held, MEMORY.hold(&six), MEMORY.held()), (&six, None, 6));
        MEMORY.allow(12);
        assert!(MEMORY.hold(&six).is_some());
        drop(held);
        assert_eq!(MEMORY.held(), 0);
    }
}
