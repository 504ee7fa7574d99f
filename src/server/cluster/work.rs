//! What a worker thread does where several nodes share a store: it takes a hint, claims the making, and ends it once.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::claim::{Claim, Held};
use super::ports::Lease;
use super::records::{self, End};
use super::{Cluster, Known, index};
use crate::server::entry::{Entry, Status};
use crate::server::jobs::Jobs;
use crate::server::maker::{Fault, Product};
use crate::server::part::Part;
use crate::server::problem::Problem;
use crate::server::records::Failed;
use crate::server::time::now_ms;
use crate::server::traces::Job;
use crate::server::worker::{Others, gave_up, make, said};

/// Longest wait for a hint; then it is seen whether the server stops.
const WAIT: Duration = Duration::from_secs(1);
/// Time for which the store is tried that is to take a result.
const COMMIT: Duration = Duration::from_mins(5);
/// Pause between such tries, doubled up to its longest.
const AGAIN: Duration = Duration::from_millis(250);
const MOST_AGAIN: Duration = Duration::from_secs(5);
/// Pause after a fault of the store.
const LATER: Duration = Duration::from_secs(2);
const MUCH_LATER: Duration = Duration::from_mins(1);

/// What becomes of the hint.
enum Then {
    Acknowledge,
    GiveBack(Duration),
}

/// Makes photos until the server stops.
pub fn work(jobs: &Arc<Jobs>, cluster: &Arc<Cluster>) {
    while jobs.is_accepting() {
        if let Some(until) = jobs.suffers_until()
            && Instant::now() < until
        {
            std::thread::sleep(WAIT.min(until.saturating_duration_since(Instant::now())));
            continue;
        }
        let Some(lease) = cluster.queue.lease(WAIT) else { continue };
        // whatever goes wrong, the next photo finds a worker
        let then = catch_unwind(AssertUnwindSafe(|| take(jobs, cluster, &*lease))).unwrap_or_else(|panic| {
            tracing::error!(text = said(panic.as_ref()), "a worker panicked");
            Then::GiveBack(LATER)
        });
        match then {
            Then::Acknowledge => lease.acknowledge(),
            Then::GiveBack(delay) => lease.give_back(delay),
        }
    }
}

/// Takes up what a hint names, if it is to be done.
fn take(jobs: &Arc<Jobs>, cluster: &Arc<Cluster>, lease: &dyn Lease) -> Then {
    let held = match cluster.claim(lease.hint()) {
        Ok(Claim::Ours(held)) => held,
        Ok(Claim::Over) => return Then::Acknowledge,
        Ok(Claim::Later(delay)) => return Then::GiveBack(delay),
        Err(error) => {
            tracing::warn!(%error, "a photo cannot be taken up now");
            // a record that cannot be understood will not be soon
            return Then::GiveBack(if error.kind() == io::ErrorKind::InvalidData { MUCH_LATER } else { LATER });
        }
    };
    let entry = match jobs.refresh(cluster, held.id) {
        Ok(Some(entry)) => entry,
        Ok(None) => return Then::Acknowledge,
        Err(error) => {
            tracing::warn!(id = %held.id, %error, "a photo cannot be taken up now");
            return Then::GiveBack(LATER);
        }
    };
    let start = Instant::now();
    jobs.begin(&entry);
    let marker = held.marker();
    let job = jobs.telemetry.begin_job(marker.trace.as_ref(), held.id, marker.attempts + 1);
    let (outcome, then) = beating(cluster, &entry, &held, lease, |lost| run(jobs, cluster, &entry, &held, (lost, &job)));
    job.end(outcome);
    let took = start.elapsed();
    jobs.telemetry.job(outcome, took);
    tracing::info!(id = %entry.id, outcome, ms = took.as_millis() as u64, "job");
    jobs.release(&entry, took);
    // whatever it came to, the store says so
    if let Err(error) = jobs.refresh(cluster, entry.id) {
        tracing::debug!(id = %entry.id, %error, "cannot be looked up now");
    }
    then
}

/// Tells that work has ended, also where it panics.
struct Ends<'a>(&'a (Mutex<bool>, Condvar));

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        *self.0.0.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.0.1.notify_all();
    }
}

/// Runs `work` while the lease is kept; `lost` is set where it is another's.
fn beating<T>(cluster: &Cluster, entry: &Entry, held: &Held, lease: &dyn Lease, work: impl FnOnce(&AtomicBool) -> T) -> T {
    let (lost, ended) = (AtomicBool::new(false), (Mutex::new(false), Condvar::new()));
    let (lost, ended) = (&lost, &ended);
    let beat = || {
        let mut now = ended.0.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            now = ended.1.wait_timeout(now, cluster.lease / 3).unwrap_or_else(PoisonError::into_inner).0;
            if *now {
                return;
            }
            lease.extend();
            cluster.tell_making(held, entry);
            // a store that is away decides nothing
            if matches!(cluster.extend(held), Ok(false)) {
                lost.store(true, Ordering::Release);
            }
        }
    };
    std::thread::scope(|scope| {
        let _ends = Ends(ended);
        if let Err(error) = std::thread::Builder::new().name("tmpi-beats".into()).spawn_scoped(scope, beat) {
            tracing::warn!(%error, "a lease is not kept");
        }
        work(lost)
    })
}

fn run(jobs: &Jobs, cluster: &Cluster, entry: &Arc<Entry>, held: &Held, (lost, job): (&AtomicBool, &Job)) -> (&'static str, Then) {
    let attempts = held.marker().attempts;
    if attempts >= jobs.limits.attempts {
        return fail(jobs, cluster, entry, held, gave_up(attempts));
    }
    let tell = || cluster.tell_making(held, entry);
    match make(jobs, entry, job, &Others { lost, tell: &tell }) {
        Ok(product) => keep(jobs, cluster, entry, held, product),
        Err(Fault::Photo(problem)) => fail(jobs, cluster, entry, held, problem),
        Err(Fault::Crashed(reason)) => {
            tracing::warn!(id = %held.id, attempts = attempts + 1, reason, "the photo took down what made it");
            entry.set(Status::Queued);
            told(held, cluster.crashed(held));
            cluster.tell_waiting(held);
            ("crashed", Then::GiveBack(Duration::ZERO))
        }
        Err(Fault::Server(reason)) => put_back(jobs, cluster, entry, held, reason),
        Err(Fault::Cancelled) if entry.is_deleted() => ("deleted", Then::Acknowledge),
        Err(Fault::Cancelled) if lost.load(Ordering::Acquire) => ("lost", Then::Acknowledge),
        Err(Fault::Cancelled) => {
            entry.set(Status::Queued);
            told(held, cluster.release(held));
            cluster.tell_waiting(held);
            ("cancelled", Then::GiveBack(Duration::ZERO))
        }
    }
}

fn told(held: &Held, written: io::Result<()>) {
    if let Err(error) = written {
        tracing::warn!(id = %held.id, %error, "it is taken up again when its lease has run out");
    }
}

/// A fault of the server: the photo waits, and so does this node.
fn put_back(jobs: &Jobs, cluster: &Cluster, entry: &Entry, held: &Held, reason: String) -> (&'static str, Then) {
    tracing::error!(id = %held.id, reason, "a fault of the server; the photo is tried again");
    entry.set(Status::Queued);
    let pause = cluster.put_back(held).unwrap_or(LATER);
    cluster.tell_waiting(held);
    jobs.suffer(reason, Instant::now() + pause);
    // what is amiss may be this node's alone: others see it before it comes round here
    ("put-back", Then::GiveBack(pause + cluster.sweep_every() * 3))
}

fn keep(jobs: &Jobs, cluster: &Cluster, entry: &Entry, held: &Held, product: Product) -> (&'static str, Then) {
    let done = product.done();
    let report = match serde_json::to_vec(&product.report) {
        Ok(report) => report,
        Err(error) => return put_back(jobs, cluster, entry, held, format!("the report cannot be written: {error}")),
    };
    let parts = [
        (Part::Atlas, product.container),
        (Part::Disparity, product.disparity),
        (Part::Thumbnail, product.thumbnail),
        (Part::Report, report),
    ];
    end(jobs, cluster, entry, held, crate::server::records::End::Done(done), &parts)
}

fn fail(jobs: &Jobs, cluster: &Cluster, entry: &Entry, held: &Held, problem: Problem) -> (&'static str, Then) {
    tracing::warn!(id = %held.id, kind = problem.kind, detail = problem.detail, "the photo cannot be made");
    let failed = Failed { at_ms: now_ms(), problem };
    end(jobs, cluster, entry, held, crate::server::records::End::Failed(failed), &[])
}

/// Ends a making, and tries for a while where the store is away.
fn end(
    jobs: &Jobs,
    cluster: &Cluster,
    entry: &Entry,
    held: &Held,
    end: crate::server::records::End,
    parts: &[(Part, Vec<u8>)],
) -> (&'static str, Then) {
    let of = cluster.name_of(held);
    let record = End { version: records::VERSION, outcome: end, blobs: format!("{}{of}", records::blobs(held.id)) };
    let (until, mut pause) = (Instant::now() + COMMIT, AGAIN);
    loop {
        match cluster.end(held, &of, &record, parts) {
            Ok(outcome) => {
                jobs.mended();
                return (outcome, Then::Acknowledge);
            }
            Err(error) if Instant::now() > until || jobs.aborted() || entry.is_deleted() => {
                return put_back(jobs, cluster, entry, held, format!("the store cannot be written: {error}"));
            }
            Err(error) => {
                tracing::warn!(id = %held.id, %error, "the result waits for the store");
                std::thread::sleep(pause);
                pause = (pause * 2).min(MOST_AGAIN);
            }
        }
    }
}

impl Cluster {
    /// Begin of the names of what is made now.
    pub(super) fn name_of(&self, held: &Held) -> String {
        format!("{}-{}-{}", held.making, self.node, self.next.fetch_add(1, Ordering::Relaxed))
    }

    /// Ends a making by creating the record of its end, after its blobs; where there is one, this result is thrown away.
    pub(super) fn end(&self, held: &Held, of: &str, record: &End, parts: &[(Part, Vec<u8>)]) -> io::Result<&'static str> {
        let id = held.id;
        for (part, bytes) in parts {
            self.heard(self.blobs.put(&records::blob(id, of, *part), bytes.clone()))?;
        }
        let throw_away = || self.discard(id, &[of.to_owned()], &[]);
        let known = {
            let _looking = self.looking(id);
            self.look(id)?
        };
        let Some(Known { photo, .. }) = known.filter(|known| known.photo.making == held.making) else {
            throw_away();
            return Ok("deleted");
        };
        // a version before may have accepted it; and what it takes counts from here on at the latest
        self.heard(index::enter(&*self.ledger, id, &photo.accepted, index::made(Some(&record.outcome))))?;
        let name = End::name(id, &held.making);
        let created = self.heard(self.ledger.create(&name, &serde_json::to_vec_pretty(record)?))?;
        let there =
            if created { None } else { self.ledger.get(&name)?.map(|(bytes, _)| records::read::<End>(&name, &bytes)).transpose()? };
        let ours = created || there.as_ref().is_some_and(|there| there.blobs == record.blobs);
        if !ours {
            throw_away();
        }
        self.settle_entries(id, &photo.accepted, &held.making, there.as_ref().unwrap_or(record));
        // what cannot be removed is removed by who finds it
        let _ = self.ledger.remove(&held.marker().name());
        if ours && let Some(before) = photo.before {
            let source = [Part::Upload, Part::Depth].map(|part| records::blob(id, &photo.source, part));
            let keep: Vec<&str> = source.iter().chain(&photo.strokes).map(String::as_str).collect();
            self.discard(id, &[before], &keep);
        }
        self.stale(id);
        self.tell_changed(id, &held.making);
        Ok(match (&record.outcome, ours) {
            (_, false) => "second",
            (crate::server::records::End::Done(_), _) => "done",
            (crate::server::records::End::Failed(_), _) => "failed",
        })
    }
}
