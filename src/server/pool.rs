//! Blocking work on behalf of requests, bounded in what runs and in what waits.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use axum::http::StatusCode;
use tokio::sync::Semaphore;

use super::problem::Problem;

/// Runs blocking closures.
pub struct Pool {
    slots: Arc<Semaphore>,
    waiting: AtomicUsize,
    most_waiting: usize,
}

struct Waits<'a>(&'a AtomicUsize);

impl Drop for Waits<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::AcqRel);
    }
}

impl Pool {
    /// At most `slots` closures at a time, at most `most_waiting` that wait.
    #[must_use]
    pub fn new(slots: usize, most_waiting: usize) -> Self {
        Self { slots: Arc::new(Semaphore::new(slots.max(1))), waiting: AtomicUsize::new(0), most_waiting }
    }

    /// Runs `work` once it is its turn.
    ///
    /// # Errors
    /// 503 where too many wait already, 500 where `work` panicked.
    pub async fn run<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> Result<T, Problem> {
        let permit = if let Ok(permit) = Arc::clone(&self.slots).try_acquire_owned() {
            permit
        } else {
            let waits = Waits(&self.waiting);
            if self.waiting.fetch_add(1, Ordering::AcqRel) >= self.most_waiting {
                return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", "too many views are waiting already").retry_after(1));
            }
            let permit = Arc::clone(&self.slots).acquire_owned().await;
            drop(waits);
            permit.map_err(|e| Problem::internal("view pool", &e))?
        };
        let result = tokio::task::spawn_blocking(move || {
            let result = work();
            // the slot is held to the end even where the request is gone: blocking work cannot be cut off
            drop(permit);
            result
        });
        result.await.map_err(|e| Problem::internal("drawing panicked", &e))
    }

    /// Closures that wait.
    #[must_use]
    pub fn waiting(&self) -> usize {
        self.waiting.load(Ordering::Acquire)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    #[tokio::test(flavor = "multi_thread")]
    async fn one_more_than_may_wait_is_refused() {
        let pool = Arc::new(Pool::new(1, 1));
        let (go, gate) = mpsc::channel::<()>();
        let first = tokio::spawn({
            let pool = Arc::clone(&pool);
            async move { pool.run(move || gate.recv().is_ok()).await }
        });
        while pool.slots.available_permits() > 0 {
            tokio::task::yield_now().await;
        }
        let second = tokio::spawn({
            let pool = Arc::clone(&pool);
            async move { pool.run(|| true).await }
        });
        while pool.waiting() == 0 {
            tokio::task::yield_now().await;
        }
        let refused = pool.run(|| true).await.unwrap_err();
        assert_eq!((refused.status, refused.retry_after), (503, Some(1)));
        assert_eq!(pool.waiting(), 1);
        go.send(()).unwrap();
        assert!(first.await.unwrap().unwrap() && second.await.unwrap().unwrap());
        assert_eq!(pool.waiting(), 0);
    }

    #[tokio::test]
    async fn a_panic_frees_its_slot() {
        let pool = Pool::new(1, 0);
        assert_eq!(pool.run(|| panic!("on purpose")).await.map(|()| 0).unwrap_err().status, 500);
        assert_eq!(pool.run(|| 7).await.unwrap(), 7);
    }
}
