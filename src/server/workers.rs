//! Workers: tasks that take jobs from the queue and run them on blocking threads.

use std::convert::Infallible;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use axum::http::StatusCode;
use bytes::Bytes;
use tmpi_library::{Content, Contents, Event, JobKind, Lease, LibraryError, Part, PhotoResults, Retry};
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use super::app_state::App;
use super::exports::{Recipe, write_export};
use super::finished_photo::FinishedPhoto;
use super::maker::{Fault, Product};
use super::memory_budget::Priority;
use super::photo_options;
use super::problem::Problem;
use super::traces::JobSpan;
use tmpi_pipeline::{Options, Progress, Sink};

/// Kinds of jobs of workers that make photos, and of those that write files.
const MAKES: &[JobKind] = &[JobKind::Make];
const WRITES: &[JobKind] = &[JobKind::Export, JobKind::Film];
/// Renewals within the term of a lease, of which some may fail.
const RENEWALS: u32 = 4;
/// Pause before a retry if the library is unreachable.
const PAUSE: Duration = Duration::from_millis(500);
/// Shortest time from one stored progress of a job to the next: each takes a transaction.
const STORE_EVERY: Duration = Duration::from_millis(500);
/// Time for jobs to end after they are cancelled.
const END: Duration = Duration::from_secs(2);

pub struct Workers {
    tasks: Vec<JoinHandle<()>>,
    abort: Arc<AtomicBool>,
}

impl Workers {
    pub fn start(app: &App) -> Self {
        let abort = Arc::<AtomicBool>::default();
        let of = |count: usize, kinds| (0..count).map(move |_| kinds);
        let all = of(app.limits.workers, MAKES).chain(of(app.limits.exports.workers, WRITES));
        let tasks = all.map(|kinds| tokio::spawn(work(Arc::clone(app), kinds, Arc::clone(&abort)))).collect();
        Self { tasks, abort }
    }

    /// Waits for running jobs until `deadline`; unfinished ones return to the queue.
    pub async fn drain(self, deadline: Instant) {
        let mut all = std::pin::pin!(futures_util::future::join_all(self.tasks));
        if tokio::time::timeout_at(deadline.into(), &mut all).await.is_err() {
            self.abort.store(true, Ordering::Release);
            let _ = tokio::time::timeout(END, all).await;
        }
    }
}

/// Signals to and from the thread of a job.
#[derive(Clone)]
struct Doing {
    app: App,
    /// Set if the job is deleted or another worker has it.
    lost: Arc<AtomicBool>,
    abort: Arc<AtomicBool>,
    tell: UnboundedSender<Progress>,
    span: Arc<JobSpan>,
}

impl Doing {
    fn is_over(&self) -> bool {
        self.lost.load(Ordering::Acquire) || self.abort.load(Ordering::Acquire)
    }

    /// Whether work that can be repeated easily should end: also once the server stops.
    fn is_unwanted(&self) -> bool {
        self.is_over() || self.app.stop.is_cancelled()
    }
}

/// Takes jobs until the server stops.
async fn work(app: App, kinds: &'static [JobKind], abort: Arc<AtomicBool>) {
    loop {
        match Box::pin(app.library.next(kinds, app.limits.lease, app.stop.cancelled())).await {
            Ok(Some(lease)) => Box::pin(one(&app, &lease, &abort)).await,
            Ok(None) => return,
            Err(error) => {
                tracing::warn!(%error, "no job can be taken now");
                tokio::select! {
                    () = app.stop.cancelled() => return,
                    () = tokio::time::sleep(PAUSE) => {}
                }
            }
        }
    }
}

/// Runs one job.
async fn one(app: &App, lease: &Lease, abort: &Arc<AtomicBool>) {
    let (start, photo, kind) = (Instant::now(), lease.job.photo, lease.job.kind);
    let (tell, told) = unbounded_channel();
    let span = match kind {
        JobKind::Make => app.telemetry.begin_job(lease.job.payload.as_str(), photo, lease.job.attempts as u32 + 1),
        JobKind::Export | JobKind::Film => JobSpan::default(),
    };
    let doing = Doing { app: Arc::clone(app), lost: Arc::default(), abort: Arc::clone(abort), tell, span: Arc::new(span) };
    let job = async {
        let ended = match kind {
            JobKind::Make => make(lease, &doing, told).await,
            JobKind::Export | JobKind::Film => write(lease, &doing, told).await,
        };
        match ended {
            Ok(outcome) => outcome,
            Err(why) => end(lease, &doing, why).await,
        }
    };
    let outcome = tokio::select! {
        outcome = job => outcome,
        never = renew(lease, &doing) => match never {},
    };
    doing.span.end(outcome);
    if matches!(outcome, "done" | "failed") {
        app.set_trouble(None);
    }
    let took = start.elapsed();
    let class = if matches!(kind, JobKind::Make) { lease.job.class.name() } else { "export" };
    app.telemetry.job(class, outcome, took);
    tracing::info!(%photo, kind = kind.name(), outcome, ms = took.as_millis() as u64, "job");
}

/// Renews a lease while it is polled: from reading the inputs until the result is stored.
async fn renew(lease: &Lease, doing: &Doing) -> Infallible {
    let period = lease.lasts() / RENEWALS;
    loop {
        tokio::time::sleep(period).await;
        match tokio::time::timeout(period, doing.app.library.renew(lease, None)).await {
            Ok(Ok(())) => {}
            Ok(Err(LibraryError::LeaseLost)) => {
                doing.lost.store(true, Ordering::Release);
                std::future::pending::<()>().await;
            }
            Ok(Err(error)) => tracing::warn!(%error, "cannot renew a lease"),
            Err(_) => tracing::warn!("cannot renew a lease: the database does not answer"),
        }
    }
}

/// Runs `work` on a blocking thread and publishes its progress. `None` if the thread ended without a result.
async fn hold<T: Send + 'static>(
    lease: &Lease,
    doing: &Doing,
    mut told: UnboundedReceiver<Progress>,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, JobEnd> {
    let library = &doing.app.library;
    let (send, mut done) = oneshot::channel();
    let mut events = library.subscribe();
    let started = std::thread::Builder::new().name("tmpi-job".into()).spawn(move || drop(send.send(work())));
    if let Err(error) = started {
        return Err(JobEnd::Again(Retry::Fault(format!("cannot start a thread: {error}"))));
    }
    let (mut said, mut is_stored, mut last_store) = (None, true, tokio::time::Instant::now());
    loop {
        tokio::select! {
            done = &mut done => {
                while let Ok(progress) = told.try_recv() {
                    tell(lease, doing, &progress).await;
                }
                return done.map_err(|_| JobEnd::Failed(Problem::internal("the job panicked", &"see above")));
            }
            Some(progress) = told.recv() => {
                said = tell(lease, doing, &progress).await;
                is_stored = false;
                continue;
            }
            () = tokio::time::sleep_until(last_store + STORE_EVERY), if !is_stored => {}
            event = events.next() => match event {
                Some(Event::Photo(id) | Event::Deleted(id)) if id == lease.job.photo => {
                    if let Some(said) = &said {
                        // the event made listeners forget the progress
                        tell_again(lease, doing, said).await;
                    }
                }
                Some(Event::Gap) => {}
                _ => continue,
            },
        }
        // it may be deleted or cancelled
        match library.renew(lease, said.as_ref()).await {
            Ok(()) => {}
            Err(LibraryError::LeaseLost) => doing.lost.store(true, Ordering::Release),
            Err(error) => tracing::warn!(%error, "cannot renew a lease"),
        }
        (is_stored, last_store) = (true, tokio::time::Instant::now());
    }
}

async fn tell_again(lease: &Lease, doing: &Doing, said: &serde_json::Value) {
    if let Err(error) = doing.app.library.send_progress(lease, said.clone()).await {
        tracing::debug!(%error, "progress");
    }
}

/// Publishes progress.
async fn tell(lease: &Lease, doing: &Doing, progress: &Progress) -> Option<serde_json::Value> {
    let said = serde_json::to_value(progress).ok()?;
    tell_again(lease, doing, &said).await;
    Some(said)
}

/// End of a job without a result.
enum JobEnd {
    Failed(Problem),
    Again(Retry),
}

/// Records the end, however long that takes; otherwise a database outage would count as a crash of the worker.
async fn end(lease: &Lease, doing: &Doing, end: JobEnd) -> &'static str {
    let library = &doing.app.library;
    loop {
        let told = match &end {
            JobEnd::Failed(problem) => library.fail(lease, &problem.to_library()).await,
            JobEnd::Again(retry) => library.retry(lease, retry).await,
        };
        match told {
            Ok(()) => break,
            Err(LibraryError::LeaseLost) => return "deleted",
            Err(error) => {
                tracing::warn!(%error, "cannot record the end of a job");
                if doing.abort.load(Ordering::Acquire) {
                    break;
                }
                tokio::time::sleep(PAUSE).await;
            }
        }
    }
    match end {
        JobEnd::Failed(problem) => {
            tracing::warn!(photo = %lease.job.photo, kind = problem.kind, detail = problem.detail, "a job failed");
            "failed"
        }
        JobEnd::Again(Retry::Died(reason)) => {
            tracing::warn!(photo = %lease.job.photo, reason, "a job crashed its process");
            "crashed"
        }
        JobEnd::Again(Retry::Fault(reason)) => {
            tracing::error!(photo = %lease.job.photo, reason, "a fault of the server; the job is retried");
            doing.app.set_trouble(Some(reason));
            "put-back"
        }
        JobEnd::Again(Retry::Stopping) => "cancelled",
    }
}

/// Progress and cancellation of a running job.
struct JobSink<'a> {
    doing: &'a Doing,
    deadline: Instant,
}

impl Sink for JobSink<'_> {
    fn progress(&self, message: &Progress) {
        self.doing.span.stage(message.stage);
        // fails only if the job has ended
        let _ = self.doing.tell.send(message.clone());
    }

    fn cancelled(&self) -> bool {
        self.doing.is_over()
    }

    fn deadline(&self) -> Option<Instant> {
        Some(self.deadline)
    }
}

/// Inputs of a photo.
struct Inputs {
    photo: Bytes,
    depth: Option<Bytes>,
    options: Options,
}

async fn inputs(lease: &Lease, doing: &Doing) -> Result<Inputs, JobEnd> {
    let (photo, blobs) = (&lease.photo, doing.app.library.blobs());
    let read = async |part: Part| match photo.blobs.get(&part) {
        None => Ok(None),
        Some(blob) => blobs.read(part, blob).await.map(Some).map_err(|error| match error {
            LibraryError::Damaged { .. } => {
                JobEnd::Failed(Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "lost", format!("{error}: upload the photo again")))
            }
            error => JobEnd::Again(Retry::Fault(error.to_string())),
        }),
    };
    let mut options = photo_options::from_text(&photo.options).map_err(JobEnd::Failed)?;
    options.strokes = doing.app.strokes(photo).await.map_err(|problem| JobEnd::Again(Retry::Fault(problem.detail.into())))?;
    let lost = || JobEnd::Failed(Problem::new(StatusCode::INTERNAL_SERVER_ERROR, "lost", "the upload is missing: upload the photo again"));
    Ok(Inputs { photo: read(Part::Upload).await?.ok_or_else(lost)?, depth: read(Part::Depth).await?, options })
}

/// Makes a photo; returns the outcome.
async fn make(lease: &Lease, doing: &Doing, told: UnboundedReceiver<Progress>) -> Result<&'static str, JobEnd> {
    let Inputs { photo, depth, options } = inputs(lease, doing).await?;
    let here = doing.clone();
    let made = hold(lease, doing, told, move || {
        let app = &here.app;
        let memory = app.maker.memory(&photo, depth.as_deref(), &options);
        let Some(_memory) = app.memory.wait_for(memory, Priority::Normal, || here.is_unwanted()) else { return Err(Fault::Cancelled) };
        let sink = JobSink { doing: &here, deadline: Instant::now() + app.limits.time_for(&photo) };
        let made = catch_panic("making the photo panicked", || app.maker.make(&photo, depth.as_deref(), &options, &sink));
        here.span.made();
        made
    });
    match made.await? {
        Ok(product) => keep(lease, doing, product).await,
        Err(Fault::Photo(problem)) => Err(JobEnd::Failed(problem)),
        Err(Fault::Server(reason)) => Err(JobEnd::Again(Retry::Fault(reason))),
        Err(Fault::Cancelled) if doing.lost.load(Ordering::Acquire) => Ok("deleted"),
        // when the server stops, the process may have ended with it
        Err(Fault::Crashed(reason)) if !doing.app.stop.is_cancelled() => Err(JobEnd::Again(Retry::Died(reason))),
        Err(Fault::Cancelled | Fault::Crashed(_)) => Err(JobEnd::Again(Retry::Stopping)),
    }
}

/// Stores the results of a photo; returns the outcome.
async fn keep(lease: &Lease, doing: &Doing, product: Product) -> Result<&'static str, JobEnd> {
    let Product { container, report, disparity, thumbnail } = product;
    let text = serde_json::to_vec(&report).map_err(|error| JobEnd::Failed(Problem::internal("writing a report", &error)))?;
    let parts = [(Part::Container, container), (Part::Disparity, disparity), (Part::Thumbnail, thumbnail), (Part::Report, text)];
    let digested = move || parts.into_iter().map(|(part, bytes)| (part, Content::of_bytes(bytes))).collect::<Contents>();
    let contents = tokio::task::spawn_blocking(digested).await;
    let contents = contents.map_err(|error| JobEnd::Failed(Problem::internal("taking digests", &error)))?;
    match doing.app.library.finish(lease, PhotoResults { contents, details: FinishedPhoto::details(report.width, report.height) }).await {
        Ok(_) => Ok("done"),
        Err(LibraryError::LeaseLost) => Ok("deleted"),
        Err(error) => Err(JobEnd::Again(Retry::Fault(format!("cannot store the results: {error}")))),
    }
}

/// Writes an export file; returns the outcome.
async fn write(lease: &Lease, doing: &Doing, told: UnboundedReceiver<Progress>) -> Result<&'static str, JobEnd> {
    let app = &doing.app;
    let gone = || JobEnd::Failed(Problem::not_found("the photo was made again, or was deleted"));
    let recipe = Recipe::parse(lease.job.payload.as_str().ok_or_else(gone)?, &app.limits).map_err(JobEnd::Failed)?;
    let done = FinishedPhoto::of(&lease.photo).ok_or_else(gone)?;
    let container = app.container_of(&lease.photo).await.map_err(|problem| {
        if problem.status == StatusCode::SERVICE_UNAVAILABLE {
            JobEnd::Again(Retry::Fault(problem.detail.into()))
        } else {
            JobEnd::Failed(problem)
        }
    })?;
    let here = doing.clone();
    let bytes =
        hold(lease, doing, told, move || write_export(&here.app, &recipe, (&container, &done), Priority::Low, &|| here.is_unwanted()));
    let stops = || doing.abort.load(Ordering::Acquire) || app.stop.is_cancelled();
    let file = match bytes.await? {
        Ok(bytes) => Content::of_bytes(bytes),
        Err(_) if doing.lost.load(Ordering::Acquire) => return Ok("cancelled"),
        Err(_) if stops() => return Err(JobEnd::Again(Retry::Stopping)),
        Err(problem) => return Err(JobEnd::Failed(problem)),
    };
    match app.library.finish_export(lease, file).await {
        Ok(_) => Ok("done"),
        Err(LibraryError::LeaseLost) => Ok("cancelled"),
        Err(LibraryError::Invalid(detail)) => {
            let detail = format!("{detail} (exports.disk)");
            Err(JobEnd::Failed(Problem::new(StatusCode::UNPROCESSABLE_ENTITY, "export-too-large", detail)))
        }
        Err(error @ LibraryError::StorageFull) => Err(JobEnd::Failed(error.into())),
        Err(error) => Err(JobEnd::Again(Retry::Fault(error.to_string()))),
    }
}

/// Turns a panic into a failure of the photo; `what` says what panicked. The maker borrows none of the server's state mutably, so a panic
/// cannot leave it inconsistent.
pub(super) fn catch_panic<T>(what: &str, work: impl FnOnce() -> Result<T, Fault>) -> Result<T, Fault> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<&str>().copied().or_else(|| panic.downcast_ref::<String>().map(String::as_str));
        Err(Fault::Photo(Problem::internal(what, &text.unwrap_or_default())))
    })
}
