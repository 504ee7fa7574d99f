//! Limits the number of concurrent uploads.

use std::sync::atomic::{AtomicUsize, Ordering};

use super::client_slots::{ClientLimits, ClientPermit, client_address};
use super::limits::Limits;

/// Uploads in progress.
#[derive(Debug)]
pub struct UploadSlots {
    count: AtomicUsize,
    beyond: usize,
    shares: ClientLimits,
}

/// Permit for an upload.
pub struct UploadSlot<'a> {
    of: &'a UploadSlots,
    _share: ClientPermit,
}

impl Drop for UploadSlot<'_> {
    fn drop(&mut self) {
        self.of.count.fetch_sub(1, Ordering::AcqRel);
    }
}

impl UploadSlots {
    /// With the limits of a server.
    #[must_use]
    pub fn new(limits: &Limits) -> Self {
        let beyond = limits.uploads_beyond;
        Self { count: AtomicUsize::new(0), beyond, shares: ClientLimits::half_of(limits.queue.saturating_add(beyond)) }
    }

    /// A permit for one more upload if the queue has `free` places. A few are given even if the queue is full, since the photos may be
    /// known. `None` if too many uploads are in progress, or half of them from this address: an upload may take an hour.
    pub fn take(&self, free: usize) -> Option<UploadSlot<'_>> {
        let share = self.shares.take(client_address())?;
        let before = self.count.fetch_add(1, Ordering::AcqRel);
        // dropped if it is refused
        let slot = UploadSlot { of: self, _share: share };
        (before < free.saturating_add(self.beyond)).then_some(slot)
    }
}

#[cfg(test)]
mod tests {
    use super::super::client_slots::CLIENT;
    use super::*;

    #[test]
    fn an_address_may_use_half_of_the_slots() {
        let upload_slots = UploadSlots::new(&Limits { queue: 3, uploads_beyond: 1, ..Limits::default() });
        let ask = |address: Option<&str>| CLIENT.sync_scope(address.map(|a| a.parse().unwrap()), || upload_slots.take(3));
        let slow = (ask(Some("192.0.2.1")), ask(Some("192.0.2.1")));
        assert!(slow.0.is_some() && slow.1.is_some() && ask(Some("192.0.2.1")).is_none(), "a third");
        let others = (ask(Some("192.0.2.2")), ask(None));
        assert!(others.0.is_some() && others.1.is_some() && ask(Some("192.0.2.3")).is_none(), "a fifth");
        drop(others);
        assert!(upload_slots.take(0).is_none() && upload_slots.take(1).is_none() && upload_slots.take(2).is_some());
    }
}
