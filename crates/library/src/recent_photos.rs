//! Rows of photos that were read a moment ago: a viewer asks for several parts of a photo, and many viewers for the same one.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::ids::PhotoId;
use crate::photo::Photo;

/// How long a row is used before it is read again, because another process may have changed it.
const FRESH: Duration = Duration::from_millis(500);
/// Most rows.
const ROWS: usize = 1024;

#[derive(Debug, Default)]
struct Rows {
    by_id: HashMap<PhotoId, (Instant, Photo)>,
    /// Number of changes that this process has made to photos.
    changes: u64,
}

#[derive(Debug, Default)]
pub(crate) struct RecentPhotos(Mutex<Rows>);

impl RecentPhotos {
    fn rows(&self) -> MutexGuard<'_, Rows> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The row of a photo, if it was read a moment ago and has not changed.
    pub fn get(&self, id: PhotoId) -> Option<Photo> {
        let rows = self.rows();
        rows.by_id.get(&id).filter(|(read, _)| read.elapsed() < FRESH).map(|(_, photo)| photo.clone())
    }

    /// Number of changes so far, to be read before the row that is kept.
    pub fn changes(&self) -> u64 {
        self.rows().changes
    }

    /// Keeps a row that was `read` then, unless photos have changed since there were so many `changes`: then it may be of before.
    pub fn keep(&self, photo: &Photo, read: Instant, changes: u64) {
        let mut rows = self.rows();
        if rows.changes != changes {
            return;
        }
        if rows.by_id.len() >= ROWS {
            rows.by_id.clear();
        }
        rows.by_id.insert(photo.id, (read, photo.clone()));
    }

    /// Forgets all photos.
    pub fn clear(&self) {
        let mut rows = self.rows();
        rows.changes += 1;
        rows.by_id.clear();
    }

    /// Forgets a photo that has changed.
    pub fn forget(&self, id: PhotoId) {
        let mut rows = self.rows();
        rows.changes += 1;
        rows.by_id.remove(&id);
    }
}
