//! Rooms, end to end: real sockets, real threads; brightness is disparity.

use std::net::TcpStream;

use tmpi::live::{RoomLimits, Rooms};
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{Bye, Credit, Depth, Hello, Sound, Video};
use tmpi_core::live::{TileState, VERSION, read, write};
use tmpi_core::{DisparityMap, container};
use tokio_tungstenite::tungstenite::{self, Message, WebSocket};

use crate::client;
use crate::fixture::unhurried;
use crate::prelude::*;

pub const KEY: &[u8] = b"a key that is long enough for all";

pub fn server() -> Running {
    server_with(|rooms| rooms)
}

/// The same with changed rooms.
pub fn server_with(change: impl FnOnce(Rooms) -> Rooms) -> Running {
    let rooms = change(Rooms::new(models(bright()), Some(KEY.to_vec())).with_limits(unhurried()));
    let maker = Arc::new(Does(|_: &[u8], _: &dyn Sink| Err(Fault::Cancelled)));
    Running::owning(|data| Running::launch(usual(data), maker, drawn_by_cpu(), |server| server.with_rooms(rooms)))
}

pub const SIZE: (u32, u32) = (160, 120);

/// A bright square at `x`.
pub fn frame(x: u32) -> Vec<u8> {
    frame_of(SIZE, x)
}

/// The same at another size.
pub fn frame_of((width, height): (u32, u32), x: u32) -> Vec<u8> {
    let pixel = |i: u32| if (x..x + 32).contains(&(i % width)) && (40..80).contains(&(i / width)) { 220 } else { 60 };
    let rgba = (0..width * height).map(|i| [pixel(i), pixel(i), pixel(i), 255]).collect();
    encode(&View { width, height, rgba }, PictureFormat::Jpeg, 90).unwrap()
}

pub struct Client(WebSocket<TcpStream>);

impl Client {
    pub fn at(addr: SocketAddr, path: &str, headers: &[(&'static str, &str)]) -> Result<Self, u16> {
        let stream = TcpStream::connect(addr).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream.set_nodelay(true).unwrap();
        let mut request = tungstenite::client::IntoClientRequest::into_client_request(format!("ws://{addr}{path}")).unwrap();
        for (name, value) in headers {
            request.headers_mut().insert(*name, value.parse().unwrap());
        }
        match tungstenite::client::client(request, stream) {
            Ok((socket, _)) => Ok(Self(socket)),
            Err(tungstenite::HandshakeError::Failure(tungstenite::Error::Http(answer))) => Err(answer.status().as_u16()),
            Err(error) => panic!("{error}"),
        }
    }

    pub fn watch(addr: SocketAddr, room: &str) -> Self {
        Self::at(addr, &format!("/v1/live/{room}/subscribe"), &[]).unwrap_or_else(|status| panic!("{status}"))
    }

    /// The underlying socket.
    pub const fn raw(&mut self) -> &mut WebSocket<TcpStream> {
        &mut self.0
    }

    pub fn send(&mut self, kind: Kind) {
        // a client that was disconnected learns the reason from the next message it reads
        let _ = self.0.send(Message::Binary(write(kind)));
    }

    pub fn next(&mut self) -> Option<Kind> {
        self.bytes().map(|bytes| read(bytes).unwrap())
    }

    /// The bytes of the next message.
    pub fn bytes(&mut self) -> Option<bytes::Bytes> {
        loop {
            match self.0.read() {
                Ok(Message::Binary(bytes)) => return Some(bytes),
                Ok(Message::Close(_)) | Err(tungstenite::Error::ConnectionClosed | tungstenite::Error::AlreadyClosed) => return None,
                Ok(_) => {}
                Err(error) => panic!("{error}"),
            }
        }
    }

    /// The reason for its disconnection.
    pub fn bye(self) -> String {
        self.farewell().reason
    }

    /// The last message.
    pub fn farewell(mut self) -> Bye {
        while let Some(kind) = self.next() {
            if let Kind::Bye(bye) = kind {
                return bye;
            }
        }
        panic!("it was closed without a reason");
    }
}

pub struct Publisher {
    pub client: Client,
    credit: u32,
    pub number: u64,
}

impl Publisher {
    pub fn new(addr: SocketAddr, room: &str) -> Self {
        Self::of(addr, room, hello())
    }

    pub fn of(addr: SocketAddr, room: &str, hello: Hello) -> Self {
        let mut client = Client::at(addr, &format!("/v1/live/{room}/publish"), &[]).unwrap_or_else(|status| panic!("{status}"));
        client.send(Kind::Hello(hello));
        Self { client, credit: 0, number: 0 }
    }

    /// A publisher of a room whose previous publisher has just gone. Tries again until the server has noticed that.
    pub fn once_free(addr: SocketAddr, room: &str) -> Self {
        let before = Instant::now();
        loop {
            let mut publisher = Self::new(addr, room);
            match publisher.client.next() {
                Some(Kind::Credit(c)) => {
                    publisher.credit = c.frames;
                    return publisher;
                }
                Some(Kind::Bye(bye)) if bye.reason == "someone publishes in this room" => {}
                other => panic!("{other:?}"),
            }
            assert!(before.elapsed() < Duration::from_secs(10), "the previous publisher still holds the room");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    pub fn publish(&mut self, data: Vec<u8>) {
        self.try_publish(true, data).unwrap_or_else(|bye| panic!("{bye:?}"));
    }

    /// Waits for credit; fails with the server's message if it disconnects.
    fn wait_for_credit(&mut self) -> Result<(), Bye> {
        while self.credit == 0 {
            match self.client.next() {
                Some(Kind::Credit(c)) => self.credit += c.frames,
                Some(Kind::Bye(bye)) => return Err(bye),
                other => panic!("{other:?}"),
            }
        }
        Ok(())
    }

    /// Sends a frame as soon as there is credit; fails with the server's message if it disconnects.
    pub fn try_publish(&mut self, key: bool, data: Vec<u8>) -> Result<(), Bye> {
        self.wait_for_credit()?;
        self.credit -= 1;
        self.client.send(Kind::Video(Video { frame: self.number, time: 33_333 * self.number, key, layer: 0, data: data.into() }));
        self.number += 1;
        Ok(())
    }

    /// Sends key frames, which `data` gives for their numbers, until the server disconnects; returns its message.
    pub fn publish_until_refused(&mut self, data: impl Fn(u64) -> Vec<u8>) -> Bye {
        loop {
            if let Err(bye) = self.try_publish(true, data(self.number)) {
                return bye;
            }
        }
    }
}

pub fn hello() -> Hello {
    Hello { version: VERSION, codec: "jpeg".into(), width: SIZE.0, height: SIZE.1, ..Hello::default() }
}

#[test]
fn rooms_keep_to_their_configured_limits() {
    let bounds = RoomLimits { rooms: 1, viewers: 1, frame: 20 << 10, sound: 100, ..unhurried() };
    let server = server_with(|rooms| rooms.with_limits(bounds));
    let mut publisher = Publisher::new(server.addr, "attic");
    publisher.publish(frame(10));
    assert!(matches!(Client::at(server.addr, "/v1/live/cellar/publish", &[]), Err(503)), "a second room");
    let mut viewer = Client::watch(server.addr, "attic");
    assert!(matches!(viewer.next(), Some(Kind::Hello(_))));
    assert!(matches!(Client::at(server.addr, "/v1/live/attic/subscribe", &[]), Err(503)), "a second viewer");
    let sound = |bytes: usize| Kind::Sound(Sound { time: 0, data: vec![1; bytes].into() });
    publisher.client.send(sound(100));
    publisher.publish(frame(20));
    publisher.client.send(sound(101));
    assert!(publisher.client.bye().contains("do not send"));
    let mut publisher = Publisher::once_free(server.addr, "attic");
    publisher.publish(vec![0; (20 << 10) + 1]);
    let reason = publisher.client.bye();
    assert!(reason.contains("over 20480"), "{reason}");
}

#[test]
fn frames_reach_viewers_unchanged_and_geometry_follows() {
    let server = server();
    let mut publisher = Publisher::new(server.addr, "attic");
    publisher.publish(frame(10));
    let mut viewer = Client::watch(server.addr, "attic");
    let Some(Kind::Hello(hello)) = viewer.next() else { panic!("HELLO comes first") };
    assert_eq!((hello.width, hello.height, hello.codec.as_str()), (SIZE.0, SIZE.1, "jpeg"));
    let epoch = hello.epoch;
    assert!(epoch > 1_700_000_000_000, "{epoch}: milliseconds since 1970, so that no epoch repeats after a restart");
    let mut model = TileState::new(&hello).unwrap();
    for n in 1..20 {
        publisher.publish(frame(10 + 4 * n));
    }
    let (mut frames, mut newest) = (Vec::new(), 0);
    while frames.len() < 20 || newest < 19 {
        match viewer.next().expect("the room goes on") {
            Kind::Video(v) => {
                assert_eq!(v.data, frame(10 + 4 * v.frame as u32));
                frames.push(v.frame);
            }
            Kind::Geometry(g) | Kind::Snapshot(g) => {
                newest = g.frame;
                model.take(&g).unwrap();
            }
            Kind::Statistics(s) => newest = newest.max(s.frame),
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(frames, (0..20).collect::<Vec<_>>());
    assert!(model.geometry().is_some());
    // a late viewer gets everything without a new key frame
    let mut late = Client::watch(server.addr, "attic");
    let before = Instant::now();
    let (mut told, mut shown) = (None, false);
    while told.is_none() || !shown {
        match late.next().unwrap() {
            Kind::Hello(h) => assert_eq!(h.epoch, epoch),
            Kind::Snapshot(g) => told = Some(g),
            Kind::Video(v) => shown = v.key,
            _ => {}
        }
    }
    assert!(before.elapsed() < Duration::from_secs(5));
    model.take(&told.unwrap()).unwrap();
    // the same frame by HTTP
    let answer = client::get(server.addr, "/v1/live/attic/frames/latest/atlas");
    assert_eq!((answer.status, answer.header("content-type")), (200, Some("application/vnd.tmpi")));
    let scene = container::decode(&answer.body).unwrap();
    assert_eq!(((scene.photo.width, scene.photo.height), answer.header("x-tmpi-frame")), (SIZE, Some("19")));
    assert!(scene.photo.at(10 + 4 * 19 + 16, 60)[0] > 150);
    let known = client::request(
        server.addr,
        "GET",
        "/v1/live/attic/frames/latest/atlas",
        &[("if-none-match", answer.header("etag").unwrap())],
        &[],
    );
    assert_eq!((known.status, known.header("x-tmpi-frame"), known.body.len()), (304, Some("19"), 0));
    assert_eq!(client::get(server.addr, "/v1/live/cellar/frames/latest/atlas").status, 404);
    groups_are_the_same_for_every_caller(server.addr, epoch, &mut publisher);
    // the publisher reconnects
    drop(publisher);
    let mut publisher = Publisher::once_free(server.addr, "attic");
    publisher.publish(frame(50));
    loop {
        match viewer.next().expect("the room waits for its publisher") {
            Kind::Hello(h) => {
                assert!(h.epoch > epoch);
                break;
            }
            Kind::Bye(bye) => panic!("{}", bye.reason),
            _ => {}
        }
    }
}

/// The messages of a group of pictures.
fn messages(mut body: &[u8]) -> Vec<Kind> {
    let mut messages = Vec::new();
    while let Some((length, rest)) = body.split_first_chunk::<4>() {
        let (message, rest) = rest.split_at(u32::from_le_bytes(*length) as usize);
        messages.push(read(message.to_vec().into()).unwrap());
        body = rest;
    }
    assert!(body.is_empty());
    messages
}

fn groups_are_the_same_for_every_caller(addr: SocketAddr, epoch: u64, publisher: &mut Publisher) {
    let at = |group: &str| client::get(addr, &format!("/v1/live/attic/gops/{group}"));
    // request the next group before it begins
    let waits = std::thread::spawn(move || client::get(addr, &format!("/v1/live/attic/gops/{epoch}-1")));
    // the second one is complete once a third has begun
    wait_until("two groups are complete", || {
        publisher.publish(frame(10 + 4 * (publisher.number % 20) as u32));
        at("latest").header("location").is_some_and(|l| l == format!("{epoch}-2"))
    });
    let first = at(&format!("{epoch}-0"));
    assert_eq!((first.status, first.header("content-type")), (200, Some("application/vnd.tmpi.live")));
    assert_eq!(first.header("cache-control"), Some("private, max-age=31536000, immutable"));
    let token = tmpi::live::room_token(KEY, tmpi::live::Grant::Watch, "attic", u64::MAX);
    let again = at(&format!("{epoch}-0?token={token}"));
    assert_eq!(again.header("cache-control"), Some("public, max-age=31536000, immutable"));
    assert_eq!(again.body, first.body);
    let frames = |messages: &[Kind]| -> Vec<u64> {
        messages.iter().filter_map(|m| if let Kind::Video(v) = m { Some(v.frame) } else { None }).collect()
    };
    let first = messages(&first.body);
    assert!(matches!(&first[0], Kind::Hello(h) if h.epoch == epoch));
    assert_eq!(frames(&first), (0..frames(&first).len() as u64).collect::<Vec<_>>());
    // a group begins with all tiles known before it
    let second = messages(&waits.join().unwrap().body);
    let (Kind::Hello(hello), Kind::Snapshot(tiles)) = (&second[0], &second[1]) else { panic!("HELLO and the tiles come first") };
    let mut model = TileState::new(hello).unwrap();
    model.take(tiles).unwrap();
    assert!(model.geometry().is_some());
    let (first, second) = (frames(&first), frames(&second));
    assert_eq!((second[0], second.len() >= 2), (first[first.len() - 1] + 1, true));
    let newest = at("latest").is(307);
    assert!(newest.header("location").is_some_and(|l| l.starts_with(&format!("{epoch}-")) && l > format!("{epoch}-1").as_str()));
    // only one address for each group
    let wrong = ["1-0", "0-0", "one", "-", "E", "E-", "E-9", "E-00", "E--1", "E-0-1", "+E-0", "0E-0", "E-99999999999999999999"];
    for gone in wrong.map(|form| form.replace('E', &epoch.to_string())) {
        assert_eq!(at(&gone).status, 404, "{gone}");
    }
}

#[test]
fn measured_depth_is_used_and_sound_is_forwarded_unchanged() {
    let server = server();
    let mut publisher = Publisher::new(server.addr, "attic");
    // the measured depth differs from brightness
    let map = DisparityMap::from_fn(SIZE.0, SIZE.1, |x, _| if x < 80 { 0.25 } else { 0.75 });
    let data = tmpi_live::depth_codec::pack(&map).unwrap();
    let mut viewer = None;
    for n in 0..4 {
        publisher.client.send(Kind::Depth(Depth { frame: n, data: data.clone().into() }));
        publisher.publish(frame(10 + n as u32));
        viewer.get_or_insert_with(|| Client::watch(server.addr, "attic"));
        publisher.client.send(Kind::Sound(Sound { time: n, data: vec![n as u8; 9].into() }));
    }
    let (mut model, mut sounds) = (None::<TileState>, Vec::new());
    while sounds.len() < 3 || model.as_ref().is_none_or(|m| m.geometry().is_none()) {
        match viewer.as_mut().unwrap().next().unwrap() {
            Kind::Hello(hello) => model = Some(TileState::new(&hello).unwrap()),
            Kind::Geometry(g) | Kind::Snapshot(g) => drop(model.as_mut().unwrap().take(&g).unwrap()),
            Kind::Sound(s) => {
                assert_eq!(s.data, vec![s.time as u8; 9]);
                sounds.push(s.time);
            }
            Kind::Video(_) | Kind::Statistics(_) => {}
            other => panic!("{other:?}"),
        }
    }
    assert!(sounds.is_sorted());
    let model = model.unwrap();
    let geometry = model.geometry().unwrap();
    let shown = geometry.tiles[0].disparities(&geometry.grid, 0);
    assert!(shown.iter().all(|d| (d - 0.25).abs() < 0.02), "{:?}", geometry.tiles[0].planes);
    // depth of a wrong frame, and depth that is too large
    let says = |mut publisher: Publisher, depth: Depth, words: &str| {
        publisher.wait_for_credit().unwrap();
        publisher.client.send(Kind::Depth(depth));
        let reason = publisher.client.bye();
        assert!(reason.contains(words), "{reason}");
    };
    says(publisher, Depth { frame: 9, data: data.clone().into() }, "another one was due");
    let publisher = Publisher::new(server.addr, "cellar");
    says(publisher, Depth { frame: 0, data: vec![0; (1 << 20) + 1].into() }, "over 1048576");
}

#[test]
fn a_hidden_viewer_gets_only_sound_until_it_is_shown_again() {
    let server = server();
    let mut publisher = Publisher::new(server.addr, "attic");
    publisher.publish(frame(10));
    let mut viewer = Client::watch(server.addr, "attic");
    let Some(Kind::Hello(hello)) = viewer.next() else { panic!("HELLO comes first") };
    let mut model = TileState::new(&hello).unwrap();
    while model.geometry().is_none() {
        if let Kind::Geometry(g) | Kind::Snapshot(g) = viewer.next().unwrap() {
            model.take(&g).unwrap();
        }
    }
    // the viewer is hidden: after a while only sound arrives
    viewer.send(Kind::Credit(Credit { frames: 0, key: false, viewers: 0 }));
    let mut both = |n: u64| {
        publisher.publish(frame(10 + 4 * (n % 20) as u32));
        publisher.client.send(Kind::Sound(Sound { time: n, data: vec![n as u8; 9].into() }));
    };
    let (mut n, mut alone, mut heard) = (1, 0, Vec::new());
    while alone < 4 {
        assert!(n < 300, "frames go on coming");
        both(n);
        n += 1;
        loop {
            match viewer.next().unwrap() {
                Kind::Sound(s) => {
                    heard.push(s.time);
                    alone += 1;
                    break;
                }
                Kind::Video(_) => alone = 0,
                Kind::Geometry(g) | Kind::Snapshot(g) => {
                    model.take(&g).unwrap();
                    alone = 0;
                }
                Kind::Statistics(_) => {}
                other => panic!("{other:?}"),
            }
        }
    }
    viewer.send(Kind::Credit(Credit { frames: 1, key: true, viewers: 0 }));
    let mut first = None;
    // video continues with a key frame, and the tiles that changed meanwhile follow
    let newest = loop {
        both(n);
        n += 1;
        assert!(n < 600, "video does not continue");
        match viewer.next().unwrap() {
            Kind::Video(v) => {
                assert!(first.is_some() || v.key, "video continues with a key frame");
                first.get_or_insert(v.frame);
            }
            Kind::Geometry(g) | Kind::Snapshot(g) => {
                model.take(&g).unwrap();
                if first.is_some() {
                    break g.frame;
                }
            }
            Kind::Sound(s) => heard.push(s.time),
            Kind::Statistics(_) => {}
            other => panic!("{other:?}"),
        }
    };
    assert!(newest > 0 && heard.windows(2).all(|w| w[0] < w[1]), "{heard:?}");
}
