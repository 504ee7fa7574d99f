//! What a worker thread does with a photo.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Instant;

use axum::http::StatusCode;
use sha2::{Digest, Sha256};

use super::entry::{Entry, Status};
use super::id::hex;
use super::jobs::Jobs;
use super::maker::Product;
use super::options;
use super::problem::Problem;
use super::store::{Done, End, Failed, Part, State};
use super::time::now_ms;
use tmpi_pipeline::MakeError;
use tmpi_pipeline::{Progress, Sink};

/// Makes photos until the server stops.
pub fn work(jobs: &Arc<Jobs>) {
    while let Some(entry) = jobs.take() {
        let start = Instant::now();
        let outcome = run(jobs, &entry);
        let took = start.elapsed();
        jobs.telemetry.job(outcome, took);
        tracing::info!(id = %entry.id, outcome, ms = took.as_millis() as u64, "job");
        jobs.release(&entry, took);
    }
}

/// Listeners and cancellation of one job.
struct JobSink<'a> {
    jobs: &'a Jobs,
    entry: &'a Entry,
}

impl Sink for JobSink<'_> {
    fn progress(&self, message: &Progress) {
        tracing::debug!(id = %self.entry.id, stage = message.stage, "{} of {}", message.step, message.steps);
        self.entry.enter(message.clone());
    }

    fn cancelled(&self) -> bool {
        self.jobs.aborted() || self.entry.is_deleted()
    }
}

/// Why a job brought no product.
enum Miss {
    /// It is a failure of the photo, or of the server.
    Problem(Problem),
    /// Nobody wants it any more, or the server stops.
    Cancelled,
}

fn run(jobs: &Jobs, entry: &Arc<Entry>) -> &'static str {
    let attempts = entry.attempts() + 1;
    let gate = entry.gate();
    if entry.is_deleted() {
        return "deleted";
    }
    let begun = if attempts > jobs.limits.attempts {
        let detail = format!("the server stopped {} times while it made this photo", jobs.limits.attempts);
        Err(Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "gave-up", detail))
    } else {
        jobs.store.write_state(entry.id, &State { attempts, end: None }).map_err(|e| Problem::store(&e))
    };
    entry.set_attempts(attempts);
    drop(gate);
    if let Err(problem) = begun {
        return fail(jobs, entry, problem);
    }
    entry.set(Status::Working);
    match make(jobs, entry) {
        Ok(product) => keep(jobs, entry, &product),
        Err(Miss::Problem(problem)) => fail(jobs, entry, problem),
        Err(Miss::Cancelled) => give_back(jobs, entry),
    }
}

fn make(jobs: &Jobs, entry: &Arc<Entry>) -> Result<Product, Miss> {
    let read = |part| jobs.store.read(entry.id, part).map_err(|e| Miss::Problem(Problem::store(&e)));
    let options = options::from_text(&entry.accepted.options).map_err(Miss::Problem)?;
    let photo = read(Part::Upload)?;
    let depth = entry.accepted.depth_bytes.map(|_| read(Part::Depth)).transpose()?;
    let sink = JobSink { jobs, entry };
    // no state of ours is borrowed mutably by the way, so none can be left half changed
    match catch_unwind(AssertUnwindSafe(|| jobs.maker.make(&photo, depth.as_deref(), &options, &sink))) {
        Ok(Ok(product)) => Ok(product),
        Ok(Err(MakeError::Cancelled)) if sink.cancelled() => Err(Miss::Cancelled),
        Ok(Err(error)) => Err(Miss::Problem(Problem::from(&error))),
        Err(panic) => {
            let text = panic.downcast_ref::<&str>().map(ToString::to_string).or_else(|| panic.downcast_ref::<String>().cloned());
            Err(Miss::Problem(Problem::internal("making the photo panicked", &text.unwrap_or_default())))
        }
    }
}

fn keep(jobs: &Jobs, entry: &Arc<Entry>, product: &Product) -> &'static str {
    let gate = entry.gate();
    if entry.is_deleted() {
        return "deleted";
    }
    let done = Done {
        at_ms: now_ms(),
        width: product.report.width,
        height: product.report.height,
        atlas_bytes: product.container.len() as u64,
        atlas_hash: hex(&Sha256::digest(&product.container)[..16]),
    };
    let state = State { attempts: entry.attempts(), end: Some(End::Done(done.clone())) };
    let written = serde_json::to_vec(&product.report).map_err(std::io::Error::from).and_then(|report| {
        jobs.store.write(
            entry.id,
            &[
                (Part::Atlas, &product.container),
                (Part::Disparity, &product.disparity),
                (Part::Thumbnail, &product.thumbnail),
                (Part::Report, &report),
            ],
        )?;
        jobs.store.write_state(entry.id, &state)
    });
    drop(gate);
    match written {
        Ok(()) => {
            entry.set(Status::Done(done));
            "done"
        }
        Err(error) => fail(jobs, entry, Problem::store(&error)),
    }
}

fn fail(jobs: &Jobs, entry: &Arc<Entry>, problem: Problem) -> &'static str {
    let _gate = entry.gate();
    if entry.is_deleted() {
        return "deleted";
    }
    tracing::warn!(id = %entry.id, kind = problem.kind, detail = problem.detail, "the photo cannot be made");
    let failed = Failed { at_ms: now_ms(), problem };
    let state = State { attempts: entry.attempts(), end: Some(End::Failed(failed.clone())) };
    if let Err(error) = jobs.store.write_state(entry.id, &state) {
        // it is tried again after a restart
        tracing::error!(id = %entry.id, %error, "state of a failed photo");
    }
    entry.set(Status::Failed(failed));
    "failed"
}

/// A start that was cut off by an orderly stop is not counted.
fn give_back(jobs: &Jobs, entry: &Arc<Entry>) -> &'static str {
    let _gate = entry.gate();
    if entry.is_deleted() {
        return "deleted";
    }
    let attempts = entry.attempts().saturating_sub(1);
    entry.set_attempts(attempts);
    if let Err(error) = jobs.store.write_state(entry.id, &State { attempts, end: None }) {
        tracing::warn!(id = %entry.id, %error, "state of an unfinished photo");
    }
    entry.set(Status::Queued);
    "cancelled"
}
