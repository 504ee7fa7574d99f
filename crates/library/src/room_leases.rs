//! Leases of rooms by nodes.

use std::time::Duration;

use sqlx::Row as _;

use crate::database::{Tx, is_held};
use crate::deliveries::{EventData, announce};
use crate::error::Result;
use crate::webhooks::EventType;
use crate::{Library, millis};

/// Time after the end of a lease after which its node has died, and no publisher comes back to the room.
const ABANDONED: Duration = Duration::from_mins(1);

/// The node that has a room.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Origin {
    /// URL at which other nodes subscribe to it.
    pub address: String,
    /// Grows whenever another node takes the room: the higher epoch wins. It also grows if the room's row was removed meanwhile.
    pub epoch: i64,
}

impl Library {
    /// Claims a room for the node at `address`, for `lasts`; takes it over from another node.
    pub async fn claim_room(&self, room: &str, address: &str, lasts: Duration) -> Result<Origin> {
        let mut tx = self.database().write().await?;
        let insert =
            "INSERT INTO rooms (name, origin, epoch, lease_until, live) VALUES ($1, $2, $4, $3, 0) ON CONFLICT (name) DO UPDATE SET
            origin = excluded.origin, lease_until = excluded.lease_until,
            epoch = CASE WHEN excluded.epoch > rooms.epoch THEN excluded.epoch ELSE rooms.epoch + 1 END RETURNING epoch";
        let insert = sqlx::query(insert).bind(room.to_owned()).bind(address.to_owned()).bind(tx.now + millis(lasts)).bind(tx.now);
        let row = insert.fetch_one(tx.connection()).await?;
        start(&mut tx, room).await?;
        tx.commit().await?;
        Ok(Origin { address: address.to_owned(), epoch: row.try_get("epoch")? })
    }

    /// Renews the lease of a room.
    ///
    /// # Errors
    /// [`LibraryError::LeaseLost`](crate::LibraryError::LeaseLost) if another node has taken it.
    pub async fn renew_room(&self, room: &str, origin: &Origin, lasts: Duration) -> Result<()> {
        let mut tx = self.database().write().await?;
        set(&mut tx, room, origin, millis(lasts)).await?;
        tx.commit().await
    }

    /// Releases a room at once.
    ///
    /// # Errors
    /// As [`Library::renew_room`].
    pub async fn release_room(&self, room: &str, origin: &Origin) -> Result<()> {
        let mut tx = self.database().write().await?;
        set(&mut tx, room, origin, 0).await?;
        end(&mut tx, room).await?;
        tx.commit().await
    }

    /// Tells webhooks that someone publishes in a room of a node that shares its rooms with no other; such rooms have no leases.
    pub async fn start_room(&self, room: &str) -> Result<()> {
        let mut tx = self.database().write().await?;
        let insert = "INSERT INTO rooms (name, origin, epoch, lease_until, live) VALUES ($1, '', $2, 0, 0)
            ON CONFLICT (name) DO UPDATE SET origin = excluded.origin";
        sqlx::query(insert).bind(room.to_owned()).bind(tx.now).execute(tx.connection()).await?;
        start(&mut tx, room).await?;
        tx.commit().await
    }

    /// Tells webhooks that the publisher of such a room has left for good.
    pub async fn end_room(&self, room: &str) -> Result<()> {
        let mut tx = self.database().write().await?;
        end(&mut tx, room).await?;
        tx.commit().await
    }

    /// The node that has a room, if any.
    pub async fn room(&self, room: &str) -> Result<Option<Origin>> {
        let now = self.database().now().await?;
        let select = sqlx::query("SELECT origin, epoch FROM rooms WHERE name = $1 AND lease_until > $2").bind(room.to_owned()).bind(now);
        let row = select.fetch_optional(self.database().reader()).await?;
        row.map(|row| Ok(Origin { address: row.try_get("origin")?, epoch: row.try_get("epoch")? })).transpose()
    }
}

/// Sets how long a lease lasts from now.
async fn set(tx: &mut Tx, room: &str, origin: &Origin, lasts: i64) -> Result<()> {
    let update = sqlx::query("UPDATE rooms SET lease_until = $1 WHERE name = $2 AND epoch = $3").bind(tx.now + lasts);
    is_held(&update.bind(room.to_owned()).bind(origin.epoch).execute(tx.connection()).await?)
}

/// Announces that a room is live, unless it was.
async fn start(tx: &mut Tx, room: &str) -> Result<()> {
    let update = sqlx::query("UPDATE rooms SET live = 1 WHERE name = $1 AND live = 0").bind(room.to_owned());
    if update.execute(tx.connection()).await?.rows_affected() == 0 {
        return Ok(());
    }
    announce(tx, EventType::RoomStarted, None, &EventData::of_room(room)).await
}

/// Announces that a room is live no more, unless it was not.
async fn end(tx: &mut Tx, room: &str) -> Result<()> {
    let update = sqlx::query("UPDATE rooms SET live = 0 WHERE name = $1 AND live = 1").bind(room.to_owned());
    if update.execute(tx.connection()).await?.rows_affected() == 0 {
        return Ok(());
    }
    announce(tx, EventType::RoomEnded, None, &EventData::of_room(room)).await
}

/// Ends all rooms. Only for a process that is alone.
pub(crate) async fn end_all(tx: &mut Tx) -> Result<()> {
    end_of(tx, "SELECT name FROM rooms WHERE live = 1 AND lease_until < $1", i64::MAX).await
}

/// Ends the rooms of nodes that have died.
pub(crate) async fn end_abandoned(tx: &mut Tx) -> Result<()> {
    let until = tx.now - millis(ABANDONED);
    end_of(tx, "SELECT name FROM rooms WHERE live = 1 AND origin <> '' AND lease_until <= $1", until).await
}

async fn end_of(tx: &mut Tx, select: &'static str, until: i64) -> Result<()> {
    for row in sqlx::query(select).bind(until).fetch_all(tx.connection()).await? {
        end(tx, &row.try_get::<String, _>("name")?).await?;
    }
    Ok(())
}
