//! Checking blobs, and deleting orphans.

use std::collections::HashSet;
use std::fmt;
use std::time::Duration;

use sqlx::AssertSqlSafe;

use crate::Library;
use crate::blobs::prefixes;
use crate::error::{LibraryError, Result};
use crate::exports::names_of;
use crate::ids::PhotoId;
use crate::millis;
use crate::photo::{Blobs, COLUMNS, Part, Photo, PhotoState, json};
use crate::photos::Filter;

/// Age at which a blob without references is deleted: by then its writer has committed the reference or died.
const ORPHAN: Duration = Duration::from_hours(24);
/// Photos per query.
const PART: usize = 100;

/// What `gc` found and deleted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Collected {
    /// Deleted orphans.
    pub blobs: u64,
    /// Their bytes.
    pub bytes: u64,
}

/// A damaged content.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// The photo.
    pub photo: PhotoId,
    /// The part.
    pub part: Part,
    /// What is wrong with it.
    pub detail: String,
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} is damaged: {}", self.part, self.detail)
    }
}

impl Library {
    /// Deletes blobs without references that are more than a day old by the store's clock.
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`], possibly after some deletions.
    pub async fn gc(&self) -> Result<Collected> {
        self.gc_older_than(ORPHAN).await
    }

    /// Runs [`Library::gc`] once a day, on one node; `None` if it is not due here.
    ///
    /// # Errors
    /// As [`Library::gc`].
    pub async fn gc_if_due(&self) -> Result<Option<Collected>> {
        if self.is_due("gc", ORPHAN).await? { self.gc().await.map(Some) } else { Ok(None) }
    }

    /// Whether this node should now run a task that runs once per `period` on one node.
    async fn is_due(&self, task: &'static str, period: Duration) -> Result<bool> {
        let mut tx = self.database().write().await?;
        let claim = "INSERT INTO upkeep (task, ran_at) VALUES ($1, $2)
            ON CONFLICT (task) DO UPDATE SET ran_at = excluded.ran_at WHERE upkeep.ran_at <= $3";
        let claim = sqlx::query(claim).bind(task).bind(tx.now).bind(tx.now - millis(period));
        let claimed = claim.execute(tx.on()).await?.rows_affected() > 0;
        tx.commit().await?;
        Ok(claimed)
    }

    /// Verifies the contents of a photo that no node has verified for `period`, and marks it as damaged if they are. Returns the photo;
    /// `None` if none is due.
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`]: it cannot be told now.
    pub async fn check_next(&self, period: Duration) -> Result<Option<Photo>> {
        let mut tx = self.database().write().await?;
        let lock = if tx.has_row_locks() { "FOR UPDATE SKIP LOCKED" } else { "" };
        let claim = format!(
            "UPDATE photos SET checked_at = $1 WHERE id =
                (SELECT id FROM photos WHERE state = 'done' AND checked_at <= $2 ORDER BY checked_at LIMIT 1 {lock})
             RETURNING {COLUMNS}"
        );
        let claim = sqlx::query(AssertSqlSafe(claim)).bind(tx.now).bind(tx.now - millis(period));
        let photo = claim.fetch_optional(tx.on()).await?.map(|row| Photo::from_row(&row)).transpose()?;
        tx.commit().await?;
        if let Some(photo) = &photo {
            let found = self.verify(photo).await?;
            self.take_out(photo, &found).await?;
        }
        Ok(photo)
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
        let photos = sqlx::query("SELECT blobs FROM photos WHERE id >= $1 AND id < $2").bind(prefix.to_owned()).bind(end.clone());
        for row in photos.fetch_all(self.database().reader()).await? {
            names.extend(json::<Blobs>(&row, "blobs")?.into_values().map(|blob| blob.name));
        }
        let jobs = sqlx::query("SELECT result FROM jobs WHERE photo >= $1 AND photo < $2 AND result IS NOT NULL")
            .bind(prefix.to_owned())
            .bind(end);
        names.extend(names_of(&jobs.fetch_all(self.database().reader()).await?)?);
        Ok(names)
    }

    /// Checks the contents of a photo against their sizes and digests.
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`]: it cannot be told now.
    pub async fn verify(&self, photo: &Photo) -> Result<Vec<Damage>> {
        let mut all = Vec::new();
        for (part, blob) in &photo.blobs {
            match self.blobs().read(*part, blob).await {
                Ok(_) => {}
                Err(LibraryError::Damaged { part, detail }) => all.push(Damage { photo: photo.id, part, detail }),
                Err(error) => return Err(error),
            }
        }
        Ok(all)
    }

    /// Checks the contents of all photos against their sizes and digests, and marks photos with damaged results.
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`].
    pub async fn fsck(&self) -> Result<Vec<Damage>> {
        let (mut all, mut after) = (Vec::new(), None);
        loop {
            let page = self.list(&Filter::default(), after, PART).await?;
            for photo in &page.photos {
                let found = self.verify(photo).await?;
                self.take_out(photo, &found).await?;
                // a photo that was deleted or made again meanwhile is not damaged
                if !found.is_empty() && self.find(photo.id).await?.is_some_and(|now| now.blobs == photo.blobs) {
                    all.extend(found);
                }
            }
            after = page.next;
            if after.is_none() {
                return Ok(all);
            }
        }
    }

    /// Marks a photo as damaged if one of its results is.
    pub(crate) async fn take_out(&self, photo: &Photo, found: &[Damage]) -> Result<()> {
        match found.iter().find(|damage| damage.part.is_result()) {
            Some(damage) if photo.state == PhotoState::Done => self.mark_damaged(photo, &damage.to_string()).await.map(drop),
            _ => Ok(()),
        }
    }
}
