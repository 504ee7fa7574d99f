//! Rooms with misbehaving publishers, and panics of the geometry thread.

use std::net::TcpListener;
use std::process::{Command, Stdio};
use std::sync::atomic::AtomicU32;

use tempfile::tempdir;
use tmpi::live::Rooms;
use tmpi_core::Photo;
use tmpi_core::live::schema::bye::Cause;
use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{Bye, Credit, Hello, Sound, Video};
use tmpi_core::live::{TileState, VERSION, write};
use tmpi_pipeline::depth::Estimator;
use tokio_tungstenite::tungstenite::{self, Message};

use crate::fixture::unhurried;
use crate::live::{Client, Publisher, frame, server_with};
use crate::prelude::*;

/// Rooms whose network panics this many times before it estimates.
fn rooms(panics: u32) -> Rooms {
    let (left, bright) = (AtomicU32::new(panics), bright());
    let depth = move |photo: &Photo| {
        assert!(left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(1)).is_err(), "as planned");
        bright.estimate(photo)
    };
    Rooms::new(models(("panics", depth)), None).with_limits(unhurried())
}

#[test]
fn geometry_resumes_after_a_panic_and_repeated_panics_end_the_room_with_a_reason() {
    let server = server_with(|_| rooms(2));
    let mut publisher = Publisher::new(server.addr, "attic");
    publisher.publish(frame(10));
    let mut viewer = Client::watch(server.addr, "attic");
    let mut model = None::<TileState>;
    let (mut n, mut without) = (0, 0);
    while without < 2 || model.as_ref().is_none_or(|m| m.geometry().is_none()) {
        n += 1;
        assert!(n < 300, "no geometry came");
        publisher.publish(frame(10 + 4 * (n % 20)));
        match viewer.next().unwrap() {
            Kind::Hello(hello) => model = Some(TileState::new(&hello).unwrap()),
            Kind::Geometry(g) | Kind::Snapshot(g) => drop(model.as_mut().unwrap().take(&g).unwrap()),
            Kind::Statistics(s) => without = s.frames_without_geometry,
            _ => std::thread::sleep(Duration::from_millis(20)),
        }
    }
    let server = server_with(|_| rooms(u32::MAX));
    let reason = Publisher::new(server.addr, "attic").publish_until_refused(|_| frame(10)).reason;
    assert!(reason.contains("geometry failed"), "{reason}");
}

#[test]
fn publishers_that_only_ping_flood_sound_or_send_b_frames_are_disconnected() {
    let server = server_with(|rooms| rooms);
    // far more than the limits allow
    for (room, packets, bytes) in [("cellar", 2000, 9), ("kitchen", 20, 16 << 10)] {
        let mut flood = Publisher::new(server.addr, room);
        for time in 0..packets {
            flood.client.send(Kind::Sound(Sound { time, data: vec![0; bytes].into() }));
        }
        let reason = flood.client.bye();
        assert!(reason.contains("200 packets or 65536 bytes"), "{reason}");
    }
    let mut film = Client::at(server.addr, "/v1/live/garden/publish", &[]).unwrap_or_else(|status| panic!("{status}"));
    film.send(Kind::Hello(Hello { version: VERSION, codec: "avc1.42e01e".into(), width: 64, height: 48, ..Hello::default() }));
    // `first_mb_in_slice` 0, `slice_type` 1: a B-frame
    let data = vec![0, 0, 1, 0x41, 0xA0, 7];
    film.send(Kind::Video(Video { frame: 0, time: 0, key: true, layer: 0, data: data.into() }));
    let reason = film.bye();
    assert!(reason.contains("ffmpeg -bf 0"), "{reason}");
    let mut idle = Publisher::new(server.addr, "attic");
    let (start, mut heard) = (Instant::now(), 0);
    let bye = loop {
        let _ = idle.client.raw().send(Message::Ping(vec![1].into()));
        match idle.client.next().expect("the reason comes first") {
            // the server sends credit every second
            Kind::Credit(_) => heard += 1,
            Kind::Bye(bye) => break bye,
            other => panic!("{other:?}"),
        }
    };
    let reason = bye.reason;
    assert!(bye.again, "a paused camera may reconnect");
    assert!(reason.contains("nothing came") && start.elapsed() < Duration::from_secs(15) && heard > 5, "{reason}: {heard}");
}

#[test]
fn a_viewer_that_cannot_decode_gets_a_new_key_frame() {
    let server = server_with(|rooms| rooms);
    let mut publisher = Publisher::new(server.addr, "attic");
    publisher.publish(frame(10));
    let mut viewer = Client::watch(server.addr, "attic");
    while !matches!(viewer.next(), Some(Kind::Video(video)) if video.frame == 0) {}
    viewer.send(Kind::Credit(Credit { frames: 1, key: true, viewers: 0 }));
    // the publisher is asked at once, not with the next regular credit
    while !matches!(publisher.client.next(), Some(Kind::Credit(credit)) if credit.key) {}
    publisher.publish(frame(20));
    while !matches!(viewer.next(), Some(Kind::Video(video)) if video.frame == 1 && video.key) {}
}

#[test]
fn live_watch_says_once_that_the_publisher_has_gone_and_reconnects_every_second() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let room = format!("http://{}/live/attic", listener.local_addr().unwrap());
    let program = Command::new(env!("CARGO_BIN_EXE_tmpi")).args(["live", "watch", &room]).stderr(Stdio::piped()).spawn().unwrap();
    let asked = [true, true, false].map(|again| {
        let mut socket = tungstenite::accept(listener.accept().unwrap().0).unwrap();
        let at = Instant::now();
        let bye = Bye { reason: "the publisher has gone".into(), again, cause: Cause::Left.into() };
        socket.send(Message::Binary(write(Kind::Bye(bye)))).unwrap();
        at
    });
    let output = program.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert_eq!(said.matches("the publisher has gone").count(), 1, "{said}");
    assert!(asked.windows(2).all(|w| w[1] - w[0] >= Duration::from_secs(1)), "{asked:?}");
}

#[test]
fn viewers_of_a_film_are_told_at_its_end_that_the_publisher_has_gone() {
    let film = tempdir().unwrap();
    let server = server_with(|rooms| rooms);
    for n in 0..3 {
        std::fs::write(film.path().join(format!("{n}.jpg")), frame(10 + n)).unwrap();
    }
    let room = format!("http://{}/live/attic", server.addr);
    let mut program = Command::new(env!("CARGO_BIN_EXE_tmpi"));
    let output = program.args(["live", "publish"]).arg(film.path()).args(["--room", &room]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // the room does not wait for this publisher to return
    assert_eq!(Client::watch(server.addr, "attic").farewell().cause(), Cause::Left);
    assert!(get(server.addr, "/v1/live/attic").json()["ended"].is_null(), "it was not refused");
}
