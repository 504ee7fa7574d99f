//! Webhooks: addresses that are told of events. Those of the configuration, and those that an administrator adds, are told of all photos
//! and rooms; those of an owner, of its photos.

use std::fmt;

use sqlx::any::AnyRow;
use sqlx::{Any, AssertSqlSafe, Executor, FromRow, Row as _};

use crate::database::{Lock, Tx};
use crate::digest::{Digest, hex};
use crate::error::{LibraryError, Result};
use crate::ids::random;
use crate::owner::Owner;
use crate::photo::of_names;
use crate::string_enum::string_enum;
use crate::{Library, Millis};

/// Webhooks of one owner, and those for all photos, besides the configuration's.
pub const MAX_WEBHOOKS: u64 = 16;

string_enum! {
    /// What happened.
    pub enum EventType {
        /// A photo is made.
        PhotoDone = "photo.done",
        /// A photo cannot be made.
        PhotoFailed = "photo.failed",
        /// A photo is deleted, by a caller or by retention.
        PhotoDeleted = "photo.deleted",
        /// An export or a film is written.
        ExportDone = "export.done",
        /// An export or a film cannot be written.
        ExportFailed = "export.failed",
        /// Someone publishes in a room.
        RoomStarted = "room.started",
        /// A room's publisher has left for good.
        RoomEnded = "room.ended",
        /// Somebody tests a webhook; no webhook has to ask for it.
        Ping = "ping",
    }
}

impl EventType {
    /// All that a webhook can ask for.
    pub const ALL: [Self; 7] =
        [Self::PhotoDone, Self::PhotoFailed, Self::PhotoDeleted, Self::ExportDone, Self::ExportFailed, Self::RoomStarted, Self::RoomEnded];

    /// The event of [`Self::ALL`] with this name.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|event| event.name() == name)
    }
}

/// A webhook.
#[derive(Clone, PartialEq, Eq)]
pub struct Webhook {
    /// Its id.
    pub id: String,
    /// Whose photos it is told of; `None` for all photos and rooms.
    pub owner: Option<Owner>,
    /// Whether it is from the configuration.
    pub configured: bool,
    /// Where events go.
    pub url: String,
    /// The secret that signs them, as text.
    pub secret: String,
    /// The events that it asks for.
    pub events: Vec<EventType>,
    /// When it was added.
    pub created_at: Millis,
    /// Since when and why it gets no events; `None` if it does.
    pub disabled: Option<Disabled>,
    /// Since when every attempt has failed.
    pub failing_since: Option<Millis>,
}

/// Since when and why a webhook gets no events.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Disabled {
    /// Since when.
    pub at: Millis,
    /// Why.
    pub reason: String,
}

impl fmt::Debug for Webhook {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // without the secret
        f.debug_struct("Webhook").field("id", &self.id).field("url", &self.url).field("disabled", &self.disabled).finish_non_exhaustive()
    }
}

impl FromRow<'_, AnyRow> for Webhook {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        let (at, reason): (Option<Millis>, Option<String>) = (row.try_get("disabled_at")?, row.try_get("reason")?);
        Ok(Self {
            id: row.try_get("id")?,
            owner: row.try_get::<Option<_>, _>("owner")?.map(Owner::from_column),
            configured: row.try_get::<i64, _>("configured")? != 0,
            url: row.try_get("url")?,
            secret: row.try_get("secret")?,
            events: of_names(row.try_get("events")?)?,
            created_at: row.try_get("created_at")?,
            disabled: at.map(|at| Disabled { at, reason: reason.unwrap_or_default() }),
            failing_since: row.try_get("failing_since")?,
        })
    }
}

/// Where events go and which.
#[derive(Clone)]
pub struct NewWebhook {
    /// Address.
    pub url: String,
    /// The secret that signs them, as text.
    pub secret: String,
    /// The events.
    pub events: Vec<EventType>,
}

impl fmt::Debug for NewWebhook {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // without the secret
        f.debug_struct("NewWebhook").field("url", &self.url).field("events", &self.events).finish_non_exhaustive()
    }
}

/// A change of a webhook; what is `None` stays.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct WebhookChange {
    /// Where events go.
    pub url: Option<String>,
    /// The events.
    pub events: Option<Vec<EventType>>,
    /// Whether it gets events.
    pub enabled: Option<bool>,
}

fn names_of(events: &[EventType]) -> String {
    events.iter().map(|event| event.name()).collect::<Vec<_>>().join(",")
}

/// Id of a webhook of the configuration: the same address is the same webhook.
fn configured_id(url: &str) -> String {
    format!("wh_{}", Digest::of(url.as_bytes()).as_str().get(..32).unwrap_or_default())
}

const INSERT: &str = "INSERT INTO webhooks (id, owner, configured, url, secret, events, created_at) VALUES ($1, $2, $3, $4, $5, $6, $7)";

impl Library {
    /// Adds a webhook for the photos of an owner, or for all.
    ///
    /// # Errors
    /// [`LibraryError::TooManyWebhooks`].
    pub async fn add_webhook(&self, owner: Option<&Owner>, new: &NewWebhook) -> Result<Webhook> {
        let mut tx = self.database().write().await?;
        if let Some(owner) = owner {
            tx.lock_owner(owner.as_str()).await?;
        }
        tx.lock(Lock::Webhooks).await?;
        let owner = owner.map(Owner::as_str);
        let count = sqlx::query_scalar("SELECT COUNT(*) FROM webhooks WHERE configured = 0 AND COALESCE(owner, '') = $1");
        let count: i64 = count.bind(owner.unwrap_or_default()).fetch_one(tx.connection()).await?;
        if count as u64 >= MAX_WEBHOOKS {
            return Err(LibraryError::TooManyWebhooks { limit: MAX_WEBHOOKS });
        }
        let insert = sqlx::query_as(AssertSqlSafe(format!("{INSERT} RETURNING *"))).bind(format!("wh_{}", hex(&random::<16>()?)));
        let insert = insert.bind(owner).bind(0_i64).bind(&new.url).bind(&new.secret).bind(names_of(&new.events)).bind(tx.now);
        let webhook = insert.fetch_one(tx.connection()).await?;
        tx.commit().await?;
        Ok(webhook)
    }

    /// Makes the webhooks of the configuration those of the library. One that was disabled stays so while its address does.
    pub async fn configure_webhooks(&self, all: &[NewWebhook]) -> Result<()> {
        let mut tx = self.database().write().await?;
        tx.lock(Lock::Webhooks).await?;
        let ids: Vec<String> = all.iter().map(|webhook| configured_id(&webhook.url)).collect();
        let before: Vec<String> = sqlx::query_scalar("SELECT id FROM webhooks WHERE configured = 1").fetch_all(tx.connection()).await?;
        for id in before.iter().filter(|id| !ids.contains(id)) {
            remove(&mut tx, id).await?;
        }
        for (id, webhook) in ids.into_iter().zip(all) {
            let insert = format!("{INSERT} ON CONFLICT (id) DO UPDATE SET secret = excluded.secret, events = excluded.events");
            let insert = sqlx::query(AssertSqlSafe(insert)).bind(id).bind(None::<String>).bind(1_i64).bind(&webhook.url);
            let insert = insert.bind(&webhook.secret).bind(names_of(&webhook.events)).bind(tx.now);
            insert.execute(tx.connection()).await?;
        }
        tx.commit().await
    }

    /// The webhooks of an owner, or all with `None`, oldest first.
    pub async fn webhooks(&self, owner: Option<&Owner>) -> Result<Vec<Webhook>> {
        let select = sqlx::query_as("SELECT * FROM webhooks WHERE $1 = '' OR owner = $1 ORDER BY created_at, id");
        Ok(select.bind(owner.map_or("", Owner::as_str)).fetch_all(self.database().reader()).await?)
    }

    /// A webhook.
    ///
    /// # Errors
    /// [`LibraryError::NotFound`].
    pub async fn webhook(&self, id: &str) -> Result<Webhook> {
        read_webhook(self.database().reader(), id).await?.ok_or(LibraryError::NotFound("webhook"))
    }

    /// Changes a webhook. One that is disabled fails its pending deliveries.
    ///
    /// # Errors
    /// [`LibraryError::NotFound`].
    pub async fn change_webhook(&self, id: &str, change: &WebhookChange) -> Result<Webhook> {
        let mut tx = self.database().write().await?;
        match change.enabled {
            Some(true) => {
                let enable = "UPDATE webhooks SET disabled_at = NULL, reason = NULL, failing_since = NULL WHERE id = $1";
                sqlx::query(enable).bind(id).execute(tx.connection()).await?;
            }
            Some(false) => disable(&mut tx, id, "a caller disabled it").await?,
            None => {}
        }
        let update = "UPDATE webhooks SET url = COALESCE($1, url), events = COALESCE($2, events) WHERE id = $3 RETURNING *";
        let update = sqlx::query_as(update).bind(&change.url).bind(change.events.as_deref().map(names_of)).bind(id);
        let webhook = update.fetch_optional(tx.connection()).await?.ok_or(LibraryError::NotFound("webhook"))?;
        tx.commit().await?;
        Ok(webhook)
    }

    /// Removes a webhook and its deliveries; false if it does not exist.
    pub async fn remove_webhook(&self, id: &str) -> Result<bool> {
        let mut tx = self.database().write().await?;
        let removed = remove(&mut tx, id).await?;
        tx.commit().await?;
        Ok(removed)
    }
}

pub(crate) async fn read_webhook<'c>(on: impl Executor<'c, Database = Any>, id: &str) -> Result<Option<Webhook>> {
    Ok(sqlx::query_as("SELECT * FROM webhooks WHERE id = $1").bind(id).fetch_optional(on).await?)
}

async fn remove(tx: &mut Tx, id: &str) -> Result<bool> {
    sqlx::query("DELETE FROM deliveries WHERE webhook = $1").bind(id).execute(tx.connection()).await?;
    let delete = sqlx::query("DELETE FROM webhooks WHERE id = $1").bind(id);
    Ok(delete.execute(tx.connection()).await?.rows_affected() > 0)
}

/// Disables a webhook, and fails its pending deliveries.
pub(crate) async fn disable(tx: &mut Tx, id: &str, reason: &str) -> Result<()> {
    let update = sqlx::query("UPDATE webhooks SET disabled_at = $1, reason = $2 WHERE id = $3 AND disabled_at IS NULL").bind(tx.now);
    update.bind(reason).bind(id).execute(tx.connection()).await?;
    let fail =
        "UPDATE deliveries SET state = 'failed', lease_until = NULL, ended_at = $1, error = $2 WHERE webhook = $3 AND state = 'pending'";
    let fail = sqlx::query(fail).bind(tx.now).bind(format!("the webhook was disabled: {reason}")).bind(id);
    fail.execute(tx.connection()).await?;
    Ok(())
}
