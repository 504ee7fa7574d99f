//! Blocking work for requests: each class has its own slots, so that a film does not delay views, and memory is given out in bytes.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::http::StatusCode;
use opentelemetry::Context;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::client_slots::{ClientSlots, client_address};
use super::limits::Limits;
use super::problem::Problem;
use super::traces;

/// Unit of memory in bytes.
const UNIT: u64 = 1 << 20;

/// Class of work, with its own slots.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WorkClass {
    /// Single views: a person is waiting for them.
    Interactive,
    /// Smaller levels and parts of containers.
    Derived,
    /// Films and files to download.
    Export,
}

impl WorkClass {
    #[cfg(test)]
    const ALL: [Self; 3] = [Self::Interactive, Self::Derived, Self::Export];

    /// Name in metrics.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Interactive => "interactive",
            Self::Derived => "derived",
            Self::Export => "export",
        }
    }
}

/// Gives out slots and memory.
pub struct BlockingPool {
    lanes: [Lane; 3],
    /// Memory of views and levels, and of films and files, which take minutes: waiters for memory queue up in order.
    memory: [Arc<Semaphore>; 2],
    most: u32,
    entered: AtomicU64,
}

struct Lane {
    slots: Arc<Semaphore>,
    /// Places to wait.
    waiting: ClientSlots,
    most_waiting: usize,
    count: usize,
    /// Estimated seconds per request, for `Retry-After`.
    seconds: u64,
}

/// A slot with its memory; released when the last clone is dropped.
#[derive(Clone)]
pub struct Slot {
    _held: Arc<(OwnedSemaphorePermit, OwnedSemaphorePermit, Context)>,
}

impl BlockingPool {
    pub fn new(limits: &Limits) -> Self {
        let lane = |slots: usize, most_waiting, seconds| Lane {
            slots: Arc::new(Semaphore::new(slots.max(1))),
            waiting: ClientSlots::new(most_waiting),
            most_waiting,
            count: slots.max(1),
            seconds,
        };
        let most = u32::try_from(limits.work_memory as u64 / UNIT).unwrap_or(u32::MAX >> 3).max(1);
        Self {
            lanes: [
                lane(limits.views, limits.views_waiting, 1),
                lane(limits.views, limits.views_waiting, 1),
                lane(limits.exports.workers, limits.exports.waiting, 10),
            ],
            memory: [(); 2].map(|()| Arc::new(Semaphore::new(most as usize))),
            most,
            entered: AtomicU64::new(0),
        }
    }

    /// Number of slots given out so far.
    pub fn entered(&self) -> u64 {
        self.entered.load(Ordering::Relaxed)
    }

    const fn lane(&self, class: WorkClass) -> &Lane {
        &self.lanes[class as usize]
    }

    const fn memory(&self, class: WorkClass) -> &Arc<Semaphore> {
        &self.memory[matches!(class, WorkClass::Export) as usize]
    }

    /// Waits for a slot and for `bytes` of memory; work that needs more than the total runs alone.
    ///
    /// # Errors
    /// 503 if too many of the class are waiting.
    pub async fn enter(&self, class: WorkClass, bytes: u64) -> Result<Slot, Problem> {
        let lane = self.lane(class);
        let broken = |e| Problem::internal("work pool", &e);
        let wanted = u32::try_from(bytes.div_ceil(UNIT)).unwrap_or(u32::MAX).clamp(1, self.most);
        let at_once = Arc::clone(&lane.slots).try_acquire_owned().ok();
        if let Some(slot) = at_once {
            if let Ok(memory) = Arc::clone(self.memory(class)).try_acquire_many_owned(wanted) {
                return Ok(self.slot(class, slot, memory));
            }
            drop(slot);
        }
        let Some(waits) = lane.waiting.take(client_address()) else {
            let rounds = (lane.most_waiting / lane.count) as u64;
            let detail = format!("too many requests for {} work are waiting already", class.name());
            return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", detail).retry_after((rounds * lane.seconds / 8).clamp(1, 60)));
        };
        let slot = Arc::clone(&lane.slots).acquire_owned().await.map_err(broken)?;
        let memory = Arc::clone(self.memory(class)).acquire_many_owned(wanted).await.map_err(broken)?;
        drop(waits);
        Ok(self.slot(class, slot, memory))
    }

    fn slot(&self, class: WorkClass, slot: OwnedSemaphorePermit, memory: OwnedSemaphorePermit) -> Slot {
        self.entered.fetch_add(1, Ordering::Relaxed);
        Slot { _held: Arc::new((slot, memory, traces::work(class.name()))) }
    }

    pub fn waiting(&self, class: WorkClass) -> usize {
        self.lane(class).waiting.taken()
    }

    /// Bytes of memory given out.
    pub fn bytes(&self) -> u64 {
        self.memory.iter().map(|m| u64::from(self.most).saturating_sub(m.available_permits() as u64) * UNIT).sum()
    }
}

impl Slot {
    /// Runs blocking work. It keeps the slot until it ends, even if the client has gone, since it cannot be aborted.
    pub async fn run<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> Result<T, Problem> {
        let slot = self.clone();
        let result = tokio::task::spawn_blocking(move || {
            let result = work();
            drop(slot);
            result
        });
        result.await.map_err(|e| Problem::internal("work panicked", &e))
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::super::limits::Exports;
    use super::*;

    fn pool(slots: usize, waiting: usize, memory: u64) -> Arc<BlockingPool> {
        let limits = Limits {
            views: slots,
            views_waiting: waiting,
            exports: Exports { workers: slots, waiting, ..Exports::default() },
            work_memory: (memory * UNIT) as usize,
            ..Limits::default()
        };
        Arc::new(BlockingPool::new(&limits))
    }

    /// Whether `future` is still pending.
    async fn waits<T>(future: impl Future<Output = T>) -> bool {
        tokio::time::timeout(Duration::from_millis(20), future).await.is_err()
    }

    #[tokio::test]
    async fn a_full_waiting_line_refuses_the_next() {
        let pool = pool(1, 1, 9);
        let first = pool.enter(WorkClass::Interactive, 1).await.unwrap();
        let second = tokio::spawn({
            let pool = Arc::clone(&pool);
            async move { pool.enter(WorkClass::Interactive, 1).await.is_ok() }
        });
        while pool.waiting(WorkClass::Interactive) == 0 {
            tokio::task::yield_now().await;
        }
        let refused = pool.enter(WorkClass::Interactive, 1).await.err().unwrap();
        assert!(refused.status == 503 && refused.retry_after.is_some());
        assert_eq!(pool.waiting(WorkClass::Interactive), 1);
        drop(first);
        assert!(second.await.unwrap());
        assert_eq!(pool.waiting(WorkClass::Interactive), 0);
    }

    #[tokio::test]
    async fn classes_do_not_delay_each_other() {
        let pool = pool(1, 9, 9);
        let _film = pool.enter(WorkClass::Export, 1).await.unwrap();
        assert!(waits(pool.enter(WorkClass::Export, 1)).await);
        let _level = pool.enter(WorkClass::Derived, 1).await.unwrap();
        assert!(!waits(pool.enter(WorkClass::Interactive, 1)).await);
        assert_eq!(WorkClass::ALL.map(|class| pool.waiting(class)), [0; 3], "who gives up waits no more");
    }

    #[tokio::test]
    async fn a_film_of_a_large_photo_does_not_delay_views() {
        let pool = pool(1, 9, 10);
        let film = pool.enter(WorkClass::Export, 8 * UNIT).await.unwrap();
        let large = pool.enter(WorkClass::Interactive, 8 * UNIT).await.unwrap();
        assert!(waits(pool.enter(WorkClass::Derived, 3 * UNIT)).await, "memory of views and levels is one");
        assert!(!waits(pool.enter(WorkClass::Derived, 2 * UNIT)).await);
        assert_eq!(pool.bytes(), 16 * UNIT);
        drop((film, large));
        assert_eq!(pool.bytes(), 0);
    }

    #[tokio::test]
    async fn work_that_needs_more_than_all_memory_runs_alone() {
        let pool = pool(9, 99, 10);
        let _huge = pool.enter(WorkClass::Interactive, 99 * UNIT).await.unwrap();
        assert!(waits(pool.enter(WorkClass::Derived, 1)).await);
    }

    #[tokio::test]
    async fn a_panic_frees_its_slot_and_work_holds_it_to_the_end() {
        let pool = pool(1, 0, 9);
        let slot = pool.enter(WorkClass::Interactive, 1).await.unwrap();
        assert_eq!(slot.run(|| panic!("on purpose")).await.map(|()| 0).unwrap_err().status, 500);
        let (go, gate) = std::sync::mpsc::channel::<()>();
        let work = slot.run(move || gate.recv().is_ok());
        assert!(waits(work).await);
        drop(slot);
        assert_eq!(pool.enter(WorkClass::Interactive, 1).await.err().map(|p| p.status), Some(503));
        go.send(()).unwrap();
        while pool.enter(WorkClass::Interactive, 1).await.is_err() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }
}
