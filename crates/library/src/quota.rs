//! Quotas of owners.

use sqlx::{Any, Executor};

use crate::Library;
use crate::error::{LibraryError, Quota, Result};
use crate::owner::Owner;

/// Number and bytes of an owner's photos.
const USED: &str = "SELECT COUNT(*), CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM photos WHERE owner = $1";

impl Library {
    /// Checks, before the bytes arrive, whether an owner may have one more photo of this size. [`Library::accept`] checks again.
    pub async fn check_quota(&self, owner: &Owner, bytes: u64) -> Result<()> {
        self.check_quota_on(self.database().reader(), owner, bytes).await
    }

    /// The same on a connection: that of the accepting transaction, with the owner's row locked.
    pub(crate) async fn check_quota_on<'c>(&self, on: impl Executor<'c, Database = Any>, owner: &Owner, asked: u64) -> Result<()> {
        let limits = self.limits();
        if *owner == Owner::local_user() || (limits.quota_photos.is_none() && limits.quota_bytes.is_none()) {
            return Ok(());
        }
        let (photos, bytes): (i64, i64) = sqlx::query_as(USED).bind(owner.as_str()).fetch_one(on).await?;
        for (quota, used, asked, limit) in
            [(Quota::Photos, photos as u64, 1, limits.quota_photos), (Quota::Bytes, bytes as u64, asked, limits.quota_bytes)]
        {
            if let Some(limit) = limit.filter(|limit| used.saturating_add(asked) > *limit) {
                return Err(LibraryError::QuotaExceeded { quota, used, asked, limit });
            }
        }
        Ok(())
    }
}
