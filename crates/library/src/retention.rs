//! Retention: deletes photos that are too old, the least recently viewed photos if all take too much space, unused exports, and expired
//! rows.

use std::sync::PoisonError;
use std::time::{Duration, Instant};

use sqlx::Row as _;

use crate::deliveries;
use crate::ids::{Millis, PhotoId};
use crate::photo::file_names;
use crate::{Library, LibraryError, Result, millis, rooms};

/// Photos per query.
const PART: i64 = 256;
/// How long a failed export is kept.
const FAILED_FOR: Duration = Duration::from_mins(10);
/// How long a room without a lease keeps its epoch.
const ROOM_FOR: Duration = Duration::from_hours(24 * 30);

/// What a sweep deleted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Swept {
    /// Photos deleted for their age.
    pub by_age: u64,
    /// Photos deleted for space.
    pub by_space: u64,
    /// Bytes of both.
    pub bytes: u64,
    /// Exports.
    pub exports: u64,
}

/// A photo to delete.
struct Candidate {
    id: PhotoId,
    accepted_at: Millis,
    bytes: u64,
}

impl Library {
    /// When a photo accepted at this time is deleted for its age, if ever.
    #[must_use]
    pub fn ends_at(&self, accepted_at: Millis) -> Option<Millis> {
        self.limits().retain.map(|time| accepted_at.saturating_add(millis(time)))
    }

    /// Applies the retention limits. Photos that wait or are being made stay.
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`], possibly after some deletions.
    pub async fn sweep(&self) -> Result<Swept> {
        self.save_views().await?;
        let mut swept = Swept::default();
        if let Some(time) = self.limits().retain {
            let before = self.trusted_now().await?.saturating_sub(millis(time));
            let select = "SELECT id, accepted_at, bytes FROM photos WHERE accepted_at <= $1 AND state IN ('done', 'failed', 'damaged')
                ORDER BY accepted_at LIMIT $2";
            loop {
                let going = self.candidates(select, before).await?;
                if self.delete_all(&going, u64::MAX, &mut swept.by_age, &mut swept.bytes).await? == 0 {
                    break;
                }
            }
        }
        if let Some(room) = self.limits().retain_bytes {
            self.make_room(room, &mut swept).await?;
        }
        swept.exports = self.sweep_ended().await?;
        Ok(swept)
    }

    async fn make_room(&self, room: u64, swept: &mut Swept) -> Result<()> {
        let select = "SELECT id, accepted_at, bytes FROM photos WHERE state IN ('done', 'failed', 'damaged') AND viewed_at <= $1
            ORDER BY viewed_at, id LIMIT $2";
        loop {
            let sum = "SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) AS bytes FROM photos";
            let all = sqlx::query(sum).fetch_one(self.database().reader()).await?.try_get::<i64, _>("bytes")? as u64;
            let over = all.saturating_sub(room);
            if over == 0 {
                return Ok(());
            }
            let going = self.candidates(select, Millis::MAX).await?;
            if self.delete_all(&going, over, &mut swept.by_space, &mut swept.bytes).await? == 0 {
                return Ok(());
            }
        }
    }

    async fn candidates(&self, select: &'static str, until: Millis) -> Result<Vec<Candidate>> {
        let rows = sqlx::query(select).bind(until).bind(PART).fetch_all(self.database().reader()).await?;
        let of = |row: &sqlx::any::AnyRow| {
            let id: String = row.try_get("id")?;
            let id = id.parse().map_err(|e| LibraryError::stored("id", e))?;
            Ok(Candidate { id, accepted_at: row.try_get("accepted_at")?, bytes: row.try_get::<i64, _>("bytes")? as u64 })
        };
        rows.iter().map(of).collect()
    }

    /// Deletes photos until `enough` bytes are free; returns how many.
    async fn delete_all(&self, going: &[Candidate], enough: u64, count: &mut u64, bytes: &mut u64) -> Result<u64> {
        let (mut deleted, mut freed) = (0, 0_u64);
        for photo in going {
            if freed >= enough {
                break;
            }
            if self.delete(photo.id, Some(photo.accepted_at)).await? {
                deleted += 1;
            }
            freed += photo.bytes;
        }
        *count += deleted;
        *bytes += freed;
        Ok(deleted)
    }

    /// Removes unused exports, expired sessions and rooms, and the log of deliveries beyond its limits; returns the number of exports.
    async fn sweep_ended(&self) -> Result<u64> {
        let mut tx = self.database().write().await?;
        rooms::end_abandoned(&mut tx).await?;
        let (now, limits) = (tx.now, self.limits());
        let delete = "DELETE FROM jobs WHERE (state = 'done' AND used_at <= $1) OR (state = 'failed' AND used_at <= $2) RETURNING result";
        let (done, failed) = (now - millis(limits.exports_for), now - millis(FAILED_FOR.min(limits.exports_for)));
        let deleted = sqlx::query(delete).bind(done).bind(failed).fetch_all(tx.connection()).await?;
        for (delete, until) in [
            ("DELETE FROM sessions WHERE expires_at <= $1", now),
            ("DELETE FROM rooms WHERE live = 0 AND lease_until <= $1", now - millis(ROOM_FOR)),
        ] {
            sqlx::query(delete).bind(until).execute(tx.connection()).await?;
        }
        deliveries::sweep(&mut tx).await?;
        tx.commit().await?;
        self.blobs().discard(file_names(&deleted)?).await;
        Ok(deleted.len() as u64)
    }

    /// The database's time, as far as deletions may trust it.
    async fn trusted_now(&self) -> Result<Millis> {
        let told = self.database().now().await?;
        let latest = sqlx::query("SELECT MAX(accepted_at) AS latest FROM photos").fetch_one(self.database().reader()).await?;
        let latest: Option<Millis> = latest.try_get("latest")?;
        let mut clock = self.0.trusted.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        Ok(clock.get_or_insert_with(|| TrustedClock::start(told, latest, now)).time(told, now))
    }
}

/// How far the clock may run ahead of the monotonic one before that counts as a jump.
const SLACK: Duration = Duration::from_mins(10);
/// How long the clock must stay ahead before it is trusted, and how far it may be ahead of the newest photo at the start.
const STAYS: Duration = Duration::from_hours(24);

/// The clock for deletions, which trusts a jump ahead only after a day. A clock that is temporarily wrong, as before NTP corrects it, must
/// not make photos look years old.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TrustedClock {
    at: Millis,
    read: Instant,
    /// Since when the database's clock has been ahead, and by how much.
    ahead: Option<(Instant, Millis)>,
}

impl TrustedClock {
    /// Starts at the database's time, or at the newest photo if that is more than [`STAYS`] older.
    fn start(told: Millis, latest: Option<Millis>, read: Instant) -> Self {
        let at = latest.filter(|latest| told > latest.saturating_add(millis(STAYS))).unwrap_or(told);
        Self { at, read, ahead: None }
    }

    fn time(&mut self, told: Millis, read: Instant) -> Millis {
        let counted = self.at.saturating_add(millis(read.saturating_duration_since(self.read)));
        let by = told.saturating_sub(counted);
        let is_ahead = by > millis(SLACK);
        // another far jump restarts the wait
        let since = self.ahead.filter(|(_, before)| by <= before.saturating_add(millis(STAYS))).map_or(read, |(since, _)| since);
        let is_believed = !is_ahead || read.saturating_duration_since(since) >= STAYS;
        if is_ahead && self.ahead.is_none() {
            tracing::warn!(ahead_s = by / 1000, "the clock jumped ahead: retention uses the new time after a day");
        }
        (self.at, self.read) = (if is_believed { told } else { counted }, read);
        self.ahead = (!is_believed).then_some((since, by));
        self.at
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOUR: Duration = Duration::from_hours(1);

    #[test]
    fn a_clock_that_jumps_ahead_is_trusted_after_a_day() {
        let start = Instant::now();
        let (day, year) = (millis(HOUR * 24), millis(HOUR * 24 * 365));
        let mut clock = TrustedClock::start(day, Some(day), start);
        assert_eq!(clock.time(day + year, start + HOUR), day + millis(HOUR));
        assert_eq!(clock.time(day + year, start + HOUR * 24), day + day);
        assert_eq!(clock.time(day + year, start + HOUR * 25), day + year);
        assert_eq!(clock.time(day, start + HOUR * 26), day, "put back, it is believed at once");
    }

    #[test]
    fn a_start_long_after_the_newest_photo_is_not_trusted_at_once() {
        let start = Instant::now();
        let year = millis(HOUR * 24 * 365);
        let mut clock = TrustedClock::start(year, Some(7), start);
        assert_eq!(clock.time(year, start), 7);
        assert_eq!(clock.time(year + millis(HOUR * 25), start + HOUR * 25), year + millis(HOUR * 25));
        assert_eq!(TrustedClock::start(year, None, start).time(year, start), year);
    }
}
