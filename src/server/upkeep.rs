//! What a server does by itself: it looks whether its library can be written, and has deleted what is over and checked what was made.

use std::time::Duration;

use tmpi_library::{Event, LibraryError};

use super::app::App;

/// Pause between two looks at the library, and while something is amiss: photos are made as soon as it is mended.
const PROBE: Duration = Duration::from_secs(2);
const PROBE_AMISS: Duration = Duration::from_millis(500);
/// The same of an object store, where each look costs.
const PROBE_OBJECTS: Duration = Duration::from_secs(30);
/// The first sweep after a start.
const FIRST_SWEEP: Duration = Duration::from_mins(1);
/// Pause where no photo is due for a check.
const NONE_DUE: Duration = Duration::from_mins(5);

/// Looks now and then whether the library can be written and nothing is missing to make photos with, so that asking for it costs nothing.
/// Where the disk is full, what is kept there of derived files goes first.
pub async fn probe(app: App, has_objects: bool) {
    let usual = if has_objects { PROBE_OBJECTS } else { PROBE };
    loop {
        let trouble = match app.library.check().await {
            Ok(()) => app.maker.lacks(),
            Err(LibraryError::StorageFull) => {
                app.free_disk().await;
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

/// Has deleted what is over, again and again.
pub async fn sweep(app: App) {
    let usual = app.limits.retain_sweep.min(app.limits.exports.keep);
    let mut pause = FIRST_SWEEP.min(usual);
    loop {
        tokio::time::sleep(pause).await;
        pause = usual;
        match app.library.sweep().await {
            Ok(swept) => {
                app.telemetry.swept(&swept);
                if swept.by_age + swept.by_room > 0 {
                    tracing::info!(by_age = swept.by_age, by_room = swept.by_room, bytes = swept.bytes, "photos have gone by themselves");
                }
            }
            Err(error) => tracing::warn!(%error, "what is over stays until the next sweep"),
        }
        match app.library.gc_if_due().await {
            Ok(Some(gone)) => tracing::info!(blobs = gone.blobs, bytes = gone.bytes, "orphaned blobs are removed"),
            Ok(None) => {}
            Err(error) => tracing::warn!(%error, "orphaned blobs stay until tomorrow"),
        }
    }
}

/// Checks what was made of each photo now and then, so that damage is known before somebody asks for it.
pub async fn look_over(app: App) {
    tokio::time::sleep(app.limits.look_over_first).await;
    loop {
        let pause = match app.library.check_next(app.limits.look_over).await {
            Ok(Some(photo)) => Duration::from_secs_f64(photo.bytes as f64 / app.limits.look_over_rate as f64),
            Ok(None) => NONE_DUE.min(app.limits.look_over),
            Err(error) => {
                tracing::warn!(%error, "a photo cannot be checked now");
                PROBE
            }
        };
        tokio::time::sleep(pause).await;
    }
}

/// Frees what is kept of photos that are deleted, at whichever node.
pub async fn forget(app: App) {
    let mut events = app.library.subscribe();
    while let Some(event) = events.next().await {
        if let Event::Deleted(photo) = event {
            app.forget(photo).await;
        }
    }
}
