//! What is tried again, and after how long.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::time::Duration;

use crate::Error;

/// Pause before the first other try.
const FIRST: Duration = Duration::from_millis(250);

/// When a request may be sent a second time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Again {
    /// Whatever became of the first: it changes nothing to do it twice.
    Safe,
    /// Only where the first was not done.
    Undone,
}

/// Pause before try number `tries` + 1, at most `longest`, spread so that clients that were refused together do not come back together.
pub(crate) fn pause(tries: u32, longest: Duration) -> Duration {
    let most = FIRST.saturating_mul(1 << tries.min(16)).min(longest);
    let share = RandomState::new().build_hasher().finish() as f64 / u64::MAX as f64;
    most.mul_f64(0.5 + share / 2.0)
}

impl Again {
    /// Whether a request that ended so may be sent again.
    pub(crate) fn after(self, error: &Error) -> bool {
        let safe = self == Self::Safe;
        match error {
            Error::Refused(problem) => problem.status == 429 || (safe && problem.status == 503),
            Error::Connection(e) => e.is_connect() || (safe && !e.is_builder()),
            Error::Silence(_) => safe,
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Problem;

    #[test]
    fn pauses_grow_to_the_longest() {
        let longest = Duration::from_secs(4);
        for tries in 0..40 {
            let most = FIRST.saturating_mul(1 << tries.min(16)).min(longest);
            let pause = pause(tries, longest);
            assert!(pause >= most / 2 && pause <= most, "{tries}: {pause:?}");
        }
    }

    #[test]
    fn what_may_have_been_done_is_not_done_twice() {
        let refused = |status| {
            let text = format!(r#"{{"type": "urn:tmpi:problem:x", "title": "", "status": {status}}}"#);
            Error::Refused(Box::new(serde_json::from_str::<Problem>(&text).unwrap_or_else(|e| panic!("{e}"))))
        };
        for (error, safe, undone) in [
            (refused(429), true, true),
            (refused(503), true, false),
            (refused(500), false, false),
            (refused(404), false, false),
            (Error::Silence(FIRST), true, false),
            (Error::Deleted, false, false),
        ] {
            assert_eq!((Again::Safe.after(&error), Again::Undone.after(&error)), (safe, undone), "{error}");
        }
    }
}
