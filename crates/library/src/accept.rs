//! Accepting uploads.

use std::collections::BTreeMap;

use serde_json::Value;
use sqlx::{Any, AssertSqlSafe, Executor};

use crate::Library;
use crate::blobs::{Content, Contents};
use crate::change_notifications::Event;
use crate::error::{LibraryError, Quota, Result};
use crate::ids::PhotoId;
use crate::owner::Owner;
use crate::photo::{Blobs, COLUMNS, Class, Part, Photo, PhotoState, bytes_of, to_json};
use crate::photos::locked_photo;
use crate::queue::{JobKind, NewJob, Requester};
use crate::remake::Remake;

/// Number and bytes of an owner's photos.
const USED: &str = "SELECT COUNT(*), CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM photos WHERE owner = $1";

/// A complete upload.
#[derive(Debug)]
pub struct Upload {
    /// Its id; see [`Secret::photo_id`](crate::Secret::photo_id).
    pub id: PhotoId,
    /// The caller, who owns the photo.
    pub requester: Requester,
    /// How urgent it is to process it.
    pub class: Class,
    /// Options as text, all of them.
    pub options: BTreeMap<String, String>,
    /// The owner's settings for viewers, a JSON object. A known photo keeps its own.
    pub settings: Value,
    /// The photo.
    pub photo: Content,
    /// Its depth map.
    pub depth: Option<Content>,
}

impl Upload {
    fn bytes(&self) -> u64 {
        self.photo.bytes() + self.depth.as_ref().map_or(0, Content::bytes)
    }
}

/// What an upload led to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The photo is new.
    New,
    /// The photo is known; nothing has changed.
    Known,
    /// It had failed, and is queued again.
    Retried,
    /// Its results were damaged, and it is queued again.
    Healed,
}

/// An accepted upload, which survives a crash.
#[derive(Clone, Debug, PartialEq)]
pub struct Accepted {
    /// The photo.
    pub photo: Photo,
    /// What the upload led to.
    pub outcome: Outcome,
}

impl Library {
    /// Accepts an upload. If the same photo with the same options exists, it is queued again if it failed or its results are damaged. In
    /// any case it moves to the head of the list.
    ///
    /// # Errors
    /// [`LibraryError::QueueFull`], [`LibraryError::QuotaExceeded`], [`LibraryError::StorageFull`].
    pub async fn accept(&self, upload: Upload) -> Result<Accepted> {
        let Some(photo) = self.find(upload.id).await? else { return self.accept_new(upload).await };
        let outcome = match photo.state {
            PhotoState::Queued | PhotoState::Working => Outcome::Known,
            PhotoState::Failed => Outcome::Retried,
            PhotoState::Done if self.verify(&photo).await?.is_empty() => Outcome::Known,
            PhotoState::Done | PhotoState::Damaged => Outcome::Healed,
        };
        if outcome == Outcome::Known {
            return match self.move_to_front(photo.id).await {
                Ok(photo) => Ok(Accepted { photo, outcome }),
                // deleted meanwhile
                Err(LibraryError::NotFound(_)) => self.accept_new(upload).await,
                Err(error) => Err(error),
            };
        }
        let mut contents = Contents::from([(Part::Upload, upload.photo)]);
        contents.extend(upload.depth.map(|depth| (Part::Depth, depth)));
        let remake = Remake { class: upload.class, requester: &upload.requester, from: Some(photo.state) };
        match self.remake_with(&photo, contents, remake).await {
            Ok(photo) => Ok(Accepted { photo: self.move_to_front(photo.id).await?, outcome }),
            // a concurrent upload of the same photo was faster
            Err(LibraryError::Changed | LibraryError::NotReady) => {
                Ok(Accepted { photo: self.move_to_front(photo.id).await?, outcome: Outcome::Known })
            }
            Err(error) => Err(error),
        }
    }

    /// Moves a photo to the head of the list, as a second upload does.
    ///
    /// # Errors
    /// [`LibraryError::NotFound`].
    pub async fn move_to_front(&self, id: PhotoId) -> Result<Photo> {
        let mut tx = self.database().write().await?;
        locked_photo(&mut tx, id).await?;
        let update = format!("UPDATE photos SET listed_at = $1 WHERE id = $2 RETURNING {COLUMNS}");
        let update = sqlx::query_as(AssertSqlSafe(update)).bind(tx.now).bind(id.to_string());
        let photo = update.fetch_one(tx.connection()).await?;
        tx.notify(Event::Photo(id));
        tx.commit().await?;
        Ok(photo)
    }

    async fn accept_new(&self, mut upload: Upload) -> Result<Accepted> {
        if let Some(owner) = &upload.requester.owner {
            self.check_quota(owner, upload.bytes()).await?;
        }
        let photo = std::mem::replace(&mut upload.photo, Content::of_bytes(Vec::new()));
        let mut contents = Contents::from([(Part::Upload, photo)]);
        contents.extend(upload.depth.take().map(|depth| (Part::Depth, depth)));
        match self.blobs().store_for(upload.id, contents, |blobs| self.insert(&upload, blobs)).await {
            Ok(photo) => Ok(Accepted { photo, outcome: Outcome::New }),
            // a concurrent upload of the same photo was faster
            Err(LibraryError::Changed) => Ok(Accepted { photo: self.get(upload.id).await?, outcome: Outcome::Known }),
            Err(error) => Err(error),
        }
    }

    /// Checks, before the bytes arrive, whether an owner may have one more photo of this size. [`Library::accept`] checks again.
    pub async fn check_quota(&self, owner: &Owner, bytes: u64) -> Result<()> {
        self.check_quota_on(self.database().reader(), owner, bytes).await
    }

    /// The same on a connection: that of the accepting transaction, with the owner's row locked.
    async fn check_quota_on<'c>(&self, on: impl Executor<'c, Database = Any>, owner: &Owner, asked: u64) -> Result<()> {
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

    /// Inserts a photo and its job.
    ///
    /// # Errors
    /// [`LibraryError::Changed`] if the photo exists.
    async fn insert(&self, upload: &Upload, blobs: Blobs) -> Result<Photo> {
        let mut tx = self.database().write().await?;
        let bytes = bytes_of(&blobs);
        let owner = upload.requester.owner.as_ref();
        if let Some(owner) = owner {
            tx.lock_owner(owner.as_str()).await?;
            self.check_quota_on(tx.connection(), owner, bytes as u64).await?;
        }
        let insert = format!(
            "INSERT INTO photos (id, owner, accepted_at, listed_at, viewed_at, class, options, settings, settings_version, link_generation,
             state, version, blobs, bytes, checked_at) VALUES ($1, $2, $3, $3, $3, $4, $5, $6, 1, 1, $7, 1, $8, $9, $3) ON CONFLICT (id) DO NOTHING RETURNING {COLUMNS}"
        );
        let insert = sqlx::query_as(AssertSqlSafe(insert)).bind(upload.id.to_string()).bind(owner.map(Owner::as_str)).bind(tx.now);
        let insert = insert.bind(upload.class.rank()).bind(to_json(&upload.options)?).bind(to_json(&upload.settings)?);
        let insert = insert.bind(PhotoState::Queued.name()).bind(to_json(&blobs)?).bind(bytes);
        let photo = insert.fetch_optional(tx.connection()).await?.ok_or(LibraryError::Changed)?;
        let job =
            NewJob { kind: JobKind::Make, photo: upload.id, version: 1, key: None, class: upload.class, requester: &upload.requester };
        self.enqueue(&mut tx, &job, &Value::from(upload.requester.trace.clone())).await?;
        tx.notify(Event::Photo(upload.id));
        tx.commit().await?;
        Ok(photo)
    }
}
