//! Exports: files to download that jobs write, kept until they have not been fetched for a while.

use std::time::Duration;

use serde_json::Value;
use sqlx::AssertSqlSafe;

use crate::blobs::{Content, Contents};
use crate::change_notifications::Event;
use crate::database::Tx;
use crate::deliveries::{EventData, announce};
use crate::error::{LibraryError, Result};
use crate::ids::PhotoId;
use crate::leases::Lease;
use crate::photo::{Blobs, Class, Part, Photo, PhotoState, file_names, to_json};
use crate::photos::locked_photo;
use crate::queue::{COLUMNS, Job, JobKind, JobState, NewJob, Requester, id_of, record_duration};
use crate::webhooks::EventType;
use crate::{Library, millis};

/// Each export counts as at least this fraction of the limit of all, which bounds their number.
const MAX_EXPORTS: u64 = 1024;
/// Fetches of a file within this time count as one: a player requests many ranges.
const FETCHED: Duration = Duration::from_mins(1);

/// A request for an export.
#[derive(Clone, Debug)]
pub struct NewExport<'a> {
    /// The finished photo, as the caller read it.
    pub photo: &'a Photo,
    /// Name among the exports of this photo: equal parameters have equal names.
    pub key: &'a str,
    /// [`JobKind::Export`] or [`JobKind::Film`].
    pub kind: JobKind,
    /// The worker's task.
    pub payload: Value,
    /// How urgent it is.
    pub class: Class,
    /// The caller.
    pub requester: &'a Requester,
}

/// An accepted order.
#[derive(Clone, Debug, PartialEq)]
pub struct OrderedExport {
    /// Its job.
    pub job: Job,
    /// Whether the job is new; false if the file exists or is being written.
    pub new: bool,
}

impl Library {
    /// Queues an export, unless it exists or is queued. A failed one is queued again.
    ///
    /// # Errors
    /// [`LibraryError::NotReady`] if the photo is not done, [`LibraryError::Changed`] if it was made again meanwhile,
    /// [`LibraryError::QueueFull`].
    pub async fn order_export(&self, order: &NewExport<'_>) -> Result<OrderedExport> {
        match self.job(order.kind, order.photo.id, Some(order.key)).await {
            Ok(job) if job.state != JobState::Failed && job.version == order.photo.version => return Ok(OrderedExport { job, new: false }),
            Ok(_) | Err(LibraryError::NotFound(_)) => {}
            Err(error) => return Err(error),
        }
        let mut tx = self.database().write().await?;
        tx.lock_jobs(order.photo.id).await?;
        let photo = locked_photo(&mut tx, order.photo.id).await?;
        if photo.version != order.photo.version {
            return Err(LibraryError::Changed);
        }
        if photo.state != PhotoState::Done {
            return Err(LibraryError::NotReady);
        }
        let (kind, class, requester) = (order.kind, order.class, order.requester);
        let job = NewJob { kind, photo: photo.id, version: photo.version, key: Some(order.key), class, requester };
        match self.enqueue(&mut tx, &job, &order.payload).await {
            Ok(job) => {
                tx.notify(Event::Photo(photo.id));
                tx.commit().await?;
                Ok(OrderedExport { job, new: true })
            }
            // a concurrent order was faster
            Err(LibraryError::NotReady) => {
                // awaited, so that no worker passes over the job because this still locks it
                tx.rollback().await;
                Ok(OrderedExport { job: self.job(order.kind, photo.id, Some(order.key)).await?, new: false })
            }
            Err(error) => {
                tx.rollback().await;
                Err(error)
            }
        }
    }

    /// Stores a written export. Deletes the least recently fetched ones to make room.
    ///
    /// # Errors
    /// [`LibraryError::LeaseLost`], after which the file is discarded; [`LibraryError::Invalid`] if it exceeds the limit of all exports;
    /// [`LibraryError::StorageFull`].
    pub async fn finish_export(&self, lease: &Lease, file: Content) -> Result<Job> {
        let (bytes, most) = (file.bytes(), self.limits().exports_bytes);
        if bytes > most {
            return Err(LibraryError::Invalid(format!("the file has {bytes} bytes; the limit of all exports is {most}")));
        }
        let contents = Contents::from([(Part::Export, file)]);
        let (job, gone) = self.blobs().store_for(lease.job.photo, contents, |blobs| self.keep_export(lease, blobs)).await?;
        self.blobs().discard(gone).await;
        Ok(job)
    }

    async fn keep_export(&self, lease: &Lease, blobs: Blobs) -> Result<(Job, Vec<String>)> {
        let blob = blobs.get(&Part::Export).ok_or(LibraryError::NotFound("blob"))?;
        let mut tx = self.database().write().await?;
        let update = format!(
            "UPDATE jobs SET state = 'done', lease_token = NULL, lease_until = NULL, owner = NULL, address = NULL, problem = NULL, result = $1,
             bytes = $2, used_at = $3 WHERE id = $4 AND lease_token = $5 RETURNING {COLUMNS}"
        );
        let update = sqlx::query_as(AssertSqlSafe(update)).bind(to_json(blob)?).bind(blob.bytes as i64).bind(tx.now);
        let updated: Option<Job> = update.bind(&lease.job.id).bind(&lease.token).fetch_optional(tx.connection()).await?;
        let job = updated.ok_or(LibraryError::LeaseLost)?;
        let gone = self.trim(&mut tx, &job.id).await?;
        record_duration(&mut tx, job.kind, lease.age()).await?;
        let data = EventData::of_export(&job, &lease.photo, None);
        announce(&mut tx, EventType::ExportDone, lease.photo.owner.as_ref(), &data).await?;
        tx.notify(Event::Photo(job.photo));
        tx.commit().await?;
        Ok((job, gone))
    }

    /// Removes the least recently fetched exports until the rest, including `id`, fits.
    async fn trim(&self, tx: &mut Tx, id: &str) -> Result<Vec<String>> {
        let most = self.limits().exports_bytes;
        let select = "SELECT id, bytes FROM jobs WHERE state = 'done' ORDER BY CASE WHEN id = $1 THEN 0 ELSE 1 END, used_at DESC, id";
        let exports: Vec<(String, i64)> = sqlx::query_as(select).bind(id).fetch_all(tx.connection()).await?;
        let (mut all, mut gone) = (0_u64, Vec::new());
        for (id, bytes) in exports {
            all += (bytes as u64).max(most / MAX_EXPORTS);
            if all > most {
                let delete = sqlx::query("DELETE FROM jobs WHERE id = $1 AND state = 'done' RETURNING result");
                let deleted = delete.bind(id).fetch_all(tx.connection()).await?;
                gone.extend(file_names(&deleted)?);
            }
        }
        Ok(gone)
    }

    /// Records that an export was fetched, which extends its life. A second fetch within a minute writes nothing.
    pub async fn note_export_fetch(&self, job: &Job) -> Result<()> {
        let mut tx = self.database().write().await?;
        let update = sqlx::query("UPDATE jobs SET used_at = $1 WHERE id = $2 AND used_at <= $3").bind(tx.now).bind(&job.id);
        update.bind(tx.now - millis(FETCHED)).execute(tx.connection()).await?;
        tx.commit().await
    }

    /// Cancels or removes an export; false if it does not exist.
    pub async fn cancel_export(&self, photo: PhotoId, key: &str) -> Result<bool> {
        let mut tx = self.database().write().await?;
        let delete = sqlx::query("DELETE FROM jobs WHERE id = $1 RETURNING result").bind(id_of(JobKind::Export, photo, Some(key)));
        let deleted = delete.fetch_all(tx.connection()).await?;
        tx.notify(Event::Photo(photo));
        tx.commit().await?;
        self.blobs().discard(file_names(&deleted)?).await;
        Ok(!deleted.is_empty())
    }
}

/// Removes the exports of a photo; returns the names of their blobs.
pub(crate) async fn remove_of(tx: &mut Tx, photo: PhotoId) -> Result<Vec<String>> {
    let delete = sqlx::query("DELETE FROM jobs WHERE photo = $1 AND kind IN ('export', 'film') RETURNING result");
    file_names(&delete.bind(photo.to_string()).fetch_all(tx.connection()).await?)
}
