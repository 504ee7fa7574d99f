//! Background tasks of a server: check that the library is writable, delete expired photos, and check stored files.

use std::time::Duration;

use tmpi_library::{Event, LibraryError};

use super::app_state::App;

/// Interval of the checks, and the shorter one during a fault: photos are made as soon as it is fixed.
const PROBE: Duration = Duration::from_secs(2);
const PROBE_AMISS: Duration = Duration::from_millis(500);
/// The same for an object store, where each check costs money.
const PROBE_OBJECTS: Duration = Duration::from_secs(30);
/// Time of the first sweep after the start.
const FIRST_SWEEP: Duration = Duration::from_mins(1);
/// Pause if no photo is due for a check.
const NONE_DUE: Duration = Duration::from_mins(5);

/// Checks periodically that the library is writable and that nothing is missing to make photos, so that requests can read the result. On a
/// full disk it first drops derived files.
pub async fn probe(app: App, has_objects: bool) {
    let usual = if has_objects { PROBE_OBJECTS } else { PROBE };
    loop {
        let trouble = match app.library.check().await {
            Ok(()) => app.maker.lacks(),
            Err(LibraryError::StorageFull) => {
                app.free_temp_space().await;
                Some("the data directory has no room left")
            }
            Err(error) => {
                tracing::warn!(%error, "the library");
                Some("the library cannot be written")
            }
        };
        app.set_storage(trouble);
        tokio::time::sleep(if trouble.is_some() { PROBE_AMISS } else { usual }).await;
    }
}

/// Applies retention and deletes orphaned blobs periodically.
pub async fn sweep(app: App) {
    let usual = app.limits.retain_sweep.min(app.limits.exports.keep);
    let mut pause = FIRST_SWEEP.min(usual);
    loop {
        tokio::time::sleep(pause).await;
        pause = usual;
        match app.library.sweep().await {
            Ok(swept) => {
                app.telemetry.swept(&swept);
                if swept.by_age + swept.by_space > 0 {
                    tracing::info!(by_age = swept.by_age, by_space = swept.by_space, bytes = swept.bytes, "retention deleted photos");
                }
            }
            Err(error) => tracing::warn!(%error, "cannot apply retention; the next sweep retries"),
        }
        match app.library.gc_if_due().await {
            Ok(Some(gone)) => tracing::info!(blobs = gone.blobs, bytes = gone.bytes, "deleted orphaned blobs"),
            Ok(None) => {}
            Err(error) => tracing::warn!(%error, "cannot delete orphaned blobs; retrying tomorrow"),
        }
    }
}

/// Checks the stored files of photos periodically, to find damage before a client does.
pub async fn verify_photos(app: App) {
    tokio::time::sleep(app.limits.verify_first).await;
    loop {
        let pause = match app.library.verify_next(app.limits.verify_interval).await {
            Ok(Some(photo)) => Duration::from_secs_f64(photo.bytes as f64 / app.limits.verify_rate as f64),
            Ok(None) => NONE_DUE.min(app.limits.verify_interval),
            Err(error) => {
                tracing::warn!(%error, "cannot check a photo now");
                PROBE
            }
        };
        tokio::time::sleep(pause).await;
    }
}

/// Drops the cache entries of deleted photos, whichever node deleted them.
pub async fn evict_deleted(app: App) {
    let mut events = app.library.subscribe();
    while let Some(event) = events.next().await {
        if let Event::Deleted(photo) = event {
            app.evict_photo(photo).await;
        }
    }
}
