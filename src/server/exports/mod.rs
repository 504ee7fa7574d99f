//! Files to download that are written as jobs: by threads of their own, in processes that can be ended, and kept on disk until nobody fetches
//! them any more. Which are asked for is known until the server ends; which are written, longer.

mod known;
mod recipe;
mod shelf;
#[cfg(test)]
mod tests;
mod work;
mod write;

use std::fs::File;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
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
use known::Known;
use shelf::Shelf;

/// Pause between two looks at what is over.
const SWEEP: Duration = Duration::from_mins(1);
/// How long it is remembered why a file could not be written.
const FAILED_FOR: Duration = Duration::from_mins(10);

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
    /// How often it gave way to a photo while it was being written.
    gave_way: AtomicU32,
    /// A place among those that wait.
    share: Mutex<Option<Share>>,
    /// The photo until this has ended, so that it stays in the index for as long.
    entry: Mutex<Option<Arc<Entry>>>,
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
            gave_way: AtomicU32::new(0),
            share: Mutex::default(),
            entry: Mutex::default(),
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
        self.lock().clone()
    }

    fn lock(&self) -> MutexGuard<'_, Standing> {
        self.standing.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The photo, until this has ended.
    fn entry(&self) -> Option<Arc<Entry>> {
        self.entry.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn name(&self) -> (PhotoId, String) {
        (self.photo, self.key.clone())
    }

    /// By [`Known::set`], which counts.
    fn set(&self, standing: Standing) {
        if standing != Standing::Queued {
            drop(self.share.lock().unwrap_or_else(PoisonError::into_inner).take());
        }
        if matches!(standing, Standing::Done(_) | Standing::Failed(_)) {
            drop(self.entry.lock().unwrap_or_else(PoisonError::into_inner).take());
        }
        if matches!(standing, Standing::Failed(_)) {
            self.used_ms.store(now_ms(), Ordering::Relaxed);
        }
        *self.lock() = standing;
    }

    /// True once nobody wants it.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Acquire)
    }

    /// When it goes if nobody fetches it, milliseconds since 1970.
    #[must_use]
    pub fn ends_ms(&self, limits: &Limits) -> u64 {
        let failed = matches!(*self.lock(), Standing::Failed(_));
        let stays = if failed { limits.exports_for.min(FAILED_FOR) } else { limits.exports_for };
        self.used_ms.load(Ordering::Relaxed).saturating_add(stays.as_millis() as u64)
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
    known: Mutex<Known>,
    shares: Shares,
    /// Held by who puts a file on disk.
    placing: Mutex<()>,
}

impl Exports {
    /// Those of a data directory; blocks.
    #[must_use]
    pub fn open(store: &Store, limits: &Limits) -> Self {
        let (shelf, found) = Shelf::open(store);
        let mut known = Known::of(limits.exports_bytes);
        for (photo, key, record) in found {
            let names = (record.recipe.clone(), record.results.clone());
            let (at_ms, written_ms) = (record.at_ms, record.written_ms);
            let file = Ordered::new(photo, &key, (&names.0, &names.1, at_ms), Standing::Done(record));
            file.used_ms.store(written_ms, Ordering::Relaxed);
            known.insert(Arc::new(file));
        }
        let exports = Self { known: Mutex::new(known), shelf, shares: Shares::half_of(limits.exports_waiting), placing: Mutex::default() };
        // more may have been kept before than may be now
        exports.make_room(limits.exports_bytes);
        exports
    }

    fn known(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Says how a file fares.
    fn set(&self, file: &Arc<Ordered>, standing: Standing) {
        self.known().set(file, standing);
    }

    /// Bytes of files on disk.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.known().bytes
    }

    /// Keeps what was written of a file; those that were not fetched for longest make room for it.
    fn keep(&self, file: &Arc<Ordered>, written: &[u8], store: &Store, limits: &Limits) -> Result<(), Problem> {
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
        let weight = {
            let known = self.known();
            if file.is_cancelled() || !known.has(file) {
                // whoever ordered it anew may have it on disk under this name
                return Ok(());
            }
            known.weight_of(size)
        };
        self.make_room(most.saturating_sub(weight));
        // photos that were accepted already come first
        store.room_for(size).map_err(|e| Problem::store(&e))?;
        self.shelf.put(file.photo, &file.key, written, &record).map_err(|e| Problem::store(&e))?;
        let mut known = self.known();
        if !known.has(file) {
            // cancelled meanwhile: it must not come back with the next start, and no other has put its own there yet
            self.shelf.remove(file.photo, &file.key);
            return Ok(());
        }
        file.used_ms.store(now_ms(), Ordering::Relaxed);
        known.set(file, Standing::Done(record));
        Ok(())
    }

    /// Removes files, those first that were not fetched for longest, until all weigh `most`.
    fn make_room(&self, most: u64) {
        let mut known = self.known();
        while known.weight > most {
            let Some(oldest) = known.oldest(|standing| matches!(standing, Standing::Done(_))) else { return };
            known.remove(&oldest);
            self.shelf.remove(oldest.photo, &oldest.key);
        }
    }
}

impl Jobs {
    /// Has a file of a finished photo written, unless it is there or on its way; `results` names that making of the photo. True where it is new.
    ///
    /// # Errors
    /// 503 where as many wait as may, or half of them are of who asks, or the server stops.
    pub fn order(&self, entry: &Arc<Entry>, done: &Done, results: &str, recipe: &Recipe) -> Result<(Arc<Ordered>, bool), Problem> {
        let text = recipe.text();
        let key = identity::short(&format!("file {results} {text}"));
        let mut known = self.exports.known();
        let name = (entry.id, key);
        if let Some(file) = known.get(&name).filter(|file| !matches!(*file.lock(), Standing::Failed(_))) {
            return Ok((Arc::clone(file), false));
        }
        let busy = |detail: &str| Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", detail).retry_after(10));
        if !self.is_accepting() {
            return Err(Problem::new(StatusCode::SERVICE_UNAVAILABLE, "stopping", "the server is stopping").retry_after(10));
        }
        if known.queued >= self.limits.exports_waiting {
            return busy("as many files wait to be written as may (--exports-waiting)");
        }
        let Some(share) = self.exports.shares.take(asker()) else { return busy("half of the places to wait are of your address already") };
        let file = Arc::new(Ordered::new(entry.id, &name.1, (&text, results, done.at_ms), Standing::Queued));
        *file.share.lock().unwrap_or_else(PoisonError::into_inner) = Some(share);
        *file.entry.lock().unwrap_or_else(PoisonError::into_inner) = Some(Arc::clone(entry));
        known.insert(Arc::clone(&file));
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
        if known.remove(file) && matches!(*file.lock(), Standing::Done(_)) {
            self.exports.shelf.remove(file.photo, &file.key);
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
            let over = !matches!(*file.lock(), Standing::Queued | Standing::Working) && file.ends_ms(&self.limits) <= now;
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
