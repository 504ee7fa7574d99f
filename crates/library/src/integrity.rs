//! Checking blobs against their digests.

use std::fmt;
use std::time::Duration;

use sqlx::AssertSqlSafe;

use crate::error::{LibraryError, Result};
use crate::ids::PhotoId;
use crate::photo::{COLUMNS, Part, Photo, PhotoState};
use crate::{Library, millis};

/// Photos per query.
const PART: usize = 100;

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
    /// Verifies the contents of a photo that no node has verified for `period`, and marks it as damaged if they are. Returns the photo;
    /// `None` if none is due.
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`]: it cannot be told now.
    pub async fn verify_next(&self, period: Duration) -> Result<Option<Photo>> {
        let mut tx = self.database().write().await?;
        let lock = if tx.has_row_locks() { "FOR UPDATE SKIP LOCKED" } else { "" };
        let claim = format!(
            "UPDATE photos SET checked_at = $1 WHERE id =
                (SELECT id FROM photos WHERE state = 'done' AND checked_at <= $2 ORDER BY checked_at LIMIT 1 {lock})
             RETURNING {COLUMNS}"
        );
        let claim = sqlx::query_as(AssertSqlSafe(claim)).bind(tx.now).bind(tx.now - millis(period));
        let photo: Option<Photo> = claim.fetch_optional(tx.connection()).await?;
        tx.commit().await?;
        if let Some(photo) = &photo {
            let found = self.verify(photo).await?;
            self.mark_if_damaged(photo, &found).await?;
        }
        Ok(photo)
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
    pub async fn fsck(&self) -> Result<Vec<Damage>> {
        let (mut all, mut after) = (Vec::new(), None);
        loop {
            let page = self.list(None, after, PART).await?;
            for photo in &page.photos {
                let found = self.verify(photo).await?;
                self.mark_if_damaged(photo, &found).await?;
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
    pub(crate) async fn mark_if_damaged(&self, photo: &Photo, found: &[Damage]) -> Result<()> {
        match found.iter().find(|damage| damage.part.is_result()) {
            Some(damage) if photo.state == PhotoState::Done => self.mark_damaged(photo, &damage.to_string()).await.map(drop),
            _ => Ok(()),
        }
    }
}
