//! The threads that write files, and what writing one takes: its memory, its time, and as many tries as a photo has.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use axum::http::StatusCode;

use super::recipe::Recipe;
use super::write::{Work, late};
use super::{Ordered, Standing};
use crate::server::entry::Status;
use crate::server::jobs::{Class, Jobs};
use crate::server::maker::Fault;
use crate::server::memory::Way;
use crate::server::problem::Problem;
use crate::server::store::{Done, Part, damage_of, lost};
use crate::server::worker::said;
use tmpi_pipeline::{Progress, Sink};
use tmpi_render::Renderer;

/// As often a file that is being written gives way to what waits for its memory; then it is written to its end.
pub(super) const GIVES_WAY: u32 = 3;

/// Starts the threads.
///
/// # Errors
/// The system starts none.
pub fn start(jobs: &Arc<Jobs>, renderer: &Arc<dyn Renderer>) -> std::io::Result<()> {
    for n in 0..jobs.limits.exports {
        let (jobs, renderer) = (Arc::clone(jobs), Arc::clone(renderer));
        std::thread::Builder::new().name(format!("tmpi-file-{n}")).spawn(move || work(&jobs, &renderer))?;
    }
    Ok(())
}

fn work(jobs: &Arc<Jobs>, renderer: &Arc<dyn Renderer>) {
    while let Some(file) = jobs.take_file() {
        let start = Instant::now();
        // whatever goes wrong, the next file finds a thread
        let outcome = catch_unwind(AssertUnwindSafe(|| run(jobs, &file, renderer))).unwrap_or_else(|panic| {
            jobs.exports.set(&file, Standing::Failed(Problem::internal("writing a file panicked", &said(panic.as_ref()))));
            "panicked"
        });
        let took = start.elapsed();
        jobs.telemetry.class_job(Class::Export.name(), outcome, took);
        tracing::info!(photo = %file.photo, key = file.key, recipe = file.recipe, outcome, ms = took.as_millis() as u64, "file");
        jobs.release_file();
    }
}

pub(super) fn run(jobs: &Jobs, file: &Arc<Ordered>, renderer: &Arc<dyn Renderer>) -> &'static str {
    if file.is_cancelled() {
        return "cancelled";
    }
    // it waits until there is memory for it, too
    let begun = AtomicBool::new(false);
    let began = || {
        jobs.exports.set(file, Standing::Working);
        begun.store(true, Ordering::Release);
    };
    let gives_way = file.gave_way.load(Ordering::Relaxed) < GIVES_WAY;
    let gave_way = AtomicBool::new(false);
    let yields = || {
        if gives_way && begun.load(Ordering::Acquire) && jobs.memory.is_wanted() {
            gave_way.store(true, Ordering::Release);
        }
        gave_way.load(Ordering::Acquire)
    };
    let way = if gives_way { Way::Gives } else { Way::First };
    let outcome =
        wanted(jobs, file, renderer, (&began, &yields, way)).and_then(|bytes| jobs.exports.keep(file, &bytes, &jobs.store, &jobs.limits));
    match outcome {
        _ if file.is_cancelled() => "cancelled",
        Ok(()) => "done",
        Err(_) if gave_way.load(Ordering::Acquire) && jobs.is_accepting() => {
            file.gave_way.fetch_add(1, Ordering::Relaxed);
            jobs.exports.set(file, Standing::Queued);
            jobs.push_file(file);
            "gave-way"
        }
        Err(problem) => {
            tracing::warn!(photo = %file.photo, kind = problem.kind, detail = problem.detail, "a file cannot be written");
            jobs.exports.set(file, Standing::Failed(problem));
            "failed"
        }
    }
}

/// What a file is told when it begins, whether it gives way to what waits by now, and how it waits for memory.
type Turn<'a> = (&'a (dyn Fn() + Sync), &'a (dyn Fn() -> bool + Sync), Way);

fn wanted(jobs: &Jobs, file: &Ordered, renderer: &Arc<dyn Renderer>, (began, yields, memory): Turn<'_>) -> Result<Vec<u8>, Problem> {
    let gone = || Problem::not_found("the photo was deleted, or is made again");
    let entry = file.entry().ok_or_else(gone)?;
    let Status::Done(done) = entry.status() else { return Err(gone()) };
    let recipe = Recipe::parse(&file.recipe, &jobs.limits)?;
    let container = jobs.store.read(file.photo, Part::Atlas).map_err(|e| match lost(Part::Atlas, &e) {
        Some(_) if entry.is_deleted() || jobs.get(file.photo).is_none() => gone(),
        Some(damage) => Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "damaged", damage),
        None => Problem::store(&e),
    })?;
    if !file.is_of(Some(&entry)) {
        return Err(gone());
    }
    if let Some(damage) = damage_of(&container, &done) {
        jobs.take_out(file.photo, done.at_ms, &damage);
        return Err(Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "damaged", damage));
    }
    let unwanted = || file.is_cancelled() || !file.is_of(Some(&entry)) || !jobs.is_accepting() || yields();
    let wanted = Wanted { unwanted: &unwanted, began, limit: jobs.limits.export, memory, gives_way: true };
    written(jobs, &recipe, (&container, &done), renderer, &wanted)
}

/// Whether and how long a file is waited for.
pub struct Wanted<'a> {
    /// True once nobody wants it any more.
    pub unwanted: &'a (dyn Fn() -> bool + Sync),
    /// Called once there is memory for it.
    pub began: &'a (dyn Fn() + Sync),
    /// Time that it may take, with the wait for memory.
    pub limit: Duration,
    /// How it waits for memory.
    pub memory: Way,
    /// Whether the process that writes it gives way to everything else.
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

/// Writes a file of `container`, in another process where the server's maker has such; blocks.
///
/// # Errors
/// 503 where it is not wanted any more or takes too long, 422 where it took down what wrote it as often as may be, and what writing it meets.
pub fn written(
    jobs: &Jobs,
    recipe: &Recipe,
    (container, done): (&[u8], &Done),
    renderer: &Arc<dyn Renderer>,
    wanted: &Wanted<'_>,
) -> Result<Vec<u8>, Problem> {
    let cancelled = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "cancelled", "the export is not wanted any more").retry_after(1);
    let sink = Until(wanted, Instant::now() + wanted.limit);
    let over = || sink.cancelled() || Instant::now() >= sink.1;
    let Some(_memory) = jobs.memory.wait_for(recipe.memory(done), wanted.memory, over) else {
        let busy = "there was no memory for this file in the time that it may take (--job-memory, --export-timeout)";
        let busy = || Problem::new(StatusCode::SERVICE_UNAVAILABLE, "busy", busy).retry_after(10);
        return Err(if sink.cancelled() { cancelled() } else { busy() });
    };
    (wanted.began)();
    let drawing = || Ok(Arc::clone(renderer));
    let work = Work { recipe, container, drawing: &drawing, gives_way: wanted.gives_way };
    let mut crashed = 0;
    loop {
        match jobs.maker.export(&work, &sink) {
            Ok(bytes) => return Ok(bytes),
            Err(Fault::Cancelled) if sink.cancelled() => return Err(cancelled()),
            // nobody has cancelled it but its time
            Err(Fault::Cancelled) => return Err(late()),
            Err(Fault::Photo(problem)) => return Err(problem),
            Err(Fault::Server(reason)) => return Err(Problem::internal("exporting a photo", &reason)),
            Err(Fault::Crashed(reason)) => {
                crashed += 1;
                tracing::warn!(crashed, reason, recipe = recipe.text(), "a file took down what wrote it");
                if crashed >= jobs.limits.attempts {
                    let detail = format!("writing this file took down what wrote it {crashed} times");
                    return Err(Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "gave-up", detail));
                }
            }
        }
    }
}
