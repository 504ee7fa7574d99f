//! The time by which photos go: a clock that jumps ahead is believed only once it has stayed there for a day.
//!
//! A clock that is wrong for a while, as before the network sets it right, must not take photos for years old. From its start on this counts by the
//! steady clock of the process, and takes over what the wall clock says where that is behind, or no more ahead than clocks are set right by.

use std::time::{Duration, Instant};

/// What the wall clock may be ahead of the steady one before that is a jump.
const SLACK: Duration = Duration::from_mins(10);
/// For how long a clock must have stayed ahead until it is believed; and how far it may be ahead of what is known at the start.
const STAYS: Duration = Duration::from_hours(24);

/// A clock by which may be deleted. Times are milliseconds since 1970.
#[derive(Clone, Copy, Debug)]
pub struct TrustedClock {
    at_ms: u64,
    at: Instant,
    /// Since when the wall clock is ahead, and how far.
    ahead: Option<(Instant, u64)>,
}

impl TrustedClock {
    /// Starts where the wall clock tells `told_ms`; not there, but at the latest time that is known to have been, where that is long before.
    #[must_use]
    pub fn start(told_ms: u64, latest_ms: Option<u64>, at: Instant) -> Self {
        let at_ms = latest_ms.filter(|latest| told_ms > latest.saturating_add(millis(STAYS))).unwrap_or(told_ms);
        Self { at_ms, at, ahead: None }
    }

    /// What it said last.
    #[must_use]
    pub const fn last(&self) -> u64 {
        self.at_ms
    }

    /// The time, where the wall clock tells `told_ms`.
    pub fn time(&mut self, told_ms: u64, at: Instant) -> u64 {
        let counted = self.at_ms.saturating_add(millis(at.saturating_duration_since(self.at)));
        let by = told_ms.saturating_sub(counted);
        let is_ahead = by > millis(SLACK);
        // one that jumps on, and far, has to stay there anew
        let since = self.ahead.filter(|(_, before)| by <= before.saturating_add(millis(STAYS))).map_or(at, |(since, _)| since);
        let is_believed = !is_ahead || at.saturating_duration_since(since) >= STAYS;
        if is_ahead && self.ahead.is_none() {
            tracing::warn!(ahead_s = by / 1000, "the clock is ahead of what has passed: photos go by it once it has stayed so for a day");
        }
        (self.at_ms, self.at) = (if is_believed { told_ms } else { counted }, at);
        self.ahead = (!is_believed).then_some((since, by));
        self.at_ms
    }
}

const fn millis(time: Duration) -> u64 {
    time.as_millis() as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOUR: u64 = 3_600_000;
    const NOW: u64 = 1_800_000_000_000;

    /// A clock that starts right, and what it says where so many hours have passed and the wall clock is so many ahead.
    fn run(latest_ms: Option<u64>, ahead_at_start: u64, looks: &[(u64, i64)]) -> Vec<i64> {
        let began = Instant::now();
        let mut clock = TrustedClock::start(NOW + ahead_at_start * HOUR, latest_ms, began);
        let said = looks.iter().map(|(passed, ahead)| {
            let told = (NOW + passed * HOUR).saturating_add_signed(ahead * HOUR as i64);
            let said = clock.time(told, began + Duration::from_hours(*passed));
            (said as i64 - (NOW + passed * HOUR) as i64) / HOUR as i64
        });
        said.collect()
    }

    #[test]
    fn a_clock_that_jumps_ahead_is_believed_once_it_stays_there_and_one_that_jumps_back_at_once() {
        assert_eq!(run(None, 0, &[(1, 0), (2, 0), (2000, 0)]), [0, 0, 0]);
        // for hours, and then it is set right
        assert_eq!(run(None, 0, &[(1, 9), (5, 9), (6, 0), (40, 0)]), [0, 0, 0, 0]);
        // for good
        assert_eq!(run(None, 0, &[(1, 90_000), (24, 90_000), (25, 90_000), (26, 90_000)]), [0, 0, 90_000, 90_000]);
        // on and on
        assert_eq!(run(None, 0, &[(1, 90), (20, 900), (26, 900), (43, 900), (44, 900)]), [0, 0, 0, 0, 900]);
        // a machine that sleeps each night
        assert_eq!(run(None, 0, &[(10, 8), (20, 16), (30, 24), (33, 24), (34, 24)]), [0, 0, 0, 0, 24]);
        assert_eq!(run(None, 0, &[(1, -9), (2, -9), (3, -9)]), [-9, -9, -9]);
        // behind, then right again: photos go late for a day
        assert_eq!(run(None, 0, &[(1, -9), (2, 0), (25, 0), (26, 0)]), [-9, -9, -9, 0]);
    }

    #[test]
    fn a_clock_that_is_ahead_at_the_start_is_held_against_what_is_known() {
        let years = 90_000;
        assert_eq!(run(Some(NOW), years, &[(0, years as i64), (1, 0), (2, 0)]), [0, 0, 0]);
        assert_eq!(run(Some(NOW - 20 * HOUR), 0, &[(0, 0), (1, 0)]), [0, 0], "nobody came for a day");
        assert_eq!(run(Some(NOW - 90 * HOUR), 0, &[(0, 0), (23, 0), (24, 0)]), [-90, -90, 0], "nor for more");
        assert_eq!(run(Some(NOW + 90 * HOUR), 0, &[(0, 0), (1, 0)]), [0, 0], "another node was ahead");
    }
}
