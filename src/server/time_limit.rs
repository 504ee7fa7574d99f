//! Time limit of a request. It starts when the body has arrived, so that slow links do not count, and long work may extend it.

use std::time::Duration;

use tokio::sync::watch;
use tokio::time::Instant;

/// A request's time.
#[derive(Clone, Debug)]
pub struct TimeLimit(watch::Sender<State>);

#[derive(Debug)]
struct State {
    limit: Duration,
    started: Option<Instant>,
}

impl TimeLimit {
    /// A clock of `limit` that is not started.
    pub fn new(limit: Duration) -> Self {
        Self(watch::Sender::new(State { limit, started: None }))
    }

    /// Starts it, if it is not running.
    pub fn start(&self) {
        self.0.send_modify(|state| {
            state.started.get_or_insert_with(Instant::now);
        });
    }

    /// Extends the limit to `limit` in all, if that is more.
    pub fn allow(&self, limit: Duration) {
        self.0.send_modify(|state| state.limit = state.limit.max(limit));
    }

    /// When the time is over; `None` before it starts.
    pub fn deadline(&self) -> Option<Instant> {
        let state = self.0.borrow();
        state.started.map(|at| at + state.limit)
    }

    /// Waits until the time is over; returns the limit.
    pub async fn expired(&self) -> Duration {
        let mut changes = self.0.subscribe();
        loop {
            match self.deadline() {
                // no error: `self` can still change
                None => {
                    let _ = changes.changed().await;
                }
                Some(deadline) if deadline <= Instant::now() => return self.0.borrow().limit,
                Some(deadline) => tokio::time::sleep_until(deadline).await,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_time_limit_runs_from_its_start_and_can_be_extended() {
        let short = Duration::from_millis(20);
        let expires = async |clock: &TimeLimit| tokio::time::timeout(Duration::from_millis(60), clock.expired()).await.is_ok();
        let clock = TimeLimit::new(short);
        assert!(!expires(&clock).await, "stands still");
        let (late, ()) = tokio::join!(expires(&clock), async { clock.start() });
        assert!(late && clock.deadline().is_some());
        let clock = TimeLimit::new(short);
        clock.start();
        clock.allow(Duration::from_mins(1));
        assert!(!expires(&clock).await);
    }
}
