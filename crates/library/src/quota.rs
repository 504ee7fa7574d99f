//! Quotas of owners.

use sqlx::Row as _;
use sqlx::any::AnyRow;

use crate::error::{LibraryError, Quota, Result};
use crate::ids::Owner;
use crate::{Library, database::Tx};

/// Number and bytes of an owner's photos.
const USED: &str = "SELECT COUNT(*) AS photos, CAST(COALESCE(SUM(bytes), 0) AS BIGINT) AS bytes FROM photos WHERE owner = $1";

impl Library {
    fn has_quota(&self, owner: &Owner) -> bool {
        let limits = self.limits();
        *owner != Owner::local_user() && (limits.quota_photos.is_some() || limits.quota_bytes.is_some())
    }

    /// Checks, before the bytes arrive, whether an owner may have one more photo of this size. [`Library::accept`] checks again.
    ///
    /// # Errors
    /// [`LibraryError::QuotaExceeded`].
    pub async fn check_quota(&self, owner: &Owner, bytes: u64) -> Result<()> {
        if !self.has_quota(owner) {
            return Ok(());
        }
        let row = sqlx::query(USED).bind(owner.as_str().to_owned()).fetch_one(self.database().reader()).await?;
        self.fits(&row, bytes)
    }

    /// The same in the accepting transaction, with the owner's row locked.
    pub(crate) async fn check_quota_in(&self, tx: &mut Tx, owner: &Owner, bytes: u64) -> Result<()> {
        if !self.has_quota(owner) {
            return Ok(());
        }
        let row = sqlx::query(USED).bind(owner.as_str().to_owned()).fetch_one(tx.connection()).await?;
        self.fits(&row, bytes)
    }

    fn fits(&self, row: &AnyRow, asked: u64) -> Result<()> {
        let number = |column: &str| row.try_get::<i64, _>(column).map(|n| n as u64);
        let (photos, bytes) = (number("photos")?, number("bytes")?);
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
}
