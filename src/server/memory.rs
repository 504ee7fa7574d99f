//! Memory that photos under way may take, given out by bytes.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// How often a job that waits looks whether it is still wanted.
const LOOK: Duration = Duration::from_millis(50);

/// What there is and what is given out.
pub struct Memory {
    all: u64,
    taken: Mutex<u64>,
    freed: Condvar,
}

/// Memory that a job has as long as this lives.
pub struct Share<'a> {
    of: &'a Memory,
    bytes: u64,
}

impl Drop for Share<'_> {
    fn drop(&mut self) {
        *self.of.lock() -= self.bytes;
        self.of.freed.notify_all();
    }
}

impl Memory {
    /// So many bytes.
    #[must_use]
    pub const fn new(all: u64) -> Self {
        Self { all, taken: Mutex::new(0), freed: Condvar::new() }
    }

    fn lock(&self) -> MutexGuard<'_, u64> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until `bytes` are there; what needs more than all gets that alone. None once it is `unwanted`.
    pub fn wait_for(&self, bytes: u64, unwanted: impl Fn() -> bool) -> Option<Share<'_>> {
        let mut taken = self.lock();
        while *taken > 0 && taken.saturating_add(bytes) > self.all {
            if unwanted() {
                return None;
            }
            taken = self.freed.wait_timeout(taken, LOOK).unwrap_or_else(PoisonError::into_inner).0;
        }
        *taken += bytes;
        Some(Share { of: self, bytes })
    }

    /// Bytes that are given out.
    #[must_use]
    pub fn taken(&self) -> u64 {
        *self.lock()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_fits_is_had_at_once_and_the_rest_waits_or_gives_up() {
        let memory = Memory::new(10);
        let (first, second) = (memory.wait_for(6, || true).unwrap(), memory.wait_for(4, || true).unwrap());
        assert!(memory.wait_for(1, || true).is_none() && memory.taken() == 10);
        std::thread::scope(|scope| {
            let waits = scope.spawn(|| memory.wait_for(5, || false).map(|share| share.bytes));
            drop(first);
            assert_eq!(waits.join().unwrap(), Some(5));
        });
        drop(second);
        assert_eq!(memory.taken(), 0);
        let _huge = memory.wait_for(99, || true).unwrap();
        assert!(memory.wait_for(1, || true).is_none(), "alone");
    }
}
