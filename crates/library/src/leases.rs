//! Leases by which workers hold jobs.
//!
//! A lease expires by the database's clock. The transaction that stores a result checks the lease's token, so a second result is discarded.
//! A process never takes a job from one of its own workers, even if the clock jumps.

use std::collections::HashSet;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde_json::Value;
use sqlx::{AssertSqlSafe, FromRow as _, Row as _};

use crate::change_notifications::Event;
use crate::completion::{MAX_BACK_OFF, Retry, set_state};
use crate::database::{Tx, is_held};
use crate::digest::hex;
use crate::error::{LibraryError, Result};
use crate::ids::random;
use crate::photo::{Photo, PhotoState, to_json};
use crate::queue::{COLUMNS, Job, JobKind};
use crate::{Library, Millis, deliveries, millis, room_leases};

/// Longest lease: one that ends later was granted before the clock was set back.
const MAX_LEASE: Duration = Duration::from_mins(10);
/// Every nth job is taken in the opposite order of classes, so that no class starves.
const OTHER_WAY: u64 = 4;
/// Polling interval for jobs without an event.
const LOOK: Duration = Duration::from_secs(1);

/// Tokens of this process's leases.
pub(crate) type OwnLeases = Arc<Mutex<HashSet<String>>>;

/// A worker's lease of a job. If dropped unfinished, another worker gets the job once the lease expires.
#[derive(Debug)]
pub struct Lease {
    /// The job.
    pub job: Job,
    /// The photo as it was when the job was taken.
    pub photo: Photo,
    /// An `UPDATE` of the job's row must match it.
    pub(crate) token: String,
    lasts: Duration,
    taken: Instant,
    held: OwnLeases,
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.held.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.token);
    }
}

impl Library {
    /// Takes the next job of these kinds, for `lasts`; `None` if none is ready.
    pub async fn take(&self, kinds: &[JobKind], lasts: Duration) -> Result<Option<Lease>> {
        let lasts = lasts.min(MAX_LEASE);
        let mut tx = self.database().write().await?;
        let over = self.over(&mut tx).await?;
        if !over.is_empty() {
            tx.commit().await?;
            self.take_back(over).await?;
            tx = self.database().write().await?;
        }
        let Some(id) = self.choose(&mut tx, kinds).await? else {
            tx.commit().await?;
            return Ok(None);
        };
        let token = hex(&random::<16>()?);
        let update = format!(
            "UPDATE jobs SET state = 'working', lease_token = $1, lease_until = $2, problem = NULL WHERE id = $3 RETURNING {COLUMNS}"
        );
        let update = sqlx::query_as(AssertSqlSafe(update)).bind(&token).bind(tx.now + millis(lasts)).bind(id);
        let job: Job = update.fetch_one(tx.connection()).await?;
        if job.kind == JobKind::Make {
            set_state(&mut tx, &job, PhotoState::Working).await?;
        }
        // not locked: making the photo again waits for the locks of its jobs
        let photo = self.read_photo(tx.connection(), job.photo).await?.ok_or(LibraryError::NotFound("photo"))?;
        tx.notify(Event::Photo(job.photo));
        // before the commit makes it visible
        self.0.held.lock().unwrap_or_else(PoisonError::into_inner).insert(token.clone());
        let lease = Lease { job, photo, token, lasts, taken: Instant::now(), held: self.0.held.clone() };
        tx.commit().await?;
        self.0.taken.fetch_add(1, Ordering::Relaxed);
        Ok(Some(lease))
    }

    /// Like [`Self::take`], but waits for a job; `None` once `stop` completes.
    pub async fn next(&self, kinds: &[JobKind], lasts: Duration, stop: impl Future<Output = ()>) -> Result<Option<Lease>> {
        let mut events = self.subscribe();
        let mut stop = std::pin::pin!(stop);
        loop {
            tokio::select! {
                biased;
                () = &mut stop => return Ok(None),
                () = std::future::ready(()) => {}
            }
            // not cancelled midway: a lease without a holder blocks its job until it expires
            if let Some(lease) = self.take(kinds, lasts).await? {
                return Ok(Some(lease));
            }
            let news = async { while matches!(events.next().await, Some(Event::Progress { .. } | Event::Revoked | Event::Delivery)) {} };
            tokio::select! {
                biased;
                () = &mut stop => return Ok(None),
                // delayed jobs and those of dead workers become ready without an event
                _ = tokio::time::timeout(LOOK, news) => {}
            }
        }
    }

    /// Jobs with expired leases, and their tokens: their workers have died.
    async fn over(&self, tx: &mut Tx) -> Result<Vec<(Job, String)>> {
        let over = format!("SELECT {COLUMNS}, lease_token FROM jobs WHERE state = 'working' AND (lease_until <= $1 OR lease_until > $2)");
        let over = sqlx::query(AssertSqlSafe(over)).bind(tx.now).bind(tx.now + millis(MAX_LEASE));
        let mut jobs = Vec::new();
        for row in over.fetch_all(tx.connection()).await? {
            let token: String = row.try_get("lease_token")?;
            if self.0.held.lock().unwrap_or_else(PoisonError::into_inner).contains(&token) {
                continue;
            }
            match Job::from_row(&row) {
                Ok(job) => jobs.push((job, token)),
                // from a newer version; must not block other jobs
                Err(error) => tracing::warn!(%error, "skipping a job that this version cannot read"),
            }
        }
        Ok(jobs)
    }

    /// Requeues all running jobs, lets deliveries under way be tried again, and ends all rooms. That does not count as an attempt, but each
    /// job waits longer every time, because one of them may have crashed the server. Only for a process that is the only one with workers.
    pub async fn reclaim(&self) -> Result<()> {
        let select = format!("SELECT {COLUMNS}, lease_token FROM jobs WHERE state = 'working'");
        for row in sqlx::query(AssertSqlSafe(select)).fetch_all(self.database().reader()).await? {
            let (job, token): (Job, String) = (Job::from_row(&row)?, row.try_get("lease_token")?);
            let mut tx = self.database().write().await?;
            self.put_back(&mut tx, &job, &token, &Retry::Fault("the server ended during the job".into())).await?;
            tx.commit().await?;
        }
        let mut tx = self.database().write().await?;
        deliveries::release(&mut tx).await?;
        room_leases::end_all(&mut tx).await?;
        tx.commit().await
    }

    /// Requeues jobs of dead workers, each in its own transaction, so that none locks the rows of two.
    async fn take_back(&self, jobs: Vec<(Job, String)>) -> Result<()> {
        for (job, token) in jobs {
            let mut tx = self.database().write().await?;
            let why = Retry::Died("its worker stopped responding".into());
            match self.put_back(&mut tx, &job, &token, &why).await {
                Ok(()) => tx.commit().await?,
                // another node was faster, or the worker lives
                Err(LibraryError::LeaseLost) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Locks and returns the next job.
    async fn choose(&self, tx: &mut Tx, kinds: &[JobKind]) -> Result<Option<String>> {
        let Some(first) = kinds.first() else { return Ok(None) };
        let other_way = self.0.taken.load(Ordering::Relaxed) % OTHER_WAY == OTHER_WAY - 1;
        let lock = if tx.has_row_locks() { "FOR UPDATE SKIP LOCKED" } else { "" };
        let order = if other_way { "class DESC" } else { "class" };
        let select = format!(
            "SELECT id FROM jobs WHERE state = 'queued' AND kind IN ($1, $2, $3) AND (run_after <= $4 OR run_after > $5)
             ORDER BY {order}, turn, created_at, id LIMIT 1 {lock}"
        );
        let mut select = sqlx::query_scalar(AssertSqlSafe(select));
        for n in 0..JobKind::ALL.len() {
            select = select.bind(kinds.get(n).unwrap_or(first).name());
        }
        Ok(select.bind(tx.now).bind(tx.now + millis(MAX_BACK_OFF)).fetch_optional(tx.connection()).await?)
    }

    /// Renews a lease, and stores the worker's progress.
    ///
    /// # Errors
    /// [`LibraryError::LeaseLost`]: the job was cancelled, or another worker has it.
    pub async fn renew(&self, lease: &Lease, progress: Option<&Value>) -> Result<()> {
        let mut tx = self.database().write().await?;
        let progress = progress.map(to_json).transpose()?;
        let update = "UPDATE jobs SET lease_until = $1, progress = COALESCE($2, progress) WHERE id = $3 AND lease_token = $4";
        let update = sqlx::query(update).bind(tx.now + millis(lease.lasts)).bind(progress);
        is_held(&update.bind(&lease.job.id).bind(&lease.token).execute(tx.connection()).await?)?;
        tx.commit().await
    }

    /// Sends the worker's progress to the photo's followers without storing it.
    pub async fn send_progress(&self, lease: &Lease, progress: Value) -> Result<()> {
        self.database().notify(Event::Progress { photo: lease.job.photo, progress }).await
    }
}

impl Lease {
    /// How long it lasts without renewal.
    pub const fn lasts(&self) -> Duration {
        self.lasts
    }

    /// How long the job has run, by this process's clock.
    pub(crate) fn age(&self) -> Millis {
        millis(self.taken.elapsed())
    }
}
