//! Making photos again.

use serde_json::Value;
use sqlx::AssertSqlSafe;

use crate::Library;
use crate::blobs::{Content, Contents};
use crate::change_notifications::Event;
use crate::error::{LibraryError, Result};
use crate::photo::{Blobs, COLUMNS, Class, Part, Photo, PhotoState, bytes_of, to_json};
use crate::photos::locked_photo;
use crate::queue::{JobKind, NewJob, Requester};

#[derive(Clone, Copy)]
pub(crate) struct Remake<'a> {
    pub(crate) class: Class,
    pub(crate) requester: &'a Requester,
    /// The required current state.
    pub(crate) from: Option<PhotoState>,
}

impl Library {
    /// Queues a photo to be made again with the current program and network. Its results stay until the new ones replace them. `seen` is
    /// the photo as the caller read it.
    ///
    /// # Errors
    /// [`LibraryError::NotReady`] while it is being made, [`LibraryError::Changed`], [`LibraryError::NotFound`],
    /// [`LibraryError::QueueFull`].
    pub async fn remake(&self, seen: &Photo, class: Class, requester: &Requester) -> Result<Photo> {
        self.remake_with(seen, Contents::new(), Remake { class, requester, from: None }).await
    }

    /// Replaces a photo's touch-up, JSON for the pipeline, and queues it to be made again.
    pub async fn touch_up(&self, seen: &Photo, strokes: Content, requester: &Requester) -> Result<Photo> {
        let remake = Remake { class: Class::Interactive, requester, from: None };
        self.remake_with(seen, Contents::from([(Part::Strokes, strokes)]), remake).await
    }

    pub(crate) async fn remake_with(&self, seen: &Photo, contents: Contents, remake: Remake<'_>) -> Result<Photo> {
        if !seen.state.is_final() {
            return Err(LibraryError::NotReady);
        }
        let (photo, replaced) = self.blobs().store_for(seen.id, contents, |blobs| self.requeue(seen, blobs, remake)).await?;
        self.blobs().discard(replaced).await;
        Ok(photo)
    }

    /// Queues a photo with other blobs; returns the names of the replaced blobs.
    async fn requeue(&self, seen: &Photo, blobs: Blobs, remake: Remake<'_>) -> Result<(Photo, Vec<String>)> {
        let mut tx = self.database().write().await?;
        tx.lock_jobs(seen.id).await?;
        let photo = locked_photo(&mut tx, seen.id).await?;
        if !photo.state.is_final() {
            return Err(LibraryError::NotReady);
        }
        if photo.version != seen.version || remake.from.is_some_and(|state| state != photo.state) {
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
        let update = sqlx::query_as(AssertSqlSafe(update)).bind(PhotoState::Queued.name()).bind(remake.class.rank());
        let update = update.bind(to_json(&all)?).bind(bytes_of(&all)).bind(seen.id.to_string());
        let photo: Photo = update.fetch_one(tx.connection()).await?;
        let requester = Requester { owner: photo.owner.clone().or_else(|| remake.requester.owner.clone()), ..remake.requester.clone() };
        let job =
            NewJob { kind: JobKind::Make, photo: seen.id, version: photo.version, key: None, class: remake.class, requester: &requester };
        self.enqueue(&mut tx, &job, &Value::from(requester.trace.clone())).await?;
        tx.notify(Event::Photo(seen.id));
        tx.commit().await?;
        Ok((photo, replaced))
    }
}
