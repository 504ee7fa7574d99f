//! How old things are, by the store's own clock: that of the node that took a photo, and that of the one that sweeps, may each be wrong.

use std::io;

use serde::{Deserialize, Serialize};

use super::ports::{Blobs, Ledger};
use super::records::{self, VERSION};
use super::{Cluster, index};
use crate::server::id::PhotoId;
use crate::server::part::Part;
use crate::server::time::wall_ms;

/// Record that is written to see which time the store says it was written at: [`Swept`].
const SWEPT: &str = "clock/swept";
/// The same of who audits.
const AUDITED: &str = "clock/audited";
/// Digits of the time that begins the name of a making, in milliseconds since 1970.
const TIME: usize = 13;

/// When old photos were looked for last.
#[derive(Debug, Serialize, Deserialize)]
struct Swept {
    /// [`VERSION`].
    version: u32,
    /// By a clock that is believed, milliseconds since 1970; none before any photo.
    at_ms: Option<u64>,
}

/// The time that the name of a making begins with, by the clock of the node that made it.
pub fn making_ms(making: &str) -> Option<u64> {
    making.get(..TIME)?.parse().ok()
}

/// What the store's clock says now, in milliseconds since 1970; what this machine's does where the store does not tell.
///
/// # Errors
/// The store cannot be reached.
pub fn audit_ms(blobs: &dyn Blobs, ledger: &dyn Ledger) -> io::Result<u64> {
    blobs.put(AUDITED, format!("{{\"version\": {VERSION}}}").into_bytes())?;
    Ok(ledger.written(AUDITED)?.unwrap_or_else(wall_ms))
}

impl Cluster {
    /// What the store's clock says now, in milliseconds since 1970. Keeps `latest_ms`, the latest time that is known to have been.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn now_ms(&self, latest_ms: Option<u64>) -> io::Result<u64> {
        let swept = serde_json::to_vec(&Swept { version: VERSION, at_ms: latest_ms })?;
        self.heard(self.blobs.put(SWEPT, swept))?;
        Ok(self.heard(self.ledger.written(SWEPT))?.unwrap_or_else(wall_ms))
    }

    /// The latest time that is known to have been: of the last sweep, or else of the newest photo, which has that of the node that took it.
    ///
    /// # Errors
    /// The store cannot be reached, or the record is not understood.
    pub fn latest_ms(&self) -> io::Result<Option<u64>> {
        if let Some((bytes, _)) = self.heard(self.ledger.get(SWEPT))?
            && let Swept { at_ms: Some(at_ms), .. } = records::read(SWEPT, &bytes)?
        {
            return Ok(Some(at_ms));
        }
        let newest = self.heard(self.ledger.page(index::ALL, None, 1))?;
        Ok(newest.first().and_then(|name| index::Listed::read(name)).map(|newest| newest.place.0))
    }

    /// When a photo was accepted by the store's clock, where it is known here: later than its record says where that of the node that took it
    /// was behind, by as much as the upload's name is behind when it was written.
    ///
    /// # Errors
    /// The store cannot be reached.
    pub fn accepted_ms(&self, id: PhotoId) -> io::Result<Option<u64>> {
        let Some(photo) = self.known().get(&id).map(|known| known.photo.clone()) else { return Ok(None) };
        let written = self.heard(self.ledger.written(&records::blob(id, &photo.source, Part::Upload)))?;
        let behind = written.zip(making_ms(&photo.source)).map_or(0, |(written, named)| written.saturating_sub(named));
        Ok(Some(photo.accepted.at_ms.saturating_add(behind)))
    }
}
