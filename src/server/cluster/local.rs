//! The queue of one process: hints in memory, those that others handed over among them.

use std::collections::{HashSet, VecDeque};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::{oneshot, watch};

use super::ports::{Hint, Lease, Queue};

/// Time for which a hint of this node waits for one that others hand over: each of theirs is given to one node alone.
const PATIENCE: Duration = Duration::from_millis(100);
/// Hints of others in a row; then comes one of this node's, which may be lost elsewhere.
const IN_A_ROW: u32 = 3;

/// Hints in the order in which they came.
#[derive(Clone, Debug, Default)]
pub struct LocalQueue(Arc<Inner>);

#[derive(Debug, Default)]
struct Inner {
    waiting: Mutex<Waiting>,
    came: Condvar,
    /// Workers that wait for a hint.
    idle: watch::Sender<usize>,
    /// Others hand over what they have.
    fed: AtomicBool,
}

#[derive(Debug, Default)]
struct Waiting {
    hints: VecDeque<Turn>,
    /// Those that are waiting or leased: a second hint for one of them tells nothing new.
    known: HashSet<String>,
    /// Hints of others since one of this node's.
    in_a_row: u32,
}

#[derive(Debug)]
struct Turn {
    hint: Hint,
    came: Instant,
    due: Instant,
    from: Option<Handed>,
}

/// A hint that is handed over.
#[derive(Debug)]
struct Handed {
    receipt: Box<dyn Receipt>,
    taken: oneshot::Sender<()>,
}

/// Tells who handed a hint over what becomes of it.
pub trait Receipt: std::fmt::Debug + Send + Sync {
    /// It is still worked on.
    fn extend(&self);
    /// It is done.
    fn done(&self);
    /// It is for others, after a while.
    fn back(&self, delay: Duration);
}

impl LocalQueue {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.0.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How many workers wait for a hint, now and later.
    pub fn idle(&self) -> watch::Receiver<usize> {
        self.0.idle.subscribe()
    }

    /// Says whether others hand hints over now.
    pub fn is_fed(&self, fed: bool) {
        self.0.fed.store(fed, Ordering::Release);
    }

    /// Hands a hint over to the next worker; the receiver hears when it is taken.
    pub fn hand_over(&self, hint: Hint, receipt: Box<dyn Receipt>) -> oneshot::Receiver<()> {
        let (taken, told) = oneshot::channel();
        let mut waiting = self.lock();
        if !waiting.known.insert(hint.marker.clone()) {
            // it waits here already, and is not taken twice; what is worked on is
            waiting.hints.retain(|turn| turn.hint != hint);
        }
        let now = Instant::now();
        waiting.hints.push_front(Turn { hint, came: now, due: now, from: Some(Handed { receipt, taken }) });
        self.0.came.notify_one();
        told
    }

    /// Takes back what was handed over and nobody took.
    pub fn take_back(&self, hint: &Hint) -> Option<Box<dyn Receipt>> {
        let mut waiting = self.lock();
        let at = waiting.hints.iter().position(|turn| turn.from.is_some() && turn.hint == *hint)?;
        let turn = waiting.hints.remove(at)?;
        waiting.known.remove(&hint.marker);
        turn.from.map(|from| from.receipt)
    }

    fn next(&self, wait: Duration) -> Option<Box<dyn Lease>> {
        let began = Instant::now();
        let end = began + wait;
        let mut waiting = self.lock();
        let own_turn = waiting.in_a_row >= IN_A_ROW;
        let patient = if self.0.fed.load(Ordering::Acquire) && !own_turn { (began + PATIENCE).min(end) } else { began };
        loop {
            let now = Instant::now();
            let own = |turn: &Turn| turn.from.is_none() && turn.due <= now && patient <= now;
            let first = if own_turn { waiting.hints.iter().position(own) } else { None };
            let any = || waiting.hints.iter().position(|turn| turn.from.is_some() || own(turn));
            if let Some(at) = first.or_else(any)
                && let Some(Turn { hint, from, .. }) = waiting.hints.remove(at)
            {
                waiting.in_a_row = if from.is_some() { waiting.in_a_row + 1 } else { 0 };
                let receipt = from.map(|Handed { receipt, taken }| {
                    // whoever handed it over may not wait any more, and hears it by the receipt
                    let _ = taken.send(());
                    receipt
                });
                return Some(Box::new(Leased { queue: self.clone(), hint, receipt }));
            }
            if now >= end {
                return None;
            }
            let next = waiting.hints.iter().map(|turn| turn.due.max(patient)).min().unwrap_or(end).min(end);
            let pause = next.saturating_duration_since(now);
            waiting = self.0.came.wait_timeout(waiting, pause).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl Queue for LocalQueue {
    fn offer(&self, hint: &Hint) {
        self.push(hint);
    }

    fn push(&self, hint: &Hint) {
        let mut waiting = self.lock();
        if waiting.known.insert(hint.marker.clone()) {
            let now = Instant::now();
            waiting.hints.push_back(Turn { hint: hint.clone(), came: now, due: now, from: None });
            self.0.came.notify_one();
        }
    }

    fn has(&self, hint: &Hint) -> bool {
        self.lock().known.contains(&hint.marker)
    }

    fn keep(&self, pending: &[String], listed: Instant) {
        let mut waiting = self.lock();
        let Waiting { hints, known, .. } = &mut *waiting;
        hints.retain(|turn| {
            let stays = turn.from.is_some() || turn.came >= listed || pending.binary_search(&turn.hint.marker).is_ok();
            if !stays {
                known.remove(&turn.hint.marker);
            }
            stays
        });
    }

    fn lease(&self, wait: Duration) -> Option<Box<dyn Lease>> {
        self.0.idle.send_modify(|n| *n += 1);
        let next = self.next(wait);
        self.0.idle.send_modify(|n| *n -= 1);
        next
    }
}

#[derive(Debug)]
struct Leased {
    queue: LocalQueue,
    hint: Hint,
    receipt: Option<Box<dyn Receipt>>,
}

impl Lease for Leased {
    fn hint(&self) -> &Hint {
        &self.hint
    }

    fn extend(&self) {
        if let Some(receipt) = &self.receipt {
            receipt.extend();
        }
    }

    fn acknowledge(self: Box<Self>) {
        self.queue.lock().known.remove(&self.hint.marker);
        if let Some(receipt) = self.receipt {
            receipt.done();
        }
    }

    fn give_back(self: Box<Self>, delay: Duration) {
        let Self { queue, hint, receipt } = *self;
        let mut waiting = queue.lock();
        if let Some(receipt) = receipt {
            waiting.known.remove(&hint.marker);
            return receipt.back(delay);
        }
        let now = Instant::now();
        waiting.hints.push_back(Turn { hint, came: now, due: now + delay, from: None });
        drop(waiting);
        queue.0.came.notify_one();
    }
}

/// The queue of a node that makes nothing.
#[derive(Debug)]
pub struct Idle;

impl Queue for Idle {
    fn offer(&self, _: &Hint) {}

    fn push(&self, _: &Hint) {}

    fn has(&self, _: &Hint) -> bool {
        // nothing is taken up here
        true
    }

    fn keep(&self, _: &[String], _: Instant) {}

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

    /// Writes down what it is told.
    #[derive(Debug, Default, Clone)]
    struct Notes(Arc<Mutex<Vec<String>>>);

    impl Notes {
        fn note(&self, what: &str) {
            self.0.lock().unwrap().push(what.to_owned());
        }
    }

    impl Receipt for Notes {
        fn extend(&self) {
            self.note("extend");
        }

        fn done(&self) {
            self.note("done");
        }

        fn back(&self, delay: Duration) {
            self.note(&format!("back after {delay:?}"));
        }
    }

    #[test]
    fn what_others_hand_over_comes_first_and_every_fourth_is_of_this_node() {
        let queue = LocalQueue::default();
        let (hint, notes) = (|name: &str| Hint { marker: name.into() }, Notes::default());
        queue.is_fed(true);
        for name in ["a", "b", "c", "far1"] {
            queue.push(&hint(name));
        }
        let mut came = Vec::new();
        for n in 0..5 {
            let taken = queue.hand_over(hint(&format!("far{n}")), Box::new(notes.clone()));
            let lease = queue.lease(Duration::from_secs(9)).unwrap();
            came.push(lease.hint().marker.clone());
            lease.extend();
            lease.acknowledge();
            assert_eq!(queue.take_back(&hint(&format!("far{n}"))).is_some(), n == 3);
            assert_eq!(taken.blocking_recv().is_ok(), n != 3, "who hands over hears whether it was taken");
        }
        assert_eq!(came, ["far0", "far1", "far2", "a", "far4"], "far1 waited here, too, and comes once");
        assert_eq!(notes.0.lock().unwrap().join(" "), ["extend done"; 4].join(" "));
        queue.is_fed(false);
        let began = Instant::now();
        assert_eq!(queue.lease(Duration::from_secs(9)).unwrap().hint(), &hint("b"));
        assert!(began.elapsed() < PATIENCE, "nobody hands anything over");
        let _taken = queue.hand_over(hint("far5"), Box::new(notes.clone()));
        queue.lease(Duration::ZERO).unwrap().give_back(Duration::from_secs(3));
        assert_eq!((notes.0.lock().unwrap().last().unwrap().as_str(), queue.has(&hint("far5"))), ("back after 3s", false));
    }

    #[test]
    fn what_is_no_longer_pending_is_forgotten_unless_it_came_since() {
        let queue = LocalQueue::default();
        let hint = |name: &str| Hint { marker: name.into() };
        for name in ["a", "b", "c"] {
            queue.push(&hint(name));
        }
        let a = queue.lease(Duration::ZERO).unwrap();
        std::thread::sleep(Duration::from_millis(2));
        let listed = Instant::now();
        queue.push(&hint("d"));
        queue.keep(&["b".to_owned()], listed);
        assert_eq!(["a", "b", "c", "d"].map(|name| queue.has(&hint(name))), [true, true, false, true]);
        a.acknowledge();
        let next = || queue.lease(Duration::ZERO).unwrap().hint().marker.clone();
        assert_eq!((next(), next()), ("b".to_owned(), "d".to_owned()));
    }
}
