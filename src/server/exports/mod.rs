//! Files to download that are written as jobs: by threads of their own, in processes that can be ended, and kept on disk until nobody fetches
//! them any more. Which are asked for is known until the server ends; which are written, longer.

mod recipe;
mod shelf;
mod work;
mod write;

use std::collections::HashMap;
use std::fs::File;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::http::StatusCode;

pub use recipe::Recipe;
pub use shelf::Record;
pub use work::{Wanted, start, written};
pub use write::{Drawing, TITLE, Work, late};

use super::app::App;
use super::entry::Entry;
use super::id::PhotoId;
use super::identity;
use super::jobs::Jobs;
use super::limits::Limits;
use super::problem::Problem;
use super::share::{Share, Shares, asker};
use super::store::{Done, Store};
use super::time::now_ms;
use shelf::Shelf;

/// Pause between two looks at what is over.
const SWEEP: Duration = Duration::from_mins(1);

/// How a file fares.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Standing {
    /// It waits.
    Queued,
    /// It is being written.
    Working,
    /// It is on disk.
    Done(Record),
    /// It could not be written.
    Failed(Problem),
}

/// A file that somebody has ordered.
#[derive(Debug)]
pub struct Ordered {
    /// Of which photo.
    pub photo: PhotoId,
    /// Its name among those of the photo.
    pub key: String,
    /// The recipe as text.
    pub recipe: String,
    /// Which making of the photo.
    pub at_ms: u64,
    results: String,
    standing: Mutex<Standing>,
    cancelled: AtomicBool,
    used_ms: AtomicU64,
    /// A place among those that wait.
    share: Mutex<Option<Share>>,
}

impl Ordered {
    fn new(photo: PhotoId, key: &str, record: (&str, &str, u64), standing: Standing) -> Self {
        let (recipe, results, at_ms) = record;
        Self {
            photo,
            key: key.to_owned(),
            recipe: recipe.to_owned(),
            at_ms,
            results: results.to_owned(),
            standing: Mutex::new(standing),
            cancelled: AtomicBool::new(false),
            used_ms: AtomicU64::new(now_ms()),
            share: Mutex::default(),
        }
    }

    /// One that waits, of no photo.
    #[cfg(test)]
    pub fn for_tests(key: &str) -> Self {
        Self::new(PhotoId::of(&[0; 32], None, "", ""), key, ("format=zip", "", 1), Standing::Queued)
    }

    /// How it fares now.
    #[must_use]
    pub fn standing(&self) -> Standing {
        self.standing.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn set(&self, standing: Standing) {
        if standing != Standing::Queued {
            drop(self.share.lock().unwrap_or_else(PoisonError::into_inner).take());
        }
        *self.standing.lock().unwrap_or_else(PoisonError::into_inner) = standing;
    }

    /// True once nobody wants it.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Acquire)
    }

    /// When it goes if nobody fetches it, milliseconds since 1970.
    #[must_use]
    pub fn ends_ms(&self, limits: &Limits) -> u64 {
        self.used_ms.load(Ordering::Relaxed).saturating_add(limits.exports_for.as_millis() as u64)
    }

    /// Whether it is of what the photo is now.
    fn is_of(&self, entry: Option<&Entry>) -> bool {
        entry.is_some_and(|entry| !entry.is_deleted() && entry.done_at() == Some(self.at_ms))
    }
}

/// Files that were ordered, by photo and key.
#[derive(Debug)]
pub struct Exports {
    shelf: Shelf,
    known: Mutex<HashMap<(PhotoId, String), Arc<Ordered>>>,
    shares: Shares,
    /// Held by who puts a file on disk.
    placing: Mutex<()>,
}

impl Exports {
    /// Those of a data directory; blocks.
    #[must_use]
    pub fn open(store: &Store, limits: &Limits) -> Self {
        let (shelf, found) = Shelf::open(store);
        let known = found.into_iter().map(|(photo, key, record)| {
            let names = (record.recipe.clone(), record.results.clone());
            let file = Ordered::new(photo, &key, (&names.0, &names.1, record.at_ms), Standing::Done(record.clone()));
            file.used_ms.store(record.written_ms, Ordering::Relaxed);
            ((photo, key), Arc::new(file))
        });
        Self { known: Mutex::new(known.collect()), shelf, shares: Shares::half_of(limits.exports_waiting), placing: Mutex::default() }
    }

    fn known(&self) -> MutexGuard<'_, HashMap<(PhotoId, String), Arc<Ordered>>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Bytes of files on disk.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        bytes(&self.known())
    }

    /// Keeps what was written of a file; those that were not fetched for longest make room for it.
    fn keep(&self, file: &Arc<Ordered>, written: &[u8], limits: &Limits) -> Result<(), Problem> {
        let (size, most) = (written.len() as u64, limits.exports_bytes);
        if size > most {
            let detail = format!("the file has {size} bytes, and {most} is the limit of all (--exports-mib)");
            return Err(Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "export-too-large", detail));
        }
        let digest = super::store::digest(written);
        let record = Record {
            version: 1,
            at_ms: file.at_ms,
            results: file.results.clone(),
            recipe: file.recipe.clone(),
            etag: format!("\"{}-{}\"", file.key, digest.get(..16).unwrap_or_default()),
            bytes: size,
            written_ms: now_ms(),
        };
        let _placing = self.placing.lock().unwrap_or_else(PoisonError::into_inner);
        self.make_room(most - size);
        self.shelf.put(file.photo, &file.key, written, &record).map_err(|e| Problem::store(&e))?;
        let known = self.known();
        if !known.get(&(file.photo, file.key.clone())).is_some_and(|other| Arc::ptr_eq(other, file)) {
            // cancelled meanwhile: it must not come back with the next start
            self.shelf.remove(file.photo, &file.key);
            return Ok(());
        }
        file.used_ms.store(now_ms(), Ordering::Relaxed);
        file.set(Standing::Done(record));
        Ok(())
    }

    /// Removes files, those first that were not fetched for longest, until all take `most` bytes.
    fn make_room(&self, most: u64) {
        let mut known = self.known();
        while bytes(&known) > most {
            let written = known.values().filter(|f| matches!(f.standing(), Standing::Done(_)));
            let Some(oldest) = written.min_by_key(|f| f.used_ms.load(Ordering::Relaxed)).cloned() else { return };
            known.remove(&(oldest.photo, oldest.key.clone()));
            self.shelf.remove(oldest.photo, &oldest.key);
        }
    }
}

fn bytes(known: &HashMap<(PhotoId, String), Arc<Ordered>>) -> u64 {
    known.values().map(|file| if let Standing::Done(record) = file.standing() { record.bytes } else { 0 }).sum()
}

impl Jobs {
    /// Has a file of a finished photo written, unless it is there or on its way; `results` names that making of the photo. True where it is new.
    ///
    /// # Errors
    /// 503 where as many wait as may, or half of them are of who asks, or the server stops.
    pub fn order(&self, entry: &Entry, done: &Done, results: &str, recipe: &Recipe) -> Result<(Arc<Ordered>, bool), Problem> {
        let text = recipe.text();
        let key = identity::short(&format!("file {results} {text}"));
        let mut known = self.exports.known();
        let name = (entry.id, key);
        if let Some(file) = known.get(&name).filter(|file| !matches!(file.standing(), Standing::Failed(_))) {
            return Ok((Arc::clone(file), false));
        }
        let busy = |detail: &str| Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", detail).retry_after(10));
        if !self.is_accepting() {
            return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "stopping", "the server is stopping").retry_after(10));
        }
        if known.values().filter(|file| file.standing() == Standing::Queued).count() >= self.limits.exports_waiting {
            return busy("as many files wait to be written as may (--exports-waiting)");
        }
        let Some(share) = self.exports.shares.take(asker()) else { return busy("half of the places to wait are of your address already") };
        let file = Arc::new(Ordered::new(entry.id, &name.1, (&text, results, done.at_ms), Standing::Queued));
        *file.share.lock().unwrap_or_else(PoisonError::into_inner) = Some(share);
        known.insert(name, Arc::clone(&file));
        drop(known);
        self.push_file(&file);
        Ok((file, true))
    }

    /// A file that was ordered of what a photo is now, of which `results` names the making and the program; others are forgotten. Blocks.
    #[must_use]
    pub fn ordered(&self, entry: &Entry, results: &str, key: &str) -> Option<Arc<Ordered>> {
        let file = self.exports.known().get(&(entry.id, key.to_owned())).cloned()?;
        if file.is_of(Some(entry)) && file.results == results {
            return Some(file);
        }
        self.forget_file(&file);
        None
    }

    /// Opens a written file, which counts as fetched; none where it is not on disk as it was, and is forgotten. Blocks.
    #[must_use]
    pub fn fetch(&self, file: &Arc<Ordered>) -> Option<(File, Record)> {
        let Standing::Done(record) = file.standing() else { return None };
        file.used_ms.store(now_ms(), Ordering::Relaxed);
        match self.exports.shelf.read(file.photo, &file.key, &record) {
            Ok(opened) => Some((opened, record)),
            Err(error) => {
                tracing::error!(photo = %file.photo, key = file.key, %error, "a written file is damaged; it is written again when it is asked for");
                self.forget_file(file);
                None
            }
        }
    }

    /// Ends and forgets a file; blocks.
    pub fn forget_file(&self, file: &Arc<Ordered>) {
        file.cancelled.store(true, Ordering::Release);
        self.drop_file(file);
        let mut known = self.exports.known();
        let name = (file.photo, file.key.clone());
        if known.get(&name).is_some_and(|other| Arc::ptr_eq(other, file)) {
            known.remove(&name);
            if matches!(file.standing(), Standing::Done(_)) {
                self.exports.shelf.remove(file.photo, &file.key);
            }
        }
    }

    /// Forgets the files for which `is_over` holds; blocks.
    pub fn forget_files(&self, is_over: impl Fn(&Ordered) -> bool) {
        let over: Vec<_> = self.exports.known().values().filter(|file| is_over(file)).cloned().collect();
        for file in &over {
            self.forget_file(file);
        }
    }

    /// Forgets what nobody has fetched for long enough, and what is of photos that are no more, or were made again.
    fn sweep_files(&self) {
        let now = now_ms();
        self.forget_files(|file| {
            // of a store's photos not all are known here
            let entry = self.get(file.photo);
            let stale = !file.is_of(entry.as_deref()) && (entry.is_some() || self.cluster.is_none());
            let over = !matches!(file.standing(), Standing::Queued | Standing::Working) && file.ends_ms(&self.limits) <= now;
            stale || over
        });
    }
}

/// Sweeps now and then, until the server ends.
pub async fn sweep(app: App) {
    loop {
        let shared = Arc::clone(&app);
        if let Err(error) = tokio::task::spawn_blocking(move || shared.jobs.sweep_files()).await {
            tracing::error!(%error, "sweeping written files");
        }
        tokio::time::sleep(SWEEP.min(app.limits.exports_for)).await;
    }
}
