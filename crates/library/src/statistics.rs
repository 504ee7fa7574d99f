//! Statistics of all nodes, for health and metrics.

use std::collections::BTreeMap;
use std::time::Duration;

use sqlx::Row as _;
use sqlx::any::AnyRow;

use crate::database::Tx;
use crate::error::Result;
use crate::ids::Millis;
use crate::photo::{Class, PhotoState, class_of, state_of};
use crate::queue::{Job, JobKind, JobState};
use crate::{Library, LibraryError};

/// Outcomes of the jobs of a kind since the library was created.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct OutcomeCounts {
    /// Finished jobs.
    pub finished: u64,
    /// Failed jobs.
    pub failed: u64,
    /// Workers that died on a job.
    pub died: u64,
    /// Mean duration in milliseconds, weighted towards recent jobs.
    pub mean_ms: f64,
}

/// Statistics.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Statistics {
    /// Photos by state.
    pub photos: BTreeMap<PhotoState, u64>,
    /// Bytes of photos with their results.
    pub bytes: u64,
    /// Waiting jobs, by kind and class.
    pub waiting: BTreeMap<(JobKind, Class), u64>,
    /// Running jobs, by kind.
    pub working: BTreeMap<JobKind, u64>,
    /// Finished exports.
    pub exports: u64,
    /// Bytes of exports.
    pub exports_bytes: u64,
    /// Longest current wait of a job.
    pub longest_wait: Duration,
    /// Outcomes of jobs, by kind.
    pub outcomes: BTreeMap<JobKind, OutcomeCounts>,
}

impl Statistics {
    /// Waiting jobs of a kind, of all classes.
    #[must_use]
    pub fn waiting_of(&self, kind: JobKind) -> u64 {
        self.waiting.iter().filter(|((of, _), _)| *of == kind).map(|(_, n)| n).sum()
    }
}

fn number(row: &AnyRow, column: &str) -> Result<u64> {
    Ok(row.try_get::<i64, _>(column)?.max(0) as u64)
}

impl Library {
    /// Counts of photos and jobs.
    ///
    /// # Errors
    /// [`LibraryError::Unavailable`].
    pub async fn statistics(&self) -> Result<Statistics> {
        let reader = self.database().reader();
        let mut statistics = Statistics::default();
        let photos = "SELECT state, COUNT(*) AS n, CAST(SUM(bytes) AS BIGINT) AS bytes FROM photos GROUP BY state";
        for row in sqlx::query(photos).fetch_all(reader).await? {
            statistics.photos.insert(state_of(&row)?, number(&row, "n")?);
            statistics.bytes += number(&row, "bytes")?;
        }
        let jobs = "SELECT kind, class, state, COUNT(*) AS n, CAST(SUM(bytes) AS BIGINT) AS bytes, MIN(created_at) AS oldest FROM jobs
            GROUP BY kind, class, state";
        let now = self.now().await?;
        for row in sqlx::query(jobs).fetch_all(reader).await? {
            let (kind, state): (String, String) = (row.try_get("kind")?, row.try_get("state")?);
            let (kind, n) = (JobKind::of_name(&kind)?, number(&row, "n")?);
            match JobState::ALL.into_iter().find(|known| known.name() == state) {
                Some(JobState::Queued) => {
                    *statistics.waiting.entry((kind, class_of(&row)?)).or_default() += n;
                    let waited = (now - row.try_get::<i64, _>("oldest")?).max(0) as u64;
                    statistics.longest_wait = statistics.longest_wait.max(Duration::from_millis(waited));
                }
                Some(JobState::Working) => *statistics.working.entry(kind).or_default() += n,
                Some(JobState::Done) => {
                    statistics.exports += n;
                    statistics.exports_bytes += number(&row, "bytes")?;
                }
                Some(JobState::Failed) => {}
                None => return Err(LibraryError::stored("state", state)),
            }
        }
        for row in sqlx::query("SELECT kind, finished, failed, died, mean_ms FROM outcomes").fetch_all(reader).await? {
            let kind: String = row.try_get("kind")?;
            let (finished, failed, died) = (number(&row, "finished")?, number(&row, "failed")?, number(&row, "died")?);
            statistics
                .outcomes
                .insert(JobKind::of_name(&kind)?, OutcomeCounts { finished, failed, died, mean_ms: row.try_get("mean_ms")? });
        }
        Ok(statistics)
    }
}

/// Records the end of a job: after `took` milliseconds, or without a result.
pub(crate) async fn count_outcome(tx: &mut Tx, job: &Job, took: Option<Millis>) -> Result<()> {
    let insert = "INSERT INTO outcomes (kind, mean_ms, finished, failed, died) VALUES ($1, $2, $3, $4, 0) ON CONFLICT (kind) DO UPDATE SET
        mean_ms = CASE WHEN excluded.finished = 0 THEN outcomes.mean_ms WHEN outcomes.finished = 0 THEN excluded.mean_ms
            ELSE 0.8 * outcomes.mean_ms + 0.2 * excluded.mean_ms END,
        finished = outcomes.finished + excluded.finished, failed = outcomes.failed + excluded.failed";
    let finished = i64::from(took.is_some());
    let insert = sqlx::query(insert).bind(job.kind.name()).bind(took.unwrap_or_default() as f64).bind(finished).bind(1 - finished);
    insert.execute(tx.connection()).await?;
    Ok(())
}

pub(crate) async fn count_death(tx: &mut Tx, kind: JobKind) -> Result<()> {
    let insert = "INSERT INTO outcomes (kind, mean_ms, finished, failed, died) VALUES ($1, 0, 0, 0, 1)
        ON CONFLICT (kind) DO UPDATE SET died = outcomes.died + 1";
    sqlx::query(insert).bind(kind.name()).execute(tx.connection()).await?;
    Ok(())
}
