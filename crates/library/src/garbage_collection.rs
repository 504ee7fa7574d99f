//! Deleting blobs without references.

use std::collections::HashSet;
use std::time::Duration;

use crate::blobs::prefixes;
use crate::error::Result;
use crate::photo::{Blobs, file_names, json};
use crate::{Library, millis};

/// Age at which a blob without references is deleted: by then its writer has committed the reference or died.
const ORPHAN: Duration = Duration::from_hours(24);

/// What `gc` found and deleted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Collected {
    /// Deleted orphans.
    pub blobs: u64,
    /// Their bytes.
    pub bytes: u64,
}

impl Library {
    /// Deletes blobs without references that are more than a day old by the store's clock.
    pub async fn gc(&self) -> Result<Collected> {
        self.gc_older_than(ORPHAN).await
    }

    /// Runs [`Library::gc`] once a day, on one node; `None` if it is not due here.
    pub async fn gc_if_due(&self) -> Result<Option<Collected>> {
        let mut tx = self.database().write().await?;
        let claim = "INSERT INTO upkeep (task, ran_at) VALUES ('gc', $1)
            ON CONFLICT (task) DO UPDATE SET ran_at = excluded.ran_at WHERE upkeep.ran_at <= $2";
        let claim = sqlx::query(claim).bind(tx.now).bind(tx.now - millis(ORPHAN));
        let is_due = claim.execute(tx.connection()).await?.rows_affected() > 0;
        tx.commit().await?;
        if is_due { self.gc().await.map(Some) } else { Ok(None) }
    }

    pub(crate) async fn gc_older_than(&self, age: Duration) -> Result<Collected> {
        let before = self.blobs().now().await?.saturating_sub(millis(age));
        let mut collected = Collected::default();
        for prefix in prefixes().chain(["incoming".to_owned(), "probe".to_owned()]) {
            // list the store before the rows, so that blobs written meanwhile are not in the list
            let mut old = self.blobs().list(&prefix).await?;
            old.retain(|blob| blob.written_at <= before);
            if old.is_empty() {
                continue;
            }
            let known = self.referred(&prefix).await?;
            for blob in old.into_iter().filter(|blob| !known.contains(&blob.name)) {
                self.blobs().delete(&blob.name).await?;
                collected.blobs += 1;
                collected.bytes += blob.bytes;
            }
        }
        Ok(collected)
    }

    /// Names of the blobs of photos whose ids begin with `prefix`.
    async fn referred(&self, prefix: &str) -> Result<HashSet<String>> {
        // sorts after all hex digits
        let end = format!("{prefix}g");
        let mut names = HashSet::new();
        let photos = sqlx::query("SELECT blobs FROM photos WHERE id >= $1 AND id < $2").bind(prefix).bind(&end);
        for row in photos.fetch_all(self.database().reader()).await? {
            names.extend(json::<Blobs>(&row, "blobs")?.into_values().map(|blob| blob.name));
        }
        let jobs = sqlx::query("SELECT result FROM jobs WHERE photo >= $1 AND photo < $2 AND result IS NOT NULL").bind(prefix).bind(&end);
        names.extend(file_names(&jobs.fetch_all(self.database().reader()).await?)?);
        Ok(names)
    }
}
