use std::io::Read as _;
use std::path::Path;
use std::sync::OnceLock;
use std::time::Instant;

use super::known::MOST_FAILED;
use super::work::{GIVES_WAY, run};
use super::*;
use crate::server::entry::Status;
use crate::server::files::Files as _;
use crate::server::forgetful::Forgetful;
use crate::server::maker::{Fault, Maker, Never, Product};
use crate::server::memory::Way;
use crate::server::settings::Settings;
use crate::server::store::{Accepted, Part, digest};
use tmpi_pipeline::{MakeError, Options, Sink};
use tmpi_render::Renderer;

fn ordered(exports: &Exports, key: &str) -> Arc<Ordered> {
    let file = Arc::new(Ordered::for_tests(key));
    exports.known().insert(Arc::clone(&file));
    file
}

fn in_memory(limits: &Limits) -> (Arc<Forgetful>, Store, Exports) {
    let files = Arc::new(Forgetful::new());
    let (store, _) = Store::open_in(files.clone(), Path::new("/data"), "", None).unwrap();
    let exports = Exports::open(&store, limits);
    (files, store, exports)
}

#[test]
fn who_was_cancelled_and_ends_late_leaves_the_next_of_its_name_alone() {
    let (dir, limits) = (tempfile::tempdir().unwrap(), Limits::default());
    let (store, _) = Store::open(dir.path(), "").unwrap();
    let exports = Exports::open(&store, &limits);
    let late = ordered(&exports, "k");
    late.cancelled.store(true, Ordering::Release);
    assert!(exports.known().remove(&late));
    let next = ordered(&exports, "k");
    exports.keep(&next, b"second", &store, &limits).unwrap();
    exports.keep(&late, b"first", &store, &limits).unwrap();
    let Standing::Done(record) = next.standing() else { panic!("it was written") };
    let mut bytes = Vec::new();
    exports.shelf.read(next.photo, "k", &record).unwrap().read_to_end(&mut bytes).unwrap();
    assert_eq!(bytes, b"second");
    assert_eq!(late.standing(), Standing::Queued, "nobody is told that it is written");
    assert!(!exports.known().has(&late));
    assert_eq!(exports.bytes(), 6);
    // one that nobody ordered anew is not put there at all
    let gone = ordered(&exports, "gone");
    exports.known().remove(&gone);
    exports.keep(&gone, b"third", &store, &limits).unwrap();
    assert_eq!(Exports::open(&store, &limits).known().values().count(), 1);
}

#[test]
fn small_files_are_bounded_by_their_number_and_counts_are_those_of_what_is_there() {
    let limits = Limits { exports_bytes: 10 << 10, ..Limits::default() };
    let (_files, store, exports) = in_memory(&limits);
    let mut all = Vec::new();
    for n in 0..1040_u64 {
        let file = ordered(&exports, &n.to_string());
        exports.keep(&file, b"1", &store, &limits).unwrap();
        file.used_ms.store(n, Ordering::Relaxed);
        all.push(file);
    }
    let has = |exports: &Exports, n: usize| exports.known().has(&all[n]);
    assert_eq!((exports.bytes(), exports.known().weight), (1024, 10 << 10));
    assert!(!has(&exports, 0) && !has(&exports, 15) && has(&exports, 16) && has(&exports, 1039), "the oldest go");
    let large = ordered(&exports, "large");
    exports.keep(&large, &[0; 100], &store, &limits).unwrap();
    assert_eq!((exports.bytes(), exports.known().weight), (1014 + 100, 10 << 10));
    // after a restart there may be less room
    let fewer = Exports::open(&store, &Limits { exports_bytes: 5 << 10, ..limits });
    assert!(fewer.known().weight <= 5 << 10);
    assert!(fewer.bytes() < 1014 + 100, "some had to go");
}

#[test]
fn reasons_of_failures_are_kept_for_minutes_and_not_without_end() {
    let limits = Limits::default();
    let (_files, _store, exports) = in_memory(&limits);
    let waits = ordered(&exports, "waits");
    for n in 0..MOST_FAILED + 9 {
        let file = ordered(&exports, &n.to_string());
        exports.set(&file, Standing::Failed(late()));
        assert!(file.ends_ms(&limits) <= now_ms() + 10 * 60 * 1000);
    }
    assert_eq!(exports.known().values().count(), MOST_FAILED + 1);
    assert_eq!(exports.known().queued, 1);
    exports.set(&waits, Standing::Working);
    assert_eq!(exports.known().queued, 0);
    exports.set(&waits, Standing::Queued);
    exports.known().insert(Arc::new(Ordered::for_tests("waits")));
    assert_eq!(exports.known().queued, 1, "another took its place");
    exports.set(&waits, Standing::Working);
    assert_eq!(exports.known().queued, 1, "it is not counted any more");
}

#[test]
fn what_would_take_of_the_reserve_of_the_disk_is_refused_alone() {
    let limits = Limits::default();
    let (files, store, exports) = in_memory(&limits);
    let before = ordered(&exports, "before");
    exports.keep(&before, b"bytes", &store, &limits).unwrap();
    // the most that is short
    let short = (0..30).rev().map(|bit| 1 << bit).fold(0, |short, bit| {
        files.leave(short | bit);
        if store.room().is_err() { short | bit } else { short }
    });
    files.leave(short + 5);
    let [large, small] = ["large", "small"].map(|key| ordered(&exports, key));
    assert_eq!(exports.keep(&large, b"bytes", &store, &limits).unwrap_err().status, 507);
    assert_eq!(files.names(Path::new("/data/exports")).unwrap().len(), 2, "nothing of it");
    exports.keep(&small, b"byte", &store, &limits).unwrap();
    assert!([&before, &small].iter().all(|file| matches!(file.standing(), Standing::Done(_))));
}

fn until(what: &str, is_so: impl Fn() -> bool) {
    let end = Instant::now() + Duration::from_secs(20);
    while !is_so() {
        assert!(Instant::now() < end, "{what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Writes files until they are ended, but one that gives way no more once another waits for its memory.
#[derive(Default)]
struct Holds {
    jobs: OnceLock<Arc<Jobs>>,
    tries: AtomicU32,
}

impl Maker for Holds {
    fn check(&self, _: &[u8], _: Option<&[u8]>, _: &Options) -> Result<(), MakeError> {
        Ok(())
    }

    fn make(&self, _: &[u8], _: Option<&[u8]>, _: &Options, _: &dyn Sink) -> Result<Product, Fault> {
        Err(Fault::Cancelled)
    }

    fn export(&self, _: &Work<'_>, sink: &dyn Sink) -> Result<Vec<u8>, Fault> {
        if self.tries.fetch_add(1, Ordering::Relaxed) < GIVES_WAY {
            until("it is ended", || sink.cancelled());
            return Err(Fault::Cancelled);
        }
        until("a photo waits", || self.jobs.get().unwrap().memory.is_wanted());
        if sink.cancelled() { Err(Fault::Cancelled) } else { Ok(b"file".to_vec()) }
    }
}

/// Jobs that have memory for one at a time, a finished photo, and a file of it that waits.
fn with_file(maker: Arc<dyn Maker>, limits: &Limits) -> (Arc<Jobs>, Arc<Ordered>, Arc<dyn Renderer>) {
    let (files, store, _) = in_memory(limits);
    let limits = Arc::new(Limits { workers: 0, job_memory: 1, ..limits.clone() });
    let jobs = Jobs::start(store, Vec::new(), maker, limits, Arc::default()).unwrap();
    let incoming = jobs.store.begin().unwrap();
    files.write(&incoming.path(Part::Upload), b"photo").unwrap();
    let accepted =
        Accepted { version: 1, at_ms: 1, photo_bytes: 5, depth_bytes: None, options: std::collections::BTreeMap::new(), owner: None };
    let entry = jobs.submit(incoming, PhotoId::of(&[1; 32], None, "", ""), accepted, Settings::default()).unwrap().entry;
    jobs.store.write(entry.id, &[(Part::Atlas, b"atlas")]).unwrap();
    let done = Done { at_ms: 2, width: 8, height: 6, atlas_bytes: 5, atlas_hash: digest(b"atlas") };
    entry.set(Status::Done(done.clone()));
    let recipe = Recipe::parse("format=zip", &jobs.limits).unwrap();
    let (file, _) = jobs.order(&entry, &done, "results", &recipe).unwrap();
    (jobs, file, tmpi_render::select(tmpi_render::Backend::Cpu).unwrap())
}

#[test]
fn a_file_gives_its_memory_to_a_photo_that_waits_but_not_for_ever() {
    let maker = Arc::new(Holds::default());
    let (jobs, file, renderer) = with_file(maker.clone(), &Limits::default());
    maker.jobs.set(Arc::clone(&jobs)).ok().unwrap();
    for n in 0..=GIVES_WAY {
        std::thread::scope(|scope| {
            let photo = scope.spawn(|| {
                until("the file is being written", || file.standing() == Standing::Working);
                jobs.memory.wait_for(1, Way::First, || false).is_some()
            });
            let outcome = run(&jobs, &file, &renderer);
            assert_eq!(outcome, if n < GIVES_WAY { "gave-way" } else { "done" }, "{n}");
            assert!(photo.join().unwrap());
        });
        let queued = usize::from(n < GIVES_WAY);
        assert_eq!(jobs.exports.known().queued, queued, "it waits for its next turn");
    }
    assert!(matches!(file.standing(), Standing::Done(record) if record.bytes == 4));
    assert_eq!(jobs.memory.taken(), 0);
}

#[test]
fn a_file_waits_for_memory_as_one_of_those_that_wait_and_no_longer_than_it_may() {
    let (jobs, file, renderer) = with_file(Arc::new(Never), &Limits { export: Duration::from_millis(100), ..Limits::default() });
    let held = jobs.memory.wait_for(1, Way::First, || false).unwrap();
    std::thread::scope(|scope| {
        let ended = scope.spawn(|| run(&jobs, &file, &renderer));
        until("its time is over", || {
            let standing = file.standing();
            assert_ne!(standing, Standing::Working);
            standing != Standing::Queued
        });
        assert_eq!(ended.join().unwrap(), "failed");
    });
    let Standing::Failed(problem) = file.standing() else { panic!("it had no memory") };
    assert!(problem.status == 503 && problem.kind.ends_with("busy"), "{problem:?}");
    drop(held);
}
