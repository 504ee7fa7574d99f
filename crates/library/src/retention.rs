//! Retention: deletes photos that are too old, the least recently viewed photos if all take too much space, unused exports, and expired
//! rows.

use std::time::Duration;

use crate::photo::file_names;
use crate::{Library, Millis, Result, deliveries, millis, room_leases};

/// Photos per query.
const PART: i64 = 256;
/// How long a failed export is kept.
const FAILED_FOR: Duration = Duration::from_mins(10);
/// How long a room without a lease keeps its epoch.
const ROOM_FOR: Duration = Duration::from_hours(24 * 30);
/// How long the clock must run without a jump, and the least difference from one sweep to the next that is a jump.
const STEADY: Duration = Duration::from_hours(24);

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

impl Library {
    /// When a photo accepted at this time is deleted for its age, if ever.
    pub fn ends_at(&self, accepted_at: Millis) -> Option<Millis> {
        self.limits().retain.map(|time| accepted_at.saturating_add(millis(time)))
    }

    /// Applies the retention limits. Photos that wait or are being made stay.
    pub async fn sweep(&self) -> Result<Swept> {
        self.save_views().await?;
        let mut swept = Swept::default();
        if let Some(time) = self.limits().retain
            && let Some(now) = self.steady_now().await?
        {
            let before = now.saturating_sub(millis(time));
            let select = "SELECT id, accepted_at, bytes FROM photos WHERE accepted_at <= $1 AND state IN ('done', 'failed', 'damaged')
                ORDER BY accepted_at LIMIT $2";
            loop {
                let (deleted, bytes) = self.delete_found(select, before, u64::MAX).await?;
                (swept.by_age, swept.bytes) = (swept.by_age + deleted, swept.bytes + bytes);
                if deleted == 0 {
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
            let sum = sqlx::query_scalar("SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM photos");
            let all: i64 = sum.fetch_one(self.database().reader()).await?;
            let over = (all as u64).saturating_sub(room);
            if over == 0 {
                return Ok(());
            }
            let (deleted, bytes) = self.delete_found(select, Millis::MAX, over).await?;
            (swept.by_space, swept.bytes) = (swept.by_space + deleted, swept.bytes + bytes);
            if deleted == 0 {
                return Ok(());
            }
        }
    }

    /// Deletes the photos that a query finds, until `enough` bytes are free; returns their number and their bytes.
    async fn delete_found(&self, select: &'static str, until: Millis, enough: u64) -> Result<(u64, u64)> {
        let (mut deleted, mut freed) = (0, 0_u64);
        let found: Vec<(String, Millis, i64)> = sqlx::query_as(select).bind(until).bind(PART).fetch_all(self.database().reader()).await?;
        for (id, accepted_at, bytes) in found {
            if freed >= enough {
                break;
            }
            deleted += u64::from(self.delete(id.parse()?, Some(accepted_at)).await?);
            freed += bytes as u64;
        }
        Ok((deleted, freed))
    }

    /// Removes unused exports, abandoned rooms, and the log of deliveries beyond its limits; returns the number of exports.
    async fn sweep_ended(&self) -> Result<u64> {
        let mut tx = self.database().write().await?;
        room_leases::end_abandoned(&mut tx).await?;
        let (now, limits) = (tx.now, self.limits());
        let delete = "DELETE FROM jobs WHERE (state = 'done' AND used_at <= $1) OR (state = 'failed' AND used_at <= $2) RETURNING result";
        let (done, failed) = (now - millis(limits.exports_for), now - millis(FAILED_FOR.min(limits.exports_for)));
        let deleted = sqlx::query(delete).bind(done).bind(failed).fetch_all(tx.connection()).await?;
        let rooms = sqlx::query("DELETE FROM rooms WHERE live = 0 AND lease_until <= $1").bind(now - millis(ROOM_FOR));
        rooms.execute(tx.connection()).await?;
        deliveries::sweep(&mut tx).await?;
        tx.commit().await?;
        self.blobs().discard(file_names(&deleted)?).await;
        Ok(deleted.len() as u64)
    }

    /// The database's time, if its clock has not jumped for a day. A clock that is temporarily wrong, as before NTP corrects it, must not
    /// make photos look years old.
    async fn steady_now(&self) -> Result<Option<Millis>> {
        let mut tx = self.database().write().await?;
        let look =
            "INSERT INTO clock (id, seen_at, steady_since) VALUES (1, $1, 0) ON CONFLICT (id) DO UPDATE SET seen_at = excluded.seen_at,
            steady_since = CASE WHEN ABS(excluded.seen_at - clock.seen_at) > $2 THEN excluded.seen_at ELSE clock.steady_since END
            RETURNING steady_since";
        let now = tx.now;
        let since: Millis = sqlx::query_scalar(look).bind(now).bind(millis(STEADY)).fetch_one(tx.connection()).await?;
        tx.commit().await?;
        if since == now {
            tracing::warn!("the clock jumped, or no sweep ran for a day: photos are deleted by their age again after a day");
        }
        Ok((now - since >= millis(STEADY)).then_some(now))
    }
}
