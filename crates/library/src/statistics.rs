//! Statistics of all nodes, for health and metrics.

use std::collections::BTreeMap;
use std::time::Duration;

use sqlx::Row as _;
use sqlx::any::AnyRow;

use crate::error::Result;
use crate::photo::{Class, PhotoState, class_of, state_of};
use crate::queue::{JobState, Kind};
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
    pub waiting: BTreeMap<(Kind, Class), u64>,
    /// Running jobs, by kind.
    pub working: BTreeMap<Kind, u64>,
    /// Finished exports.
    pub exports: u64,
    /// Bytes of exports.
    pub exports_bytes: u64,
    /// Longest current wait of a job.
    pub longest_wait: Duration,
    /// Outcomes of jobs, by kind.
    pub outcomes: BTreeMap<Kind, OutcomeCounts>,
}

impl Statistics {
    /// Waiting jobs of a kind, of all classes.
    #[must_use]
    pub fn waiting_of(&self, kind: Kind) -> u64 {
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
            let (kind, n) = (Kind::of_name(&kind)?, number(&row, "n")?);
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
            statistics.outcomes.insert(Kind::of_name(&kind)?, OutcomeCounts { finished, failed, died, mean_ms: row.try_get("mean_ms")? });
        }
        Ok(statistics)
    }
}
