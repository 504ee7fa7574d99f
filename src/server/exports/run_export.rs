//! Writes files within limits: memory, time, and as many tries as for a photo.

use std::sync::Arc;
use std::time::Instant;

use axum::http::StatusCode;
use tokio_util::sync::CancellationToken;

use super::recipe::Recipe;
use super::write::{ExportTask, timeout_problem};
use crate::server::app_state::AppState;
use crate::server::maker::Fault;
use crate::server::memory_budget::Priority;
use crate::server::photo_details::FinishedPhoto;
use crate::server::problem::Problem;
use tmpi_pipeline::{Progress, Sink};

/// Whether a file is still wanted, and how urgently.
pub struct WriteRequest<'a> {
    /// Returns true once it is unwanted.
    pub unwanted: &'a (dyn Fn() -> bool + Sync),
    /// Whether it waits behind all others for memory, in a low-priority process.
    pub is_low_priority: bool,
}

struct Until<'a>(&'a WriteRequest<'a>, Instant);

impl Sink for Until<'_> {
    fn progress(&self, _: &Progress) {}

    fn cancelled(&self) -> bool {
        (self.0.unwanted)()
    }

    fn deadline(&self) -> Option<Instant> {
        Some(self.1)
    }
}

impl AppState {
    /// Writes a file for a waiting client until it is `gone`, in a child process if the maker has those; blocks.
    ///
    /// # Errors
    /// As [`write_export`].
    pub fn write_export(&self, recipe: &Recipe, of: (&[u8], &FinishedPhoto), gone: &CancellationToken) -> Result<Vec<u8>, Problem> {
        let unwanted = || gone.is_cancelled();
        write_export(self, recipe, of, &WriteRequest { unwanted: &unwanted, is_low_priority: false })
    }
}

/// Writes a file of `container`, in a child process if the maker has those; blocks.
///
/// # Errors
/// 503 if it is unwanted or takes too long, 422 after too many crashes, and the errors of writing.
pub fn write_export(
    app: &AppState,
    recipe: &Recipe,
    (container, done): (&[u8], &FinishedPhoto),
    wanted: &WriteRequest<'_>,
) -> Result<Vec<u8>, Problem> {
    let cancelled = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "cancelled", "the export was cancelled").retry_after(1);
    let sink = Until(wanted, Instant::now() + app.limits.exports.timeout);
    let over = || sink.cancelled() || Instant::now() >= sink.1;
    let way = if wanted.is_low_priority { Priority::Low } else { Priority::Normal };
    let Some(_memory) = app.memory.wait_for(recipe.memory(done), way, over) else {
        let busy = "no memory for this file became free within its time limit (limits.job-memory, exports.timeout)";
        let busy = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", busy).retry_after(10);
        return Err(if sink.cancelled() { cancelled() } else { busy() });
    };
    let drawing = || Ok(Arc::clone(&app.renderer));
    let work = ExportTask { recipe, container, drawing: &drawing, is_low_priority: wanted.is_low_priority };
    let mut crashed = 0;
    loop {
        match app.maker.export(&work, &sink) {
            Ok(bytes) => return Ok(bytes),
            Err(Fault::Cancelled) if sink.cancelled() => return Err(cancelled()),
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
