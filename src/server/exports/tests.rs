use std::io::Read as _;
use std::path::Path;

use super::known::MOST_FAILED;
use super::*;
use crate::server::files::Files as _;
use crate::server::forgetful::Forgetful;

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
    assert!(fewer.bytes() < 1024);
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
