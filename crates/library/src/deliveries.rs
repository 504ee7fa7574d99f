//! Deliveries: events on their way to webhooks.
//!
//! A delivery is inserted by the transaction that makes its event true, so that a crash loses none. It has its own table rather than a
//! row in `jobs`, because it outlives its photo and takes no worker. As a job has, it has a lease by the database's clock; an attempt
//! counts if no later one was begun. After a crash or an outage the same delivery may arrive twice.

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use sqlx::any::AnyRow;
use sqlx::{FromRow, Row as _};

use crate::change_notifications::Event;
use crate::database::{Lock, Tx, is_held};
use crate::digest::hex;
use crate::error::{LibraryError, Result};
use crate::ids::{PhotoId, random};
use crate::owner::Owner;
use crate::photo::{Photo, Problem, json, parsed, to_json};
use crate::queue::{Job, JobKind};
use crate::string_enum::string_enum;
use crate::webhooks::{EventType, Webhook, disable, read_webhook};
use crate::{Library, Millis, millis};

/// Longest attempt: after that another one begins.
const LEASE: Duration = Duration::from_mins(1);
/// Deliveries of one webhook under way at a time, at all nodes together.
const AT_ONCE: i64 = 2;
/// Longest pause that a receiver can ask for.
const MAX_PAUSE: Duration = Duration::from_hours(6);
/// After a failed delivery, a webhook is disabled if it has failed for so long.
const PATIENCE: Duration = Duration::from_hours(24 * 5);
/// How long ended deliveries are kept, and how many of one webhook.
const LOG: (Duration, i64) = (Duration::from_hours(24 * 7), 1000);

/// Pauses after failed attempts; after one more, a delivery fails.
pub const RETRIES: [Duration; 8] = [
    Duration::from_secs(5),
    Duration::from_mins(1),
    Duration::from_mins(5),
    Duration::from_mins(30),
    Duration::from_hours(2),
    Duration::from_hours(5),
    Duration::from_hours(10),
    Duration::from_hours(14),
];

/// What an event is about.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct EventData {
    /// The photo.
    pub photo: Option<PhotoId>,
    /// Its title.
    pub title: Option<String>,
    /// The export.
    pub export: Option<ExportData>,
    /// Why the photo or the export failed.
    pub problem: Option<Problem>,
    /// The room.
    pub room: Option<String>,
}

/// An export of a photo.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ExportData {
    /// Its name among those of its photo.
    pub key: String,
    /// [`JobKind::Export`] or [`JobKind::Film`].
    pub kind: JobKind,
    /// The worker's task.
    pub payload: Value,
}

impl EventData {
    pub(crate) fn of_photo(photo: &Photo, problem: Option<&Problem>) -> Self {
        Self { photo: Some(photo.id), title: photo.title().map(str::to_owned), problem: problem.cloned(), ..Self::default() }
    }

    pub(crate) fn of_export(job: &Job, photo: &Photo, problem: Option<&Problem>) -> Self {
        let key = job.key().unwrap_or_default().to_owned();
        Self { export: Some(ExportData { key, kind: job.kind, payload: job.payload.clone() }), ..Self::of_photo(photo, problem) }
    }

    pub(crate) fn of_room(name: &str) -> Self {
        Self { room: Some(name.to_owned()), ..Self::default() }
    }
}

string_enum! {
    /// State of a delivery.
    pub enum DeliveryState {
        /// It waits for an attempt, or one is under way.
        Pending = "pending",
        /// The receiver has it.
        Delivered = "delivered",
        /// It is given up.
        Failed = "failed",
    }
}

/// A delivery.
#[derive(Clone, Debug, PartialEq)]
pub struct Delivery {
    /// Its id, the same for all attempts. Later deliveries have greater ids.
    pub id: String,
    /// What happened.
    pub event: EventType,
    /// What it is about.
    pub data: EventData,
    /// When it happened.
    pub created_at: Millis,
    /// When the next attempt is due.
    pub run_after: Millis,
    /// Attempts so far.
    pub attempts: i64,
    /// Its state.
    pub state: DeliveryState,
    /// HTTP status of the last answer.
    pub status: Option<u16>,
    /// Why the last attempt failed.
    pub error: Option<String>,
    /// Milliseconds that the last attempt took.
    pub took_ms: Option<i64>,
    /// When it was delivered or given up.
    pub ended_at: Option<Millis>,
}

impl FromRow<'_, AnyRow> for Delivery {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.try_get("id")?,
            event: parsed(row, "event")?,
            data: json(row, "data")?,
            created_at: row.try_get("created_at")?,
            run_after: row.try_get("run_after")?,
            attempts: row.try_get("attempts")?,
            state: parsed(row, "state")?,
            status: row.try_get::<Option<i64>, _>("status")?.map(|status| status as u16),
            error: row.try_get("error")?,
            took_ms: row.try_get("took_ms")?,
            ended_at: row.try_get("ended_at")?,
        })
    }
}

/// A page of a webhook's deliveries, newest first.
#[derive(Clone, Debug, PartialEq)]
pub struct DeliveryPage {
    /// The deliveries.
    pub deliveries: Vec<Delivery>,
    /// The last one of this page if there are more, for the next page.
    pub next: Option<String>,
}

/// An attempt that is due, and leased to the caller.
#[derive(Clone, Debug, PartialEq)]
pub struct DueDelivery {
    /// The delivery, with this attempt counted.
    pub delivery: Delivery,
    /// Where it goes.
    pub webhook: Webhook,
}

/// What became of an attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The receiver has it.
    Delivered,
    /// It did not take it, and may ask for a pause.
    Refused(Option<Duration>),
    /// The receiver accepts no more events.
    Gone,
}

/// The end of an attempt.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attempt {
    /// What became of it.
    pub verdict: Verdict,
    /// HTTP status of the answer.
    pub status: Option<u16>,
    /// Why it failed.
    pub error: Option<String>,
    /// How long it took.
    pub took: Duration,
}

/// Inserts the deliveries of an event: to webhooks for all photos, and to those of `owner`.
pub(crate) async fn announce(tx: &mut Tx, event: EventType, owner: Option<&Owner>, data: &EventData) -> Result<()> {
    let select = sqlx::query_as("SELECT id, events FROM webhooks WHERE disabled_at IS NULL AND (owner IS NULL OR owner = $1) ORDER BY id");
    let webhooks: Vec<(String, String)> = select.bind(owner.map(Owner::as_str)).fetch_all(tx.connection()).await?;
    for (id, events) in webhooks {
        // an event of a newer version must not fail this one
        if events.split(',').any(|name| name == event.name()) {
            insert(tx, &id, event, data).await?;
        }
    }
    Ok(())
}

async fn insert(tx: &mut Tx, webhook: &str, event: EventType, data: &EventData) -> Result<String> {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    // in order of time, and of this process within a millisecond
    let id = format!("msg_{:012x}{:08x}{}", tx.now.max(0), NEXT.fetch_add(1, Ordering::Relaxed), hex(&random::<6>()?));
    let insert = "INSERT INTO deliveries (id, webhook, event, data, created_at, run_after, attempts, state)
        VALUES ($1, $2, $3, $4, $5, $5, 0, 'pending')";
    let insert = sqlx::query(insert).bind(&id).bind(webhook).bind(event.name()).bind(to_json(data)?).bind(tx.now);
    insert.execute(tx.connection()).await?;
    tx.notify(Event::Delivery);
    Ok(id)
}

/// Lets attempts of a process that has ended be made again. Only for a process that is alone.
pub(crate) async fn release(tx: &mut Tx) -> Result<()> {
    sqlx::query("UPDATE deliveries SET lease_until = NULL WHERE lease_until IS NOT NULL").execute(tx.connection()).await?;
    Ok(())
}

/// Removes ended deliveries that are old or many, and those of removed webhooks.
pub(crate) async fn sweep(tx: &mut Tx) -> Result<()> {
    let old = sqlx::query("DELETE FROM deliveries WHERE state <> 'pending' AND ended_at <= $1").bind(tx.now - millis(LOG.0));
    old.execute(tx.connection()).await?;
    let many = "DELETE FROM deliveries WHERE id IN (SELECT id FROM (
            SELECT id, ROW_NUMBER() OVER (PARTITION BY webhook ORDER BY id DESC) AS place FROM deliveries WHERE state <> 'pending'
        ) AS placed WHERE place > $1)";
    sqlx::query(many).bind(LOG.1).execute(tx.connection()).await?;
    sqlx::query("DELETE FROM deliveries WHERE webhook NOT IN (SELECT id FROM webhooks)").execute(tx.connection()).await?;
    // inserted while their webhook was disabled
    let late = "UPDATE deliveries SET state = 'failed', error = 'the webhook was disabled', ended_at = $1 WHERE state = 'pending'
        AND webhook IN (SELECT id FROM webhooks WHERE disabled_at IS NOT NULL)";
    sqlx::query(late).bind(tx.now).execute(tx.connection()).await?;
    Ok(())
}

impl Library {
    /// Sends a [`EventType::Ping`] to a webhook; returns the id of the delivery.
    ///
    /// # Errors
    /// [`LibraryError::Invalid`] if the webhook is disabled, [`LibraryError::NotFound`].
    pub async fn ping(&self, webhook: &str) -> Result<String> {
        let mut tx = self.database().write().await?;
        let found = read_webhook(tx.connection(), webhook).await?.ok_or(LibraryError::NotFound("webhook"))?;
        if found.disabled.is_some() {
            return Err(LibraryError::Invalid("the webhook is disabled".into()));
        }
        let id = insert(&mut tx, webhook, EventType::Ping, &EventData::default()).await?;
        tx.commit().await?;
        Ok(id)
    }

    /// Takes at most `most` due deliveries, those first that have waited longest, for a minute. A webhook has two under way at a time.
    pub async fn take_deliveries(&self, most: usize) -> Result<Vec<DueDelivery>> {
        let mut tx = self.database().write().await?;
        // counts what is under way
        tx.lock(Lock::Deliveries).await?;
        let mut taken = Vec::new();
        while taken.len() < most {
            match take(&mut tx).await {
                Ok(Some(due)) => taken.push(due),
                Ok(None) => break,
                // from a newer version; its lease keeps it from blocking others
                Err(LibraryError::Internal(error)) => tracing::warn!(error, "skipping a delivery that this version cannot read"),
                Err(error) => return Err(error),
            }
        }
        tx.commit().await?;
        Ok(taken)
    }

    /// Time until the next attempt is due; `None` if none is pending.
    pub async fn next_delivery_in(&self) -> Result<Option<Duration>> {
        let now = self.database().now().await?;
        let select = sqlx::query_scalar("SELECT MIN(run_after) FROM deliveries WHERE state = 'pending'");
        let due: Option<Millis> = select.fetch_one(self.database().reader()).await?;
        Ok(due.map(|due| Duration::from_millis(due.saturating_sub(now).max(0) as u64)))
    }

    /// Records the end of an attempt: it is delivered, is due again, or fails for good. A webhook that answers [`Verdict::Gone`], or whose
    /// attempts have failed for five days, is disabled.
    ///
    /// # Errors
    /// [`LibraryError::LeaseLost`] if another attempt has begun, or the delivery has ended.
    pub async fn record_attempt(&self, due: &DueDelivery, attempt: &Attempt) -> Result<DeliveryState> {
        let mut tx = self.database().write().await?;
        let (delivery, webhook) = (&due.delivery, due.webhook.id.as_str());
        let pause = self.limits().retries.get((delivery.attempts - 1).max(0) as usize);
        let (state, after) = match (attempt.verdict, pause) {
            (Verdict::Delivered, _) => (DeliveryState::Delivered, None),
            (Verdict::Refused(asked), Some(pause)) => {
                (DeliveryState::Pending, Some(tx.now + jittered(*pause)?.max(millis(asked.unwrap_or_default().min(MAX_PAUSE)))))
            }
            (Verdict::Refused(_), None) | (Verdict::Gone, _) => (DeliveryState::Failed, None),
        };
        let update =
            "UPDATE deliveries SET state = $1, run_after = COALESCE($2, run_after), status = $3, error = $4, took_ms = $5, ended_at = $6,
            lease_until = NULL WHERE id = $7 AND attempts = $8 AND state = 'pending'";
        let update = sqlx::query(update).bind(state.name()).bind(after).bind(attempt.status.map(i64::from)).bind(&attempt.error);
        let update = update.bind(millis(attempt.took)).bind(Some(tx.now).filter(|_| state != DeliveryState::Pending));
        is_held(&update.bind(&delivery.id).bind(delivery.attempts).execute(tx.connection()).await?)?;
        note(&mut tx, webhook, attempt.verdict, state).await?;
        tx.commit().await?;
        Ok(state)
    }

    /// At most `limit` deliveries of a webhook before `after`, newest first.
    pub async fn deliveries(&self, webhook: &str, after: Option<&str>, limit: usize) -> Result<DeliveryPage> {
        let select = sqlx::query_as("SELECT * FROM deliveries WHERE webhook = $1 AND ($2 = '' OR id < $2) ORDER BY id DESC LIMIT $3");
        let select = select.bind(webhook).bind(after.unwrap_or_default()).bind(limit as i64 + 1);
        let mut deliveries: Vec<Delivery> = select.fetch_all(self.database().reader()).await?;
        let has_more = deliveries.len() > limit;
        deliveries.truncate(limit);
        let next = deliveries.last().filter(|_| has_more).map(|delivery| delivery.id.clone());
        Ok(DeliveryPage { deliveries, next })
    }
}

async fn take(tx: &mut Tx) -> Result<Option<DueDelivery>> {
    let update = "UPDATE deliveries SET attempts = attempts + 1, lease_until = $1 WHERE id = (
            SELECT id FROM deliveries WHERE state = 'pending' AND run_after <= $2 AND (lease_until IS NULL OR lease_until <= $2)
            AND webhook IN (SELECT id FROM webhooks WHERE disabled_at IS NULL)
            AND webhook NOT IN (SELECT webhook FROM deliveries WHERE lease_until > $2 GROUP BY webhook HAVING COUNT(*) >= $3)
            ORDER BY run_after, id LIMIT 1
        ) AND state = 'pending' RETURNING *";
    let update = sqlx::query(update).bind(tx.now + millis(LEASE)).bind(tx.now).bind(AT_ONCE);
    let Some(row) = update.fetch_optional(tx.connection()).await? else { return Ok(None) };
    let Some(webhook) = read_webhook(tx.connection(), row.try_get("webhook")?).await? else { return Ok(None) };
    Ok(Some(DueDelivery { delivery: Delivery::from_row(&row)?, webhook }))
}

/// Records at a webhook how an attempt ended.
async fn note(tx: &mut Tx, webhook: &str, verdict: Verdict, state: DeliveryState) -> Result<()> {
    match verdict {
        Verdict::Delivered => {
            let update = sqlx::query("UPDATE webhooks SET failing_since = NULL WHERE id = $1 AND failing_since IS NOT NULL");
            update.bind(webhook).execute(tx.connection()).await?;
        }
        Verdict::Gone => disable(tx, webhook, "it answers 410 Gone").await?,
        Verdict::Refused(_) => {
            let update = "UPDATE webhooks SET failing_since = COALESCE(failing_since, $1) WHERE id = $2 RETURNING failing_since";
            let update = sqlx::query_scalar(update).bind(tx.now).bind(webhook);
            let since: Option<Millis> = update.fetch_optional(tx.connection()).await?;
            if state == DeliveryState::Failed && since.is_some_and(|since| tx.now - since >= millis(PATIENCE)) {
                disable(tx, webhook, "its deliveries have failed for five days").await?;
            }
        }
    }
    Ok(())
}

/// A pause that is longer by up to a fifth, so that receivers are not asked by all at once, in milliseconds.
fn jittered(pause: Duration) -> Result<Millis> {
    let [part] = random::<1>()?;
    Ok(millis(pause) + millis(pause) * i64::from(part) / (5 * 256))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pause_is_up_to_a_fifth_longer() {
        for _ in 0..100 {
            assert!((1000..1200).contains(&jittered(Duration::from_secs(1)).unwrap()));
        }
    }
}
