//! Several nodes with one PostgreSQL database and one object store: each makes, serves, changes and deletes photos that another accepted.

use std::collections::BTreeSet;
use std::sync::Mutex;
use std::sync::atomic::AtomicUsize;

#[cfg(target_os = "linux")]
use rustix::process::Signal;
use tmpi_testing::Engine;

use crate::events::Events;
use crate::prelude::*;
use crate::process::{Process, large, upload};

/// The database and the store that nodes share.
pub struct Shared {
    dir: tempfile::TempDir,
    database: String,
    objects: Engine,
}

impl Shared {
    /// `None`, with a message, if PostgreSQL or the S3 server is not installed.
    pub fn start() -> Option<Self> {
        let (database, objects) = (tmpi_testing::database()?, Engine::s3()?);
        Some(Self { dir: tempfile::tempdir().unwrap(), database, objects })
    }

    fn node(&self, name: &str, arguments: &[&str]) -> Process {
        self.node_at(0, name, arguments)
    }

    /// A node at a given port.
    pub fn node_at(&self, port: u16, name: &str, arguments: &[&str]) -> Process {
        let shared = ["--database", &self.database, "--blobs", "s3://photos/tmpi", "--set", "limits.drain=5", "--set", "limits.lease=3"];
        let variables = Engine::s3_variables(self.objects.addr);
        let mut environment: Vec<(&str, &str)> = variables.iter().map(|(name, value)| (*name, value.as_str())).collect();
        environment.push(("AWS_ALLOW_HTTP", "true"));
        Process::start_at(port, &self.dir.path().join(name), &[&shared[..], arguments].concat(), &environment)
    }
}

#[test]
fn one_node_accepts_a_photo_another_makes_it_and_a_third_serves_it() {
    let Some(shared) = Shared::start() else { return };
    let (a, b) = (shared.node("a", &["--role", "serve"]), shared.node("b", &["--role", "serve"]));
    let id = upload(a.addr, &large(1)).unwrap();
    assert_eq!(state(b.addr, &id)["state"], "queued", "the other node knows it at once");
    let mut followed = Events::open(b.addr, &id);
    let worker = shared.node("w", &["--role", "work"]);
    assert_eq!(get(worker.addr, "/healthz").status, 200);
    get(worker.addr, "/v1/photos").problem(404);
    let told: Vec<String> = std::iter::from_fn(|| followed.next()).map(|(name, _)| name).collect();
    assert!(["stage", "done"].iter().all(|name| told.iter().any(|t| t == name)), "events arrive at another node: {told:?}");
    let path = |what: &str| format!("/v1/photos/{id}{what}");
    let atlas = get(a.addr, &path("/atlas"));
    assert_eq!(get(b.addr, &path("/atlas")).body, atlas.body);
    let part = request(b.addr, "GET", &path("/atlas"), &[("range", "bytes=2-9"), ("if-range", atlas.header("etag").unwrap())], &[]);
    assert_eq!((part.status, part.body.as_slice()), (206, &atlas.body[2..10]));
    assert_eq!(get(b.addr, &path("/view?w=32")).status, 200);
    request(a.addr, "PATCH", &path(""), &[JSON], br#"{"title": "A name"}"#).is(200);
    assert_eq!(state(b.addr, &id)["settings"]["title"], "A name");
    // any node serves a file that the worker wrote
    let ordered = request(a.addr, "POST", &path("/exports?format=html"), &[], &[]);
    let location = ordered.header("location").unwrap().to_owned();
    wait_until("it is written", || get(b.addr, &location).json()["state"] == "done");
    assert_eq!(get(b.addr, &format!("{location}/file")).status, 200);
    // the same upload at another node is the same photo
    assert_eq!(upload(b.addr, &large(1)).unwrap(), id);
    assert_eq!(listed(b.addr).len(), 1);
    assert_eq!(request(b.addr, "DELETE", &path(""), &[], &[]).status, 204);
    for node in [&a, &b] {
        assert_eq!(get(node.addr, &path("/atlas")).status, 404);
    }
}

#[test]
fn kill_9_of_each_node_under_uploads_loses_and_doubles_nothing() {
    const UPLOADS: usize = 12;
    let Some(shared) = Shared::start() else { return };
    let node = |n: usize| shared.node(&n.to_string(), &["--role", if n < 2 { "serve" } else { "work" }]);
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
                    let mut id = None;
                    wait_until("it is accepted", || {
                        to += 1;
                        // the nodes in turn, as one may be down
                        let addr = nodes[to % 2].lock().unwrap().addr;
                        id = upload(addr, &photo);
                        id.is_some()
                    });
                    accepted.lock().unwrap().extend(id);
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
    let distinct: BTreeSet<&String> = accepted.iter().collect();
    assert_eq!(distinct.len(), UPLOADS);
    for id in &accepted {
        wait_until("every accepted photo is finished", || state(serve, id)["state"] == "done");
        assert_eq!(get(serve, &format!("/v1/photos/{id}/atlas")).status, 200);
    }
    assert_eq!(listed(serve).len(), UPLOADS, "none is there twice");
}

#[cfg(target_os = "linux")]
#[test]
fn if_two_workers_make_one_photo_only_one_result_counts() {
    let Some(shared) = Shared::start() else { return };
    let (serve, slow) = (shared.node("a", &["--role", "serve"]), shared.node("w1", &["--role", "work"]));
    let held = slow.hold();
    let id = upload(serve.addr, &large(1)).unwrap();
    wait_until("it has begun", || state(serve.addr, &id)["state"] == "working");
    // the worker stops, as on a machine that swaps, and does not renew its lease
    slow.signal(Signal::STOP);
    let _quick = shared.node("w2", &["--role", "work"]);
    wait_until("the other worker has made it", || state(serve.addr, &id)["state"] == "done");
    let atlas = get(serve.addr, &format!("/v1/photos/{id}/atlas")).body;
    slow.signal(Signal::CONT);
    drop(held);
    wait_until("the first worker has dropped it", || slow.logged().contains("outcome=\"deleted\""));
    assert_eq!(state(serve.addr, &id)["state"], "done");
    assert_eq!(get(serve.addr, &format!("/v1/photos/{id}/atlas")).body, atlas);
}
