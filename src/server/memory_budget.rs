//! Memory for running jobs, given out in bytes.
//!
//! First come, first served, but low-priority jobs wait behind all others.

use std::collections::BTreeSet;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Interval at which a waiting job checks whether it is still wanted.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);

/// The total and what is given out.
pub struct MemoryBudget {
    all: u64,
    allocated: Mutex<Allocated>,
    freed: Condvar,
}

#[derive(Default)]
struct Allocated {
    taken: u64,
    /// Waiting jobs by priority and number of arrival; the first is next.
    waiting: BTreeSet<(Priority, u64)>,
    arrived: u64,
}

/// Whether a job has low priority.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Priority {
    Normal,
    Low,
}

/// Memory of a job, until it is dropped.
pub struct MemoryPermit<'a> {
    of: &'a MemoryBudget,
    bytes: u64,
}

impl Drop for MemoryPermit<'_> {
    fn drop(&mut self) {
        self.of.lock().taken -= self.bytes;
        self.of.freed.notify_all();
    }
}

impl MemoryBudget {
    /// A pool of so many bytes.
    pub fn new(all: u64) -> Self {
        Self { all, allocated: Mutex::default(), freed: Condvar::new() }
    }

    fn lock(&self) -> MutexGuard<'_, Allocated> {
        self.allocated.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for `bytes` of memory; a job that needs more than all gets all. `None` once it is `unwanted`.
    pub fn wait_for(&self, bytes: u64, priority: Priority, unwanted: impl Fn() -> bool) -> Option<MemoryPermit<'_>> {
        let mut allocated = self.lock();
        let turn = (priority, allocated.arrived);
        allocated.arrived += 1;
        allocated.waiting.insert(turn);
        let there = loop {
            let fits = allocated.taken == 0 || allocated.taken.saturating_add(bytes) <= self.all;
            if fits && allocated.waiting.first() == Some(&turn) {
                break true;
            }
            if unwanted() {
                break false;
            }
            allocated = self.freed.wait_timeout(allocated, CHECK_INTERVAL).unwrap_or_else(PoisonError::into_inner).0;
        };
        allocated.waiting.remove(&turn);
        allocated.taken += if there { bytes } else { 0 };
        drop(allocated);
        // wake the next one
        self.freed.notify_all();
        there.then(|| MemoryPermit { of: self, bytes })
    }

    pub fn taken(&self) -> u64 {
        self.lock().taken
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    #[test]
    fn memory_that_fits_is_granted_at_once_and_others_wait_or_give_up() {
        let memory = MemoryBudget::new(10);
        let (first, second) = (memory.wait_for(6, Priority::Normal, || true).unwrap(), memory.wait_for(4, Priority::Low, || true).unwrap());
        assert!(memory.wait_for(1, Priority::Normal, || true).is_none() && memory.taken() == 10);
        std::thread::scope(|scope| {
            let waits = scope.spawn(|| memory.wait_for(5, Priority::Low, || false).map(|share| share.bytes));
            drop(first);
            assert_eq!(waits.join().unwrap(), Some(5));
        });
        drop(second);
        assert_eq!(memory.taken(), 0);
        let _huge = memory.wait_for(99, Priority::Normal, || true).unwrap();
        assert!(memory.wait_for(1, Priority::Normal, || true).is_none(), "alone");
    }

    #[test]
    fn memory_is_first_come_first_served_with_low_priority_last() {
        let memory = MemoryBudget::new(10);
        let held = memory.wait_for(10, Priority::Normal, || true).unwrap();
        let order = Mutex::new(Vec::new());
        std::thread::scope(|scope| {
            for (n, bytes, priority) in [(0, 2, Priority::Low), (1, 10, Priority::Normal), (2, 3, Priority::Normal)] {
                let (memory, order) = (&memory, &order);
                scope.spawn(move || {
                    let share = memory.wait_for(bytes, priority, || false);
                    order.lock().unwrap().push(n);
                    drop(share);
                });
                let end = Instant::now() + Duration::from_secs(20);
                while memory.lock().waiting.len() <= n {
                    assert!(Instant::now() < end, "it waits");
                    std::thread::yield_now();
                }
            }
            drop(held);
        });
        let order = order.into_inner().unwrap();
        assert_eq!(order.first(), Some(&1), "a small one behind a large one does not keep it waiting: {order:?}");
        assert_eq!(memory.taken(), 0);
    }
}
