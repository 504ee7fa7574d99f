//! Damage on disk: a read or the regular integrity check notices it, the state reports it, the same upload repairs it.

use std::io::Read as _;
use std::path::PathBuf;

use tmpi::server::Caches;

use crate::prelude::*;

/// A finished photo and the original bytes of its container.
struct Made {
    server: Running,
    photo: Vec<u8>,
    id: String,
    whole: Vec<u8>,
}

fn made(limits: Limits, photo: Vec<u8>) -> Made {
    let server = Running::with(limits, Arc::new(pipeline()));
    let id = server.make(&photo);
    let whole = std::fs::read(&contents(server.data(), &id, "container")[0]).unwrap();
    Made { server, photo, id, whole }
}

impl Made {
    /// The one file of a part.
    fn file(&self, part: &str) -> PathBuf {
        let mut all = Vec::new();
        // the old file is deleted after the answer
        wait_until("there is one", || {
            all = contents(self.server.data(), &self.id, part);
            all.len() == 1
        });
        all.remove(0)
    }

    /// Every kind of damage: one bit flipped, half of the file missing, the whole file missing.
    fn kinds(&self) -> [(&str, Option<Vec<u8>>); 3] {
        let mut flipped = self.whole.clone();
        flipped[self.whole.len() / 2] ^= 1;
        [("flipped", Some(flipped)), ("cut", Some(self.whole[..self.whole.len() / 2].to_vec())), ("missing", None)]
    }

    fn spoil(&self, damage: Option<&Vec<u8>>) {
        match damage {
            Some(bytes) => std::fs::write(self.file("container"), bytes).unwrap(),
            None => std::fs::remove_file(self.file("container")).unwrap(),
        }
    }

    /// Uploads the photo again and compares the result with the original.
    fn heal(&self, context: &str) {
        self.server.upload(&self.photo);
        self.server.wait(&self.id, "done");
        assert_eq!(std::fs::read(self.file("container")).unwrap(), self.whole, "{context}");
        assert_eq!(get(self.server.addr, &format!("/v1/photos/{}/atlas", self.id)).body, self.whole, "{context}");
        assert_eq!(get(self.server.addr, &format!("/v1/photos/{}/view?w=32", self.id)).status, 200, "{context}");
    }
}

#[test]
fn unnoticed_damage_is_repaired_by_the_same_upload() {
    let made = made(Limits::default(), jpeg(1));
    for (kind, damage) in made.kinds() {
        made.spoil(damage.as_ref());
        made.heal(kind);
    }
}

#[test]
fn requests_for_a_damaged_photo_report_the_damage() {
    // a container that is streamed from disk, and one that is kept in memory
    for (photo, large) in [(jpeg(1), false), (noise(), true)] {
        // no caches
        let made = made(Limits { cache: Caches { scenes: 0, files: 0, views: 0, ..Caches::default() }, ..Limits::default() }, photo);
        assert_eq!(made.whole.len() > 256 << 10, large);
        for ask in ["atlas", "view?w=40", "atlas?level=1", "atlas?sections=photo", "export?format=zip", "atlas?region=0,0,40,40"] {
            for (kind, damage) in made.kinds() {
                let context = format!("{kind}, {ask}, {} bytes", made.whole.len());
                made.spoil(damage.as_ref());
                let path = format!("/v1/photos/{}/{ask}", made.id);
                assert_eq!(get(made.server.addr, &path).problem(500)["type"], "urn:tmpi:problem:damaged", "{context}");
                let state = made.server.state(&made.id);
                assert_eq!([&state["state"], &state["problem"]["type"]], ["damaged", "urn:tmpi:problem:damaged"], "{context}");
                assert!(state["problem"]["detail"].as_str().unwrap().contains("container is damaged"), "{state}");
                // the photo's other files are not served either
                get(made.server.addr, &format!("/v1/photos/{}/thumbnail", made.id)).problem(500);
                assert_eq!(made.server.metric("tmpi_photos_damaged"), 1, "{context}");
                made.heal(&context);
            }
        }
    }
}

#[test]
fn a_folder_that_is_away_damages_no_photo() {
    for photo in [jpeg(1), noise()] {
        let made = made(Limits { cache: Caches { scenes: 0, files: 0, views: 0, ..Caches::default() }, ..Limits::default() }, photo);
        let (blobs, away) = (made.server.data().join("blobs"), made.server.data().join("away"));
        let path = format!("/v1/photos/{}/atlas", made.id);
        std::fs::rename(&blobs, &away).unwrap();
        std::fs::create_dir(&blobs).unwrap();
        assert_eq!(get(made.server.addr, &path).problem(503)["type"], "urn:tmpi:problem:store-unreachable");
        assert_eq!(made.server.state(&made.id)["state"], "done");
        std::fs::remove_dir(&blobs).unwrap();
        std::fs::rename(&away, &blobs).unwrap();
        assert_eq!(get(made.server.addr, &path).body, made.whole);
    }
}

#[test]
fn a_body_that_is_cut_off_midway_is_an_error_for_its_client() {
    let made = made(Limits::default(), noise());
    let path = format!("/v1/photos/{}/atlas", made.id);
    let whole = get(made.server.addr, &path);
    assert_eq!((&whole.body, whole.header("content-length")), (&made.whole, Some(made.whole.len().to_string().as_str())));
    let last = made.whole.len() - 300_000;
    let range = format!("bytes={last}-");
    let part = request(made.server.addr, "GET", &path, &[("range", &range), ("if-range", whole.header("etag").unwrap())], &[]);
    assert_eq!((part.status, part.body.as_slice()), (206, &made.whole[last..]));
    // the server keeps the file open
    let half = made.whole.len() / 2;
    std::fs::File::options().write(true).open(made.file("container")).unwrap().set_len(half as u64).unwrap();
    let mut client = Connection::asking(made.server.addr, &path);
    let (mut answer, patience) = (Vec::new(), Instant::now());
    let ended = client.raw().read_to_end(&mut answer);
    let came = answer.len();
    assert!(came < half + 2000 && patience.elapsed() < Duration::from_mins(1), "{came} bytes: {ended:?}");
    // without the head if the server meets the end of the file before it has sent any
    let head = String::from_utf8_lossy(&answer).to_lowercase();
    assert!(came == 0 || head.contains(&format!("content-length: {}\r\n", made.whole.len())), "{came} bytes: {ended:?}");
}

#[test]
fn the_integrity_check_finds_damage_without_requests() {
    let soon = Duration::from_millis(20);
    let made = made(Limits { verify_first: soon, verify_interval: soon, ..Limits::default() }, jpeg(1));
    for (kind, damage) in made.kinds() {
        // caches do not hide the damage
        assert_eq!(get(made.server.addr, &format!("/v1/photos/{}/atlas", made.id)).status, 200);
        made.spoil(damage.as_ref());
        wait_until(&format!("{kind} is noticed"), || made.server.state(&made.id)["state"] == "damaged");
        made.heal(kind);
    }
    std::fs::remove_file(made.file("thumbnail")).unwrap();
    wait_until("it is noticed", || made.server.state(&made.id)["state"] == "damaged");
    made.heal("thumbnail");
    assert!(made.file("thumbnail").exists());
}

#[test]
fn a_second_server_on_a_folder_is_refused_and_removes_nothing() {
    let server = Running::open();
    let upload = server.data().join("blobs/incoming/upload");
    std::fs::write(&upload, b"a part").unwrap();
    let config = Config::new(([127, 0, 0, 1], 0).into(), server.data().to_owned());
    let refused = block_on(tmpi::server::Server::bind(config, Arc::new(pipeline()), drawn_by_cpu())).err().unwrap();
    let cause = std::error::Error::source(&refused).unwrap().to_string();
    assert!(cause.contains("another process"), "{refused}: {cause}");
    assert!(upload.exists());
}
