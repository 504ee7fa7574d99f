//! The lease by which the library records a room's origin: the node to which its publisher is connected.
//!
//! A publisher that connects to another node takes the room there at once, with a higher epoch; the lease only limits how long a dead node
//! stays the origin. It uses the database's clock, never a node's.

use std::time::Duration;

use tmpi_library::{Library, LibraryError, Origin};
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

use super::origin_client::Nodes;

/// Duration of a lease, and the interval of its renewal.
const LEASE: Duration = Duration::from_secs(5);
const RENEW: Duration = Duration::from_secs(1);

impl Nodes {
    /// Claims a room for this node; takes it over from another node.
    pub async fn claim(&self, room: &str) -> Result<Lease, LibraryError> {
        let origin = self.library.claim_room(room, &self.address.url, LEASE).await?;
        let (library, room, lost) = (self.library.clone(), room.to_owned(), CancellationToken::new());
        let renewal = tokio::spawn(renew(library.clone(), room.clone(), origin.clone(), lost.clone()));
        Ok(Lease { library, room, origin, lost, renewal: AbortOnDropHandle::new(renewal) })
    }

    /// The other node that has a room, if any.
    pub async fn origin(&self, room: &str) -> Result<Option<Origin>, LibraryError> {
        Ok(self.library.room(room).await?.filter(|origin| origin.address != self.address.url))
    }
}

/// Renews the lease of a room until it is lost.
async fn renew(library: Library, room: String, origin: Origin, lost: CancellationToken) {
    loop {
        sleep(RENEW).await;
        match library.renew_room(&room, &origin, LEASE).await {
            Ok(()) => {}
            Err(LibraryError::LeaseLost) => return lost.cancel(),
            // keep the room: other nodes only take it over for a publisher
            Err(error) => tracing::warn!(%error, room, "cannot renew the lease of a room"),
        }
    }
}

/// This node's lease of a room.
pub struct Lease {
    library: Library,
    room: String,
    origin: Origin,
    /// Set when another node has taken it.
    lost: CancellationToken,
    renewal: AbortOnDropHandle<()>,
}

impl Lease {
    /// The epoch: higher than that of the room's previous node. It is the database's time in milliseconds, which grows faster than the
    /// epochs that changes of the pictures' size begin.
    pub const fn epoch(&self) -> u64 {
        self.origin.epoch.cast_unsigned()
    }

    /// Releases the room, unless another node has taken it.
    pub async fn release(self) {
        self.renewal.abort();
        match self.library.release_room(&self.room, &self.origin).await {
            Ok(()) | Err(LibraryError::LeaseLost) => {}
            Err(error) => tracing::warn!(%error, room = self.room, "cannot release a room"),
        }
    }
}

/// Completes when the lease is lost; never without one.
pub async fn lost(lease: Option<&Lease>) {
    match lease {
        Some(lease) => lease.lost.cancelled().await,
        None => std::future::pending().await,
    }
}
