//! Writes files within limits: memory, time, and as many tries as for a photo.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::http::StatusCode;
use tmpi_library::Photo;
use tokio_util::sync::CancellationToken;

use super::recipe::Recipe;
use super::write::{ExportTask, timeout_problem};
use crate::server::app_state::{App, AppState, DiskFullPolicy, Export, StoredFile};
use crate::server::blocking_pool::WorkClass;
use crate::server::maker::Fault;
use crate::server::memory_budget::Priority;
use crate::server::photo_details::FinishedPhoto;
use crate::server::problem::Problem;
use tmpi_pipeline::{Progress, Sink};

/// Ends the writing of an unwanted file, or at the deadline.
struct Until<'a> {
    unwanted: &'a (dyn Fn() -> bool + Sync),
    deadline: Instant,
}

impl Sink for Until<'_> {
    fn progress(&self, _: &Progress) {}

    fn cancelled(&self) -> bool {
        (self.unwanted)()
    }

    fn deadline(&self) -> Option<Instant> {
        Some(self.deadline)
    }
}

/// Writes a file for a waiting client, with an entity tag that begins with `tag`. Also returns the times of waiting and of writing.
///
/// # Errors
/// 503 if too many wait, and the errors of [`write_export`] and of storing the file.
pub async fn export_for_client(
    app: &App,
    (photo, done): (&Photo, &FinishedPhoto),
    recipe: Recipe,
    tag: String,
) -> Result<(Export, [Duration; 2]), Problem> {
    // cancelled when the client goes away
    let gone = CancellationToken::new();
    let _guard = gone.clone().drop_guard();
    let asked = Instant::now();
    let slot = app.pool.enter(WorkClass::Export, recipe.slot_bytes(done)).await?;
    let waited = asked.elapsed();
    let (container, app, done) = (app.container_of(photo).await?, Arc::clone(app), done.clone());
    let written = slot.run(move || {
        let start = Instant::now();
        let bytes = write_export(&app, &recipe, (&container, &done), Priority::Normal, &|| gone.is_cancelled())?;
        let stored = StoredFile::derived(Some(&tag), bytes, &app.temp_folder(), DiskFullPolicy::Refuse)?;
        Ok::<_, Problem>((Export(stored), [waited, start.elapsed()]))
    });
    written.await?
}

/// Writes a file of `container`; blocks. Normal priority means that a client waits: this process then writes cheap files itself. All others
/// take memory of jobs and, if the maker has those, a child process.
///
/// # Errors
/// 503 if it is `unwanted` or takes too long, 422 after too many crashes, and the errors of writing.
pub fn write_export(
    app: &AppState,
    recipe: &Recipe,
    (container, done): (&[u8], &FinishedPhoto),
    priority: Priority,
    unwanted: &(dyn Fn() -> bool + Sync),
) -> Result<Vec<u8>, Problem> {
    let cancelled = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "cancelled", "the export was cancelled").retry_after(1);
    let sink = Until { unwanted, deadline: Instant::now() + app.limits.exports.timeout };
    let drawing = || Ok(Arc::clone(&app.renderer));
    let task = ExportTask { recipe, container, drawing: &drawing, is_low_priority: priority == Priority::Low };
    let here = priority == Priority::Normal && recipe.is_cheap(done);
    let over = || unwanted() || Instant::now() >= sink.deadline;
    let memory = if here { None } else { app.memory.wait_for(recipe.memory(done), priority, over) };
    if !here && memory.is_none() {
        let busy = "no memory for this file became free within its time limit (limits.job-memory, exports.timeout)";
        let busy = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", busy).retry_after(10);
        return Err(if unwanted() { cancelled() } else { busy() });
    }
    let mut crashed = 0;
    loop {
        let written = if here { task.run(&sink) } else { app.maker.export(&task, &sink) };
        match written {
            Ok(bytes) => return Ok(bytes),
            Err(Fault::Cancelled) if unwanted() => return Err(cancelled()),
            // only its time limit cancelled it
            Err(Fault::Cancelled) => return Err(timeout_problem()),
            Err(Fault::Photo(problem)) => return Err(problem),
            Err(Fault::Server(reason)) => return Err(Problem::internal("exporting a photo", &reason)),
            Err(Fault::Crashed(reason)) => {
                crashed += 1;
                tracing::warn!(crashed, reason, recipe = recipe.text(), "a file crashed the process that wrote it");
                if crashed >= app.limits.attempts {
                    let detail = format!("writing this file crashed its process {crashed} times");
                    return Err(Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "gave-up", detail));
                }
            }
        }
    }
}
