//! Rooms that several servers share over NATS, end to end: a real `nats-server`, real sockets. Without that program these tests say so and pass.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use bytes::Bytes;
use tempfile::{TempDir, tempdir};
use tmpi::live::NodeConfig;
use tmpi_core::live::wire::Hello;
use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::{Model, read};

use super::client::get;
use super::fixture::{Running, wait_until};
use super::live::{Client, Publisher, frame, server_with};
use super::nats::{Nats, figure};
use super::process::Process;

impl Nats {
    /// A node that is ready.
    fn node(&self, data: &Path, name: &str) -> Running {
        let (url, name) = (self.url(), name.to_owned());
        let config = NodeConfig { servers: vec![url.parse().unwrap()], login: None, name };
        let node = server_with(data, |rooms| rooms.shared(config));
        wait_until("the node hears the others", || get(node.addr, "/readyz").status == 200);
        node
    }

    /// The name that the node called `name` goes by among the others.
    fn id(&self, name: &str) -> String {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
        write!(stream, "CONNECT {{\"verbose\":false}}\r\nSUB tmpi.nodes 1\r\n").unwrap();
        let begins = format!(r#"{{"version":1,"node":"{name}-"#);
        let line = lines.find_map(|line| line.unwrap().strip_prefix(&begins).map(str::to_owned)).unwrap();
        format!("{name}-{}", line.split('"').next().unwrap())
    }
}

fn dropped(addr: SocketAddr) -> u64 {
    figure(addr, "tmpi_live_nats_dropped_total").expect("it is counted")
}

/// Waits until somebody may watch a room here.
fn known(addr: SocketAddr, room: &str) {
    wait_until("the room is known", || get(addr, &format!("/v1/live/{room}")).json()["publishing"] == true);
}

/// What a viewer got until frame `last` and its tiles: HELLO, frames by number, and chunks of tiles by their frame, as the bytes that came.
#[derive(Default)]
struct Got {
    hello: Bytes,
    frames: BTreeMap<u64, Bytes>,
    tiles: BTreeMap<u64, Bytes>,
    viewers: u32,
}

/// The viewer comes back with it: it is to be counted until the other one has all, too.
fn watch(mut viewer: Client, last: u64) -> (Got, Client) {
    let (mut got, mut model) = (Got::default(), None::<Model>);
    loop {
        let bytes = viewer.bytes().expect("the room goes on");
        match read(bytes.clone()).unwrap() {
            Kind::Hello(hello) => {
                model = Some(Model::new(&hello).unwrap());
                got.hello = bytes;
            }
            Kind::Video(video) => assert!(got.frames.insert(video.frame, bytes).is_none(), "frame {} twice", video.frame),
            Kind::Snapshot(tiles) => drop(model.as_mut().unwrap().take(&tiles).unwrap()),
            Kind::Geometry(tiles) => {
                model.as_mut().unwrap().take(&tiles).unwrap();
                got.tiles.insert(tiles.frame, bytes);
            }
            // nothing else is to be said, so all of it has come
            Kind::Statistics(s) if s.frame >= last && s.viewers == 2 => {
                got.viewers = s.viewers;
                assert!(model.unwrap().geometry().is_some(), "something is known of each tile");
                return (got, viewer);
            }
            Kind::Statistics(_) => {}
            other => panic!("{other:?}"),
        }
    }
}

/// Two nodes, of which one has the room `attic` with a frame in it, and the other knows it.
struct Pair {
    publisher: Publisher,
    a: Running,
    b: Running,
    _data: [TempDir; 2],
}

impl Pair {
    fn start(nats: &Nats) -> Self {
        let data = [tempdir().unwrap(), tempdir().unwrap()];
        let (a, b) = (nats.node(data[0].path(), "a"), nats.node(data[1].path(), "b"));
        let mut publisher = Publisher::new(a.addr, "attic");
        publisher.publish(frame(10));
        known(b.addr, "attic");
        Self { publisher, a, b, _data: data }
    }
}

#[test]
fn viewers_at_another_node_get_the_very_bytes() {
    // so small that each frame comes in parts
    let Some(nats) = Nats::start(1024) else { return };
    let (one, two) = (tempdir().unwrap(), tempdir().unwrap());
    let (a, b) = (nats.node(one.path(), "a"), nats.node(two.path(), "b"));
    assert_eq!(Client::at(b.addr, "/v1/live/attic/subscribe", &[]).err(), Some(404));
    let mut publisher = Publisher::new(a.addr, "attic");
    publisher.publish(frame(10));
    known(b.addr, "attic");
    let (here, there) = (Client::watch(a.addr, "attic"), Client::watch(b.addr, "attic"));
    let watching = [here, there].map(|viewer| std::thread::spawn(move || watch(viewer, 29)));
    // the node that watches has the room before much has come
    wait_until("both are counted", || get(a.addr, "/v1/live/attic").json()["viewers"] == 2);
    let began = Instant::now();
    for n in 1..30 {
        publisher.publish(frame(10 + 3 * n));
        std::thread::sleep(Duration::from_millis(20));
    }
    let [(here, _a), (there, _b)] = watching.map(|thread| thread.join().unwrap());
    let took = began.elapsed();
    assert!(took < Duration::from_secs(30));
    assert_eq!((here.viewers, there.viewers), (2, 2));
    assert!(frame(10).len() > 1024 && here.hello == there.hello);
    // who is behind by a second skips: where the machine stood still so long that is no fault
    let slow = took > Duration::from_secs(1);
    for got in [&here, &there] {
        assert!(got.frames.contains_key(&29) && (slow || got.frames.len() == 30), "{:?}", got.frames.keys());
    }
    assert!(there.frames.iter().all(|(n, bytes)| here.frames.get(n).is_none_or(|b| b == bytes)), "the bytes of frames");
    let both = there.tiles.iter().filter(|(n, _)| here.tiles.contains_key(*n)).collect::<Vec<_>>();
    assert!((slow || both.len() > 3) && both.iter().all(|(n, bytes)| here.tiles[*n] == **bytes), "the bytes of tiles");
    assert_eq!(get(a.addr, "/v1/live/attic/frames/latest/atlas").status, 200);
    assert_eq!((dropped(a.addr), dropped(b.addr)), (0, 0));
}

#[test]
fn frames_and_groups_are_the_same_at_any_node() {
    // so small that each of them comes in parts
    let Some(nats) = Nats::start(1024) else { return };
    let Pair { mut publisher, a, b, _data } = Pair::start(&nats);
    let of = |addr, path: &str| get(addr, &format!("/v1/live/attic/{path}"));
    wait_until("a frame is done", || of(a.addr, "frames/latest/atlas").status == 200);
    // nobody watches at the other node
    let both = [a.addr, b.addr].map(|addr| of(addr, "frames/latest/atlas"));
    for answer in &both {
        assert_eq!((answer.status, answer.header("content-type")), (200, Some("application/vnd.tmpi")));
        assert_eq!((answer.header("x-tmpi-frame"), &answer.body), (Some("0"), &both[0].body));
    }
    assert!(both[0].body.len() > 1024, "{}", both[0].body.len());
    let newest = of(b.addr, "gops/latest");
    assert_eq!((newest.status, newest.header("location")), (307, of(a.addr, "gops/latest").header("location")));
    let epoch: u64 = newest.header("location").unwrap().split_once('-').unwrap().0.parse().unwrap();
    // the first while it grows, the second before it begins
    let waits = [0, 1].map(|n| std::thread::spawn(move || get(b.addr, &format!("/v1/live/attic/gops/{epoch}-{n}"))));
    for n in 1..5 {
        std::thread::sleep(Duration::from_millis(600));
        publisher.publish(frame(10 + 4 * n));
    }
    let [first, second] = waits.map(|thread| thread.join().unwrap());
    for (n, there) in [first, second].into_iter().enumerate() {
        let here = of(a.addr, &format!("gops/{epoch}-{n}"));
        assert_eq!((there.status, there.header("content-type")), (200, Some("application/vnd.tmpi.live")));
        assert_eq!(there.header("cache-control"), Some("private, max-age=31536000, immutable"));
        assert!(here.status == 200 && here.body == there.body && here.body.len() > 2048, "group {n}");
    }
    for gone in [format!("{epoch}-9"), "1-0".into(), format!("{epoch}-00")] {
        assert_eq!(of(b.addr, &format!("gops/{gone}")).status, 404, "{gone}");
    }
    assert_eq!(get(b.addr, "/v1/live/cellar/frames/latest/atlas").status, 404);
    assert_eq!((dropped(a.addr), dropped(b.addr)), (0, 0));
}

#[test]
fn a_node_that_the_owner_lost_sight_of_goes_on() {
    let Some(nats) = Nats::start(1 << 20) else { return };
    let Pair { mut publisher, a: _a, b, _data } = Pair::start(&nats);
    let mut viewer = Client::watch(b.addr, "attic");
    while !matches!(viewer.next(), Some(Kind::Video(v)) if v.frame == 0) {}
    let leaving = format!(r#"{{"version":1,"node":"{}","rooms":[],"watched":[],"leaving":true}}"#, nats.id("b"));
    // as if nothing of it were heard, until the owner has looked and sends to nobody any more
    let began = Instant::now();
    while began.elapsed() < Duration::from_millis(2200) {
        nats.say("tmpi.nodes", leaving.as_bytes());
        std::thread::sleep(Duration::from_millis(5));
    }
    publisher.publish(frame(50));
    // no other frame follows that would tell
    loop {
        match viewer.next().expect("the viewer stays") {
            Kind::Video(video) if video.frame == 1 => return assert_eq!(video.data, frame(50)),
            Kind::Bye(bye) => panic!("{}", bye.reason),
            _ => {}
        }
    }
}

#[test]
fn of_two_publishers_at_once_one_has_the_room() {
    let Some(nats) = Nats::start(1 << 20) else { return };
    let (one, two) = (tempdir().unwrap(), tempdir().unwrap());
    let (a, b) = (nats.node(one.path(), "a"), nats.node(two.path(), "b"));
    for round in 0..5 {
        let room = format!("room{round}");
        let come = |addr| {
            let room = room.clone();
            std::thread::spawn(move || {
                let mut publisher = Publisher::new(addr, &room);
                match publisher.client.next() {
                    Some(Kind::Credit(_)) => Some(publisher),
                    Some(Kind::Bye(bye)) => {
                        assert_eq!((bye.reason.as_str(), bye.again), ("someone publishes in this room", false));
                        None
                    }
                    other => panic!("{other:?}"),
                }
            })
        };
        let come = [come(a.addr), come(b.addr)].map(|thread| thread.join().unwrap());
        assert_eq!(come.iter().flatten().count(), 1, "round {round}");
        let other = if come[0].is_some() { b.addr } else { a.addr };
        known(other, &room);
        assert_eq!(Publisher::new(other, &room).client.bye(), "someone publishes in this room");
        drop(come);
        // who goes by itself leaves the room at once
        wait_until("the room is free", || get(other, &format!("/v1/live/{room}")).json()["publishing"] == false);
        assert!(matches!(Publisher::new(other, &room).client.next(), Some(Kind::Credit(_))));
    }
}

/// HELLO; before it there may be statistics alone.
fn hello(viewer: &mut Client) -> Hello {
    loop {
        match viewer.next() {
            Some(Kind::Hello(hello)) => return hello,
            Some(Kind::Statistics(_)) => {}
            other => panic!("{other:?}"),
        }
    }
}

/// Reads until a frame of an epoch above `epoch` comes; gives that epoch.
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
fn a_room_whose_node_is_killed_goes_on_at_another() {
    let Some(nats) = Nats::start(1 << 20) else { return };
    let (one, two, frames) = (tempdir().unwrap(), tempdir().unwrap(), tempdir().unwrap());
    let url = nats.url();
    let node = |data: &Path, name| Process::start_with(data, &["--nats", &url, "--node", name]);
    let (mut a, b) = (node(one.path(), "a"), node(two.path(), "b"));
    for n in 0..10 {
        std::fs::write(frames.path().join(format!("{n}.jpg")), frame(10 + 5 * n)).unwrap();
    }
    let rooms = [a.addr, b.addr].map(|addr| format!("http://{addr}/live/attic")).join(",");
    let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
    command.args(["live", "publish", frames.path().to_str().unwrap(), "--room", &rooms, "--times", "1000000"]);
    let mut publisher = Killed(command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap());
    known(b.addr, "attic");
    let mut viewer = Client::watch(b.addr, "attic");
    let hello = hello(&mut viewer);
    while !matches!(viewer.next(), Some(Kind::Video(_))) {}
    // one that is served by the node that dies
    let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
    command.args(["live", "watch", &rooms, "--seconds", "60"]).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut other = Killed(command.spawn().unwrap());
    let mut said = BufReader::new(other.0.stderr.take().unwrap()).lines().map(Result::unwrap);
    assert!(said.any(|line| line.ends_with(&format!("epoch {}", hello.epoch))));
    a.crash();
    let killed = Instant::now();
    let epoch = next_epoch(&mut viewer, hello.epoch);
    // two seconds are what the load script measures on an idle machine
    assert!(killed.elapsed() < Duration::from_secs(10), "{:?}", killed.elapsed());
    assert!(said.any(|line| line.ends_with(&format!("epoch {epoch}"))), "the other viewer comes back");
    assert_eq!(get(b.addr, "/v1/live/attic").json()["viewers"], 2);
    publisher.0.kill().unwrap();
    let mut words = String::new();
    publisher.0.stderr.take().unwrap().read_to_string(&mut words).unwrap();
    assert_eq!(words.matches("again").count(), 1, "it was never sent away: {words}");
}

/// A process that does not outlive its test.
pub struct Killed(pub Child);

impl Killed {
    /// What it prints until its end.
    pub fn printed(mut self) -> String {
        let mut all = String::new();
        self.0.stdout.take().unwrap().read_to_string(&mut all).unwrap();
        all
    }
}

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn without_nats_rooms_go_on_for_those_who_are_here() {
    let Some(mut nats) = Nats::start(1 << 20) else { return };
    let Pair { mut publisher, a, b, _data } = Pair::start(&nats);
    let (mut here, mut there) = (Client::watch(a.addr, "attic"), Client::watch(b.addr, "attic"));
    let until = |viewer: &mut Client, number: u64| loop {
        match viewer.next().expect("the viewer stays") {
            Kind::Video(video) if video.frame >= number => return video.frame,
            Kind::Bye(bye) => panic!("{}", bye.reason),
            _ => {}
        }
    };
    assert_eq!((until(&mut here, 0), until(&mut there, 0)), (0, 0));
    nats.kill();
    wait_until("the nodes notice", || get(a.addr, "/readyz").status == 503 && get(b.addr, "/readyz").status == 503);
    assert!(get(a.addr, "/readyz").problem(503)["detail"].as_str().unwrap().contains("NATS"));
    assert_eq!(get(a.addr, "/healthz").status, 200);
    for n in 1..20 {
        publisher.publish(frame(10 + 3 * n));
    }
    assert_eq!(until(&mut here, 19), 19);
    // a room that nobody else can have had is anybody's, the other's is not
    assert!(matches!(Publisher::new(b.addr, "cellar").client.next(), Some(Kind::Credit(_))));
    assert!(Publisher::new(b.addr, "attic").client.bye().contains("another node"));
    nats.restart();
    wait_until("the nodes are back", || get(a.addr, "/readyz").status == 200 && get(b.addr, "/readyz").status == 200);
    // the same epoch goes on, with what was missed left out
    for n in 20..40 {
        publisher.publish(frame(10 + 2 * n));
        std::thread::sleep(Duration::from_millis(50));
    }
    assert_eq!((until(&mut here, 39), until(&mut there, 39)), (39, 39));
    // and whoever comes now is let in at both
    known(b.addr, "attic");
    assert!(hello(&mut Client::watch(b.addr, "attic")).epoch > 0);
}

#[test]
fn garbage_older_epochs_and_too_much_are_left_out_and_counted() {
    let Some(nats) = Nats::start(8 << 20) else { return };
    let Pair { mut publisher, a: _a, b, _data } = Pair::start(&nats);
    let mut viewer = Client::watch(b.addr, "attic");
    let hello = hello(&mut viewer);
    while !matches!(viewer.next(), Some(Kind::Video(v)) if v.frame == 0) {}
    let live = format!("tmpi.live.attic.{}", hello.epoch);
    let head = |sort: u8, part: u16, parts: u16, number: u64, after: u64| {
        let mut head = vec![b'T', 1, sort, 0];
        head.extend(part.to_le_bytes());
        head.extend(parts.to_le_bytes());
        head.extend(number.to_le_bytes());
        head.extend(after.to_le_bytes());
        head
    };
    let fake = tmpi_core::live::write(Kind::Video(tmpi_core::live::wire::Video { frame: 7777, key: true, ..Default::default() }));
    let held = |node: &str, epoch: u64| {
        format!(r#"{{"version":1,"node":"{node}","rooms":[{{"room":"attic","epoch":{epoch},"open":true}}],"watched":[]}}"#)
    };
    let before = dropped(b.addr);
    let ahead = hello.epoch + 1_000_000_000_000;
    let garbage: [(&str, Vec<u8>); 12] = [
        (&live, b"garbage".to_vec()),
        (&live, Vec::new()),
        (&live, vec![0xff; 100]),
        (&live, head(9, 0, 1, 0, 0)),
        // of a ring that nobody has
        (&live, [head(0, 0, 1, 1 << 60, 0), fake.to_vec()].concat()),
        // no message; one part of many that does not begin
        (&live, [head(0, 0, 1, 9, 0), vec![0xff; 50]].concat()),
        (&live, [head(0, 5, 9, 9, 0), fake.to_vec()].concat()),
        // over what a message may have
        (&live, [head(0, 0, 1, 9, 0), vec![0; (4 << 20) + 1]].concat()),
        ("tmpi.nodes", b"{\"version\":1".to_vec()),
        ("tmpi.nodes", vec![b' '; 100_000]),
        ("tmpi.nodes", held("no.node", hello.epoch).into()),
        ("tmpi.nodes", held("mallory", ahead).into()),
    ];
    let many = garbage.len() as u64;
    for (subject, payload) in garbage {
        nats.say(subject, &payload);
    }
    wait_until("all of it is counted", || dropped(b.addr) >= before + many);
    assert_eq!(dropped(b.addr), before + many);
    // an older epoch is nobody's: neither what is said of it nor what comes by it
    nats.say("tmpi.nodes", held("mallory", hello.epoch - 1).as_bytes());
    nats.say(&format!("tmpi.live.attic.{}", hello.epoch - 1), &[head(0, 0, 1, 2, 0), fake.to_vec()].concat());
    let mut frames = Vec::new();
    for n in 1..20 {
        publisher.publish(frame(10 + 3 * n as u32));
        // one after the other: a viewer that is behind is sent the newest alone
        while frames.last() != Some(&n) {
            match viewer.next().expect("the viewer stays") {
                Kind::Video(video) => {
                    assert_eq!(video.data, frame(10 + 3 * video.frame as u32));
                    frames.push(video.frame);
                }
                Kind::Hello(_) => panic!("the room is not another one's"),
                Kind::Bye(bye) => panic!("{}", bye.reason),
                _ => {}
            }
        }
    }
    assert_eq!(frames, (1..20).collect::<Vec<_>>());
}
