//! Reading, listing, changing and deleting photos.

use std::fmt;
use std::str::FromStr;
use std::sync::PoisonError;
use std::time::Instant;

use serde_json::Value;
use sqlx::{Any, AssertSqlSafe, Executor};

use crate::change_notifications::Event;
use crate::database::Tx;
use crate::deliveries::{EventData, announce};
use crate::error::{LibraryError, Result};
use crate::ids::PhotoId;
use crate::owner::Owner;
use crate::photo::{COLUMNS, Photo, Problem, blob_names, file_names, to_json};
use crate::webhooks::EventType;
use crate::{Library, Millis};

/// Views recorded per transaction.
const VIEWS: usize = 500;

/// A position in the list, stable while photos come and go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cursor {
    listed_at: Millis,
    id: PhotoId,
}

impl From<&Photo> for Cursor {
    fn from(photo: &Photo) -> Self {
        Self { listed_at: photo.listed_at, id: photo.id }
    }
}

impl fmt::Display for Cursor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{}", self.listed_at, self.id)
    }
}

impl FromStr for Cursor {
    type Err = LibraryError;

    fn from_str(text: &str) -> Result<Self> {
        let read = |text: &str| {
            let (listed_at, id) = text.split_once('-')?;
            Some(Self { listed_at: listed_at.parse().ok()?, id: id.parse().ok()? })
        };
        read(text).ok_or_else(|| LibraryError::Invalid(format!("{text:?} is not a position in the list")))
    }
}

/// A page of the list, most recently uploaded photos first.
#[derive(Clone, Debug, PartialEq)]
pub struct Page {
    /// Its photos.
    pub photos: Vec<Photo>,
    /// Start of the next page; `None` on the last one.
    pub next: Option<Cursor>,
}

impl Library {
    pub(crate) async fn read_photo<'c>(&self, on: impl Executor<'c, Database = Any>, id: PhotoId) -> Result<Option<Photo>> {
        let select = sqlx::query_as(AssertSqlSafe(format!("SELECT {COLUMNS} FROM photos WHERE id = $1"))).bind(id.to_string());
        Ok(select.fetch_optional(on).await?)
    }

    /// A photo, if it exists.
    pub async fn find(&self, id: PhotoId) -> Result<Option<Photo>> {
        self.read_photo(self.database().reader(), id).await
    }

    /// Like [`Self::find`], for many requests a second: with SQLite, a change by another process, or by a request that was cut off while
    /// it committed, may show half a second later.
    pub async fn find_recent(&self, id: PhotoId) -> Result<Option<Photo>> {
        let Some(recent) = self.database().events().recent() else { return self.find(id).await };
        if let Some(photo) = recent.get(id) {
            return Ok(Some(photo));
        }
        let (read, changes) = (Instant::now(), recent.changes());
        let photo = self.find(id).await?;
        if let Some(photo) = &photo {
            recent.keep(photo, read, changes);
        }
        Ok(photo)
    }

    /// A photo.
    pub async fn get(&self, id: PhotoId) -> Result<Photo> {
        self.find(id).await?.ok_or(LibraryError::NotFound("photo"))
    }

    /// At most `limit` photos after `after`, of one owner or of all, most recently uploaded first.
    pub async fn list(&self, owner: Option<&Owner>, after: Option<Cursor>, limit: usize) -> Result<Page> {
        let of_owner = if owner.is_some() { "AND owner = $4" } else { "" };
        let select =
            format!("SELECT {COLUMNS} FROM photos WHERE (listed_at, id) < ($1, $2) {of_owner} ORDER BY listed_at DESC, id DESC LIMIT $3");
        let (at, id) = after.map_or((Millis::MAX, String::new()), |after| (after.listed_at, after.id.to_string()));
        let mut select = sqlx::query_as(AssertSqlSafe(select)).bind(at).bind(id).bind(limit as i64 + 1);
        if let Some(owner) = owner {
            select = select.bind(owner.as_str());
        }
        let mut photos: Vec<Photo> = select.fetch_all(self.database().reader()).await?;
        let has_more = photos.len() > limit;
        photos.truncate(limit);
        let next = photos.last().filter(|_| has_more).map(Cursor::from);
        Ok(Page { photos, next })
    }

    /// Replaces a photo's settings for viewers, a JSON object, if the photo has not changed since the caller read it as `seen`.
    pub async fn set_settings(&self, seen: &Photo, settings: &Value) -> Result<Photo> {
        let mut tx = self.database().write().await?;
        let before = locked_photo(&mut tx, seen.id).await?;
        if before.settings_version != seen.settings_version || before.accepted_at != seen.accepted_at {
            if let Some(recent) = self.database().events().recent() {
                // a caller that tries again reads the row as it is
                recent.forget(seen.id);
            }
            return Err(LibraryError::Changed);
        }
        let update = "UPDATE photos SET settings = $1, settings_version = settings_version + 1 WHERE id = $2";
        sqlx::query(update).bind(to_json(settings)?).bind(seen.id.to_string()).execute(tx.connection()).await?;
        tx.notify(Event::Photo(seen.id));
        tx.commit().await?;
        Ok(Photo { settings: settings.clone(), settings_version: before.settings_version + 1, ..before })
    }

    /// Revokes all links to a photo.
    pub async fn revoke_links(&self, id: PhotoId) -> Result<()> {
        let mut tx = self.database().write().await?;
        let update = sqlx::query("UPDATE photos SET link_generation = link_generation + 1 WHERE id = $1").bind(id.to_string());
        if update.execute(tx.connection()).await?.rows_affected() == 0 {
            return Err(LibraryError::NotFound("photo"));
        }
        tx.notify(Event::Photo(id));
        tx.notify(Event::Revoked);
        tx.commit().await
    }

    /// Deletes a photo in any state, with everything that belongs to it; false if it does not exist. With `accepted_at`, deletes only the
    /// upload accepted at that time.
    pub async fn delete(&self, id: PhotoId, accepted_at: Option<Millis>) -> Result<bool> {
        let mut tx = self.database().write().await?;
        tx.lock_jobs(id).await?;
        let photo = match locked_photo(&mut tx, id).await {
            Ok(photo) if accepted_at.is_none_or(|at| at == photo.accepted_at) => photo,
            Ok(_) | Err(LibraryError::NotFound(_)) => return Ok(false),
            Err(error) => return Err(error),
        };
        let jobs = sqlx::query("DELETE FROM jobs WHERE photo = $1 RETURNING result").bind(id.to_string());
        let mut names = file_names(&jobs.fetch_all(tx.connection()).await?)?;
        sqlx::query("DELETE FROM photos WHERE id = $1").bind(id.to_string()).execute(tx.connection()).await?;
        announce(&mut tx, EventType::PhotoDeleted, photo.owner.as_ref(), &EventData::of_photo(&photo, None)).await?;
        tx.notify(Event::Deleted(id));
        tx.commit().await?;
        names.extend(blob_names(&photo.blobs));
        self.blobs().discard(names).await;
        Ok(true)
    }

    /// Records a view of a photo in memory; [`Library::save_views`] writes it to the database.
    pub fn note_view(&self, id: PhotoId) {
        self.0.viewed.lock().unwrap_or_else(PoisonError::into_inner).insert(id);
    }

    /// Writes the recorded views to the database. [`Library::sweep`] calls it, too.
    pub async fn save_views(&self) -> Result<()> {
        let viewed = || self.0.viewed.lock().unwrap_or_else(PoisonError::into_inner);
        let mut ids: Vec<PhotoId> = std::mem::take(&mut *viewed()).into_iter().collect();
        // all nodes lock rows in the same order
        ids.sort_unstable();
        for part in ids.chunks(VIEWS) {
            if let Err(error) = self.note_part(part).await {
                viewed().extend(&ids);
                return Err(error);
            }
        }
        Ok(())
    }

    async fn note_part(&self, ids: &[PhotoId]) -> Result<()> {
        let mut tx = self.database().write().await?;
        for id in ids {
            let update = sqlx::query("UPDATE photos SET viewed_at = $1 WHERE id = $2 AND viewed_at < $1").bind(tx.now).bind(id.to_string());
            update.execute(tx.connection()).await?;
        }
        tx.commit().await
    }

    /// Marks a finished photo as damaged, with `detail`; false if it was made again or deleted meanwhile. Uploading it again repairs it.
    pub async fn mark_damaged(&self, seen: &Photo, detail: &str) -> Result<bool> {
        let mut tx = self.database().write().await?;
        let problem = Problem::new("damaged", format!("{detail}: upload the photo again to repair it"));
        let update =
            "UPDATE photos SET state = 'damaged', problem = $1, finished_at = $2 WHERE id = $3 AND version = $4 AND state = 'done'";
        let update = sqlx::query(update).bind(to_json(&problem)?).bind(tx.now).bind(seen.id.to_string()).bind(seen.version);
        let marked = update.execute(tx.connection()).await?.rows_affected() > 0;
        if marked {
            tracing::error!(id = %seen.id, detail, "a photo is damaged");
            tx.notify(Event::Photo(seen.id));
        }
        tx.commit().await?;
        Ok(marked)
    }
}

/// A photo, with its row locked. Lock the rows of jobs first.
pub(crate) async fn locked_photo(tx: &mut Tx, id: PhotoId) -> Result<Photo> {
    let lock = if tx.has_row_locks() { "FOR UPDATE" } else { "" };
    let select = format!("SELECT {COLUMNS} FROM photos WHERE id = $1 {lock}");
    let photo = sqlx::query_as(AssertSqlSafe(select)).bind(id.to_string()).fetch_optional(tx.connection()).await?;
    photo.ok_or(LibraryError::NotFound("photo"))
}
