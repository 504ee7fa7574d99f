//! Points in time as clients read them.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

/// The latest time that was told.
static LATEST: AtomicU64 = AtomicU64::new(0);

/// Milliseconds since 1970, UTC; never earlier than it said before, as the list and versions of photos go by it.
pub fn now_ms() -> u64 {
    let now = wall_ms();
    LATEST.fetch_max(now, Ordering::AcqRel).max(now)
}

/// What this machine's clock says now, in milliseconds since 1970, whatever it said before.
pub fn wall_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_millis() as u64)
}

/// From now on no time is told before `ms`, which is one that was told before a restart.
pub fn not_before(ms: u64) {
    LATEST.fetch_max(ms, Ordering::AcqRel);
}

/// `2026-01-31T12:00:00.000Z` (RFC 3339).
pub fn rfc3339(ms: u64) -> String {
    let (days, in_day) = (ms / 86_400_000, ms % 86_400_000);
    // civil from days: years start in March, eras of 400 years have 146 097 days
    let z = days + 719_468;
    let (era, day_of_era) = (z / 146_097, z % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted + 2) / 5 + 1;
    let month = if shifted < 10 { shifted + 3 } else { shifted - 9 };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    let (h, m, s, frac) = (in_day / 3_600_000, in_day / 60_000 % 60, in_day / 1000 % 60, in_day % 1000);
    format!("{year:04}-{month:02}-{day:02}T{h:02}:{m:02}:{s:02}.{frac:03}Z")
}

#[cfg(test)]
mod tests {
    use super::{not_before, now_ms, rfc3339};

    #[test]
    fn time_goes_on_from_what_was_told_before_a_restart() {
        let later = now_ms() + 200;
        not_before(later);
        assert!(now_ms() >= later);
        not_before(1);
        assert!(now_ms() >= later);
    }

    #[test]
    fn known_dates() {
        assert_eq!(rfc3339(0), "1970-01-01T00:00:00.000Z");
        assert_eq!(rfc3339(951_782_400_000), "2000-02-29T00:00:00.000Z");
        assert_eq!(rfc3339(951_868_799_999), "2000-02-29T23:59:59.999Z");
        assert_eq!(rfc3339(1_767_225_600_001), "2026-01-01T00:00:00.001Z");
        assert_eq!(rfc3339(4_107_542_400_000), "2100-03-01T00:00:00.000Z");
    }
}
