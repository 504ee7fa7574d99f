//! Quotas of owners.

use sqlx::any::AnyRow;
use sqlx::{Any, Row as _};

use crate::error::{LibraryError, Quota, Result};
use crate::ids::{Millis, Owner};
use crate::{Library, database::Tx, millis};

/// Use of an owner: photos, and reservations of resumable uploads except one.
const USED: &str = "SELECT
    (SELECT COUNT(*) FROM photos WHERE owner = $1) AS photos,
    (SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM photos WHERE owner = $1) AS bytes,
    (SELECT COUNT(*) FROM reservations WHERE owner = $1 AND expires_at > $2 AND id <> $3) AS coming,
    (SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM reservations WHERE owner = $1 AND expires_at > $2 AND id <> $3) AS reserved";

type Query<'q> = sqlx::query::Query<'q, Any, <Any as sqlx::Database>::Arguments>;

fn used(owner: &Owner, reservation: Option<&str>, now: Millis) -> Query<'static> {
    sqlx::query(USED).bind(owner.as_str().to_owned()).bind(now).bind(reservation.unwrap_or_default().to_owned())
}

impl Library {
    fn has_quota(&self, owner: &Owner) -> bool {
        let limits = self.limits();
        *owner != Owner::local_user() && (limits.quota_photos.is_some() || limits.quota_bytes.is_some())
    }

    /// Checks, before the bytes arrive, whether an owner may have one more photo of this size. [`Library::accept`] checks again.
    /// `reservation` is the upload's own reservation.
    ///
    /// # Errors
    /// [`LibraryError::QuotaExceeded`].
    pub async fn check_quota(&self, owner: &Owner, bytes: u64, reservation: Option<&str>) -> Result<()> {
        if !self.has_quota(owner) {
            return Ok(());
        }
        let now = self.now().await?;
        let row = used(owner, reservation, now).fetch_one(self.database().reader()).await?;
        self.fits(&row, bytes)
    }

    /// The same in the accepting transaction, with the owner's row locked.
    pub(crate) async fn check_quota_in(&self, tx: &mut Tx, owner: &Owner, bytes: u64, reservation: Option<&str>) -> Result<()> {
        if !self.has_quota(owner) {
            return Ok(());
        }
        let now = tx.now;
        let row = used(owner, reservation, now).fetch_one(tx.on()).await?;
        self.fits(&row, bytes)
    }

    fn fits(&self, row: &AnyRow, asked: u64) -> Result<()> {
        let number = |column: &str| row.try_get::<i64, _>(column).map(|n| n as u64);
        let (photos, bytes) = (number("photos")? + number("coming")?, number("bytes")? + number("reserved")?);
        let limits = self.limits();
        for (quota, used, asked, limit) in
            [(Quota::Photos, photos, 1, limits.quota_photos), (Quota::Bytes, bytes, asked, limits.quota_bytes)]
        {
            if let Some(limit) = limit.filter(|limit| used.saturating_add(asked) > *limit) {
                return Err(LibraryError::QuotaExceeded { quota, used, asked, limit });
            }
        }
        Ok(())
    }

    /// Reserves this many bytes for a resumable upload, for `lasts`. A second call with the same `id` replaces the reservation.
    ///
    /// # Errors
    /// [`LibraryError::QuotaExceeded`]; the previous reservation stays.
    pub async fn reserve(&self, id: &str, owner: &Owner, bytes: u64, lasts: std::time::Duration) -> Result<()> {
        let mut tx = self.database().write().await?;
        tx.lock_owner(owner.as_str()).await?;
        self.check_quota_in(&mut tx, owner, bytes, Some(id)).await?;
        let ends = tx.now + millis(lasts);
        let insert = "INSERT INTO reservations (id, owner, bytes, expires_at) VALUES ($1, $2, $3, $4)
            ON CONFLICT (id) DO UPDATE SET bytes = excluded.bytes, expires_at = excluded.expires_at";
        sqlx::query(insert).bind(id).bind(owner.as_str()).bind(bytes as i64).bind(ends).execute(tx.on()).await?;
        tx.commit().await
    }

    /// Releases a reservation, if it exists.
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`].
    pub async fn release_reservation(&self, id: &str) -> Result<()> {
        let mut tx = self.database().write().await?;
        release(&mut tx, id).await?;
        tx.commit().await
    }
}

pub(crate) async fn release(tx: &mut Tx, id: &str) -> Result<()> {
    sqlx::query("DELETE FROM reservations WHERE id = $1").bind(id.to_owned()).execute(tx.on()).await?;
    Ok(())
}
