//! This machine's clock, and timestamps for clients.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use humantime::format_rfc3339_millis;
use tmpi_library::Millis;

/// Time since 1970, UTC, by this machine's clock. To compare with times of other nodes, use the database's clock.
pub fn since_1970() -> Duration {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default()
}

/// Last millisecond of the year 9999, the last that RFC 3339 writes.
const LAST: Millis = 253_402_300_799_999;

/// `2026-01-31T12:00:00.000Z` (RFC 3339).
pub fn rfc3339(at: Millis) -> String {
    format_rfc3339_millis(UNIX_EPOCH + Duration::from_millis(at.clamp(0, LAST) as u64)).to_string()
}

#[cfg(test)]
mod tests {
    use super::rfc3339;

    #[test]
    fn times_are_written_up_to_the_year_9999() {
        assert_eq!(rfc3339(1_767_225_600_001), "2026-01-01T00:00:00.001Z");
        assert_eq!((rfc3339(-1), rfc3339(i64::MAX)), (rfc3339(0), "9999-12-31T23:59:59.999Z".into()));
    }
}
