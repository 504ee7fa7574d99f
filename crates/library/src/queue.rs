//! The job queue.
//!
//! A new job gets a turn: the next one of its owner and of its address, but at least that of the job at the head of the queue.
//! Workers take jobs by class, turn and age, so that a hundred jobs of one owner do not delay the first of another.

use std::net::{IpAddr, Ipv6Addr};
use std::time::Duration;

use serde_json::Value;
use sqlx::any::AnyRow;
use sqlx::{AssertSqlSafe, FromRow, Row as _};

use crate::database::{Lock, Tx};
use crate::error::{LibraryError, QueueLimit, Result};
use crate::ids::PhotoId;
use crate::owner::Owner;
use crate::photo::{Blob, Class, Problem, class_of, json, optional_json, parsed, to_json};
use crate::string_enum::string_enum;
use crate::{Library, Millis};

/// Estimated duration of a job before any was measured.
const FIRST_GUESS: Duration = Duration::from_secs(5);
/// Longest `retry_after`.
const MAX_RETRY: Duration = Duration::from_mins(2);

string_enum! {
    /// What a job does.
    pub enum JobKind {
        /// Makes a photo.
        Make = "make",
        /// Writes a file to download.
        Export = "export",
        /// Draws a film to download.
        Film = "film",
    }
}

impl JobKind {
    /// All kinds.
    pub const ALL: [Self; 3] = [Self::Make, Self::Export, Self::Film];

    /// Kinds that share the limits of the queue with this one.
    const fn beside(self) -> [Self; 2] {
        match self {
            Self::Make => [Self::Make, Self::Make],
            Self::Export | Self::Film => [Self::Export, Self::Film],
        }
    }
}

string_enum! {
    /// State of a job.
    pub enum JobState {
        /// Waiting for a worker.
        Queued = "queued",
        /// A worker holds it.
        Working = "working",
        /// Its file exists.
        Done = "done",
        /// It failed.
        Failed = "failed",
    }
}

/// The caller. The limits of the queue apply to owner and address.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Requester {
    /// The owner, if authenticated.
    pub owner: Option<Owner>,
    /// The client's address, if known. Deleted when the job ends.
    pub address: Option<IpAddr>,
    /// `traceparent` of the request, which becomes the payload of its job.
    pub trace: Option<String>,
}

impl Requester {
    fn network(&self) -> Option<String> {
        self.address.map(|address| client_network(address).to_string())
    }
}

/// The address that stands for a customer: an IPv6 customer has a whole /64 network.
pub fn client_network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(v6) => Ipv6Addr::from(u128::from(v6) >> 64 << 64).into(),
        v4 @ IpAddr::V4(_) => v4,
    }
}

/// A job.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// Its id, from kind, photo and key.
    pub id: String,
    /// What it does.
    pub kind: JobKind,
    /// The photo.
    pub photo: PhotoId,
    /// The version of the photo.
    pub version: i64,
    /// How urgent it is.
    pub class: Class,
    /// Details, as the caller passed them.
    pub payload: Value,
    /// Its state.
    pub state: JobState,
    /// Number of workers that died on it.
    pub attempts: i64,
    /// Progress at the last renewal of its lease.
    pub progress: Option<Value>,
    /// Why it failed; or while it waits, the last fault of the server.
    pub problem: Option<Problem>,
    /// The file that it wrote.
    pub result: Option<Blob>,
    /// When it was queued.
    pub created_at: Millis,
    /// When its file was last written or fetched.
    pub used_at: Millis,
}

/// Columns of [`Job`].
pub(crate) const COLUMNS: &str =
    "id, kind, photo, version, class, payload, state, attempts, progress, problem, result, created_at, used_at";

impl Job {
    /// Name of an export among those of its photo.
    pub fn key(&self) -> Option<&str> {
        self.id.splitn(3, '/').nth(2)
    }
}

impl FromRow<'_, AnyRow> for Job {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.try_get("id")?,
            kind: parsed(row, "kind")?,
            photo: parsed(row, "photo")?,
            version: row.try_get("version")?,
            class: class_of(row)?,
            payload: json(row, "payload")?,
            state: parsed(row, "state")?,
            attempts: row.try_get("attempts")?,
            progress: optional_json(row, "progress")?,
            problem: optional_json(row, "problem")?,
            result: optional_json(row, "result")?,
            created_at: row.try_get("created_at")?,
            used_at: row.try_get("used_at")?,
        })
    }
}

pub(crate) struct NewJob<'a> {
    pub kind: JobKind,
    pub photo: PhotoId,
    pub version: i64,
    /// Name of an export.
    pub key: Option<&'a str>,
    pub class: Class,
    pub requester: &'a Requester,
}

pub(crate) fn id_of(kind: JobKind, photo: PhotoId, key: Option<&str>) -> String {
    match (kind, key) {
        (JobKind::Export | JobKind::Film, Some(key)) => format!("export/{photo}/{key}"),
        _ => format!("{}/{photo}", kind.name()),
    }
}

impl Library {
    /// Queues a job if the limits allow it. Replaces an ended job of the same id.
    pub(crate) async fn enqueue(&self, tx: &mut Tx, job: &NewJob<'_>, payload: &Value) -> Result<Job> {
        // serialises counting jobs and assigning turns
        tx.lock(Lock::Queue).await?;
        self.check_places(tx, job).await?;
        let id = id_of(job.kind, job.photo, job.key);
        let ended = "DELETE FROM jobs WHERE id = $1 AND state IN ('done', 'failed')";
        sqlx::query(ended).bind(&id).execute(tx.connection()).await?;
        let (owner, address) = (job.requester.owner.as_ref().map(Owner::as_str), job.requester.network());
        let turn = turn(tx, job.class, owner.unwrap_or_default(), address.as_deref().unwrap_or_default()).await?;
        let insert = format!(
            "INSERT INTO jobs (id, kind, photo, version, class, owner, address, payload, state, turn, created_at, run_after, attempts, faults,
             bytes, used_at) VALUES ($1, $2, $3, $4, $5, $6, $7, $8, 'queued', $9, $10, $10, 0, 0, 0, $10) ON CONFLICT (id) DO NOTHING
             RETURNING {COLUMNS}"
        );
        let insert = sqlx::query_as(AssertSqlSafe(insert)).bind(id).bind(job.kind.name()).bind(job.photo.to_string()).bind(job.version);
        let insert = insert.bind(job.class.rank()).bind(owner).bind(address).bind(to_json(payload)?).bind(turn).bind(tx.now);
        insert.fetch_optional(tx.connection()).await?.ok_or(LibraryError::NotReady)
    }

    /// Checks the limits of the queue.
    async fn check_places(&self, tx: &mut Tx, job: &NewJob<'_>) -> Result<()> {
        let [one, other] = job.kind.beside();
        let all = if job.kind == JobKind::Make { self.limits().queue } else { self.limits().exports };
        let count = "SELECT COUNT(*),
            CAST(COALESCE(SUM(CASE WHEN owner = $3 THEN 1 ELSE 0 END), 0) AS BIGINT),
            CAST(COALESCE(SUM(CASE WHEN address = $4 THEN 1 ELSE 0 END), 0) AS BIGINT)
            FROM jobs WHERE state = 'queued' AND kind IN ($1, $2)";
        let count = sqlx::query_as(count).bind(one.name()).bind(other.name());
        let count = count.bind(job.requester.owner.as_ref().map(Owner::as_str)).bind(job.requester.network());
        let (any, of_owner, of_address): (i64, i64, i64) = count.fetch_one(tx.connection()).await?;
        let half = all.div_ceil(2);
        for (share, waiting, places) in
            [(QueueLimit::All, any, all), (QueueLimit::Owner, of_owner, half), (QueueLimit::Address, of_address, half)]
        {
            let waiting = waiting as u64;
            if waiting >= places {
                let retry_after = wait(tx, job.kind, waiting).await?;
                return Err(LibraryError::QueueFull { waiting, places, share, retry_after });
            }
        }
        Ok(())
    }

    /// Number of photos until the queue is full.
    pub async fn free_places(&self) -> Result<u64> {
        let count = sqlx::query_scalar("SELECT COUNT(*) FROM jobs WHERE state = 'queued' AND kind = 'make'");
        let waiting: i64 = count.fetch_one(self.database().reader()).await?;
        Ok(self.limits().queue.saturating_sub(waiting as u64))
    }

    /// Number of photos that are made before this one; `None` if it is not waiting.
    pub async fn position(&self, photo: PhotoId) -> Result<Option<u64>> {
        let ahead = "SELECT (SELECT COUNT(*) FROM jobs o WHERE o.state = 'queued' AND o.kind = j.kind
                AND (o.class, o.turn, o.created_at, o.id) < (j.class, j.turn, j.created_at, j.id))
            FROM jobs j WHERE j.id = $1 AND j.state = 'queued'";
        let ahead = sqlx::query_scalar(ahead).bind(id_of(JobKind::Make, photo, None));
        Ok(ahead.fetch_optional(self.database().reader()).await?.map(|ahead: i64| ahead as u64))
    }

    /// A job of a photo; `key` names an export.
    pub async fn job(&self, kind: JobKind, photo: PhotoId, key: Option<&str>) -> Result<Job> {
        let select = format!("SELECT {COLUMNS} FROM jobs WHERE id = $1");
        let select = sqlx::query_as(AssertSqlSafe(select)).bind(id_of(kind, photo, key));
        select.fetch_optional(self.database().reader()).await?.ok_or(LibraryError::NotFound("job"))
    }
}

/// The turn of a new job: after those of the same owner and of the same address, and not before the job at the head of the queue. Strangers
/// are a new owner with each upload, so owners alone would not be fair. `owner` and `address` are empty if unknown.
async fn turn(tx: &mut Tx, class: Class, owner: &str, address: &str) -> Result<i64> {
    let turn = "SELECT COALESCE(
        (SELECT MAX(turn) + 1 FROM jobs WHERE state = 'queued' AND class = $1
            AND (owner = $2 OR address = $3 OR ($2 = '' AND $3 = '' AND owner IS NULL AND address IS NULL))),
        (SELECT MIN(turn) FROM jobs WHERE state = 'queued' AND class = $1), 0)";
    Ok(sqlx::query_scalar(turn).bind(class.rank()).bind(owner).bind(address).fetch_one(tx.connection()).await?)
}

/// Estimated time in which the running workers do this many jobs, within bounds.
async fn wait(tx: &mut Tx, kind: JobKind, jobs: u64) -> Result<Duration> {
    let rate = "SELECT (SELECT mean_ms FROM durations WHERE kind = $1),
        (SELECT COUNT(*) FROM jobs WHERE state = 'working' AND kind = $1)";
    let (mean, working): (Option<f64>, i64) = sqlx::query_as(rate).bind(kind.name()).fetch_one(tx.connection()).await?;
    let mean = mean.map_or(FIRST_GUESS.as_secs_f64(), |ms| ms / 1000.0);
    let wait = Duration::try_from_secs_f64(mean * jobs as f64 / working.max(1) as f64).unwrap_or(MAX_RETRY);
    Ok(wait.clamp(Duration::from_secs(1), MAX_RETRY))
}

/// Records how long a job took, for estimates.
pub(crate) async fn record_duration(tx: &mut Tx, kind: JobKind, took: Millis) -> Result<()> {
    let insert = "INSERT INTO durations (kind, mean_ms) VALUES ($1, $2)
        ON CONFLICT (kind) DO UPDATE SET mean_ms = 0.8 * durations.mean_ms + 0.2 * excluded.mean_ms";
    sqlx::query(insert).bind(kind.name()).bind(took as f64).execute(tx.connection()).await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_ipv6_network_is_one_address() {
        let network = |text: &str| Requester { address: Some(text.parse().unwrap()), ..Requester::default() }.network();
        assert_eq!(network("2001:db8::1"), network("2001:db8::2"));
        assert_ne!(network("2001:db8::1"), network("2001:db8:0:1::1"));
        assert_eq!(network("::ffff:192.0.2.1"), network("192.0.2.1"));
        assert_ne!(network("192.0.2.1"), network("192.0.2.2"));
    }
}
