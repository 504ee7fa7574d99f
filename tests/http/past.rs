//! Frames of a room that came earlier: to the bit what they were when each was the newest.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use tempfile::tempdir;
use tmpi::live::{Config as RoomConfig, Role, Rooms, token};
use tmpi::server::{Config, Limits, Server};
use tmpi_core::container::{self, Carried, Carries};
use tmpi_core::live::wire::message::Kind;
use tmpi_core::live::wire::{self, Depth, Hello, Video};
use tmpi_core::live::{Model, VERSION};
use tmpi_core::{DisparityMap, Geometry, Photo, Scene, Texels};
use tmpi_live::video;
use tmpi_pipeline::Models;
use tmpi_pipeline::depth::{DepthError, Estimator};
use tmpi_render::Backend;

use super::client::{Response, get, request};
use super::fixture::{Does, Running, wait_until};
use super::live::{Bright, Client, Publisher, frame, server_with};

const KEY: &[u8] = b"a key that is long enough for all";

/// As [`Bright`], but slower than frames come: some go without planes of their own.
struct Slow;

impl Estimator for Slow {
    fn name(&self) -> &'static str {
        "slow"
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        std::thread::sleep(Duration::from_millis(90));
        Bright.estimate(photo)
    }
}

fn rooms(depth: impl Estimator + 'static) -> Rooms {
    Rooms::new(RoomConfig { models: Models { depth: Arc::new(depth), theta: None, psi: None }, frame_ms: 0.0, key: Some(KEY.to_vec()) })
}

fn server(data: &Path, depth: impl Estimator + 'static, limits: Limits) -> Running {
    let config = Config { hosts: vec!["photos.example".into()], limits, ..Config::new(([127, 0, 0, 1], 0).into(), data.to_owned()) };
    let renderer = tmpi_render::select(Backend::Cpu).unwrap();
    Running::of(async move {
        let maker = Does(|_: &[u8], _: &dyn tmpi_pipeline::Sink| Err(tmpi::server::Fault::Cancelled));
        Server::bind(config, Arc::new(maker), renderer).await.unwrap().with_rooms(rooms(depth))
    })
}

/// What a camera sends.
struct Film {
    codec: &'static str,
    size: (u32, u32),
    frames: Vec<Shot>,
}

/// A frame, whether it is a key, and its depth where that was measured.
type Shot = (Vec<u8>, bool, Option<Vec<u8>>);

/// A film of two groups, twice: with parameters of its own in each key frame.
fn h264() -> Film {
    let mut splitter = tmpi_live::units::Splitter::default();
    let mut units = splitter.push(include_bytes!("../../crates/live/tests/video/testsrc.h264")).unwrap();
    units.extend(splitter.finish());
    let frames = units.into_iter().map(|unit| (unit.data, unit.key, None)).collect();
    Film { codec: "avc1.42c01e", size: (174, 142), frames }
}

fn vp9() -> Film {
    let mut rest = &include_bytes!("../../crates/live/tests/video/testsrc.ivf")[32..];
    let mut frames = Vec::new();
    while let Some((head, after)) = rest.split_first_chunk::<12>() {
        let (data, after) = after.split_at(u32::from_le_bytes([head[0], head[1], head[2], head[3]]) as usize);
        frames.push((data.to_vec(), frames.len().is_multiple_of(20), None));
        rest = after;
    }
    Film { codec: "vp09.00.10.08", size: (174, 142), frames }
}

/// JPEG files, with a depth that moves as they do.
fn measured() -> Film {
    let (width, height) = (160, 120);
    let depth = |x: u32| {
        let delta = (0..width * height).map(|i| if (x..x + 32).contains(&(i % width)) { 0.75 } else { 0.25 }).collect();
        tmpi_live::depth::pack(&DisparityMap { width, height, delta }).unwrap()
    };
    let frames = (0..40).map(|n| 10 + 3 * n).map(|x| (frame(x), true, Some(depth(x)))).collect();
    Film { codec: "jpeg", size: (width, height), frames }
}

/// A publisher of any codec.
struct Camera {
    client: Client,
    credit: u32,
    number: u64,
}

impl Camera {
    fn new(addr: SocketAddr, film: &Film) -> Self {
        let mut client = Client::at(addr, "/v1/live/attic/publish", &[]).unwrap_or_else(|status| panic!("{status}"));
        let (width, height) = film.size;
        client.send(Kind::Hello(Hello { version: VERSION, codec: film.codec.into(), width, height, ..Hello::default() }));
        Self { client, credit: 0, number: 0 }
    }

    fn send(&mut self, (data, key, depth): &Shot) {
        while self.credit == 0 {
            match self.client.next() {
                Some(Kind::Credit(c)) => self.credit += c.frames,
                other => panic!("{other:?}"),
            }
        }
        let frame = self.number;
        if let Some(depth) = depth {
            self.client.send(Kind::Depth(Depth { frame, data: depth.clone().into() }));
        }
        self.client.send(Kind::Video(Video { frame, time: frame, key: *key, layer: 0, data: data.clone().into() }));
        self.credit -= 1;
        self.number += 1;
    }
}

fn at(addr: SocketAddr, path: &str) -> Response {
    get(addr, &format!("/v1/live/attic/frames/{path}"))
}

fn number(answer: &Response) -> u64 {
    answer.header("x-tmpi-frame").and_then(|n| n.parse().ok()).expect("a number")
}

/// The container of a picture with those tiles.
fn contained(photo: Photo, geometry: &Geometry) -> Vec<u8> {
    let carried = Carried::from_photo(&photo, 90).unwrap();
    let Geometry { grid, intrinsics, view_box, .. } = geometry.clone();
    let scene = Scene { grid, intrinsics, view_box, photo, layers: Vec::new(), texels: Texels::default() };
    container::encode(geometry, &scene, &carried, Carries::default()).unwrap().0
}

/// Publishes a film, and asks for each of its frames once it is over. Each is what `latest` was, as far as that was seen, and the picture with
/// the planes that a viewer had by then.
fn every_frame_is_what_it_was(film: &Film, depth: impl Estimator + 'static) {
    let dir = tempdir().unwrap();
    let server = server(dir.path(), depth, Limits::default());
    let (addr, last) = (server.addr, film.frames.len() as u64 - 1);
    let mut camera = Camera::new(addr, film);
    camera.send(&film.frames[0]);
    wait_until("a frame is done", || at(addr, "latest/atlas").status == 200);
    let mut viewer = Client::watch(addr, "attic");
    let (joins, joined) = std::sync::mpsc::channel();
    let told = std::thread::spawn(move || {
        let (mut hello, mut tiles) = (None, Vec::<wire::Geometry>::new());
        loop {
            match viewer.next().unwrap() {
                Kind::Hello(told) => hello = Some(told),
                Kind::Geometry(g) | Kind::Snapshot(g) => {
                    tiles.push(g);
                    joins.send(()).unwrap();
                }
                Kind::Statistics(s) if s.frame >= last => return (hello.unwrap(), tiles, s.skipped),
                _ => {}
            }
        }
    });
    joined.recv().unwrap();
    let over = Arc::new(AtomicBool::new(false));
    let ends = Arc::clone(&over);
    let newest = std::thread::spawn(move || {
        let mut seen = BTreeMap::new();
        while !ends.load(Relaxed) {
            let answer = at(addr, "latest/atlas");
            assert_eq!((answer.status, answer.header("cache-control")), (200, Some("no-store")));
            seen.entry(number(&answer)).or_insert(answer.body);
            std::thread::sleep(Duration::from_millis(3));
        }
        seen
    });
    for shot in &film.frames[1..] {
        // so that groups, which last a second at least, end with each other key frame at the latest
        std::thread::sleep(Duration::from_millis(55));
        camera.send(shot);
    }
    wait_until("the last one is done", || number(&at(addr, "latest/atlas")) == last);
    let (hello, tiles, skipped) = told.join().unwrap();
    over.store(true, Relaxed);
    let seen = newest.join().unwrap();
    let group = get(addr, "/v1/live/attic/gops/latest").header("location").unwrap().to_owned();
    assert!(!group.ends_with("-0"), "{group}: there are several groups");
    let (mut model, mut decoder) = (Model::new(&hello).unwrap(), video::decoder(film.codec, film.size).unwrap());
    let mut alone = 0;
    for (n, (data, ..)) in (0..).zip(&film.frames) {
        let photo = decoder.decode(data).unwrap().unwrap();
        for message in tiles.iter().filter(|t| t.frame == n) {
            model.take(message).unwrap();
        }
        let answer = at(addr, &format!("{n}/atlas"));
        assert_eq!((answer.status, number(&answer)), (200, n), "{}", String::from_utf8_lossy(&answer.body));
        assert_eq!(answer.header("content-type"), Some("application/vnd.tmpi"));
        if let Some(body) = seen.get(&n) {
            assert!(*body == answer.body, "frame {n} is another one than it was");
        } else {
            alone += 1;
        }
        // a viewer that was behind for want of a processor was told some tiles later
        let shown = skipped > 0 || answer.body == contained(photo, model.geometry().unwrap());
        assert!(shown, "frame {n} is not what viewers showed");
    }
    assert!(seen.len() > 2, "{:?}", seen.keys());
    println!("{}: {} frames were seen as the newest, {alone} were not", film.codec, seen.len());
}

#[test]
fn frames_of_h264_and_those_without_planes_of_their_own() {
    every_frame_is_what_it_was(&h264(), Slow);
}

#[test]
fn frames_of_vp9() {
    every_frame_is_what_it_was(&vp9(), Bright);
}

#[test]
fn frames_of_jpeg_with_measured_depth() {
    every_frame_is_what_it_was(&measured(), Bright);
}

#[test]
fn what_is_not_there_is_told_apart_and_caches_keep_what_cannot_change() {
    let dir = tempdir().unwrap();
    let server = server_with(dir.path(), |_| rooms(Bright));
    let addr = server.addr;
    let mut publisher = Publisher::new(addr, "attic");
    // each frame is a key; a group lasts a second, and four are kept
    for n in 0..24 {
        publisher.publish(frame(10 + 4 * n));
        std::thread::sleep(Duration::from_millis(260));
    }
    wait_until("the last one is done", || at(addr, "latest/atlas").header("x-tmpi-frame") == Some("23"));
    let detail = |path: &str| at(addr, path).problem(404)["detail"].as_str().unwrap().to_owned();
    assert_eq!(detail("24/atlas"), "that frame is not done yet: the newest is 23");
    let gone = detail("0/atlas");
    let oldest: u64 =
        gone.strip_prefix("that frame is not kept: the first of those that are is ").unwrap().split_once(';').unwrap().0.parse().unwrap();
    assert!((1..15).contains(&oldest), "{gone}");
    assert_eq!((detail(&format!("{}/view", oldest - 1)), detail("x/atlas")), (gone, "frames have numbers".into()));
    let first = at(addr, &format!("{oldest}/atlas"));
    assert_eq!((first.status, first.header("cache-control")), (200, Some("no-cache")));
    let (epoch, tag) = (first.header("x-tmpi-epoch").unwrap().to_owned(), first.header("etag").unwrap().to_owned());
    assert_eq!(at(addr, "latest/atlas").header("x-tmpi-epoch"), Some(epoch.as_str()));
    let newest = [at(addr, "latest/atlas"), at(addr, "23/atlas")];
    assert!(newest[0].body == newest[1].body && newest[0].header("etag") == newest[1].header("etag"));
    // who has it is told so, and a part is a part
    let path = format!("/v1/live/attic/frames/{oldest}/atlas");
    let known = request(addr, "GET", &path, &[("if-none-match", &tag)], &[]);
    assert_eq!((known.status, number(&known), known.body.len()), (304, oldest, 0));
    let part = request(addr, "GET", &path, &[("range", "bytes=0-99")], &[]);
    assert!(part.status == 206 && part.body == first.body[..100]);
    // the address that no other frame can have
    let own = at(addr, &format!("{epoch}-{oldest}/atlas"));
    assert!(own.body == first.body);
    assert_eq!(own.header("cache-control"), Some("private, max-age=31536000, immutable"));
    let watch = token(KEY, Role::Watch, "attic", u64::MAX).unwrap();
    for (what, kind) in [("atlas", "application/vnd.tmpi"), ("view", "image/png")] {
        let shared = at(addr, &format!("{epoch}-{oldest}/{what}?token={watch}"));
        assert_eq!((shared.status, shared.header("content-type")), (200, Some(kind)));
        assert_eq!(shared.header("cache-control"), Some("public, max-age=31536000, immutable"), "{what}");
    }
    // a view of it: that of its container, not of the newest
    let view = at(addr, &format!("{oldest}/view?format=png&w=80&tx=0.02"));
    assert_eq!((view.status, number(&view), view.header("cache-control")), (200, oldest, Some("no-cache")));
    let scene = Arc::new(container::decode(&first.body).unwrap());
    let pose = tmpi_core::Pose { tx: 0.02, ..tmpi_core::Pose::default() };
    let camera = tmpi_core::Camera { pose, intrinsics: scene.intrinsics.resized((160, 120), (80, 60)), width: 80, height: 60 };
    let drawn = tmpi_render::select(Backend::Cpu).unwrap().render(&scene, &camera).unwrap();
    assert!(view.body == tmpi_render::encode(&drawn, tmpi_render::PictureFormat::Png, tmpi_render::DEFAULT_QUALITY).unwrap());
    // the next publisher begins to count anew
    drop(publisher);
    let mut publisher = Publisher::once_free(addr, "attic");
    publisher.publish(frame(50));
    wait_until("its frame is done", || at(addr, "0/atlas").status == 200);
    assert!(detail(&format!("{epoch}-{oldest}/atlas")).starts_with("the room is in epoch "));
    assert_eq!(detail(&format!("{oldest}/atlas")), "that frame is not done yet: the newest is 0");
}

#[test]
fn many_who_ask_for_one_frame_cost_one_and_too_many_are_sent_back() {
    let dir = tempdir().unwrap();
    let server = server(dir.path(), Bright, Limits { views: 1, views_waiting: 1, ..Limits::default() });
    let (addr, film) = (server.addr, h264());
    let mut camera = Camera::new(addr, &film);
    for (n, shot) in film.frames.iter().cycle().take(60).enumerate() {
        camera.send(shot);
        // all of the others have tiles
        wait_until("a frame is done", || n > 0 || at(addr, "latest/atlas").status == 200);
    }
    wait_until("the last one is done", || at(addr, "latest/atlas").header("x-tmpi-frame") == Some("59"));
    let all = |numbers: Vec<u64>| -> Vec<Response> {
        let ask = |n| std::thread::spawn(move || at(addr, &format!("{n}/atlas")));
        let asking: Vec<_> = numbers.into_iter().map(ask).collect();
        asking.into_iter().map(|thread| thread.join().unwrap()).collect()
    };
    for n in [17, 38, 57] {
        let same = all(vec![n; 16]);
        assert!(same.iter().all(|a| a.status == 200 && a.body == same[0].body), "frame {n}: one is made, and nobody waits for a place");
    }
    // one is made and one waits: of those that come meanwhile some are too many
    let mut rest = 0..56;
    loop {
        let few: Vec<u64> = rest.by_ref().take(14).collect();
        assert!(!few.is_empty(), "all are made at once");
        let answers = all(few);
        assert!(answers.iter().all(|a| matches!(a.status, 200 | 503)));
        if let Some(busy) = answers.iter().find(|a| a.status == 503) {
            assert!(busy.problem(503)["type"] == "urn:tmpi:problem:busy" && busy.header("retry-after").is_some());
            return;
        }
    }
}
