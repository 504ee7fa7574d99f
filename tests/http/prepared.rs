//! Answers that are given again, without a way through all layers: nobody can tell them from the others.

use std::sync::Arc;

use tmpi::server::Limits;
use tmpi_render::PictureFormat;

use crate::access::{ask, private_within};
use crate::client::{Response, get, request};
use crate::fixture::{Running, jpeg, picture, pipeline};

/// Headers that every answer has of its own.
const OWN: [&str; 3] = ["x-request-id", "server-timing", "date"];

/// A header that no answer depends on but for itself; who sends it goes the usual way.
const USUAL: (&str, &str) = ("x-request-id", "usual");

/// Status, headers and body but for what each answer has of its own.
fn shown(answer: &Response) -> (u16, Vec<(String, String)>, &[u8]) {
    let mut headers: Vec<_> = answer.headers().iter().filter(|(name, _)| !OWN.contains(&name.as_str())).cloned().collect();
    headers.sort();
    (answer.status, headers, &answer.body)
}

#[test]
fn they_are_the_same_and_count_as_the_others() {
    let dir = tempfile::tempdir().unwrap();
    let server = Running::start(dir.path(), Limits::default(), Arc::new(pipeline()));
    let id = server.upload(&picture(1, PictureFormat::Png));
    let links = server.wait(&id, "done")["links"].clone();
    let named = |link: &str| links[link].as_str().unwrap().to_owned();
    let plain = |rest: &str| format!("/v1/photos/{id}/{rest}");
    let all = [
        plain("atlas"),
        plain("atlas?level=1"),
        plain("atlas?v=0"),
        plain("thumbnail"),
        plain("depth"),
        named("atlas"),
        named("thumbnail"),
    ];
    for path in &all {
        let usual = request(server.addr, "GET", path, &[USUAL], &[]);
        assert_eq!((usual.status, usual.header("x-request-id")), (200, Some("usual")), "{path}");
        let mut ids = Vec::new();
        for _ in 0..4 {
            let again = get(server.addr, path);
            assert!(shown(&again) == shown(&usual), "{path}: {:?} {:?}", again.headers(), usual.headers());
            assert!(again.all("server-timing").starts_with("total;dur=") && !again.all("server-timing").contains(','), "{path}");
            ids.push(again.header("x-request-id").unwrap().to_owned());
        }
        ids.dedup();
        assert_eq!(ids.len(), 4, "{path}: an id for each");
        // pages of other sites are told the same that the usual way tells them
        let foreign = [("origin", "https://other.example"), ("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "cors")];
        let (kept, as_ever) =
            (request(server.addr, "GET", path, &foreign, &[]), request(server.addr, "GET", path, &[&foreign[..], &[USUAL]].concat(), &[]));
        assert!(shown(&kept) == shown(&as_ever), "{path}: {:?} {:?}", kept.headers(), as_ever.headers());
        let tag = usual.header("etag").unwrap();
        assert_eq!(request(server.addr, "GET", path, &[("if-none-match", tag)], &[]).status, 304, "{path}");
        let part = request(server.addr, "GET", path, &[("range", "bytes=1-2")], &[]);
        assert_eq!((part.status, part.body.as_slice()), (206, &usual.body[1..3]), "{path}");
    }
    let metrics = String::from_utf8(get(server.addr, "/metrics").body).unwrap();
    let line = "tmpi_requests_total{method=\"GET\",route=\"/v1/photos/{id}/thumbnail\",status=\"200\"} 14";
    assert!(metrics.lines().any(|l| l == line), "{metrics}");
    let count = "tmpi_request_seconds_count{route=\"/v1/photos/{id}/depth\"} 9";
    assert!(metrics.lines().any(|l| l == count), "{metrics}");
    // names of other servers are not answered to, and nothing is known of what is deleted
    request(server.addr, "GET", &all[0], &[("host", "evil.example")], &[]).problem(421);
    assert_eq!(request(server.addr, "DELETE", &format!("/v1/photos/{id}"), &[], &[]).status, 204);
    for path in &all {
        get(server.addr, path).problem(404);
    }
}

#[test]
fn they_go_to_nobody_who_may_not_have_the_photo() {
    let dir = tempfile::tempdir().unwrap();
    let server = private_within(dir.path(), Arc::new(pipeline()), Limits::default());
    let secret = format!("Bearer tmpi_o_{}", "a".repeat(40));
    let own = |method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]| {
        ask(&server, method, path, &[&[("authorization", secret.as_str())], headers].concat(), body)
    };
    let made = own("POST", "/v1/photos", &[("prefer", "wait=60")], &jpeg(1));
    assert_eq!(made.status, 201);
    let at = format!("/v1/photos/{}", made.json()["id"].as_str().unwrap());
    let path = format!("{at}/atlas");
    let show = |visibility: &str| {
        let body = format!("{{\"visibility\": {visibility:?}}}");
        assert_eq!(own("PATCH", &at, &[("content-type", "application/json")], body.as_bytes()).status, 200);
    };
    let strangers = || ask(&server, "GET", &path, &[], &[]);
    for _ in 0..2 {
        assert_eq!(own("GET", &path, &[], &[]).status, 200);
        strangers().problem(404);
        show("link");
        let usual = ask(&server, "GET", &path, &[USUAL], &[]);
        for _ in 0..3 {
            assert!(shown(&strangers()) == shown(&usual) && usual.status == 200);
        }
        ask(&server, "GET", &path, &[("authorization", "Bearer tmpi_o_short")], &[]).problem(401);
        show("private");
    }
    strangers().problem(404);
}
