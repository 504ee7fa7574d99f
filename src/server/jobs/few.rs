//! No more photos than are worth their memory, where a store has any number: what nobody needs now is read again when somebody asks for it.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::Jobs;
use crate::server::cluster::Cluster;
use crate::server::entry::{Entry, Status};
use crate::server::id::PhotoId;

/// Part of those that may be kept which goes at a time, so that they are not looked through for each.
const PART: usize = 16;

impl Jobs {
    /// True where the index has a photo; that is not to ask for it.
    #[cfg(test)]
    pub(in crate::server) fn has(&self, id: PhotoId) -> bool {
        self.lock().by_id.contains_key(&id)
    }

    /// True where a photo may wait that is not among those that do: it is not known here, or there was no place for it.
    pub(in crate::server) fn is_left_over(&self, id: PhotoId) -> bool {
        let inner = self.lock();
        inner.by_id.get(&id).is_none_or(|entry| inner.is_waiting(entry) && !inner.queue.has(id))
    }

    /// Somebody asks for a photo.
    pub(super) fn is_asked_for(&self, entry: &Entry) {
        entry.asked_for(self.asked.fetch_add(1, Ordering::Relaxed));
    }

    /// Where there are more than [`crate::server::Limits::known_photos`], lets go of those that were asked for least recently. Those stay that wait
    /// in a place here or are made, that somebody follows, and that a request has in its hands: of whatever is done with them all see the same.
    pub(in crate::server) fn let_go(&self, cluster: &Cluster) {
        for id in self.idle_beyond(self.limits.known_photos) {
            cluster.let_go(id, || self.drop_idle(id));
        }
    }

    /// Photos that may go, where there are more than `most`.
    fn idle_beyond(&self, most: usize) -> Vec<PhotoId> {
        let inner = self.lock();
        let there = inner.by_id.len();
        if there <= most {
            return Vec::new();
        }
        let mut idle: Vec<(u64, PhotoId)> =
            inner.by_id.values().filter(|entry| is_idle(entry)).map(|entry| (entry.last_asked(), entry.id)).collect();
        drop(inner);
        let goes = there - (most - most / PART);
        if goes < idle.len() {
            idle.select_nth_unstable(goes);
            idle.truncate(goes);
        }
        idle.into_iter().map(|(_, id)| id).collect()
    }

    /// Takes a photo out of the index unless somebody needs it by now; true where it is gone.
    fn drop_idle(&self, id: PhotoId) -> bool {
        let _membership = self.membership();
        let mut inner = self.lock();
        let idle = inner.by_id.get(&id).filter(|entry| is_idle(entry)).cloned();
        let Some(entry) = idle else { return false };
        inner.remove(&entry);
        entry.count_out();
        true
    }
}

/// True for a photo that has ended or waits, and that nobody but the index has, the queue and the threads neither, with the lock on that held:
/// nobody gets at it meanwhile.
fn is_idle(entry: &Arc<Entry>) -> bool {
    let of_index = 2 + usize::from(entry.accepted.owner.is_some());
    let may_go = |status: &Status| status.is_final() || *status == Status::Queued;
    Arc::strong_count(entry) == of_index && !entry.is_followed() && may_go(&entry.status())
}
