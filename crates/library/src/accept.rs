//! Accepting uploads, and making photos again.

use std::collections::BTreeMap;

use serde_json::Value;
use sqlx::AssertSqlSafe;

use crate::blobs::{Content, Contents};
use crate::database::Tx;
use crate::error::{LibraryError, Result};
use crate::events::Event;
use crate::ids::PhotoId;
use crate::photo::{Blobs, COLUMNS, Class, Part, Photo, PhotoState, bytes_of, title_of, to_json};
use crate::queue::{Asker, Kind, NewJob};
use crate::{Library, quota};

/// A complete upload.
#[derive(Debug)]
pub struct Upload {
    /// Its id; see [`Secret::photo_id`](crate::Secret::photo_id).
    pub id: PhotoId,
    /// The caller, who owns the photo.
    pub asker: Asker,
    /// How urgent its making is.
    pub class: Class,
    /// Options as text, all of them.
    pub options: BTreeMap<String, String>,
    /// The owner's settings for viewers, a JSON object. A known photo keeps its own.
    pub settings: Value,
    /// The photo.
    pub photo: Content,
    /// Its depth map.
    pub depth: Option<Content>,
    /// Its reservation, by [`Library::reserve`].
    pub reservation: Option<String>,
}

impl Upload {
    fn bytes(&self) -> u64 {
        self.photo.len() + self.depth.as_ref().map_or(0, Content::len)
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

/// Whether an error guarantees that nothing was committed. After other errors the blobs stay for `gc`.
pub(crate) const fn is_refusal(error: &LibraryError) -> bool {
    !matches!(error, LibraryError::Unavailable { .. } | LibraryError::Internal(_))
}

/// Names of blobs, for deleting them.
pub(crate) fn names_of(blobs: &Blobs) -> Vec<String> {
    blobs.values().map(|blob| blob.name.clone()).collect()
}

impl Library {
    /// Accepts an upload. If the same photo with the same options exists, it is queued again if it failed or its results are damaged. In
    /// any case it moves to the head of the list.
    ///
    /// # Errors
    /// [`LibraryError::QueueFull`], [`LibraryError::QuotaExceeded`], [`LibraryError::StorageFull`], [`LibraryError::Unavailable`].
    pub async fn accept(&self, upload: Upload) -> Result<Accepted> {
        let Some(photo) = self.find(upload.id).await? else { return self.accept_new(upload).await };
        let outcome = match photo.state {
            PhotoState::Queued | PhotoState::Working => Outcome::Known,
            PhotoState::Failed => Outcome::Retried,
            PhotoState::Done if self.verify(&photo).await?.is_empty() => Outcome::Known,
            PhotoState::Done | PhotoState::Damaged => Outcome::Healed,
        };
        if outcome == Outcome::Known {
            return match self.list_first(photo.id).await {
                Ok(photo) => Ok(Accepted { photo, outcome }),
                // deleted meanwhile
                Err(LibraryError::NotFound(_)) => self.accept_new(upload).await,
                Err(error) => Err(error),
            };
        }
        let mut contents = Contents::from([(Part::Upload, upload.photo)]);
        contents.extend(upload.depth.map(|depth| (Part::Depth, depth)));
        let again = Again { class: upload.class, asker: &upload.asker, from: Some(photo.state) };
        match self.make_again_with(&photo, contents, again).await {
            Ok(photo) => Ok(Accepted { photo: self.list_first(photo.id).await?, outcome }),
            // a concurrent upload of the same photo was faster
            Err(LibraryError::Changed | LibraryError::NotReady) => {
                Ok(Accepted { photo: self.list_first(photo.id).await?, outcome: Outcome::Known })
            }
            Err(error) => Err(error),
        }
    }

    /// Moves a photo to the head of the list, as a second upload does.
    ///
    /// # Errors
    /// [`LibraryError::NotFound`], [`LibraryError::Unavailable`].
    pub async fn list_first(&self, id: PhotoId) -> Result<Photo> {
        let mut tx = self.database().write().await?;
        photo_in(&mut tx, id).await?;
        let update = format!("UPDATE photos SET listed_at = $1 WHERE id = $2 RETURNING {COLUMNS}");
        let update = sqlx::query(AssertSqlSafe(update)).bind(tx.now).bind(id.to_string());
        let photo = Photo::from_row(&update.fetch_one(tx.on()).await?)?;
        tx.tell(Event::Photo(id));
        tx.commit().await?;
        Ok(photo)
    }

    async fn accept_new(&self, mut upload: Upload) -> Result<Accepted> {
        if let Some(owner) = &upload.asker.owner {
            self.check_quota(owner, upload.bytes(), upload.reservation.as_deref()).await?;
        }
        let photo = std::mem::replace(&mut upload.photo, Content::of_bytes(Vec::new()));
        let mut contents = Contents::from([(Part::Upload, photo)]);
        contents.extend(upload.depth.take().map(|depth| (Part::Depth, depth)));
        let blobs = self.blobs().store(upload.id, contents).await?;
        let written = names_of(&blobs);
        match self.insert(&upload, &blobs).await {
            Ok(Some(photo)) => Ok(Accepted { photo, outcome: Outcome::New }),
            Ok(None) => {
                self.blobs().discard(written).await;
                Ok(Accepted { photo: self.get(upload.id).await?, outcome: Outcome::Known })
            }
            Err(error) => {
                if is_refusal(&error) {
                    self.blobs().discard(written).await;
                }
                Err(error)
            }
        }
    }

    /// Inserts a photo and its job; `None` if the photo exists.
    async fn insert(&self, upload: &Upload, blobs: &Blobs) -> Result<Option<Photo>> {
        let mut tx = self.database().write().await?;
        let bytes = bytes_of(blobs);
        let owner = upload.asker.owner.as_ref();
        if let Some(owner) = owner {
            tx.lock_owner(owner.as_str()).await?;
            self.check_quota_in(&mut tx, owner, bytes as u64, upload.reservation.as_deref()).await?;
        }
        let insert = format!(
            "INSERT INTO photos (id, owner, accepted_at, listed_at, viewed_at, class, title, options, settings, settings_version, link_generation,
             state, version, blobs, bytes, checked_at) VALUES ($1, $2, $3, $3, $3, $4, $5, $6, $7, 1, 1, $8, 1, $9, $10, $3) ON CONFLICT (id) DO NOTHING RETURNING {COLUMNS}"
        );
        let now = tx.now;
        let insert = sqlx::query(AssertSqlSafe(insert)).bind(upload.id.to_string()).bind(owner.map(|o| o.as_str().to_owned())).bind(now);
        let insert = insert.bind(upload.class.rank()).bind(title_of(&upload.settings).map(str::to_owned)).bind(to_json(&upload.options)?);
        let insert = insert.bind(to_json(&upload.settings)?).bind(PhotoState::Queued.name()).bind(to_json(blobs)?).bind(bytes);
        let Some(row) = insert.fetch_optional(tx.on()).await? else { return Ok(None) };
        if let Some(reservation) = &upload.reservation {
            quota::release(&mut tx, reservation).await?;
        }
        let job = NewJob { kind: Kind::Make, photo: upload.id, version: 1, key: None, class: upload.class, asker: &upload.asker };
        self.enqueue(&mut tx, &job, &Value::from(upload.asker.trace.clone())).await?;
        tx.tell(Event::Photo(upload.id));
        tx.commit().await?;
        Photo::from_row(&row).map(Some)
    }

    /// Queues a photo to be made again with the current program and network. Its results stay until the new ones replace them. `seen` is
    /// the photo as the caller read it.
    ///
    /// # Errors
    /// [`LibraryError::NotReady`] while it is being made, [`LibraryError::Changed`], [`LibraryError::NotFound`],
    /// [`LibraryError::QueueFull`].
    pub async fn make_again(&self, seen: &Photo, class: Class, asker: &Asker) -> Result<Photo> {
        self.make_again_with(seen, Contents::new(), Again { class, asker, from: None }).await
    }

    /// Replaces a photo's touch-up, JSON for the pipeline, and queues it to be made again.
    ///
    /// # Errors
    /// As [`Library::make_again`].
    pub async fn touch_up(&self, seen: &Photo, strokes: Content, asker: &Asker) -> Result<Photo> {
        let again = Again { class: Class::Interactive, asker, from: None };
        self.make_again_with(seen, Contents::from([(Part::Strokes, strokes)]), again).await
    }

    async fn make_again_with(&self, seen: &Photo, contents: Contents, again: Again<'_>) -> Result<Photo> {
        if !seen.state.is_final() {
            return Err(LibraryError::NotReady);
        }
        let blobs = if contents.is_empty() { Blobs::new() } else { self.blobs().store(seen.id, contents).await? };
        let written = names_of(&blobs);
        match self.restart(seen, blobs, again).await {
            Ok((photo, replaced)) => {
                self.blobs().discard(replaced).await;
                Ok(photo)
            }
            Err(error) => {
                if is_refusal(&error) {
                    self.blobs().discard(written).await;
                }
                Err(error)
            }
        }
    }

    /// Queues a photo with other blobs; returns the names of the replaced blobs.
    async fn restart(&self, seen: &Photo, blobs: Blobs, again: Again<'_>) -> Result<(Photo, Vec<String>)> {
        let mut tx = self.database().write().await?;
        tx.lock_jobs(seen.id).await?;
        let photo = photo_in(&mut tx, seen.id).await?;
        if !photo.state.is_final() {
            return Err(LibraryError::NotReady);
        }
        if photo.version != seen.version || again.from.is_some_and(|state| state != photo.state) {
            return Err(LibraryError::Changed);
        }
        let (mut all, mut replaced) = (photo.blobs, Vec::new());
        for (part, blob) in blobs {
            replaced.extend(all.insert(part, blob).map(|old| old.name));
        }
        let update = format!(
            "UPDATE photos SET state = $1, version = version + 1, class = $2, blobs = $3, bytes = $4, problem = NULL, finished_at = NULL
             WHERE id = $5 RETURNING {COLUMNS}"
        );
        let update = sqlx::query(AssertSqlSafe(update)).bind(PhotoState::Queued.name()).bind(again.class.rank());
        let update = update.bind(to_json(&all)?).bind(bytes_of(&all)).bind(seen.id.to_string());
        let photo = Photo::from_row(&update.fetch_one(tx.on()).await?)?;
        let asker = Asker { owner: photo.owner.clone().or_else(|| again.asker.owner.clone()), ..again.asker.clone() };
        let job = NewJob { kind: Kind::Make, photo: seen.id, version: photo.version, key: None, class: again.class, asker: &asker };
        self.enqueue(&mut tx, &job, &Value::from(asker.trace.clone())).await?;
        tx.tell(Event::Photo(seen.id));
        tx.commit().await?;
        Ok((photo, replaced))
    }
}

/// Options of [`Library::restart`].
#[derive(Clone, Copy)]
struct Again<'a> {
    class: Class,
    asker: &'a Asker,
    /// The required current state.
    from: Option<PhotoState>,
}

/// A photo, with its row locked.
pub(crate) async fn photo_in(tx: &mut Tx, id: PhotoId) -> Result<Photo> {
    let id = id.to_string();
    tx.lock_photo(&id).await?;
    let row = sqlx::query(AssertSqlSafe(format!("SELECT {COLUMNS} FROM photos WHERE id = $1"))).bind(id).fetch_optional(tx.on()).await?;
    Photo::from_row(&row.ok_or(LibraryError::NotFound("photo"))?)
}
