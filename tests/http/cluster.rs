//! Several nodes on one store.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tmpi::server::{Config, Limits, Role, Server, Sharing};
use tmpi_render::{Backend, PictureFormat};
use tmpi_testing::Engine;

use crate::client::{Connection, get, post_form, request};
use crate::fixture::{Gate, Running, depth_map, jpeg, picture, pipeline, wait_until};
use crate::process::{Process, large};

/// A node of the store in a folder, in this process.
pub fn node(shared: &Path, data: &Path, role: Role, maker: Arc<dyn tmpi::server::Maker>) -> Running {
    node_with(shared, data, role, maker, &Limits::default())
}

/// The same with other limits.
fn node_with(shared: &Path, data: &Path, role: Role, maker: Arc<dyn tmpi::server::Maker>, limits: &Limits) -> Running {
    let sharing = Sharing { store: format!("file://{}", shared.display()), role, nats: None };
    let config = Config {
        limits: Limits { sweep: Duration::from_millis(100), ..limits.clone() },
        ..Config::new(([127, 0, 0, 1], 0).into(), data.to_owned())
    };
    let renderer = tmpi_render::select(Backend::Cpu).unwrap();
    Running::of(async move { Server::bind_among(Some(sharing), config, maker, renderer).await.unwrap() })
}

/// The events of a photo until its stream ends.
fn events(addr: SocketAddr, id: &str) -> std::thread::JoinHandle<String> {
    let path = format!("/v1/photos/{id}/events");
    std::thread::spawn(move || {
        let mut connection = Connection::open(addr);
        connection.send("GET", &path, &[], &[]);
        assert_eq!(connection.head().unwrap().status, 200);
        let mut all = Vec::new();
        while let Some(chunk) = connection.chunk() {
            all.extend(chunk);
        }
        String::from_utf8(all).unwrap()
    })
}

#[test]
fn one_node_takes_a_photo_another_makes_it_and_a_third_serves_it() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (gate, photo) = (Gate::new(0), jpeg(1));
    let alone = Running::start(&at("alone"), Limits::default(), Arc::new(pipeline()));
    let expected = alone.upload(&photo);
    alone.wait(&expected, "done");
    let expected_atlas = get(alone.addr, &format!("/v1/photos/{expected}/atlas")).body;
    let (a, b) =
        (node(&at("store"), &at("a"), Role::Serve, Arc::new(pipeline())), node(&at("store"), &at("b"), Role::Serve, Arc::new(pipeline())));
    let id = a.upload(&photo);
    assert_eq!(id, expected);
    assert_eq!(b.state(&id)["state"], "queued", "it is known at once");
    let followed = events(b.addr, &id);
    let worker = node(&at("store"), &at("w"), Role::Work, gate.clone());
    gate.wait_started(1);
    assert_eq!(get(worker.addr, "/healthz").status, 200);
    get(worker.addr, "/v1/photos").problem(404);
    gate.open(1);
    b.wait(&id, "done");
    a.wait(&id, "done");
    assert!(followed.join().unwrap().contains("event: done"), "who follows it elsewhere is told");
    let path = |what: &str| format!("/v1/photos/{id}{what}");
    assert_eq!(get(b.addr, &path("/atlas")).body, expected_atlas, "the same bytes as one server alone makes");
    assert_eq!(get(b.addr, &path("/atlas")).body, get(a.addr, &path("/atlas")).body);
    assert_eq!(get(b.addr, &path("/view?w=32")).status, 200);
    let patched = request(a.addr, "PATCH", &path(""), &[("content-type", "application/json")], br#"{"title": "A name"}"#);
    assert_eq!(patched.status, 200);
    wait_until("the other node sees the title", || b.state(&id)["settings"]["title"] == "A name");
    // a second upload is known, wherever it comes in
    assert_eq!(request(b.addr, "POST", "/v1/photos", &[], &photo).json()["id"], id.as_str());
    assert_eq!(gate.finished.load(Ordering::SeqCst), 1);
    let listed = get(b.addr, "/v1/photos").json();
    assert_eq!(listed["photos"].as_array().unwrap().len(), 1);
    assert_eq!(request(b.addr, "DELETE", &path(""), &[], &[]).status, 204);
    wait_until("it is gone elsewhere", || get(a.addr, &path("")).status == 404);
    assert_eq!(get(b.addr, &path("/atlas")).status, 404);
}

#[test]
fn a_node_that_knows_few_photos_lists_and_serves_all_of_them() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let maker = node(&at("store"), &at("a"), Role::All, Arc::new(pipeline()));
    let ids: Vec<String> = (1..=6).map(|n| maker.upload(&jpeg(n))).collect();
    for id in &ids {
        maker.wait(id, "done");
    }
    let few = Limits { known_photos: 2, ..Limits::default() };
    let serve = node_with(&at("store"), &at("b"), Role::Serve, Arc::new(pipeline()), &few);
    let listed = |query: &str| {
        let list = get(serve.addr, &format!("/v1/photos?{query}")).json();
        let ids: Vec<String> = list["photos"].as_array().unwrap().iter().map(|photo| photo["id"].as_str().unwrap().to_owned()).collect();
        (ids, list["next"].as_str().map(str::to_owned))
    };
    let newest: Vec<String> = ids.iter().rev().cloned().collect();
    assert_eq!(listed("limit=9"), (newest.clone(), None));
    let (first, next) = listed("limit=4");
    assert_eq!(first, newest[..4]);
    assert_eq!(listed(next.unwrap().split_once('?').unwrap().1), (newest[4..].to_vec(), None));
    // by an id that is known no longer
    assert_eq!(listed(&format!("limit=9&after={}", newest[2])).0, newest[3..]);
    for id in ids.iter().chain(&newest) {
        assert_eq!(serve.state(id)["state"], "done");
        let answer = get(serve.addr, &format!("/v1/photos/{id}/atlas"));
        assert_eq!(answer.body, get(maker.addr, &format!("/v1/photos/{id}/atlas")).body);
        let page = format!("http%3A%2F%2F{}%2Fview%2F{id}", serve.addr);
        assert_eq!(get(serve.addr, &format!("/oembed?url={page}")).status, 200);
    }
    let known = || {
        let metrics = String::from_utf8(get(serve.addr, "/metrics").body).unwrap();
        assert!(!metrics.contains("tmpi_photos_done"), "it does not know");
        metrics.lines().find_map(|line| line.strip_prefix("tmpi_photos_known ")).unwrap().parse::<f64>().unwrap()
    };
    wait_until("no more are known than may be", || known() < 2.5);
    assert_eq!(request(serve.addr, "DELETE", &format!("/v1/photos/{}", newest[1]), &[], &[]).status, 204);
    assert_eq!(listed("limit=9").0, [&newest[..1], &newest[2..]].concat());
}

#[test]
fn photos_of_a_store_go_by_their_age_though_the_node_never_saw_them() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let maker = node(&at("store"), &at("a"), Role::All, Arc::new(pipeline()));
    let ids: Vec<String> = (1..=3).map(|n| maker.upload(&jpeg(n))).collect();
    for id in &ids {
        maker.wait(id, "done");
    }
    let retain = Limits { retain: Some(Duration::from_millis(1)), retain_sweep: Duration::from_millis(200), ..Limits::default() };
    let sweeps = node_with(&at("store"), &at("b"), Role::Serve, Arc::new(pipeline()), &retain);
    for id in &ids {
        wait_until("it is gone", || get(sweeps.addr, &format!("/v1/photos/{id}")).status == 404);
    }
    let listed = get(maker.addr, "/v1/photos").json();
    assert_eq!(listed["photos"].as_array().unwrap().len(), 0);
}

#[test]
fn a_photo_that_is_deleted_elsewhere_is_no_longer_made_and_one_that_is_made_again_counts() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let gate = Gate::new(0);
    let a = node(&at("store"), &at("a"), Role::Serve, Arc::new(pipeline()));
    let worker = node(&at("store"), &at("w"), Role::All, gate.clone());
    let id = a.upload(&jpeg(2));
    gate.wait_started(1);
    assert_eq!(request(worker.addr, "DELETE", &format!("/v1/photos/{id}"), &[], &[]).status, 204);
    let other = a.upload(&jpeg(3));
    gate.wait_started(2);
    assert_eq!(gate.finished.load(Ordering::SeqCst), 0, "the worker is free for the next");
    gate.open(1);
    a.wait(&other, "done");
    let made = a.state(&other);
    let strokes = br#"{"strokes": [{"points": [[0.5, 0.5]], "radius": 0.2, "to": 0.5}]}"#;
    let again = request(a.addr, "PATCH", &format!("/v1/photos/{other}/strokes"), &[("content-type", "application/json")], strokes);
    assert!(matches!(again.status, 200 | 202), "{}", String::from_utf8_lossy(&again.body));
    gate.wait_started(3);
    gate.open(1);
    wait_until("it is made again", || {
        let now = a.state(&other);
        now["state"] == "done" && now["version"] != made["version"]
    });
    // the node that made it may hear of it after others
    wait_until("the worker has it, too", || get(worker.addr, &format!("/v1/photos/{other}/atlas")).status == 200);
}

/// Uploads with a depth map, so that no network is needed.
pub fn upload(addr: SocketAddr, photo: &[u8]) -> Option<String> {
    let answer = post_form(addr, &[], &[("photo", photo), ("depth", &depth_map())]);
    (answer.status == 202 || answer.status == 200).then(|| answer.json()["id"].as_str().unwrap().to_owned())
}

pub fn wait_done(addr: SocketAddr, id: &str) {
    wait_until(&format!("{id} is done"), || get(addr, &format!("/v1/photos/{id}")).json()["state"] == "done");
}

pub fn start(data: &Path, store: &str, more: &[&str], environment: &[(&str, String)]) -> Process {
    let environment: Vec<(&str, &str)> = environment.iter().map(|(name, value)| (*name, value.as_str())).collect();
    Process::start_in(data, &[&["--store", store, "--lease", "3", "--drain", "2"][..], more].concat(), &environment)
}

#[test]
#[cfg(target_os = "linux")]
fn what_a_killed_worker_had_is_made_by_another() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let store = format!("file://{}", at("store").display());
    let serve = start(&at("a"), &store, &["--role", "serve"], &[]);
    let mut worker = start(&at("w1"), &store, &["--role", "work"], &[]);
    let held = worker.hold();
    let photo = large(1);
    let id = upload(serve.addr, &photo).unwrap();
    worker.wait_for_photo();
    worker.crash();
    drop(held);
    let _other = start(&at("w2"), &store, &["--role", "work"], &[]);
    wait_done(serve.addr, &id);
}

/// How a store is away.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Away {
    /// It answers 503.
    Busy,
    /// It takes connections and says nothing.
    Silent,
    /// It is cut off: connections end at once.
    Cut,
}

/// Passes connections on to a server that is away for a while.
pub struct Faults {
    pub addr: SocketAddr,
    away: Arc<Mutex<Option<Away>>>,
    open: Arc<Mutex<Vec<TcpStream>>>,
}

impl Faults {
    pub fn before(server: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let addr = listener.local_addr().unwrap();
        let (away, open) = (Arc::new(Mutex::new(None)), Arc::new(Mutex::new(Vec::<TcpStream>::new())));
        let (fails, kept) = (away.clone(), open.clone());
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                let (fails, kept) = (fails.clone(), kept.clone());
                std::thread::spawn(move || Self::pass(client, server, &fails, &kept));
            }
        });
        Self { addr, away, open }
    }

    fn pass(mut client: TcpStream, server: SocketAddr, fails: &Mutex<Option<Away>>, kept: &Mutex<Vec<TcpStream>>) {
        let away = *fails.lock().unwrap();
        if away == Some(Away::Cut) {
            return;
        }
        if let Some(away) = away {
            kept.lock().unwrap().push(client.try_clone().unwrap());
            if away == Away::Busy {
                let _ = client.read(&mut [0; 4096]);
                let _ = client.write_all(b"HTTP/1.1 503 Slow Down\r\ncontent-length: 0\r\nconnection: close\r\n\r\n");
                let _ = client.shutdown(Shutdown::Write);
            }
            let _ = std::io::copy(&mut client, &mut std::io::sink());
            return;
        }
        let Ok(mut there) = TcpStream::connect(server) else { return };
        let (mut back, mut from) = (client.try_clone().unwrap(), there.try_clone().unwrap());
        kept.lock().unwrap().extend([client.try_clone().unwrap(), there.try_clone().unwrap()]);
        let answers = std::thread::spawn(move || {
            let _ = std::io::copy(&mut from, &mut back);
            let _ = back.shutdown(Shutdown::Both);
        });
        let _ = std::io::copy(&mut client, &mut there);
        let _ = there.shutdown(Shutdown::Both);
        answers.join().unwrap();
    }

    pub fn set(&self, away: Option<Away>) {
        *self.away.lock().unwrap() = away;
        for stream in self.open.lock().unwrap().drain(..) {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }
}

#[test]
fn nothing_is_lost_while_an_object_store_is_away_and_what_is_here_is_served() {
    let Some(engine) = Engine::s3() else { return };
    let faults = Faults::before(engine.addr);
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (store, variables) = ("s3://photos/tmpi", Engine::s3_variables(faults.addr));
    let serve = start(&at("a"), store, &["--role", "serve"], &variables);
    let worker = start(&at("w"), store, &["--role", "work"], &variables);
    let first = upload(serve.addr, &picture(1, PictureFormat::Jpeg)).expect("it is accepted");
    wait_done(serve.addr, &first);
    let atlas = format!("/v1/photos/{first}/atlas");
    let before = get(serve.addr, &atlas);
    assert_eq!(before.status, 200);
    for (seed, away) in [(10, Away::Busy), (20, Away::Silent)] {
        let photo = |n: u8| picture(seed + n, PictureFormat::Jpeg);
        let mut accepted: Vec<String> = (0..2).filter_map(|n| upload(serve.addr, &photo(n))).collect();
        assert_eq!(accepted.len(), 2);
        faults.set(Some(away));
        let refused = post_form(serve.addr, &[], &[("photo", &photo(7)), ("depth", &depth_map())]);
        refused.problem(503);
        wait_until("it says that it is not ready", || get(serve.addr, "/readyz").status == 503);
        let why = get(serve.addr, "/readyz").json()["detail"].to_string();
        assert!(why.contains("the store cannot be reached"), "{why}");
        for node in [&serve, &worker] {
            assert_eq!(get(node.addr, "/healthz").status, 200);
        }
        let began = Instant::now();
        assert_eq!(get(serve.addr, &atlas).body, before.body);
        assert_eq!(get(serve.addr, &format!("/v1/photos/{first}")).json()["state"], "done");
        get(serve.addr, &format!("/v1/photos/{}", "0".repeat(first.len()))).problem(503);
        assert_eq!(get(serve.addr, "/v1/photos").status, 200);
        assert!(began.elapsed() < Duration::from_secs(4), "{away:?}: what is here waits for nobody, {:?}", began.elapsed());
        std::thread::sleep(Duration::from_secs(5));
        faults.set(None);
        wait_until("it is ready again", || get(serve.addr, "/readyz").status == 200);
        accepted.extend(upload(serve.addr, &photo(7)));
        assert_eq!(accepted.len(), 3);
        for id in &accepted {
            wait_done(serve.addr, id);
        }
    }
}

#[test]
fn an_accepted_photo_that_lost_its_marker_is_made() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let serve = node(&at("store"), &at("a"), Role::Serve, Arc::new(pipeline()));
    let id = serve.upload(&jpeg(1));
    let markers: Vec<_> = std::fs::read_dir(at("store/pending")).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert_eq!(markers.len(), 1);
    std::fs::remove_file(&markers[0]).unwrap();
    let _worker = node(&at("store"), &at("w"), Role::Work, Arc::new(pipeline()));
    serve.wait(&id, "done");
}

#[test]
fn a_node_that_nobody_asks_does_not_take_what_others_made_for_waiting() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let serve = node(&at("store"), &at("a"), Role::Serve, Arc::new(pipeline()));
    serve.upload(&jpeg(1));
    let waiting = || {
        let metrics = String::from_utf8(get(serve.addr, "/metrics").body).unwrap();
        metrics.lines().find_map(|line| line.strip_prefix("tmpi_queue_depth ")).unwrap().parse::<f64>().unwrap()
    };
    assert!(waiting() > 0.5);
    let _worker = node(&at("store"), &at("w"), Role::Work, Arc::new(pipeline()));
    wait_until("it is seen that it was made", || waiting() < 0.5);
}
