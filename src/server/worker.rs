//! What a worker thread does with a photo.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use axum::http::StatusCode;

use super::entry::{Entry, Status};
use super::jobs::Jobs;
use super::maker::{Fault, Product};
use super::memory::Way;
use super::options;
use super::problem::Problem;
use super::store::{self, End, Failed, Part, State};
use super::time::now_ms;
use super::traces::Job;
use tmpi_pipeline::{Progress, Sink};

/// Makes photos until the server stops.
pub fn work(jobs: &Arc<Jobs>) {
    while let Some(entry) = jobs.take() {
        let start = Instant::now();
        let job = jobs.telemetry.begin_job(entry.asked_by().as_ref(), entry.id, entry.attempts() + 1);
        // whatever goes wrong, the next photo finds a worker
        let outcome = catch_unwind(AssertUnwindSafe(|| run(jobs, &entry, &job))).unwrap_or_else(|panic| {
            let text = said(panic.as_ref());
            tracing::error!(id = %entry.id, text, "a worker panicked");
            catch_unwind(AssertUnwindSafe(|| try_again(jobs, &entry, &text))).unwrap_or("panicked")
        });
        job.end(outcome);
        let took = start.elapsed();
        jobs.telemetry.job(outcome, took);
        jobs.telemetry.class_job(entry.class().name(), outcome, took);
        tracing::info!(id = %entry.id, outcome, ms = took.as_millis() as u64, "job");
        jobs.release(&entry, took);
    }
}

/// What a making has to do with other nodes.
pub(super) struct Others<'a> {
    /// Set where it is another's by now.
    pub lost: &'a AtomicBool,
    /// Tells them that it goes on.
    pub tell: &'a (dyn Fn() + Sync),
}

/// Listeners and cancellation of one job.
struct JobSink<'a> {
    jobs: &'a Jobs,
    entry: &'a Entry,
    deadline: Instant,
    others: &'a Others<'a>,
    job: &'a Job,
}

impl Sink for JobSink<'_> {
    fn progress(&self, message: &Progress) {
        tracing::debug!(id = %self.entry.id, stage = message.stage, "{} of {}", message.step, message.steps);
        self.job.stage(message.stage);
        self.entry.enter(message.clone());
        (self.others.tell)();
    }

    fn cancelled(&self) -> bool {
        self.jobs.aborted() || self.entry.is_deleted() || self.others.lost.load(Ordering::Acquire)
    }

    fn deadline(&self) -> Option<Instant> {
        Some(self.deadline)
    }
}

fn run(jobs: &Jobs, entry: &Arc<Entry>, job: &Job) -> &'static str {
    if entry.is_deleted() {
        return "deleted";
    }
    if entry.attempts() >= jobs.limits.attempts {
        return fail(jobs, entry, gave_up(entry.attempts()));
    }
    match make(jobs, entry, job, &Others { lost: &AtomicBool::new(false), tell: &|| {} }) {
        Ok(product) => keep(jobs, entry, &product),
        Err(Fault::Photo(problem)) => fail(jobs, entry, problem),
        Err(Fault::Crashed(reason)) => try_again(jobs, entry, &reason),
        Err(Fault::Server(reason)) => put_back(jobs, entry, reason),
        Err(Fault::Cancelled) => give_back(entry),
    }
}

/// Why a photo is not tried any more.
pub(super) fn gave_up(attempts: u32) -> Problem {
    let detail = format!("making this photo took down what made it {attempts} times");
    Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "gave-up", detail)
}

/// Makes a photo, until nobody wants it any more, or it is lost to another node.
pub(super) fn make(jobs: &Jobs, entry: &Arc<Entry>, job: &Job, others: &Others<'_>) -> Result<Product, Fault> {
    let read = |part: Part| {
        jobs.store.read(entry.id, part).map_err(|e| match store::lost(part, &e) {
            // its own sectors or name: others can be made
            Some(what) => Fault::Photo(Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "lost", format!("{what}: upload the photo again"))),
            None => Fault::Server(format!("the data directory cannot be read: {e}")),
        })
    };
    let mut options = options::from_text(&entry.accepted.options).map_err(Fault::Photo)?;
    options.strokes = jobs.strokes(entry.id).map_err(|e| Fault::Server(format!("the data directory cannot be read: {e}")))?;
    let photo = read(Part::Upload)?;
    let depth = entry.accepted.depth_bytes.map(|_| read(Part::Depth)).transpose()?;
    let unwanted = || jobs.aborted() || entry.is_deleted() || !jobs.is_accepting() || others.lost.load(Ordering::Acquire);
    let memory = jobs.maker.memory(&photo, depth.as_deref(), &options);
    let Some(_memory) = jobs.memory.wait_for(memory, Way::First, unwanted) else { return Err(Fault::Cancelled) };
    entry.set(Status::Working);
    (others.tell)();
    let sink = JobSink { jobs, entry, deadline: Instant::now() + jobs.limits.time_for(&photo), others, job };
    let made = caught(|| jobs.maker.make(&photo, depth.as_deref(), &options, &sink));
    job.made();
    made
}

/// Turns a panic into a failure of the photo. No state of ours is borrowed mutably by the maker, so none can be left half changed.
pub(super) fn caught(make: impl FnOnce() -> Result<Product, Fault>) -> Result<Product, Fault> {
    catch_unwind(AssertUnwindSafe(make))
        .unwrap_or_else(|panic| Err(Fault::Photo(Problem::internal("making the photo panicked", &said(panic.as_ref())))))
}

/// What a panic said.
pub(super) fn said(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(ToString::to_string);
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default()
}

fn keep(jobs: &Jobs, entry: &Arc<Entry>, product: &Product) -> &'static str {
    let gate = entry.gate();
    if entry.is_deleted() {
        return "deleted";
    }
    let done = product.done();
    let state = State::new(entry.attempts(), Some(End::Done(done.clone())));
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
            jobs.mended();
            entry.set(Status::Done(done));
            "done"
        }
        Err(error) => put_back(jobs, entry, format!("the data directory cannot be written: {error}")),
    }
}

fn fail(jobs: &Jobs, entry: &Arc<Entry>, problem: Problem) -> &'static str {
    let _gate = entry.gate();
    if entry.is_deleted() {
        return "deleted";
    }
    tracing::warn!(id = %entry.id, kind = problem.kind, detail = problem.detail, "the photo cannot be made");
    let failed = Failed { at_ms: now_ms(), problem };
    let state = State::new(entry.attempts(), Some(End::Failed(failed.clone())));
    if let Err(error) = jobs.store.write_state(entry.id, &state) {
        // it is tried again after a restart
        tracing::error!(id = %entry.id, %error, "state of a failed photo");
    }
    entry.set(Status::Failed(failed));
    "failed"
}

/// Counts a try that took down what made the photo, alone, and puts it behind the others.
fn try_again(jobs: &Jobs, entry: &Arc<Entry>, reason: &str) -> &'static str {
    let _gate = entry.gate();
    if entry.is_deleted() {
        return "deleted";
    }
    if !jobs.is_accepting() {
        // it may have ended with the server
        entry.set(Status::Queued);
        return "cancelled";
    }
    let attempts = entry.attempts() + 1;
    tracing::warn!(id = %entry.id, attempts, reason, "the photo took down what made it");
    entry.set_attempts(attempts);
    if let Err(error) = jobs.store.write_state(entry.id, &State::new(attempts, None)) {
        tracing::warn!(id = %entry.id, %error, "state of an unfinished photo");
    }
    entry.set(Status::Queued);
    jobs.queue_again(entry);
    "crashed"
}

/// A fault of the server: the photo waits until it is mended.
fn put_back(jobs: &Jobs, entry: &Arc<Entry>, reason: String) -> &'static str {
    let _gate = entry.gate();
    if entry.is_deleted() {
        return "deleted";
    }
    tracing::error!(id = %entry.id, reason, "a fault of the server; the photo is tried again");
    entry.set(Status::Queued);
    jobs.wait_for_repair(entry, reason);
    "put-back"
}

/// Cut off by an orderly stop.
fn give_back(entry: &Arc<Entry>) -> &'static str {
    if entry.is_deleted() {
        return "deleted";
    }
    entry.set(Status::Queued);
    "cancelled"
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeMap, BTreeSet};
    use std::path::Path;
    use std::time::Duration;

    use tmpi_pipeline::{MakeError, Options, Report};

    use super::super::files::Files as _;
    use super::super::forgetful::Forgetful;
    use super::super::id::PhotoId;
    use super::super::maker::{Maker, Never};
    use super::super::store::{Accepted, Store};
    use super::*;
    use crate::server::Limits;
    use crate::server::settings::Settings;

    #[test]
    fn a_photo_on_worn_sectors_fails_alone_and_is_made_where_it_is_uploaded_again() {
        let files = Arc::new(Forgetful::new());
        let (store, _) = Store::open_in(files.clone(), Path::new("/data"), "", None).unwrap();
        let limits = Arc::new(Limits { workers: 0, ..Limits::default() });
        let jobs = Jobs::start(store, Vec::new(), Arc::new(Never), limits, Arc::default()).unwrap();
        let upload = || {
            let incoming = jobs.store.begin().unwrap();
            files.write(&incoming.path(Part::Upload), b"photo").unwrap();
            let accepted = Accepted { version: 1, at_ms: 1, photo_bytes: 5, depth_bytes: None, options: BTreeMap::new(), owner: None };
            jobs.submit(incoming, PhotoId::of(&[1; 32], None, "", ""), accepted, Settings::default()).unwrap().entry
        };
        let entry = upload();
        files.wear_out(&jobs.store.path(entry.id, Part::Upload));
        assert_eq!(run(&jobs, &jobs.take().unwrap(), &Job::default()), "failed");
        assert!(matches!(entry.status(), Status::Failed(f) if f.problem.kind.ends_with("lost")));
        assert_eq!(jobs.trouble(), None, "no reason to keep others waiting");
        upload();
        // it is read, and nobody makes it here
        assert_eq!(run(&jobs, &jobs.take().unwrap(), &Job::default()), "cancelled");
    }

    /// Makes of each photo its own bytes, once it is opened.
    #[derive(Debug, Default)]
    struct Copies {
        open: AtomicBool,
    }

    impl Maker for Copies {
        fn check(&self, _: &[u8], _: Option<&[u8]>, _: &Options) -> Result<(), MakeError> {
            Ok(())
        }

        fn make(&self, photo: &[u8], _: Option<&[u8]>, _: &Options, _: &dyn Sink) -> Result<Product, Fault> {
            until("it is opened", || self.open.load(Ordering::Acquire));
            Ok(Product { container: photo.to_vec(), report: Report::default(), disparity: vec![1], thumbnail: vec![2] })
        }
    }

    fn until(what: &str, is_so: impl Fn() -> bool) {
        let end = Instant::now() + Duration::from_secs(30);
        while !is_so() {
            assert!(Instant::now() < end, "{what}");
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Takes photos in and makes them over a disk that `fill` fills and empties: what is accepted is finished, none is lost, none is there twice.
    fn loses_and_doubles_nothing(fill: impl Fn(&Forgetful, bool)) {
        let (files, dir) = (Arc::new(Forgetful::new()), Path::new("/data"));
        let (store, _) = Store::open_in(files.clone(), dir, "", None).unwrap();
        files.sync_dir(Path::new("/")).unwrap();
        let (maker, limits) = (Arc::new(Copies::default()), Arc::new(Limits { workers: 2, ..Limits::default() }));
        let jobs = Jobs::start(store, Vec::new(), maker.clone(), limits, Arc::default()).unwrap();
        let upload = |n: u8| {
            let refused = |error| Problem::store(&error).status;
            let incoming = jobs.store.begin().map_err(refused)?;
            files.write(&incoming.path(Part::Upload), &[n; 5]).map_err(refused)?;
            let accepted = Accepted { version: 1, at_ms: 1, photo_bytes: 5, depth_bytes: None, options: BTreeMap::new(), owner: None };
            let id = PhotoId::of(&[n; 32], None, "", "");
            jobs.submit(incoming, id, accepted, Settings::default()).map(|submitted| submitted.entry).map_err(|problem| problem.status)
        };
        let mut accepted: Vec<Arc<Entry>> = (0..6).map(|n| upload(n).unwrap()).collect();
        fill(&files, true);
        let refused: Vec<u16> = (6..12).filter_map(|n| upload(n).err()).collect();
        assert_eq!(refused, [507; 6]);
        maker.open.store(true, Ordering::Release);
        until("what was made waits for room", || jobs.trouble().is_some());
        assert!(accepted.iter().all(|entry| !entry.status().is_final()), "no photo is at fault");
        fill(&files, false);
        let began = Instant::now();
        accepted.extend((6..12).map(|n| upload(n).unwrap()));
        until("all are done", || accepted.iter().all(|entry| matches!(entry.status(), Status::Done(_))));
        assert!(began.elapsed() < Duration::from_secs(10), "{:?}", began.elapsed());
        // as a node finds them that starts after the machine stopped
        files.crash();
        let (again, found) = Store::open_in(files, dir, "", None).unwrap();
        let finished = found.iter().filter(|photo| matches!(photo.state.end, Some(End::Done(_)))).count();
        let ids: BTreeSet<PhotoId> = found.iter().map(|photo| photo.id).collect();
        let lost = accepted.iter().filter(|entry| !ids.contains(&entry.id)).count();
        assert_eq!((accepted.len(), finished, lost, found.len() - ids.len()), (12, 12, 0, 0), "accepted, finished, lost, double");
        for (n, entry) in accepted.iter().enumerate() {
            assert_eq!(again.read(entry.id, Part::Atlas).unwrap(), [n as u8; 5]);
        }
    }

    #[test]
    fn a_disk_that_is_full_for_a_while_loses_and_doubles_nothing() {
        loses_and_doubles_nothing(Forgetful::fill);
    }

    #[test]
    fn a_disk_without_place_for_files_for_a_while_loses_and_doubles_nothing() {
        loses_and_doubles_nothing(Forgetful::use_up_files);
    }
}
