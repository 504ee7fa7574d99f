//! Faults under uploads to several nodes, on any machine: what was accepted is finished, nothing is lost, nothing is there twice.
//! `tests/load/README.md` has a table of all faults; `tests/load/scale.py` does the same at scale.

use std::collections::BTreeSet;
use std::io::Write as _;
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use tmpi_render::PictureFormat;

use crate::client::{Connection, form, get};
use crate::cluster::{Away, Faults, start};
use crate::fixture::{depth_map, picture, wait_until};
use crate::google;
use crate::process::{Process, large};

/// Longest until all is made once a fault is over; seconds on an idle machine.
const RECOVERY: Duration = Duration::from_secs(30);

/// What became of uploads.
#[derive(Debug, PartialEq, Eq)]
struct Count {
    accepted: usize,
    finished: usize,
    lost: usize,
    double: usize,
}

/// Offers a photo with a depth map; none where it is not accepted, for whatever reason.
fn offer(addr: SocketAddr, photo: &[u8]) -> Option<String> {
    let (content_type, body) = form(&[("photo", photo), ("depth", &depth_map())]);
    TcpStream::connect(addr).ok()?;
    let mut connection = std::panic::catch_unwind(|| Connection::open(addr)).ok()?;
    let head =
        format!("POST /v1/photos HTTP/1.1\r\nhost: localhost\r\ncontent-type: {content_type}\r\ncontent-length: {}\r\n\r\n", body.len());
    connection.raw().write_all(head.as_bytes()).ok()?;
    connection.raw().write_all(&body).ok()?;
    let answer = connection.receive("POST").ok()?;
    // one whose answer was lost is known
    matches!(answer.status, 200 | 202).then(|| answer.json()["id"].as_str().unwrap().to_owned())
}

/// Waits until all that was accepted is finished, and counts by the `names` of records and blobs that the store has.
fn counted(serve: SocketAddr, accepted: &[String], names: impl Fn() -> Vec<String>) -> Count {
    let began = Instant::now();
    let state = |id: &String| get(serve, &format!("/v1/photos/{id}")).json()["state"].as_str().map(str::to_owned);
    for id in accepted {
        wait_until("what was accepted is finished", || state(id).is_none_or(|state| state == "done"));
    }
    assert!(began.elapsed() < RECOVERY, "{:?} until all is made", began.elapsed());
    let of = |begin: &str| names().iter().filter(|name| name.starts_with(begin)).count();
    let distinct: BTreeSet<&String> = accepted.iter().collect();
    let finished = accepted.iter().filter(|id| state(id).is_some() && get(serve, &format!("/v1/photos/{id}/atlas")).status == 200).count();
    let lost = accepted.iter().filter(|id| state(id).is_none()).count();
    let listed = get(serve, "/v1/photos?limit=200").json()["photos"].as_array().unwrap().len();
    let double = (of("ends/") - distinct.len()) + (of("photos/") - distinct.len()) + (listed - distinct.len());
    Count { accepted: accepted.len(), finished, lost, double }
}

/// Names of all files in a folder, as a store has them.
fn files(store: &Path) -> Vec<String> {
    fn walk(root: &Path, at: &Path, names: &mut Vec<String>) {
        for entry in std::fs::read_dir(at).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                walk(root, &path, names);
            } else {
                names.push(path.strip_prefix(root).unwrap().to_str().unwrap().to_owned());
            }
        }
    }
    let mut names = Vec::new();
    walk(store, store, &mut names);
    names
}

#[test]
fn kill_9_of_each_node_under_uploads_loses_and_doubles_nothing() {
    const UPLOADS: usize = 16;
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let store = format!("file://{}", at("store").display());
    let node = |n: usize| start(&at(&n.to_string()), &store, &["--role", if n < 2 { "serve" } else { "work" }], &[]);
    let nodes: Vec<Mutex<Process>> = (0..4).map(|n| Mutex::new(node(n))).collect();
    let (next, accepted) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                loop {
                    let n = next.fetch_add(1, Ordering::SeqCst);
                    if n >= UPLOADS {
                        return;
                    }
                    let photo = picture(n as u8, PictureFormat::Jpeg);
                    let mut to = n;
                    let id = loop {
                        to += 1;
                        // where that one is down, the other
                        let addr = nodes[to % 2].lock().unwrap().addr;
                        if let Some(id) = offer(addr, &photo) {
                            break id;
                        }
                        std::thread::sleep(Duration::from_millis(50));
                    };
                    accepted.lock().unwrap().push(id);
                }
            });
        }
        for n in [0, 2, 1, 3] {
            let many = || accepted.lock().unwrap().len();
            let before = many();
            wait_until("another is accepted", || many() > before || many() == UPLOADS);
            let mut killed = nodes[n].lock().unwrap();
            killed.crash();
            *killed = node(n);
        }
    });
    let (serve, accepted) = (nodes[0].lock().unwrap().addr, accepted.into_inner().unwrap());
    let count = counted(serve, &accepted, || files(&at("store")));
    assert_eq!(count, Count { accepted: UPLOADS, finished: UPLOADS, lost: 0, double: 0 });
}

#[test]
#[cfg(target_os = "linux")]
fn of_two_workers_that_have_one_photo_one_result_counts() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let store = format!("file://{}", at("store").display());
    let (serve, slow) = (start(&at("a"), &store, &["--role", "serve"], &[]), start(&at("w1"), &store, &["--role", "work"], &[]));
    let held = slow.hold();
    let id = offer(serve.addr, &large(1)).unwrap();
    slow.wait_for_photo();
    // it stands still as a machine does that swaps, and knows nothing of its lease
    slow.signal(libc::SIGSTOP);
    let _quick = start(&at("w2"), &store, &["--role", "work"], &[]);
    let done = || get(serve.addr, &format!("/v1/photos/{id}")).json()["state"] == "done";
    wait_until("another has made it", done);
    let atlas = get(serve.addr, &format!("/v1/photos/{id}/atlas")).body;
    slow.signal(libc::SIGCONT);
    drop(held);
    let atlases = || files(&at("store")).iter().filter(|name| name.ends_with(".atlas.tmpi")).count();
    wait_until("the first has ended with it", || slow.logged().contains(" job "));
    wait_until("its result is thrown away", || atlases() == 1);
    let count = counted(serve.addr, std::slice::from_ref(&id), || files(&at("store")));
    assert_eq!(count, Count { accepted: 1, finished: 1, lost: 0, double: 0 });
    assert_eq!(get(serve.addr, &format!("/v1/photos/{id}/atlas")).body, atlas);
}

/// Uploads while an object store is there, away, and there again.
fn over(away: Away) {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let engine = google::start(&runtime);
    let faults = Faults::before(engine);
    let variables = [("GOOGLE_BASE_URL", format!("http://{}", faults.addr)), ("GOOGLE_BEARER_TOKEN", "a token".into())];
    let dir = tempfile::tempdir().unwrap();
    let node = |role: &str| start(&dir.path().join(role), "gs://photos/tmpi", &["--role", role], &variables);
    let (serve, worker) = (node("serve"), node("work"));
    let photo = |n: u8| picture(n, PictureFormat::Jpeg);
    let first = offer(serve.addr, &photo(0)).unwrap();
    wait_until("it is made", || get(serve.addr, &format!("/v1/photos/{first}")).json()["state"] == "done");
    assert_eq!(get(serve.addr, &format!("/v1/photos/{first}/atlas")).status, 200);
    let mut accepted = vec![first.clone()];
    // not made yet, some of them
    accepted.extend((1..5).map(|n| offer(serve.addr, &photo(n)).unwrap()));
    faults.set(Some(away));
    let refused = (5..7).filter(|n| offer(serve.addr, &photo(*n)).is_none()).count();
    assert_eq!(refused, 2, "nothing is promised that is not kept");
    for node in [&serve, &worker] {
        assert_eq!(get(node.addr, "/healthz").status, 200);
    }
    assert_eq!(get(serve.addr, &format!("/v1/photos/{first}/atlas")).status, 200, "what is here is served");
    faults.set(None);
    let taken = |n: u8| {
        let mut id = None;
        wait_until("uploads are taken again", || {
            id = offer(serve.addr, &photo(n));
            id.is_some()
        });
        id.unwrap()
    };
    accepted.extend((5..9).map(taken));
    let names = || {
        let listed = String::from_utf8(get(engine, "/photos?list-type=2&prefix=tmpi/").body).unwrap();
        listed.split("<Key>tmpi/").skip(1).map(|rest| rest.split_once("</Key>").unwrap().0.to_owned()).collect()
    };
    let count = counted(serve.addr, &accepted, names);
    assert_eq!(count, Count { accepted: 9, finished: 9, lost: 0, double: 0 }, "{away:?}");
    drop((serve, worker));
    runtime.shutdown_background();
}

#[test]
fn a_store_that_answers_503_for_a_while_loses_and_doubles_nothing() {
    over(Away::Busy);
}

#[test]
fn a_store_that_says_nothing_for_a_while_loses_and_doubles_nothing() {
    over(Away::Silent);
}

#[test]
fn a_store_that_is_cut_off_for_a_while_loses_and_doubles_nothing() {
    over(Away::Cut);
}
