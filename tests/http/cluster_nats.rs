//! Several nodes on one store that tell each other over NATS.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use sha2::{Digest as _, Sha256};
use tmpi::live::NodeConfig;
use tmpi::server::{Config, Limits, Maker, Role, Server, Sharing, hex};
use tmpi_render::{Backend, PictureFormat};

use crate::client::{Connection, get, request};
use crate::cluster::{Away, Faults, start, upload, wait_done};
use crate::fixture::{Gate, Running, jpeg, picture, pipeline, wait_until};
use crate::nats::{Nats, figure};
use crate::process::large;

/// Longer than any of these tests: what happens before was no sweep and no lease that ran out.
const NEVER: Duration = Duration::from_mins(10);

/// Nodes of one store.
struct Nodes<'a> {
    folder: &'a Path,
    servers: Vec<&'a Nats>,
    sweep: Duration,
}

impl Nodes<'_> {
    fn store(&self) -> String {
        format!("file://{}", self.folder.join("store").display())
    }

    /// Last part of their subjects.
    fn key(&self) -> String {
        hex(&Sha256::digest(self.store())[..8])
    }

    /// One that hears the others and has a queue; its first sweep is over.
    fn node(&self, name: &str, role: Role, maker: Arc<dyn Maker>) -> Running {
        self.node_at(name, role, maker, &self.servers.iter().map(|nats| nats.url()).collect::<Vec<_>>())
    }

    /// The same, which finds them at these addresses.
    fn node_at(&self, name: &str, role: Role, maker: Arc<dyn Maker>, urls: &[String]) -> Running {
        let at = NodeConfig { servers: urls.iter().map(|url| url.parse().unwrap()).collect(), login: None, name: name.into() };
        let nats = Some(tmpi::server::Nats { at, replicas: self.servers.len() });
        let sharing = Sharing { store: self.store(), role, nats };
        let config = Config {
            limits: Limits { sweep: self.sweep, lease: 4 * self.sweep, ..Limits::default() },
            ..Config::new(([127, 0, 0, 1], 0).into(), self.folder.join(name))
        };
        let renderer = tmpi_render::select(Backend::Cpu).unwrap();
        let node = Running::of(async move { Server::bind_among(Some(sharing), config, maker, renderer).await.unwrap() });
        wait_until("it has a queue", || figure(node.addr, "tmpi_hints_queue") == Some(1));
        node
    }
}

/// Waits for an event of a photo.
fn wait_event(addr: SocketAddr, id: &str, event: &str) {
    let mut connection = Connection::open(addr);
    connection.send("GET", &format!("/v1/photos/{id}/events"), &[], &[]);
    assert_eq!(connection.head().unwrap().status, 200);
    let mut all = Vec::new();
    while let Some(chunk) = connection.chunk() {
        all.extend(chunk);
        if String::from_utf8_lossy(&all).contains(&format!("event: {event}\n")) {
            return;
        }
    }
    panic!("no {event} in {}", String::from_utf8_lossy(&all));
}

#[test]
fn a_photo_is_begun_followed_and_stopped_at_once_though_nobody_looks() {
    let Some(nats) = Nats::storing() else { return };
    let dir = tempfile::tempdir().unwrap();
    let nodes = Nodes { folder: dir.path(), servers: vec![&nats], sweep: NEVER };
    let gate = Gate::new(0);
    let (a, b) = (nodes.node("a", Role::Serve, Arc::new(pipeline())), nodes.node("b", Role::Serve, Arc::new(pipeline())));
    let _worker = nodes.node("w", Role::Work, gate.clone());
    let began = Instant::now();
    let id = a.upload(&jpeg(1));
    gate.wait_started(1);
    // milliseconds on an idle machine
    assert!(began.elapsed() < Duration::from_secs(10), "{:?}", began.elapsed());
    // it has ended nowhere, so that the store knows of no stage
    wait_event(a.addr, &id, "stage");
    assert_eq!(a.state(&id)["state"], "working");
    assert_eq!(
        (b.state(&id)["state"].as_str(), figure(a.addr, "tmpi_queue_depth")),
        (Some("queued"), Some(0)),
        "b asks for the first time"
    );
    let other = a.upload(&jpeg(2));
    assert_eq!(request(b.addr, "DELETE", &format!("/v1/photos/{id}"), &[], &[]).status, 204);
    gate.wait_started(2);
    assert_eq!(gate.finished.load(Ordering::SeqCst), 0, "the worker was told to stop");
    wait_until("a hears of it", || get(a.addr, &format!("/v1/photos/{id}")).status == 404);
    let ended = {
        let addr = b.addr;
        let other = other.clone();
        std::thread::spawn(move || wait_event(addr, &other, "done"))
    };
    gate.open(1);
    ended.join().unwrap();
    a.wait(&other, "done");
    assert!(figure(a.addr, "tmpi_hints_sent_total") == Some(2) && figure(a.addr, "tmpi_hints_lost_total") == Some(0));
}

#[test]
fn what_was_accepted_is_made_once_though_nats_is_killed_and_its_disk_wiped() {
    let Some(mut nats) = Nats::storing() else { return };
    let dir = tempfile::tempdir().unwrap();
    let gates = [Gate::new(1), Gate::new(1)];
    let (serve, workers) = {
        let nodes = Nodes { folder: dir.path(), servers: vec![&nats], sweep: Duration::from_secs(1) };
        let serve = nodes.node("a", Role::Serve, Arc::new(pipeline()));
        (serve, [nodes.node("w1", Role::Work, gates[0].clone()), nodes.node("w2", Role::Work, gates[1].clone())])
    };
    let mut ids: Vec<String> = (0..6).map(|seed| serve.upload(&jpeg(seed))).collect();
    wait_until("two are made and two begun", || gates.iter().all(|gate| gate.started.load(Ordering::SeqCst) == 2));
    nats.kill();
    nats.wipe();
    wait_until("it is noticed", || figure(serve.addr, "tmpi_nats_connected") == Some(0));
    ids.extend((6..9).map(|seed| serve.upload(&jpeg(seed))));
    for addr in [serve.addr, workers[0].addr] {
        assert_eq!((get(addr, "/healthz").status, get(addr, "/readyz").status), (200, 200));
    }
    for gate in &gates {
        gate.open(2);
    }
    wait_until("they go on without it", || gates.iter().map(|gate| gate.finished.load(Ordering::SeqCst)).sum::<usize>() >= 6);
    nats.restart();
    for gate in &gates {
        gate.open(9);
    }
    for id in &ids {
        serve.wait(id, "done");
    }
    let made = || gates.iter().map(|gate| gate.started.load(Ordering::SeqCst)).sum::<usize>();
    assert_eq!(made(), ids.len(), "none twice");
    // the queue is made again, by whoever finds it missing
    let taken = || workers.iter().filter_map(|worker| figure(worker.addr, "tmpi_hints_taken_total")).sum::<u64>();
    wait_until("there is a queue again", || [serve.addr, workers[0].addr].into_iter().all(|at| figure(at, "tmpi_hints_queue") == Some(1)));
    let (before, mut seed) = (taken(), 20);
    wait_until("a hint comes by it", || {
        seed += 1;
        let id = serve.upload(&jpeg(seed));
        serve.wait(&id, "done");
        taken() > before
    });
    // what was accepted while it was away may have been sent once it was back
    let told = || figure(serve.addr, "tmpi_hints_sent_total").unwrap() + figure(serve.addr, "tmpi_hints_lost_total").unwrap();
    wait_until("each hint is accounted for", || told() == ids.len() as u64 + u64::from(seed - 20));
}

#[test]
fn one_of_three_nats_servers_may_go() {
    let Some(mut cluster) = Nats::cluster() else { return };
    let dir = tempfile::tempdir().unwrap();
    let gate = Gate::new(1000);
    let (serve, worker) = {
        let nodes = Nodes { folder: dir.path(), servers: cluster.iter().collect(), sweep: Duration::from_secs(1) };
        (nodes.node("a", Role::Serve, Arc::new(pipeline())), nodes.node("w", Role::Work, gate.clone()))
    };
    let mut ids = Vec::new();
    for (round, seeds) in [0..4, 4..8, 8..12].into_iter().enumerate() {
        if round > 0 {
            cluster[round - 1].kill();
        }
        for seed in seeds {
            ids.push(serve.upload(&jpeg(seed)));
        }
        if round > 0 {
            cluster[round - 1].restart();
        }
    }
    for id in &ids {
        serve.wait(id, "done");
    }
    assert_eq!(gate.started.load(Ordering::SeqCst), ids.len(), "none twice");
    let taken = || figure(worker.addr, "tmpi_hints_taken_total");
    let (before, mut seed) = (taken(), 20);
    wait_until("hints come", || {
        seed += 1;
        let id = serve.upload(&jpeg(seed));
        serve.wait(&id, "done");
        taken() > before
    });
}

#[test]
fn all_three_nats_servers_may_lose_their_disks() {
    let Some(mut cluster) = Nats::cluster() else { return };
    let dir = tempfile::tempdir().unwrap();
    let gate = Gate::new(2);
    let (serve, worker) = {
        let nodes = Nodes { folder: dir.path(), servers: cluster.iter().collect(), sweep: Duration::from_secs(1) };
        (nodes.node("a", Role::Serve, Arc::new(pipeline())), nodes.node("w", Role::Work, gate.clone()))
    };
    let mut ids: Vec<String> = (0..6).map(|seed| serve.upload(&jpeg(seed))).collect();
    gate.wait_started(3);
    for nats in &mut cluster {
        nats.kill();
        nats.wipe();
    }
    wait_until("it is noticed", || figure(serve.addr, "tmpi_nats_connected") == Some(0));
    ids.extend((6..9).map(|seed| serve.upload(&jpeg(seed))));
    gate.open(2);
    wait_until("it goes on without them", || gate.finished.load(Ordering::SeqCst) >= 4);
    for nats in &mut cluster {
        nats.restart();
    }
    gate.open(9);
    for id in &ids {
        serve.wait(id, "done");
    }
    assert_eq!((ids.len(), gate.started.load(Ordering::SeqCst)), (9, 9), "none twice");
    wait_until("there is a queue again", || [&serve, &worker].iter().all(|node| figure(node.addr, "tmpi_hints_queue") == Some(1)));
}

#[test]
fn a_network_that_is_cut_between_nodes_and_nats_loses_and_doubles_nothing() {
    let Some(nats) = Nats::storing() else { return };
    let dir = tempfile::tempdir().unwrap();
    let nodes = Nodes { folder: dir.path(), servers: vec![&nats], sweep: Duration::from_secs(1) };
    let ways = [(); 2].map(|()| Faults::before(([127, 0, 0, 1], nats.port).into()));
    let by = |n: usize| [format!("nats://{}", ways[n].addr)];
    let gates = [Gate::new(1000), Gate::new(1000)];
    let serve = nodes.node_at("a", Role::Serve, Arc::new(pipeline()), &by(0));
    let worker = nodes.node_at("w", Role::Work, gates[0].clone(), &by(1));
    let _other = nodes.node("v", Role::Work, gates[1].clone());
    let connected = |n: usize, is: u64| {
        let addr = [serve.addr, worker.addr][n];
        wait_until("it is noticed", || figure(addr, "tmpi_nats_connected") == Some(is));
    };
    let mut ids = Vec::new();
    for (round, cut) in [&[0][..], &[1], &[0, 1]].into_iter().enumerate() {
        let upload = |n: usize| serve.upload(&jpeg((8 * round + n) as u8));
        ids.extend((0..2).map(upload));
        for n in cut {
            ways[*n].set(Some(Away::Cut));
            connected(*n, 0);
        }
        ids.extend((2..5).map(upload));
        for n in cut {
            ways[*n].set(None);
            connected(*n, 1);
        }
    }
    for id in &ids {
        serve.wait(id, "done");
    }
    let made: usize = gates.iter().map(|gate| gate.started.load(Ordering::SeqCst)).sum();
    assert_eq!((ids.len(), made), (15, 15), "none twice");
}

#[test]
#[cfg(target_os = "linux")]
fn a_hint_that_a_killed_worker_had_is_given_again_and_its_photo_made() {
    let Some(nats) = Nats::storing() else { return };
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (store, url) = (format!("file://{}", at("store").display()), nats.url());
    let node = |name: &str, role: &str| start(&at(name), &store, &["--nats", &url, "--node", name, "--role", role], &[]);
    let (serve, mut worker) = (node("a", "serve"), node("w1", "work"));
    wait_until("there is a queue", || figure(worker.addr, "tmpi_hints_queue") == Some(1));
    let held = worker.hold();
    let id = upload(serve.addr, &large(1)).unwrap();
    worker.wait_for_photo();
    wait_until("it hears of it", || get(serve.addr, &format!("/v1/photos/{id}")).json()["state"] == "working");
    worker.crash();
    drop(held);
    let other = node("w2", "work");
    wait_done(serve.addr, &id);
    wait_until("the hint comes again", || figure(other.addr, "tmpi_hints_redelivered_total") >= Some(1));
    assert_eq!(figure(other.addr, "tmpi_hints_dropped_total"), Some(0));
}

#[test]
fn without_any_nats_photos_are_taken_and_made_all_the_same() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let store = format!("file://{}", at("store").display());
    // nobody listens there
    let node = |name: &str, role: &str| start(&at(name), &store, &["--nats", "nats://127.0.0.1:9", "--node", name, "--role", role], &[]);
    let (serve, worker) = (node("a", "serve"), node("w", "work"));
    for addr in [serve.addr, worker.addr] {
        wait_until("it is ready", || get(addr, "/readyz").status == 200);
        assert_eq!((figure(addr, "tmpi_nats_connected"), figure(addr, "tmpi_hints_queue")), (Some(0), Some(0)));
    }
    let id = upload(serve.addr, &picture(1, PictureFormat::Jpeg)).expect("it is accepted");
    wait_done(serve.addr, &id);
    wait_until("its hint is given up", || figure(serve.addr, "tmpi_hints_lost_total") == Some(1));
}

#[test]
fn garbage_on_the_subjects_is_counted_and_changes_nothing() {
    let Some(nats) = Nats::storing() else { return };
    let dir = tempfile::tempdir().unwrap();
    let nodes = Nodes { folder: dir.path(), servers: vec![&nats], sweep: NEVER };
    let gate = Gate::new(0);
    let (a, worker) = (nodes.node("a", Role::Serve, Arc::new(pipeline())), nodes.node("w", Role::Work, gate.clone()));
    let id = a.upload(&jpeg(1));
    gate.wait_started(1);
    wait_until("a hears of it", || a.state(&id)["state"] == "working");
    let marker = std::fs::read_dir(dir.path().join("store/pending")).unwrap().next().unwrap().unwrap().file_name();
    let making = marker.to_str().unwrap().split_once('.').unwrap().0.to_owned();
    let note = |version: u32, id: &str, making: &str, what: &str| {
        format!(r#"{{"version":{version},"id":"{id}","making":"{making}","what":{what}}}"#).into_bytes()
    };
    let stage = r#"{"making":{"claim":9,"stages":[{"name":"no such","step":1,"steps":2,"elapsed_ms":0}]}}"#;
    let none = [
        Vec::new(),
        b"{}".to_vec(),
        vec![0xff; 100],
        vec![b' '; 100_000],
        note(2, &id, &making, "\"changed\""),
        note(1, "none", &making, "\"changed\""),
        note(1, &id, "../x", "\"changed\""),
        note(1, &id, &making, stage),
    ];
    let (photos, jobs) = (format!("tmpi.photos.{}", nodes.key()), format!("tmpi.jobs.{}", nodes.key()));
    for payload in &none {
        nats.say(&photos, payload);
    }
    wait_until("all of it is counted", || figure(a.addr, "tmpi_notes_dropped_total") == Some(none.len() as u64));
    // what may be meant and is not so: of a making that nobody has, of a claim that was before, of a photo that is none
    nats.say(&photos, &note(1, &id, "0000000000007-ab-1", r#"{"waiting":{"claim":9}}"#));
    nats.say(&photos, &note(1, &id, &making, r#"{"waiting":{"claim":0}}"#));
    nats.say(&photos, &note(1, &"0".repeat(32), &making, "\"changed\""));
    nats.say(&photos, &note(1, &id, &making, "\"changed\""));
    let up = format!(r#"{{"version":1,"marker":"pending/../../{}"}}"#, marker.to_str().unwrap());
    let no_photo = format!(r#"{{"version":1,"marker":"pending/0000000000007-ab-1.{}"}}"#, "0".repeat(32));
    for hint in [b"garbage".to_vec(), Vec::new(), up.into_bytes()] {
        nats.say(&jobs, &hint);
    }
    nats.say(&jobs, no_photo.as_bytes());
    assert_eq!(a.state(&id)["state"], "working");
    gate.open(2);
    a.wait(&id, "done");
    let other = a.upload(&jpeg(2));
    a.wait(&other, "done");
    wait_until("hints that are none are counted", || figure(worker.addr, "tmpi_hints_dropped_total") == Some(3));
    assert_eq!((gate.started.load(Ordering::SeqCst), figure(a.addr, "tmpi_notes_dropped_total")), (2, Some(none.len() as u64)));
}
