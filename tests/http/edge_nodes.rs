//! Rooms on several nodes, end to end: servers as processes, one PostgreSQL, real sockets. Without PostgreSQL and an S3 server these
//! tests say so and pass.

use std::collections::BTreeMap;
use std::net::TcpListener;

use bytes::Bytes;
use tempfile::tempdir;
use tmpi_core::Tile;
use tmpi_core::live::schema::Bye;
use tmpi_core::live::schema::bye::Cause;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::{TileState, read};

use crate::live::{Client, KEY, Publisher, SIZE, frame, frame_of};
use crate::nodes::Shared;
use crate::prelude::*;
use crate::process::Process;

/// A node with `--advertise`.
struct Node {
    process: Process,
    addr: SocketAddr,
}

fn node(shared: &Shared, name: &str, arguments: &[&str]) -> Node {
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let url = format!("http://127.0.0.1:{port}");
    let process = shared.node_at(port, name, &[&["--advertise", url.as_str()][..], arguments].concat());
    Node { addr: process.addr, process }
}

impl Node {
    /// How many rooms it is an edge of.
    fn edges(&self) -> u64 {
        figure(self.addr, "tmpi_live_edges")
    }

    fn room(&self, room: &str, path: &str) -> super::client::Response {
        get(self.addr, &format!("/v1/live/{room}{path}"))
    }
}

/// What a viewer received: the bytes of each frame by number, and its tiles at the end.
#[derive(Default)]
struct Got {
    epoch: u64,
    frames: BTreeMap<u64, Bytes>,
    tiles: Vec<Tile>,
}

/// Watches until frame `last` and its tiles have arrived.
fn watch(mut viewer: Client, last: u64) -> Got {
    let (mut got, mut model) = (Got::default(), None::<TileState>);
    loop {
        let bytes = viewer.bytes().expect("the room goes on");
        match read(bytes.clone()).unwrap() {
            Kind::Hello(hello) => {
                model = Some(TileState::new(&hello).unwrap());
                got.epoch = hello.epoch;
            }
            Kind::Video(video) => assert!(got.frames.insert(video.frame, bytes).is_none(), "frame {} twice", video.frame),
            Kind::Snapshot(tiles) | Kind::Geometry(tiles) => drop(model.as_mut().unwrap().take(&tiles).unwrap()),
            Kind::Statistics(s) if s.frame >= last && got.frames.contains_key(&last) => {
                got.tiles.clone_from(&model.unwrap().geometry().expect("every tile has arrived").tiles);
                return got;
            }
            Kind::Statistics(_) => {}
            other => panic!("{other:?}"),
        }
    }
}

/// Reads until a frame of a later epoch than `epoch` arrives; returns its epoch.
fn next_epoch(viewer: &mut Client, epoch: u64) -> u64 {
    let mut now = 0;
    loop {
        match viewer.next().expect("the viewer stays") {
            Kind::Hello(hello) => now = hello.epoch,
            Kind::Video(_) if now > epoch => return now,
            Kind::Bye(bye) => panic!("{}", bye.reason),
            _ => {}
        }
    }
}

#[test]
fn viewers_at_edge_and_origin_receive_the_same_bytes() {
    let Some(shared) = Shared::start() else { return };
    let (a, b) = (node(&shared, "node-1", &[]), node(&shared, "node-2", &[]));
    assert_eq!(Client::at(b.addr, "/v1/live/attic/subscribe", &[]).err(), Some(404));
    let mut publisher = Publisher::new(a.addr, "attic");
    publisher.publish(frame(10));
    let watching = [&a, &b].map(|node| Client::watch(node.addr, "attic")).map(|v| std::thread::spawn(move || watch(v, 29)));
    wait_until("both viewers are counted", || a.room("attic", "").json()["viewers"] == 2);
    let state = b.room("attic", "").json();
    assert_eq!((&state["publishing"], &state["viewers"], &state["full"]), (&true.into(), &2.into(), &false.into()));
    for n in 1..30 {
        publisher.publish(frame(10 + 3 * n));
    }
    let [here, there] = watching.map(|thread| thread.join().unwrap());
    assert_eq!(here.epoch, there.epoch);
    assert!(there.frames.keys().any(|n| *n > 0) && there.frames.iter().all(|(n, bytes)| here.frames.get(n).is_none_or(|b| b == bytes)));
    assert_eq!(here.tiles, there.tiles);
    // by plain HTTP
    let path = "/frames/latest/atlas";
    let [at_origin, at_edge] = [&a, &b].map(|node| node.room("attic", path));
    assert_eq!((at_edge.status, at_edge.header("content-type")), (200, Some("application/vnd.tmpi")));
    assert_eq!((at_edge.header("x-tmpi-frame"), &at_edge.body), (at_origin.header("x-tmpi-frame"), &at_origin.body));
    let known = request(b.addr, "GET", &format!("/v1/live/attic{path}"), &[("if-none-match", at_edge.header("etag").unwrap())], &[]);
    assert_eq!((known.status, known.body.len()), (304, 0));
    drop(publisher);
    wait_until("the publisher has gone", || b.room("attic", "").json()["publishing"] == false);
    let newest = b.room("attic", "/gops/latest");
    assert_eq!((newest.status, newest.header("location")), (307, a.room("attic", "/gops/latest").header("location")));
    let group = format!("/gops/{}", newest.header("location").unwrap());
    let [at_origin, at_edge] = [&a, &b].map(|node| node.room("attic", &group));
    assert_eq!((at_edge.status, at_edge.header("content-type"), &at_edge.body), (200, Some("application/vnd.tmpi.live"), &at_origin.body));
    assert_eq!(at_edge.header("cache-control"), Some("private, max-age=31536000, immutable"));
    for node in [&a, &b] {
        let missing = node.room("attic", &format!("/gops/{}-999", here.epoch));
        assert_eq!((missing.status, missing.header("retry-after")), (404, Some("1")));
        assert_eq!(node.room("garden", path).status, 404);
    }
}

#[test]
fn a_room_whose_origin_is_killed_goes_on_when_its_publisher_moves_to_another_node() {
    let Some(shared) = Shared::start() else { return };
    let (mut a, b, c) = (node(&shared, "node-3", &[]), node(&shared, "node-4", &[]), node(&shared, "node-5", &[]));
    let mut publisher = Publisher::new(a.addr, "barn");
    publisher.publish(frame(10));
    let mut viewers = [&b, &c].map(|node| Client::watch(node.addr, "barn"));
    let epochs = viewers.each_mut().map(|viewer| next_epoch(viewer, 0));
    assert_eq!(epochs[0], epochs[1]);
    a.process.crash();
    let mut publisher = Publisher::new(b.addr, "barn");
    publisher.publish(frame(20));
    let back = Instant::now();
    for (viewer, which) in viewers.iter_mut().zip(["the new origin", "another node"]) {
        assert!(next_epoch(viewer, epochs[0]) > epochs[0]);
        // only the load script asserts how soon, on an idle machine
        println!("viewers of {which} go on after {:.0?}", back.elapsed());
        publisher.publish(frame(30));
    }
    wait_until("all are counted", || b.room("barn", "").json()["viewers"] == 2);
}

#[test]
fn a_publisher_at_another_node_takes_the_room_over_and_the_old_one_is_told() {
    let Some(shared) = Shared::start() else { return };
    let (a, b) = (node(&shared, "node-6", &[]), node(&shared, "node-7", &[]));
    let mut old = Publisher::new(a.addr, "cellar");
    old.publish(frame(10));
    let mut viewer = Client::watch(a.addr, "cellar");
    let epoch = next_epoch(&mut viewer, 0);
    let mut new = Publisher::new(b.addr, "cellar");
    new.publish(frame(20));
    assert_eq!(old.client.bye(), "the room's publisher has come to another server");
    // the old origin becomes an edge
    let next = next_epoch(&mut viewer, epoch);
    wait_until("the viewer is counted at the new origin", || b.room("cellar", "").json()["viewers"] == 1);
    assert_eq!((a.edges(), b.edges()), (1, 0));
    // it becomes the origin again when its publisher comes back
    drop(new);
    let mut publisher = Publisher::new(a.addr, "cellar");
    publisher.publish(frame(30));
    assert!(next_epoch(&mut viewer, next) > next);
    wait_until("the node is no longer an edge", || a.edges() == 0);
    let second = Publisher::new(a.addr, "cellar").client.next();
    assert!(matches!(second, Some(Kind::Bye(bye)) if bye.reason == "someone publishes in this room"));
}

#[test]
fn an_edge_checks_its_viewers_own_tokens() {
    let Some(shared) = Shared::start() else { return };
    let dir = tempdir().unwrap();
    let key = dir.path().join("key");
    std::fs::write(&key, KEY).unwrap();
    let arguments = ["--host", "photos.example", "--access", "private", "--live-key", key.to_str().unwrap()];
    let (a, b) = (node(&shared, "node-8", &arguments), node(&shared, "node-9", &arguments));
    let mut publisher = Publisher::new(a.addr, "den");
    publisher.publish(frame(10));
    let token = |role, room, ends| tmpi::live::room_token(KEY, role, room, ends);
    let stranger = ("host", "photos.example");
    let with = |token: &str| {
        let bearer = format!("Bearer {token}");
        Client::at(b.addr, "/v1/live/den/subscribe", &[stranger, ("authorization", &bearer)])
    };
    let forged = format!("{}-{}", u64::MAX, "ab".repeat(32));
    for wrong in ["", &token(tmpi::live::Grant::Watch, "attic", u64::MAX), &token(tmpi::live::Grant::Watch, "den", 1), &forged] {
        assert_eq!(with(wrong).err(), Some(403), "{wrong}");
    }
    let mut viewer = with(&token(tmpi::live::Grant::Watch, "den", u64::MAX)).unwrap();
    assert!(next_epoch(&mut viewer, 0) > 0);
    let state = |addr| request(addr, "GET", "/v1/live/den", &[stranger], &[]).status;
    assert_eq!((state(a.addr), state(b.addr)), (403, 403));
}

#[test]
fn an_edge_without_viewers_unsubscribes_and_the_room_limit_holds() {
    let Some(shared) = Shared::start() else { return };
    let (a, b) = (node(&shared, "node-10", &[]), node(&shared, "node-11", &["--set", "live.rooms=1"]));
    let mut publishers = ["east", "west"].map(|room| Publisher::new(a.addr, room));
    for publisher in &mut publishers {
        publisher.publish(frame(10));
    }
    let mut viewer = Client::watch(b.addr, "east");
    assert!(next_epoch(&mut viewer, 0) > 0);
    assert_eq!(Client::at(b.addr, "/v1/live/west/subscribe", &[]).err(), Some(503));
    assert_eq!(Client::at(b.addr, "/v1/live/north/publish", &[]).err(), Some(503));
    drop(viewer);
    wait_until("the edge ends", || b.edges() == 0);
    wait_until("the origin has no viewer", || a.room("east", "").json()["viewers"] == 0);
    assert!(next_epoch(&mut Client::watch(b.addr, "west"), 0) > 0);
}

#[test]
fn a_room_whose_frame_size_changed_follows_its_publisher_to_another_node() {
    let Some(shared) = Shared::start() else { return };
    let (a, b) = (node(&shared, "node-12", &[]), node(&shared, "node-13", &[]));
    let mut old = Publisher::new(a.addr, "loft");
    old.publish(frame(10));
    let mut viewer = Client::watch(a.addr, "loft");
    let came = next_epoch(&mut viewer, 0);
    old.publish(frame_of((SIZE.1, SIZE.0), 10));
    let turned = next_epoch(&mut viewer, came);
    let mut new = Publisher::new(b.addr, "loft");
    new.publish(frame(20));
    assert!(next_epoch(&mut viewer, turned) > turned);
    assert_eq!((a.edges(), b.edges()), (1, 0));
}

#[test]
fn viewers_at_an_edge_are_told_at_once_that_the_publisher_left() {
    let Some(shared) = Shared::start() else { return };
    let (a, b) = (node(&shared, "node-14", &[]), node(&shared, "node-15", &[]));
    let mut publisher = Publisher::new(a.addr, "mill");
    publisher.publish(frame(10));
    // a publisher that sends nothing does not take the room
    let _silent = Client::at(b.addr, "/v1/live/mill/publish", &[]).unwrap_or_else(|status| panic!("{status}"));
    let mut viewer = Client::watch(b.addr, "mill");
    assert!(next_epoch(&mut viewer, 0) > 0);
    publisher.client.send(Kind::Bye(Bye::default()));
    assert_eq!(viewer.farewell().cause(), Cause::Left);
    // so does a viewer that connects later
    assert_eq!(Client::watch(b.addr, "mill").farewell().cause(), Cause::Left);
}

#[test]
fn viewers_of_a_group_at_an_edge_share_one_request_to_the_origin() {
    let Some(shared) = Shared::start() else { return };
    let (a, b) = (node(&shared, "node-16", &[]), node(&shared, "node-17", &[]));
    let mut publisher = Publisher::new(a.addr, "porch");
    publisher.publish(frame(10));
    let mut newest = None;
    wait_until("a group begins", || {
        newest = a.room("porch", "/gops/latest").header("location").map(str::to_owned);
        newest.is_some()
    });
    let group = format!("/gops/{}", newest.unwrap());
    let mut viewers: Vec<_> = (0..6).map(|_| Connection::asking(b.addr, &format!("/v1/live/porch{group}"))).collect();
    for viewer in &mut viewers {
        assert_eq!(viewer.head().unwrap().status, 200);
    }
    publisher.publish(frame(20));
    // which ends the group
    drop(publisher);
    let bodies: Vec<Vec<u8>> = viewers.iter_mut().map(|viewer| std::iter::from_fn(|| viewer.chunk()).flatten().collect()).collect();
    let late = b.room("porch", &group);
    let asked = figure(a.addr, r#"tmpi_requests_total{method="GET",route="/v1/live/{room}/gops/{group}",status="200"}"#);
    assert_eq!((late.status, asked), (200, 1));
    let at_origin = a.room("porch", &group).body;
    assert!(late.body == at_origin && bodies.iter().all(|body| *body == at_origin));
}
