//! The queue of one process: hints in memory.

use std::collections::{HashSet, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::ports::{Hint, Lease, Queue};

/// Hints in the order in which they came.
#[derive(Clone, Debug, Default)]
pub struct LocalQueue(Arc<Inner>);

#[derive(Debug, Default)]
struct Inner {
    waiting: Mutex<Waiting>,
    came: Condvar,
}

#[derive(Debug, Default)]
struct Waiting {
    /// Each with when its turn is.
    hints: VecDeque<(Instant, Hint)>,
    /// Those that are waiting or leased: a second hint for one of them tells nothing new.
    known: HashSet<String>,
}

impl LocalQueue {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.0.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Queue for LocalQueue {
    fn push(&self, hint: &Hint) {
        let mut waiting = self.lock();
        if waiting.known.insert(hint.marker.clone()) {
            waiting.hints.push_back((Instant::now(), hint.clone()));
            self.0.came.notify_one();
        }
    }

    fn has(&self, hint: &Hint) -> bool {
        self.lock().known.contains(&hint.marker)
    }

    fn lease(&self, wait: Duration) -> Option<Box<dyn Lease>> {
        let end = Instant::now() + wait;
        let mut waiting = self.lock();
        loop {
            let now = Instant::now();
            if let Some(at) = waiting.hints.iter().position(|(due, _)| *due <= now)
                && let Some((_, hint)) = waiting.hints.remove(at)
            {
                return Some(Box::new(Leased { queue: self.clone(), hint }));
            }
            let next = waiting.hints.iter().map(|(due, _)| *due).min().unwrap_or(end).min(end);
            if now >= end {
                return None;
            }
            let pause = next.saturating_duration_since(now);
            waiting = self.0.came.wait_timeout(waiting, pause).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

struct Leased {
    queue: LocalQueue,
    hint: Hint,
}

impl Lease for Leased {
    fn hint(&self) -> &Hint {
        &self.hint
    }

    fn extend(&self) {}

    fn acknowledge(self: Box<Self>) {
        self.queue.lock().known.remove(&self.hint.marker);
    }

    fn give_back(self: Box<Self>, delay: Duration) {
        self.queue.lock().hints.push_back((Instant::now() + delay, self.hint));
        self.queue.0.came.notify_one();
    }
}

/// The queue of a node that makes nothing.
#[derive(Debug)]
pub struct Idle;

impl Queue for Idle {
    fn push(&self, _: &Hint) {}

    fn has(&self, _: &Hint) -> bool {
        // nothing is taken up here
        true
    }

    fn lease(&self, wait: Duration) -> Option<Box<dyn Lease>> {
        std::thread::sleep(wait);
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hint_is_given_once_until_it_is_acknowledged_and_later_where_it_is_given_back() {
        let queue = LocalQueue::default();
        let hint = |name: &str| Hint { marker: name.into() };
        for name in ["a", "b", "a"] {
            queue.push(&hint(name));
        }
        let next = || queue.lease(Duration::ZERO);
        let (a, b) = (next().unwrap(), next().unwrap());
        assert_eq!((a.hint(), b.hint(), next().is_none()), (&hint("a"), &hint("b"), true));
        queue.push(&hint("a"));
        assert!(next().is_none() && queue.has(&hint("a")), "it is worked on");
        a.acknowledge();
        assert!(!queue.has(&hint("a")));
        queue.push(&hint("a"));
        assert_eq!(next().unwrap().hint(), &hint("a"));
        b.give_back(Duration::from_millis(60));
        assert!(next().is_none(), "not yet");
        assert_eq!(queue.lease(Duration::from_secs(9)).unwrap().hint(), &hint("b"));
    }
}
