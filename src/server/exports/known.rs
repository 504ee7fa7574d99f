//! Files that were ordered, with running counts: nobody goes through all of them for each that comes or goes.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::{Ordered, Standing};
use crate::server::id::PhotoId;

/// As many files are kept at most, however small they are: each counts at least this share of the room.
const MOST_FILES: u64 = 1024;
/// Files that could not be written of which the reason is kept.
pub const MOST_FAILED: usize = 256;

/// Files by photo and key.
#[derive(Debug)]
pub struct Known {
    files: HashMap<(PhotoId, String), Arc<Ordered>>,
    /// What one weighs at least.
    least: u64,
    /// Those that wait.
    pub queued: usize,
    /// Those that failed.
    failed: usize,
    /// Bytes on disk.
    pub bytes: u64,
    /// What they weigh.
    pub weight: u64,
}

impl Known {
    /// None, of which `most` bytes may be on disk.
    pub fn of(most: u64) -> Self {
        Self { files: HashMap::new(), least: most / MOST_FILES, queued: 0, failed: 0, bytes: 0, weight: 0 }
    }

    /// What a file of so many bytes weighs.
    pub fn weight_of(&self, bytes: u64) -> u64 {
        bytes.max(self.least)
    }

    pub fn get(&self, name: &(PhotoId, String)) -> Option<&Arc<Ordered>> {
        self.files.get(name)
    }

    /// Whether it is this one that is known by its name, not another.
    pub fn has(&self, file: &Arc<Ordered>) -> bool {
        self.files.get(&file.name()).is_some_and(|known| Arc::ptr_eq(known, file))
    }

    pub fn values(&self) -> impl Iterator<Item = &Arc<Ordered>> {
        self.files.values()
    }

    fn count(&mut self, file: &Ordered) {
        match &*file.lock() {
            Standing::Queued => self.queued += 1,
            Standing::Working => {}
            Standing::Done(record) => {
                self.bytes += record.bytes;
                self.weight += self.weight_of(record.bytes);
            }
            Standing::Failed(_) => self.failed += 1,
        }
    }

    fn discount(&mut self, file: &Ordered) {
        match &*file.lock() {
            Standing::Queued => self.queued -= 1,
            Standing::Working => {}
            Standing::Done(record) => {
                self.bytes -= record.bytes;
                self.weight -= self.weight_of(record.bytes);
            }
            Standing::Failed(_) => self.failed -= 1,
        }
    }

    /// Adds one, in place of another of its name.
    pub fn insert(&mut self, file: Arc<Ordered>) {
        self.count(&file);
        if let Some(before) = self.files.insert(file.name(), file) {
            self.discount(&before);
        }
    }

    /// Removes this one; false where it is not known.
    pub fn remove(&mut self, file: &Arc<Ordered>) -> bool {
        let known = self.has(file);
        if known {
            self.files.remove(&file.name());
            self.discount(file);
        }
        known
    }

    /// Says how one fares, which need not be known any more.
    pub fn set(&mut self, file: &Arc<Ordered>, standing: Standing) {
        let known = self.has(file);
        if known {
            self.discount(file);
        }
        file.set(standing);
        if known {
            self.count(file);
        }
        // what fails again and again is not remembered without end
        while self.failed > MOST_FAILED
            && let Some(oldest) = self.oldest(|standing| matches!(standing, Standing::Failed(_)))
        {
            self.remove(&oldest);
        }
    }

    /// That of such a standing which was not asked for for longest.
    pub fn oldest(&self, of: impl Fn(&Standing) -> bool) -> Option<Arc<Ordered>> {
        let such = self.files.values().filter(|file| of(&file.lock()));
        such.min_by_key(|file| file.used_ms.load(Ordering::Relaxed)).cloned()
    }
}
