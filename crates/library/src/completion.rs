//! How jobs end: with results, with a failure, or back in the queue.

use std::time::Duration;

use serde_json::Value;
use sqlx::AssertSqlSafe;

use crate::blobs::Contents;
use crate::change_notifications::Event;
use crate::database::{Tx, is_held};
use crate::deliveries::{EventData, announce};
use crate::error::{LibraryError, Result};
use crate::leases::Lease;
use crate::photo::{self, Blobs, Photo, PhotoState, Problem, blob_names, bytes_of, to_json};
use crate::photos::locked_photo;
use crate::queue::{Job, JobKind, record_duration};
use crate::webhooks::EventType;
use crate::{Library, Millis, exports, millis};

/// Pause after the server's first fault, doubled after each further one, and the longest pause.
const BACK_OFF: Duration = Duration::from_millis(500);
pub(crate) const MAX_BACK_OFF: Duration = Duration::from_mins(1);

/// A worker's results for a photo.
#[derive(Debug)]
pub struct PhotoResults {
    /// Container, disparity, thumbnail and report.
    pub contents: Contents,
    /// Details, a JSON object: width, height.
    pub details: Value,
}

/// Why a worker gives a job back.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Retry {
    /// The worker's process died. The job fails if that happens too often.
    Died(String),
    /// The server is at fault: disk, store or memory. The job waits, longer each time.
    Fault(String),
    /// The worker is shutting down.
    Stopping,
}

impl Library {
    /// Stores a photo's results and marks it done.
    ///
    /// # Errors
    /// [`LibraryError::LeaseLost`], after which the results are discarded; [`LibraryError::StorageFull`] and [`LibraryError::Unavailable`],
    /// after which the lease still holds.
    pub async fn finish(&self, lease: &Lease, made: PhotoResults) -> Result<Photo> {
        let PhotoResults { contents, details } = made;
        let keep = |blobs| self.keep(lease, &details, blobs);
        let (photo, replaced) = self.blobs().store_for(lease.job.photo, contents, keep).await?;
        self.blobs().discard_later(replaced).await;
        Ok(photo)
    }

    async fn keep(&self, lease: &Lease, details: &Value, blobs: Blobs) -> Result<(Photo, Vec<String>)> {
        let mut tx = self.database().write().await?;
        tx.lock_jobs(lease.job.photo).await?;
        end(&mut tx, &lease.job, &lease.token).await?;
        let before = locked_photo(&mut tx, lease.job.photo).await?;
        let (old, mut all): (Blobs, Blobs) = before.blobs.into_iter().partition(|(part, _)| part.is_result());
        all.extend(blobs);
        let update = format!(
            "UPDATE photos SET state = $1, blobs = $2, bytes = $3, details = $4, problem = NULL, finished_at = $5, checked_at = $5 WHERE id = $6 RETURNING {}",
            photo::COLUMNS
        );
        let update = sqlx::query_as(AssertSqlSafe(update)).bind(PhotoState::Done.name()).bind(to_json(&all)?).bind(bytes_of(&all));
        let update = update.bind(to_json(details)?).bind(tx.now).bind(lease.job.photo.to_string());
        let photo: Photo = update.fetch_one(tx.connection()).await?;
        // exports of the previous version
        let mut replaced = exports::remove_of(&mut tx, lease.job.photo).await?;
        replaced.extend(blob_names(&old));
        record_duration(&mut tx, JobKind::Make, lease.age()).await?;
        announce(&mut tx, EventType::PhotoDone, photo.owner.as_ref(), &EventData::of_photo(&photo, None)).await?;
        tx.notify(Event::Photo(lease.job.photo));
        tx.commit().await?;
        Ok((photo, replaced))
    }

    /// Fails a job for good because of its photo or its parameters.
    pub async fn fail(&self, lease: &Lease, problem: &Problem) -> Result<()> {
        let mut tx = self.database().write().await?;
        self.fail_in(&mut tx, &lease.job, &lease.token, problem).await?;
        tx.commit().await
    }

    async fn fail_in(&self, tx: &mut Tx, job: &Job, token: &str, problem: &Problem) -> Result<()> {
        let photo = self.read_photo(tx.connection(), job.photo).await?.ok_or(LibraryError::LeaseLost)?;
        let (event, data) = if job.kind == JobKind::Make {
            end(tx, job, token).await?;
            let update = sqlx::query("UPDATE photos SET state = 'failed', problem = $1, finished_at = $2 WHERE id = $3");
            update.bind(to_json(problem)?).bind(tx.now).bind(job.photo.to_string()).execute(tx.connection()).await?;
            (EventType::PhotoFailed, EventData::of_photo(&photo, Some(problem)))
        } else {
            let update =
                "UPDATE jobs SET state = 'failed', lease_token = NULL, lease_until = NULL, owner = NULL, address = NULL, problem = $1,
                used_at = $2 WHERE id = $3 AND lease_token = $4";
            let update = sqlx::query(update).bind(to_json(problem)?).bind(tx.now).bind(&job.id).bind(token);
            is_held(&update.execute(tx.connection()).await?)?;
            (EventType::ExportFailed, EventData::of_export(job, &photo, Some(problem)))
        };
        announce(tx, event, photo.owner.as_ref(), &data).await?;
        tx.notify(Event::Photo(job.photo));
        Ok(())
    }

    /// Requeues a job.
    pub async fn retry(&self, lease: &Lease, why: &Retry) -> Result<()> {
        let mut tx = self.database().write().await?;
        self.put_back(&mut tx, &lease.job, &lease.token, why).await?;
        tx.commit().await
    }

    /// Queues a job again, or fails it if too many workers died on it.
    pub(crate) async fn put_back(&self, tx: &mut Tx, job: &Job, token: &str, why: &Retry) -> Result<()> {
        let (died, fault, problem) = match why {
            Retry::Died(reason) => (1_i64, 0_i64, Some(Problem::new("died", reason))),
            Retry::Fault(reason) => (0, 1, Some(Problem::new("fault", reason))),
            Retry::Stopping => (0, 0, None),
        };
        if died == 1 && job.attempts + 1 >= self.limits().attempts {
            let times = job.attempts + 1;
            let problem = Problem::new("gave-up", format!("it crashed its worker process {times} times"));
            return self.fail_in(tx, job, token, &problem).await;
        }
        let update =
            "UPDATE jobs SET state = 'queued', lease_token = NULL, lease_until = NULL, attempts = attempts + $1, faults = faults + $2,
            problem = $3 WHERE id = $4 AND lease_token = $5 RETURNING faults, attempts";
        let update = sqlx::query_as(update).bind(died).bind(fault).bind(problem.as_ref().map(to_json).transpose()?);
        let updated: Option<(i64, i64)> = update.bind(&job.id).bind(token).fetch_optional(tx.connection()).await?;
        let (faults, attempts) = updated.ok_or(LibraryError::LeaseLost)?;
        let after = tx.now + back_off(if fault == 1 { faults } else { died * attempts });
        sqlx::query("UPDATE jobs SET run_after = $1 WHERE id = $2").bind(after).bind(&job.id).execute(tx.connection()).await?;
        if job.kind == JobKind::Make {
            set_state(tx, job, PhotoState::Queued).await?;
        }
        tx.notify(Event::Photo(job.photo));
        Ok(())
    }
}

fn back_off(faults: i64) -> Millis {
    if faults == 0 {
        return 0;
    }
    millis(BACK_OFF.saturating_mul(1 << (faults - 1).clamp(0, 16)).min(MAX_BACK_OFF))
}

/// Deletes the row of a job.
async fn end(tx: &mut Tx, job: &Job, token: &str) -> Result<()> {
    let delete = sqlx::query("DELETE FROM jobs WHERE id = $1 AND lease_token = $2").bind(&job.id).bind(token);
    is_held(&delete.execute(tx.connection()).await?)
}

pub(crate) async fn set_state(tx: &mut Tx, job: &Job, state: PhotoState) -> Result<()> {
    let update = sqlx::query("UPDATE photos SET state = $1 WHERE id = $2").bind(state.name()).bind(job.photo.to_string());
    update.execute(tx.connection()).await?;
    Ok(())
}
