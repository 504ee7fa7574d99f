//! Reading, listing, changing and deleting photos.

use std::fmt;
use std::str::FromStr;
use std::sync::PoisonError;

use serde_json::Value;
use sqlx::{Any, AssertSqlSafe, Executor};

use crate::Library;
use crate::database::Tx;
use crate::deliveries::{EventData, announce};
use crate::error::{LibraryError, Result};
use crate::events::Event;
use crate::ids::{Millis, Owner, PhotoId};
use crate::photo::{COLUMNS, Photo, PhotoState, Problem, blob_names, file_names, title_of, to_json};
use crate::webhooks::EventType;

/// Views recorded per transaction.
const VIEWS: usize = 500;

/// Filter of the list.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Filter {
    /// Photos of one owner; `None` for all.
    pub owner: Option<Owner>,
    /// Photos in one state.
    pub state: Option<PhotoState>,
    /// Photos whose titles contain this text, ignoring ASCII case.
    pub title: Option<String>,
}

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
        let select = sqlx::query(AssertSqlSafe(format!("SELECT {COLUMNS} FROM photos WHERE id = $1"))).bind(id.to_string());
        select.fetch_optional(on).await?.map(|row| Photo::from_row(&row)).transpose()
    }

    /// A photo, if it exists.
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`].
    pub async fn find(&self, id: PhotoId) -> Result<Option<Photo>> {
        self.read_photo(self.database().reader(), id).await
    }

    /// A photo.
    ///
    /// # Errors
    /// [`LibraryError::NotFound`], [`LibraryError::Unavailable`].
    pub async fn get(&self, id: PhotoId) -> Result<Photo> {
        self.find(id).await?.ok_or(LibraryError::NotFound("photo"))
    }

    /// At most `limit` photos after `after`, most recently uploaded first.
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`].
    pub async fn list(&self, filter: &Filter, after: Option<Cursor>, limit: usize) -> Result<Page> {
        let mut conditions = vec!["(listed_at, id) < ($1, $2)".to_owned()];
        let mut texts = Vec::new();
        let mut add = |condition: &str, text: String| {
            texts.push(text);
            conditions.push(condition.replace('?', &format!("${}", texts.len() + 3)));
        };
        if let Some(owner) = &filter.owner {
            add("owner = ?", owner.as_str().to_owned());
        }
        if let Some(state) = filter.state {
            add("state = ?", state.name().to_owned());
        }
        if let Some(title) = &filter.title {
            let escaped = title.to_ascii_lowercase().replace('!', "!!").replace('%', "!%").replace('_', "!_");
            add("LOWER(title) LIKE ? ESCAPE '!'", format!("%{escaped}%"));
        }
        let conditions = conditions.join(" AND ");
        let select = format!("SELECT {COLUMNS} FROM photos WHERE {conditions} ORDER BY listed_at DESC, id DESC LIMIT $3");
        let (at, id) = after.map_or((Millis::MAX, String::new()), |after| (after.listed_at, after.id.to_string()));
        let mut select = sqlx::query(AssertSqlSafe(select)).bind(at).bind(id).bind(limit as i64 + 1);
        for text in texts {
            select = select.bind(text);
        }
        let rows = select.fetch_all(self.database().reader()).await?;
        let photos: Vec<Photo> = rows.iter().take(limit).map(Photo::from_row).collect::<Result<_>>()?;
        let next = photos.last().filter(|_| rows.len() > limit).map(Cursor::from);
        Ok(Page { photos, next })
    }

    /// Replaces a photo's settings for viewers, a JSON object, if the photo has not changed since the caller read it as `seen`.
    ///
    /// # Errors
    /// [`LibraryError::Changed`], [`LibraryError::NotFound`], [`LibraryError::Unavailable`].
    pub async fn set_settings(&self, seen: &Photo, settings: &Value) -> Result<Photo> {
        let mut tx = self.database().write().await?;
        let before = locked_photo(&mut tx, seen.id).await?;
        if before.settings_version != seen.settings_version || before.accepted_at != seen.accepted_at {
            return Err(LibraryError::Changed);
        }
        let update = "UPDATE photos SET settings = $1, title = $2, settings_version = settings_version + 1 WHERE id = $3";
        let update = sqlx::query(update).bind(to_json(settings)?).bind(title_of(settings).map(str::to_owned)).bind(seen.id.to_string());
        update.execute(tx.connection()).await?;
        tx.notify(Event::Photo(seen.id));
        tx.commit().await?;
        Ok(Photo { settings: settings.clone(), settings_version: before.settings_version + 1, ..before })
    }

    /// Revokes all links to a photo.
    ///
    /// # Errors
    /// [`LibraryError::NotFound`], [`LibraryError::Unavailable`].
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
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`].
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
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`].
    pub async fn save_views(&self) -> Result<()> {
        let viewed = std::mem::take(&mut *self.0.viewed.lock().unwrap_or_else(PoisonError::into_inner));
        if viewed.is_empty() {
            return Ok(());
        }
        let mut ids: Vec<PhotoId> = viewed.into_iter().collect();
        // all nodes lock rows in the same order
        ids.sort_unstable();
        let mut done = 0;
        for part in ids.chunks(VIEWS) {
            if let Err(error) = self.note_part(part).await {
                self.0.viewed.lock().unwrap_or_else(PoisonError::into_inner).extend(&ids[done..]);
                return Err(error);
            }
            done += part.len();
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
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`].
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

/// A photo, with its row locked.
pub(crate) async fn locked_photo(tx: &mut Tx, id: PhotoId) -> Result<Photo> {
    let id = id.to_string();
    tx.lock_photo(&id).await?;
    let row =
        sqlx::query(AssertSqlSafe(format!("SELECT {COLUMNS} FROM photos WHERE id = $1"))).bind(id).fetch_optional(tx.connection()).await?;
    Photo::from_row(&row.ok_or(LibraryError::NotFound("photo"))?)
}
