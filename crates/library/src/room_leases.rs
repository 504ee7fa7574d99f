//! Leases of rooms by nodes.

use std::time::Duration;

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
        let insert = sqlx::query_scalar(insert).bind(room).bind(address).bind(tx.now + millis(lasts)).bind(tx.now);
        let epoch = insert.fetch_one(tx.connection()).await?;
        set_live(&mut tx, room, true).await?;
        tx.commit().await?;
        Ok(Origin { address: address.to_owned(), epoch })
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
    pub async fn release_room(&self, room: &str, origin: &Origin) -> Result<()> {
        let mut tx = self.database().write().await?;
        set(&mut tx, room, origin, 0).await?;
        set_live(&mut tx, room, false).await?;
        tx.commit().await
    }

    /// Tells webhooks that someone publishes in a room of a node that shares its rooms with no other; such rooms have no leases.
    pub async fn start_room(&self, room: &str) -> Result<()> {
        let mut tx = self.database().write().await?;
        let insert = "INSERT INTO rooms (name, origin, epoch, lease_until, live) VALUES ($1, '', $2, 0, 0)
            ON CONFLICT (name) DO UPDATE SET origin = excluded.origin";
        sqlx::query(insert).bind(room).bind(tx.now).execute(tx.connection()).await?;
        set_live(&mut tx, room, true).await?;
        tx.commit().await
    }

    /// Tells webhooks that the publisher of such a room has left for good.
    pub async fn end_room(&self, room: &str) -> Result<()> {
        let mut tx = self.database().write().await?;
        set_live(&mut tx, room, false).await?;
        tx.commit().await
    }

    /// The node that has a room, if any.
    pub async fn room(&self, room: &str) -> Result<Option<Origin>> {
        let now = self.database().now().await?;
        let select = sqlx::query_as("SELECT origin, epoch FROM rooms WHERE name = $1 AND lease_until > $2").bind(room).bind(now);
        let found: Option<(String, i64)> = select.fetch_optional(self.database().reader()).await?;
        Ok(found.map(|(address, epoch)| Origin { address, epoch }))
    }
}

/// Sets how long a lease lasts from now.
async fn set(tx: &mut Tx, room: &str, origin: &Origin, lasts: i64) -> Result<()> {
    let update = sqlx::query("UPDATE rooms SET lease_until = $1 WHERE name = $2 AND epoch = $3").bind(tx.now + lasts);
    is_held(&update.bind(room).bind(origin.epoch).execute(tx.connection()).await?)
}

/// Announces that a room is live, or live no more, unless that is known.
async fn set_live(tx: &mut Tx, room: &str, live: bool) -> Result<()> {
    let event = if live { EventType::RoomStarted } else { EventType::RoomEnded };
    let update = sqlx::query("UPDATE rooms SET live = $1 WHERE name = $2 AND live <> $1").bind(i64::from(live)).bind(room);
    if update.execute(tx.connection()).await?.rows_affected() == 0 {
        return Ok(());
    }
    announce(tx, event, None, &EventData::of_room(room)).await
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
    let rooms: Vec<String> = sqlx::query_scalar(select).bind(until).fetch_all(tx.connection()).await?;
    for room in rooms {
        set_live(tx, &room, false).await?;
    }
    Ok(())
}
