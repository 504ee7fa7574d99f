//! What writing a file takes: its memory, its time, and as many tries as a photo has.

use std::sync::Arc;
use std::time::Instant;

use axum::http::StatusCode;
use tokio_util::sync::CancellationToken;

use super::recipe::Recipe;
use super::write::{Work, late};
use crate::server::app::Shared;
use crate::server::made::Done;
use crate::server::maker::Fault;
use crate::server::memory::Way;
use crate::server::problem::Problem;
use tmpi_pipeline::{Progress, Sink};

/// Whether a file is waited for.
pub struct Wanted<'a> {
    /// True once nobody wants it any more.
    pub unwanted: &'a (dyn Fn() -> bool + Sync),
    /// Whether it waits behind all others for memory, and the process that writes it gives way to everything else.
    pub gives_way: bool,
}

struct Until<'a>(&'a Wanted<'a>, Instant);

impl Sink for Until<'_> {
    fn progress(&self, _: &Progress) {}

    fn cancelled(&self) -> bool {
        (self.0.unwanted)()
    }

    fn deadline(&self) -> Option<Instant> {
        Some(self.1)
    }
}

impl Shared {
    /// Writes a file for who waits for it until it is `gone`, in another process where the server's maker has such; blocks.
    ///
    /// # Errors
    /// As [`written`].
    pub fn written(&self, recipe: &Recipe, of: (&[u8], &Done), gone: &CancellationToken) -> Result<Vec<u8>, Problem> {
        let unwanted = || gone.is_cancelled();
        written(self, recipe, of, &Wanted { unwanted: &unwanted, gives_way: false })
    }
}

/// Writes a file of `container`, in another process where the server's maker has such; blocks.
///
/// # Errors
/// 503 where it is not wanted any more or takes too long, 422 where it took down what wrote it as often as may be, and what writing it meets.
pub fn written(app: &Shared, recipe: &Recipe, (container, done): (&[u8], &Done), wanted: &Wanted<'_>) -> Result<Vec<u8>, Problem> {
    let cancelled = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "cancelled", "the export is not wanted any more").retry_after(1);
    let sink = Until(wanted, Instant::now() + app.limits.exports.timeout);
    let over = || sink.cancelled() || Instant::now() >= sink.1;
    let way = if wanted.gives_way { Way::Gives } else { Way::First };
    let Some(_memory) = app.memory.wait_for(recipe.memory(done), way, over) else {
        let busy = "there was no memory for this file in the time that it may take (limits.job-memory, exports.timeout)";
        let busy = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", busy).retry_after(10);
        return Err(if sink.cancelled() { cancelled() } else { busy() });
    };
    let drawing = || Ok(Arc::clone(&app.renderer));
    let work = Work { recipe, container, drawing: &drawing, gives_way: wanted.gives_way };
    let mut crashed = 0;
    loop {
        match app.maker.export(&work, &sink) {
            Ok(bytes) => return Ok(bytes),
            Err(Fault::Cancelled) if sink.cancelled() => return Err(cancelled()),
            // nobody has cancelled it but its time
            Err(Fault::Cancelled) => return Err(late()),
            Err(Fault::Photo(problem)) => return Err(problem),
            Err(Fault::Server(reason)) => return Err(Problem::internal("exporting a photo", &reason)),
            Err(Fault::Crashed(reason)) => {
                crashed += 1;
                tracing::warn!(crashed, reason, recipe = recipe.text(), "a file took down what wrote it");
                if crashed >= app.limits.attempts {
                    let detail = format!("writing this file took down what wrote it {crashed} times");
                    return Err(Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "gave-up", detail));
                }
            }
        }
    }
}
