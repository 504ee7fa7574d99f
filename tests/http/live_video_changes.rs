//! Rooms whose video changes its size or cannot be shown.

use std::process::Command;

use tmpi_core::live::TileState;
use tmpi_core::live::schema::Hello;
use tmpi_core::live::schema::message::Kind;
use tmpi_live::access_units::{Splitter, Unit, codec};
use tmpi_testing::Need;
use tmpi_testing::pictures::ivf_frames;

use crate::client;
use crate::live::{Client, Publisher, hello, server, server_with};
use crate::prelude::*;

/// Test pictures that ffmpeg encodes with these arguments; `None` without ffmpeg.
fn encoded(size: &str, arguments: &[&str]) -> Option<Vec<u8>> {
    let mut command = Command::new("ffmpeg");
    command.args(["-loglevel", "error", "-f", "lavfi", "-i", &format!("testsrc2=size={size}:rate=10:duration=1")]).args(arguments);
    let out = Need::Ffmpeg.or_skip(command.arg("-").output())?;
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    Some(out.stdout)
}

/// Access units of a film in H.264.
fn film(size: &str, arguments: &[&str]) -> Option<Vec<Unit>> {
    let coder = ["-c:v", "libx264", "-preset", "ultrafast", "-bf", "0"];
    let mut splitter = Splitter::default();
    let mut units = splitter.push(&encoded(size, &[&coder[..], arguments, &["-f", "h264"]].concat())?).unwrap();
    units.extend(splitter.finish());
    Some(units)
}

/// The same in VP9.
fn vp9_film(size: &str) -> Option<Vec<Unit>> {
    let coder = "-pix_fmt yuv420p -c:v libvpx-vp9 -deadline realtime -cpu-used 8 -lag-in-frames 0 -auto-alt-ref 0 -g 5 -f ivf";
    let file = encoded(size, &coder.split(' ').collect::<Vec<_>>())?;
    // bit 2: set for frames that refer to others
    Some(ivf_frames(&file).into_iter().map(|frame| Unit { data: frame.to_vec(), key: frame[0] & 4 == 0 }).collect())
}

/// A publisher of H.264 or VP9.
fn camera(addr: SocketAddr, room: &str, first: &Unit, (width, height): (u32, u32)) -> Publisher {
    let codec = codec(&first.data).unwrap_or_else(|| "vp09.00.10.08".into());
    Publisher::of(addr, room, Hello { codec, width, height, ..hello() })
}

/// Sends all frames of a film.
fn play(camera: &mut Publisher, film: &[Unit]) {
    for unit in film {
        camera.try_publish(unit.key, unit.data.clone()).unwrap();
    }
}

/// Reads until all tiles of frames of this size have arrived.
fn sees(viewer: &mut Client, size: (u32, u32)) {
    let mut model = None::<TileState>;
    loop {
        match viewer.next().expect("the viewer stays connected") {
            Kind::Hello(hello) => model = ((hello.width, hello.height) == size).then(|| TileState::new(&hello).unwrap()),
            Kind::Geometry(tiles) | Kind::Snapshot(tiles) => {
                let Some(model) = &mut model else { continue };
                model.take(&tiles).unwrap();
                if model.geometry().is_some() {
                    return;
                }
            }
            Kind::Bye(bye) => panic!("{}", bye.reason),
            _ => {}
        }
    }
}

/// `ended` of a room's state: why its publisher has gone.
fn ended(addr: SocketAddr, room: &str) -> Option<String> {
    client::get(addr, &format!("/v1/live/{room}")).json()["ended"].as_str().map(str::to_owned)
}

#[test]
fn viewers_see_a_camera_that_changes_its_size_at_the_new_size() {
    let [Some(wide), Some(high), Some(large)] =
        ["320x240", "240x320", "640x360"].map(|size| film(size, &["-pix_fmt", "yuv420p", "-g", "5"]))
    else {
        return;
    };
    changes_its_size([&wide, &high, &large]);
}

/// Publishes films of 320×240, 240×320 and 640×360 pixels one after the other; a viewer sees each at its size.
fn changes_its_size([wide, high, large]: [&[Unit]; 3]) {
    let server = server();
    let mut camera = camera(server.addr, "attic", &wide[0], (320, 240));
    play(&mut camera, wide);
    let mut viewer = Client::watch(server.addr, "attic");
    sees(&mut viewer, (320, 240));
    for (film, size) in [(high, (240, 320)), (large, (640, 360)), (wide, (320, 240))] {
        play(&mut camera, film);
        sees(&mut viewer, size);
    }
    // so does a viewer that connects later
    sees(&mut Client::watch(server.addr, "attic"), (320, 240));
}

#[test]
fn vp9_video_that_changes_its_size_is_shown_at_the_new_size() {
    let [Some(wide), Some(high), Some(large)] = ["320x240", "240x320", "640x360"].map(vp9_film) else { return };
    changes_its_size([&wide, &high, &large]);
}

#[test]
fn the_size_of_the_frames_counts_not_the_announced_one() {
    let Some(film) = film("320x240", &["-pix_fmt", "yuv420p"]) else { return };
    let server = server();
    let mut camera = camera(server.addr, "attic", &film[0], (640, 480));
    play(&mut camera, &film);
    sees(&mut Client::watch(server.addr, "attic"), (320, 240));
}

#[test]
fn video_that_cannot_be_shown_ends_with_a_reason_for_publisher_and_viewers() {
    let kinds: [(&[&str], &str); 5] = [
        (&["-pix_fmt", "yuv422p"], "4:2:0"),
        (&["-pix_fmt", "yuv420p10le"], "8 bits"),
        (&["-pix_fmt", "yuv420p", "-x264-params", "interlaced=1"], "interlaced"),
        (&["-pix_fmt", "yuv420p", "-bf", "2", "-x264-params", "b-adapt=0"], "B-frames"),
        (&["-pix_fmt", "yuv420p", "-bsf:v", "h264_metadata=display_orientation=insert:rotate=90"], "upright"),
    ];
    let Some(sound) = film("320x240", &["-pix_fmt", "yuv420p"]) else { return };
    for (n, (arguments, word)) in kinds.into_iter().enumerate() {
        let film = film("320x240", arguments).unwrap();
        let server = server_with(|rooms| rooms);
        let room = format!("attic{n}");
        let mut camera = camera(server.addr, &room, &film[0], (320, 240));
        play(&mut camera, &sound[..1]);
        let viewer = Client::watch(server.addr, &room);
        let reason = film.iter().find_map(|unit| camera.try_publish(unit.key, unit.data.clone()).err());
        let reason = reason.map_or_else(|| camera.client.bye(), |bye| bye.reason);
        assert!(reason.contains(word), "{reason}");
        let told = viewer.bye();
        assert!(told.contains(&reason), "watchers are told {told:?}, the publisher {reason:?}");
        // the room's state keeps the reason for later viewers
        assert!(ended(server.addr, &room).is_some_and(|ended| ended.contains(&reason)));
    }
}
