//! Publishers and viewers that break the protocol or stop reading.

use tmpi_core::live::schema::message::Kind;
use tmpi_core::live::schema::{Bye, Credit, Hello, Video};
use tmpi_core::live::{VERSION, write};
use tokio_tungstenite::tungstenite::Message;

use crate::live::{Client, Publisher, SIZE, frame, frame_of, hello, server};

#[test]
fn hostile_publishers_are_disconnected_with_a_reason_and_the_room_goes_on() {
    let server = server();
    let mut good = Publisher::new(server.addr, "attic");
    good.publish(frame(10));
    let mut viewer = Client::watch(server.addr, "attic");
    let raw = || Client::at(server.addr, "/v1/live/cellar/publish", &[]).unwrap_or_else(|status| panic!("{status}"));
    let with = |messages: Vec<Kind>| {
        let mut client = Publisher::once_free(server.addr, "cellar").client;
        for m in messages {
            client.send(m);
        }
        client.bye()
    };
    let video = |frame: u64, key: bool, data: Vec<u8>| Kind::Video(Video { frame, time: 0, key, layer: 0, data: data.into() });
    let says = |reason: String, words: &str| assert!(reason.contains(words), "{reason:?} does not say {words:?}");
    says(with(vec![video(0, false, frame(1))]), "not a key frame");
    says(with(vec![video(0, true, frame(1)), video(2, true, frame(1))]), "frame 2 where 1 was due");
    says(with((0..20).map(|n| video(n, true, frame(1))).collect()), "credit");
    says(with(vec![Kind::Hello(hello())]), "do not send");
    good.publish(frame(20));
    says(with(vec![video(0, true, vec![0; (1 << 20) + 512])]), "over 1048576");
    let refused = |first: Message| {
        let mut client = raw();
        client.raw().send(first).unwrap();
        client.bye()
    };
    let hello_of = |hello: Hello| Message::Binary(write(Kind::Hello(hello)));
    says(refused(Message::Text("hello".into())), "binary");
    says(refused(Message::Binary(vec![0xFF; 40].into())), "not a readable message");
    says(refused(Message::Binary(write(video(0, true, vec![])))), "HELLO");
    says(refused(hello_of(Hello { version: VERSION + 1, ..hello() })), "version");
    says(refused(hello_of(Hello { width: 5000, ..hello() })), "5000");
    says(refused(hello_of(Hello { codec: "hevc".into(), ..hello() })), "hevc");
    says(refused(hello_of(Hello { fov_x: f64::NAN, ..hello() })), "fov-x");
    good.publish(frame(25));
    let mut second = Client::at(server.addr, "/v1/live/attic/publish", &[]).unwrap_or_else(|status| panic!("{status}"));
    second.send(Kind::Hello(hello()));
    says(second.bye(), "someone publishes");
    let mut talker = Client::watch(server.addr, "attic");
    talker.send(Kind::Hello(hello()));
    says(talker.bye(), "viewers may send only");
    let mut talker = Client::watch(server.addr, "attic");
    (0..40).for_each(|_| talker.send(Kind::Credit(Credit { frames: 1, key: false, viewers: 0 })));
    says(talker.bye(), "more CREDIT");
    // frames that are not pictures
    let mut broken = Publisher::new(server.addr, "garden");
    says(broken.publish_until_refused(|_| vec![1, 2, 3]).reason, "cannot be decoded");
    assert!(broken.number < 40);
    // the other room is unaffected
    good.publish(frame(30));
    let mut last = 0;
    while last < 3 {
        if let Kind::Video(v) = viewer.next().unwrap() {
            last = v.frame;
        }
    }
}

#[test]
fn a_viewer_that_stops_reading_delays_no_other_and_resumes_with_whole_frames() {
    const FRAMES: u64 = 160;
    let server = server();
    let mut publisher = Publisher::new(server.addr, "attic");
    let large = |n: u64| {
        // decoders ignore bytes after a JPEG's end
        let mut data = frame(8 * (n % 10) as u32);
        data.resize(100_000, n as u8);
        data
    };
    publisher.publish(large(0));
    let mut stalled = Client::watch(server.addr, "attic");
    let mut healthy = Client::watch(server.addr, "attic");
    let mut shown = || loop {
        if let Kind::Video(v) = healthy.next().unwrap() {
            break v.frame;
        }
    };
    assert_eq!(shown(), 0);
    for n in 1..FRAMES {
        publisher.publish(large(n));
        assert_eq!(shown(), n, "the healthy viewer gets every frame");
    }
    // the frames buffered in the sockets, then the newest
    let (mut seen, mut skipped) = (Vec::new(), 0);
    while seen.last() != Some(&(FRAMES - 1)) {
        match stalled.next().unwrap() {
            Kind::Video(v) => {
                assert_eq!(v.data, large(v.frame));
                seen.push(v.frame);
            }
            Kind::Statistics(s) => skipped = s.skipped,
            _ => {}
        }
    }
    assert!(seen.is_sorted() && (seen.len() as u64) < FRAMES, "{} frames of 100 kB came through an unread socket", seen.len());
    while skipped == 0 {
        if let Kind::Statistics(s) = stalled.next().unwrap() {
            skipped = s.skipped;
        }
    }
    assert!(seen.len() as u64 + skipped >= FRAMES, "{} seen, {skipped} skipped", seen.len());
}

#[test]
fn publishers_with_too_large_frames_or_endless_size_changes_are_disconnected_for_good() {
    let server = server();
    let says = |bye: Bye, words: &str| assert!(bye.reason.contains(words) && !bye.again, "{bye:?} does not say {words:?}");
    // over the limit of a frame, and over the limit of a message
    for bytes in [(1 << 20) + 2048, 3 << 20] {
        let mut publisher = Publisher::once_free(server.addr, "attic");
        publisher.publish(vec![0; bytes]);
        says(publisher.client.farewell(), "over ");
    }
    let mut turning = Publisher::once_free(server.addr, "attic");
    let turned = |n: u64| if n.is_multiple_of(2) { SIZE } else { (SIZE.1, SIZE.0) };
    says(turning.publish_until_refused(|n| frame_of(turned(n), 10)), "change their size");
    assert!(turning.number > 9, "a camera may be turned a few times");
}
