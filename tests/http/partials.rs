//! Uploads in parts, as clients of draft-ietf-httpbis-resumable-upload send them.

use std::io::Write;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tmpi::server::Limits;
use tmpi_render::{PictureFormat, View, encode};

use crate::access::{ask, private, private_within, secret};
use crate::client::{Connection, Response, form, get, request};
use crate::fixture::{Gate, Running, depth_map, jpeg, pipeline, wait_until};
use crate::process::Process;

const PART: (&str, &str) = ("content-type", "application/partial-upload");
/// What a client of the fifth draft sends with each request.
const DRAFT: (&str, &str) = ("upload-draft-interop-version", "6");

fn start(limits: Limits) -> (tempfile::TempDir, Running) {
    let dir = tempfile::tempdir().unwrap();
    let server = Running::start(dir.path(), limits, Arc::new(pipeline()));
    (dir, server)
}

/// Begins an upload of `length` bytes, none of which is sent with it; gives its address.
fn begin(addr: SocketAddr, path: &str, length: usize, more: &[(&str, &str)]) -> String {
    let length = length.to_string();
    let headers = [&[DRAFT, ("upload-complete", "?0"), ("upload-length", &length)], more].concat();
    let answer = request(addr, "POST", path, &headers, &[]);
    assert_eq!(answer.status, 201, "{}", String::from_utf8_lossy(&answer.body));
    assert_eq!((answer.header("upload-offset"), answer.header("upload-complete")), (Some("0"), Some("?0")));
    let state = answer.json();
    assert_eq!(
        (&state["offset"], &state["length"], &state["complete"]),
        (&0.into(), &length.parse::<usize>().unwrap().into(), &false.into())
    );
    answer.header("location").unwrap().to_owned()
}

fn append(addr: SocketAddr, to: &str, (offset, complete): (usize, bool), part: &[u8]) -> Response {
    let headers = [DRAFT, PART, ("upload-offset", &offset.to_string()), ("upload-complete", if complete { "?1" } else { "?0" })];
    Connection::open(addr).request("PATCH", to, &headers, part)
}

/// Sends the head of a part and so much of it as is given, and leaves it at that.
fn interrupted(addr: SocketAddr, to: &str, offset: usize, length: usize, part: &[u8]) -> Connection {
    let mut connection = Connection::open(addr);
    let head = format!(
        "PATCH {to} HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/partial-upload\r\nupload-offset: {offset}\r\n\
         upload-complete: ?1\r\ncontent-length: {length}\r\n\r\n"
    );
    connection.raw().write_all(head.as_bytes()).unwrap();
    connection.raw().write_all(part).unwrap();
    connection
}

fn offset(addr: SocketAddr, at: &str) -> usize {
    let answer = request(addr, "HEAD", at, &[DRAFT], &[]);
    assert_eq!(answer.status, 200);
    answer.header("upload-offset").unwrap().parse().unwrap()
}

fn id(answer: &Response) -> String {
    assert_eq!(answer.status, 202, "{}", String::from_utf8_lossy(&answer.body));
    answer.json()["id"].as_str().unwrap().to_owned()
}

fn uploads(dir: &tempfile::TempDir) -> usize {
    std::fs::read_dir(dir.path().join("uploads")).unwrap().count()
}

#[test]
fn parts_make_the_photo_that_they_make_at_once() {
    let (dir, server) = start(Limits::default());
    let photo = jpeg(1);
    let at = begin(server.addr, "/v1/photos?title=In%20parts&planes=4", photo.len(), &[]);
    let third = photo.len() / 3;
    for part in [0..third, third..2 * third] {
        let answer = append(server.addr, &at, (part.start, false), &photo[part.clone()]);
        assert_eq!((answer.status, answer.header("upload-offset").unwrap()), (204, part.end.to_string().as_str()));
        assert_eq!(answer.header("upload-complete"), Some("?0"));
    }
    let answer = append(server.addr, &at, (2 * third, true), &photo[2 * third..]);
    let made = id(&answer);
    assert_eq!(answer.header("upload-offset").unwrap(), photo.len().to_string());
    assert_eq!((answer.header("upload-complete"), answer.header("location")), (Some("?1"), Some(format!("/v1/photos/{made}").as_str())));
    let at_once = request(server.addr, "POST", "/v1/photos?planes=4", &[], &photo);
    assert_eq!(id(&at_once), made, "one way leads to it");
    assert_eq!(server.wait(&made, "done")["settings"]["title"], "In parts");
    // whoever lost the answer learns of it
    let state = get(server.addr, &at).json();
    assert_eq!((&state["complete"], &state["photo"]), (&true.into(), &format!("/v1/photos/{made}").into()));
    let head = request(server.addr, "HEAD", &at, &[], &[]);
    assert_eq!(head.header("upload-length"), head.header("upload-offset"));
    let again = append(server.addr, &at, (photo.len(), true), &[]);
    assert_eq!(again.problem(400)["type"], "https://iana.org/assignments/http-problem-types#completed-upload");
    assert!(!dir.path().join("uploads").join(at.rsplit('/').next().unwrap()).join("data").exists());
}

#[test]
fn what_came_of_a_part_that_was_interrupted_is_kept() {
    let (dir, server) = start(Limits::default());
    let photo = large();
    let at = begin(server.addr, "/v1/photos", photo.len(), &[]);
    let data = dir.path().join("uploads").join(at.rsplit('/').next().unwrap()).join("data");
    // not by asking, which ends the part
    let written = || std::fs::metadata(&data).unwrap().len() as usize;
    let part = 1 << 20;
    let lost = interrupted(server.addr, &at, 0, photo.len(), &photo[..part]);
    wait_until("some of it is written", || written() > part / 2);
    drop(lost);
    let first = offset(server.addr, &at);
    assert!((part / 2..=part).contains(&first), "{first}");
    // one that hangs is ended by whoever asks
    let mut stuck = interrupted(server.addr, &at, first, photo.len() - first, &photo[first..first + part]);
    wait_until("more of it is written", || written() > first + part / 2);
    let second = offset(server.addr, &at);
    assert!((first + part / 2..=first + part).contains(&second), "{second}");
    assert_eq!(stuck.receive("PATCH").unwrap().problem(409)["type"], "urn:tmpi:problem:upload-superseded");
    let made = id(&append(server.addr, &at, (second, true), &photo[second..]));
    assert_eq!(server.upload(&photo), made);
}

#[test]
fn a_form_may_come_in_parts_too() {
    let (_dir, server) = start(Limits::default());
    let (mut photo, depth) = (jpeg(3), depth_map());
    // what is behind the picture is none of it; over what frameworks take by themselves
    photo.extend((0..3_000_000_u32).map(|n| (n.wrapping_mul(2_654_435_761) >> 24) as u8));
    let (content_type, body) = form(&[("photo", &photo), ("depth", &depth), ("planes", b"3")]);
    let at = begin(server.addr, "/v1/photos", body.len(), &[("content-type", &content_type)]);
    assert_eq!(append(server.addr, &at, (0, false), &body[..500]).status, 204);
    let made = id(&append(server.addr, &at, (500, true), &body[500..]));
    let at_once = request(server.addr, "POST", "/v1/photos", &[("content-type", &content_type)], &body);
    assert_eq!(id(&at_once), made);
}

#[test]
fn parts_that_do_not_go_together_are_refused_and_change_nothing() {
    let photo = jpeg(4);
    let (dir, server) = start(Limits { body: photo.len(), ..Limits::default() });
    let addr = server.addr;
    let at = begin(addr, "/v1/photos", photo.len(), &[]);
    assert_eq!(append(addr, &at, (0, false), &photo[..100]).status, 204);
    for offset in [0, 99, 101, photo.len()] {
        let answer = append(addr, &at, (offset, false), &photo[100..200]);
        assert_eq!((answer.header("upload-offset"), answer.header("upload-complete")), (Some("100"), Some("?0")));
        let problem = answer.problem(409);
        assert_eq!(problem["type"], "https://iana.org/assignments/http-problem-types#mismatching-upload-offset");
        assert_eq!((&problem["expected-offset"], &problem["provided-offset"]), (&100.into(), &offset.into()));
    }
    for (complete, part) in [(true, &photo[100..200]), (false, &photo[..])] {
        let answer = append(addr, &at, (100, complete), part);
        let kind = answer.json()["type"].as_str().unwrap().to_owned();
        assert!(matches!(answer.status, 400 | 413), "{kind}");
        assert!(kind.ends_with("#inconsistent-upload-length") || kind.ends_with(":body-too-large"), "{kind}");
    }
    let plain = request(addr, "PATCH", &at, &[("content-type", "image/jpeg"), ("upload-offset", "100"), ("upload-complete", "?0")], b"x");
    assert_eq!(plain.problem(415)["field"], "Content-Type");
    assert_eq!(request(addr, "PATCH", &at, &[PART, ("upload-complete", "?0")], b"x").problem(400)["field"], "upload-offset");
    assert_eq!(offset(addr, &at), 100, "nothing has changed");
    let made = id(&append(addr, &at, (100, true), &photo[100..]));
    server.wait(&made, "done");
    // what is wrong from the beginning leaves nothing
    let before = uploads(&dir);
    let wrong: [&[(&str, &str)]; 5] = [
        &[("upload-complete", "?0"), ("upload-length", &(photo.len() + 1).to_string())],
        &[("upload-complete", "maybe")],
        &[("upload-complete", "?0"), ("upload-draft-interop-version", "5")],
        &[("upload-complete", "?0"), ("upload-length", "many")],
        &[("upload-complete", "?0"), ("upload-length", "3")],
    ];
    for headers in wrong {
        let answer = request(addr, "POST", "/v1/photos", headers, b"four");
        assert!(matches!(answer.status, 400 | 413), "{headers:?}: {}", answer.status);
    }
    request(addr, "POST", "/v1/photos?halo=1", &[("upload-complete", "?0")], &[]).problem(400);
    assert_eq!(uploads(&dir), before);
    // what is whole and no photo is refused as at once, and is no more
    let at = begin(addr, "/v1/photos", 4, &[]);
    append(addr, &at, (0, true), b"none").problem(415);
    request(addr, "GET", &at, &[], &[]).problem(404);
    assert_eq!(uploads(&dir), before);
}

#[test]
fn an_upload_may_come_whole_with_the_request_that_begins_it() {
    let (dir, server) = start(Limits::default());
    let photo = jpeg(5);
    let length = photo.len().to_string();
    let answer = request(server.addr, "POST", "/v1/photos", &[DRAFT, PART, ("upload-complete", "?1"), ("upload-length", &length)], &photo);
    let made = id(&answer);
    assert_eq!((answer.header("upload-complete"), answer.header("upload-offset")), (Some("?1"), Some(length.as_str())));
    // or in part
    let answer =
        request(server.addr, "POST", "/v1/photos", &[DRAFT, PART, ("upload-complete", "?0"), ("upload-length", &length)], &photo[..70]);
    assert_eq!((answer.status, answer.header("upload-offset")), (201, Some("70")));
    let limit = answer.header("upload-limit").unwrap();
    assert!(limit.starts_with(&format!("max-size={}, max-age=", Limits::BODY)), "{limit}");
    let at = answer.header("location").unwrap();
    assert_eq!(id(&append(server.addr, at, (70, true), &photo[70..])), made);
    // one of which the first part breaks off is nobody's
    let before = uploads(&dir);
    let mut lost = Connection::open(server.addr);
    lost.raw()
        .write_all(b"POST /v1/photos HTTP/1.1\r\nhost: localhost\r\nupload-complete: ?0\r\ncontent-length: 1000\r\n\r\nsome")
        .unwrap();
    wait_until("it has begun", || uploads(&dir) == before + 1);
    drop(lost);
    wait_until("it is gone", || uploads(&dir) == before);
}

#[test]
fn uploads_have_places_and_a_time() {
    let (dir, server) = start(Limits { partials: 2, partial_time: Duration::from_secs(3), ..Limits::default() });
    let first = begin(server.addr, "/v1/photos", 10, &[]);
    let _second = begin(server.addr, "/v1/photos", 10, &[]);
    let refused = request(server.addr, "POST", "/v1/photos", &[("upload-complete", "?0")], &[]);
    assert!(refused.header("retry-after").is_some());
    assert_eq!(refused.problem(429)["type"], "urn:tmpi:problem:uploads-full");
    assert_eq!(request(server.addr, "DELETE", &first, &[], &[]).status, 204);
    request(server.addr, "DELETE", &first, &[], &[]).problem(404);
    let third = begin(server.addr, "/v1/photos", 10, &[]);
    assert_eq!(append(server.addr, &third, (0, false), b"some").status, 204);
    let metrics = String::from_utf8(get(server.addr, "/metrics").body).unwrap();
    assert!(metrics.contains("\ntmpi_partial_uploads 2.0\n"), "{metrics}");
    wait_until("their time is over", || uploads(&dir) == 0);
    request(server.addr, "HEAD", &third, &[], &[]);
    assert_eq!(request(server.addr, "GET", &third, &[], &[]).status, 404);
    drop(server);
    let (_dir, none) = start(Limits { partials: 0, ..Limits::default() });
    request(none.addr, "POST", "/v1/photos", &[("upload-complete", "?0")], &[]).problem(501);
}

#[test]
fn a_part_for_which_there_is_no_place_is_sent_again_later() {
    let gate = Gate::new(0);
    let dir = tempfile::tempdir().unwrap();
    let server = Running::start(dir.path(), Limits { queue: 1, uploads_beyond: 0, ..Limits::default() }, gate.clone());
    let photo = jpeg(7);
    let at = begin(server.addr, "/v1/photos", photo.len(), &[]);
    assert_eq!(append(server.addr, &at, (0, false), &photo[..9]).status, 204);
    let running = server.upload(&jpeg(1));
    gate.wait_started(1);
    let waiting = server.upload(&jpeg(2));
    let refused = append(server.addr, &at, (9, true), &photo[9..]);
    assert!(refused.header("retry-after").is_some());
    assert_eq!(refused.problem(429)["type"], "urn:tmpi:problem:queue-full");
    gate.open(9);
    server.wait(&waiting, "done");
    server.wait(&running, "done");
    assert_eq!(offset(server.addr, &at), 9, "what was there still is");
    let made = id(&append(server.addr, &at, (9, true), &photo[9..]));
    server.wait(&made, "done");
}

#[test]
fn an_upload_is_of_whoever_began_it() {
    let dir = tempfile::tempdir().unwrap();
    let server = private(dir.path());
    let (ann, bob) = (secret("a"), secret("b"));
    let photo = jpeg(8);
    let as_who = |who: Option<&str>, method: &str, path: &str, more: &[(&str, &str)], body: &[u8]| {
        let who: Vec<_> = who.map(|who| ("authorization", who)).into_iter().collect();
        ask(&server, method, path, &[&who, more].concat(), body)
    };
    let begin = |who| {
        let answer = as_who(who, "POST", "/v1/photos", &[("upload-complete", "?0")], &photo[..10]);
        assert_eq!(answer.status, 201);
        answer.header("location").unwrap().to_owned()
    };
    let rest = [PART, ("upload-offset", "10"), ("upload-complete", "?1")];
    let at = begin(Some(&ann));
    for who in [Some(bob.as_str()), None] {
        as_who(who, "GET", &at, &[], &[]).problem(404);
        as_who(who, "PATCH", &at, &rest, &photo[10..]).problem(404);
        as_who(who, "DELETE", &at, &[], &[]).problem(404);
    }
    let state = as_who(Some(&ann), "PATCH", &at, &rest, &photo[10..]);
    assert_eq!((state.status, &state.json()["visibility"]), (202, &"private".into()));
    let made = id(&state);
    as_who(Some(&bob), "GET", &format!("/v1/photos/{made}"), &[], &[]).problem(404);
    assert_eq!(as_who(Some(&ann), "GET", &format!("/v1/photos/{made}"), &[], &[]).status, 200);
    // who has no secret is told one with the photo
    let at = begin(None);
    let state = as_who(None, "PATCH", &at, &rest, &photo[10..]);
    assert_ne!(id(&state), made);
    assert!(state.json()["links"]["manage"].as_str().unwrap().contains("#owner=tmpi_o_"));
    let kept =
        std::fs::read_dir(dir.path().join("uploads")).unwrap().map(|e| std::fs::read_to_string(e.unwrap().path().join("record.json")));
    assert!(kept.map(|text| text.unwrap()).all(|text| !text.contains("tmpi_o_")), "secrets are not kept");
}

#[test]
fn parts_count_against_what_their_owner_may_have() {
    let dir = tempfile::tempdir().unwrap();
    let (ann, bob, photo) = (secret("a"), secret("b"), jpeg(8));
    let quota = photo.len() as u64 + 1000;
    let start =
        || private_within(dir.path(), Arc::new(pipeline()), Limits { quota_bytes: Some(quota), partials_of_owner: 2, ..Limits::default() });
    let mut server = start();
    let by = |server: &Running, who: &str, method: &str, path: &str, more: &[(&str, &str)], body: &[u8]| {
        ask(server, method, path, &[&[("authorization", who)], more].concat(), body)
    };
    let begin = |server: &Running, who: &str, length: Option<usize>| {
        let length = length.map(|length| length.to_string());
        let told: Vec<_> = length.iter().map(|length| ("upload-length", length.as_str())).collect();
        by(server, who, "POST", "/v1/photos", &[&[("upload-complete", "?0")], &told[..]].concat(), &[])
    };
    let refused = |answer: Response| assert_eq!(answer.problem(403)["type"], "urn:tmpi:problem:quota");
    let first = begin(&server, &ann, Some(photo.len()));
    assert_eq!(first.status, 201);
    let at = first.header("location").unwrap().to_owned();
    // nothing of it came yet, and it counts, also after a restart
    for restart in [false, true] {
        if restart {
            server.stop();
            server = start();
        }
        refused(begin(&server, &ann, Some(1001)));
        refused(by(&server, &ann, "POST", "/v1/photos", &[], &photo));
        assert_eq!(begin(&server, &bob, Some(1001)).status, 201, "of others");
    }
    // a part of which the whole is not known counts as it comes
    let second = begin(&server, &ann, None);
    assert_eq!(second.status, 201);
    let other = second.header("location").unwrap().to_owned();
    let part = |at: &str, offset: usize, complete: &str, body: &[u8]| {
        let offset = offset.to_string();
        by(&server, &ann, "PATCH", at, &[PART, ("upload-offset", &offset), ("upload-complete", complete)], body)
    };
    assert_eq!(part(&other, 0, "?0", &photo[..1000]).status, 204);
    refused(part(&other, 1000, "?0", &photo[1000..1001]));
    // so many at a time
    let many = begin(&server, &ann, None).problem(429);
    assert!(many["detail"].as_str().unwrap().contains("--partial-uploads-per-owner"), "{many}");
    // the first has the room that was kept for it, and is counted once
    let made = id(&part(&at, 0, "?1", &photo));
    assert_eq!(by(&server, &ann, "DELETE", &format!("/v1/photos/{made}"), &[], &[]).status, 204);
    assert_eq!(by(&server, &ann, "DELETE", &other, &[], &[]).status, 204);
    assert_eq!(begin(&server, &ann, Some(quota as usize)).status, 201, "all of it is free again");
}

/// A picture of some megabytes.
fn large() -> Vec<u8> {
    let (width, height) = (1800, 1400);
    let mut seed = 1_u32;
    let mut noise = || {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (seed >> 24) as u8
    };
    let rgba = (0..width * height).map(|_| [noise(), noise(), noise(), 255]).collect();
    encode(&View { width, height, rgba }, PictureFormat::Png, 90).unwrap()
}

#[test]
fn an_upload_goes_on_after_a_crash_in_the_middle_of_a_part() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Process::start(dir.path());
    let photo = large();
    let at = begin(server.addr, "/v1/photos", photo.len(), &[]);
    let sent = photo.len() - 1000;
    let stuck = interrupted(server.addr, &at, 0, photo.len(), &photo[..sent]);
    let record = dir.path().join("uploads").join(at.rsplit('/').next().unwrap()).join("record.json");
    let kept = || serde_json::from_slice::<serde_json::Value>(&std::fs::read(&record).unwrap()).unwrap()["offset"].as_u64().unwrap();
    wait_until("some of it is kept", || kept() > 0);
    server.crash();
    drop(stuck);
    let mut server = Process::start(dir.path());
    let there = offset(server.addr, &at);
    assert!(there as u64 == kept() && there > 0 && there <= sent, "{there} of {sent}");
    // and once more where all is there and nothing was accepted
    let answer = append(server.addr, &at, (there, false), &photo[there..]);
    assert_eq!(answer.status, 204);
    server.crash();
    let server = Process::start(dir.path());
    let head = request(server.addr, "HEAD", &at, &[], &[]);
    assert_eq!((head.header("upload-complete"), head.header("upload-length")), (Some("?0"), None), "a client is to ask for the rest");
    let made = id(&append(server.addr, &at, (photo.len(), true), &[]));
    assert_eq!(id(&request(server.addr, "POST", "/v1/photos", &[], &photo)), made);
    assert_eq!(std::fs::read(dir.path().join("photos").join(&made).join("upload")).unwrap(), photo);
}
