//! Statistics of all nodes, for health and metrics.

use std::collections::BTreeMap;
use std::time::Duration;

use sqlx::Row as _;
use sqlx::any::AnyRow;

use crate::Library;
use crate::error::Result;
use crate::photo::{Class, PhotoState, class_of, parsed};
use crate::queue::{JobKind, JobState};

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
    /// Bytes of exports.
    pub exports_bytes: u64,
    /// Longest current wait of a job.
    pub longest_wait: Duration,
}

impl Statistics {
    /// Waiting jobs of a kind, of all classes.
    pub fn waiting_of(&self, kind: JobKind) -> u64 {
        self.waiting.iter().filter(|((of, _), _)| *of == kind).map(|(_, n)| n).sum()
    }
}

fn number(row: &AnyRow, column: &str) -> Result<u64> {
    Ok(row.try_get::<i64, _>(column)?.max(0) as u64)
}

impl Library {
    /// Counts of photos and jobs.
    pub async fn statistics(&self) -> Result<Statistics> {
        let reader = self.database().reader();
        let mut statistics = Statistics::default();
        let photos = "SELECT state, COUNT(*) AS n, CAST(SUM(bytes) AS BIGINT) AS bytes FROM photos GROUP BY state";
        for row in sqlx::query(photos).fetch_all(reader).await? {
            statistics.photos.insert(parsed(&row, "state")?, number(&row, "n")?);
            statistics.bytes += number(&row, "bytes")?;
        }
        let jobs = "SELECT kind, class, state, COUNT(*) AS n, CAST(SUM(bytes) AS BIGINT) AS bytes, MIN(created_at) AS oldest FROM jobs
            GROUP BY kind, class, state";
        let now = self.now().await?;
        for row in sqlx::query(jobs).fetch_all(reader).await? {
            let (kind, n) = (parsed(&row, "kind")?, number(&row, "n")?);
            match parsed(&row, "state")? {
                JobState::Queued => {
                    *statistics.waiting.entry((kind, class_of(&row)?)).or_default() += n;
                    let waited = (now - row.try_get::<i64, _>("oldest")?).max(0) as u64;
                    statistics.longest_wait = statistics.longest_wait.max(Duration::from_millis(waited));
                }
                JobState::Working => *statistics.working.entry(kind).or_default() += n,
                JobState::Done => statistics.exports_bytes += number(&row, "bytes")?,
                JobState::Failed => {}
            }
        }
        Ok(statistics)
    }
}
