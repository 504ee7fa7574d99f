//! Photos by address, with a source in this process.

use tmpi::server::AddressPolicy;
use tmpi_testing::{Answer, Request, StandIn};

use crate::prelude::*;

/// A source of files.
fn source() -> StandIn {
    StandIn::start(|request| {
        let start = &jpeg(1)[..100];
        let cut = || [b"HTTP/1.1 200 OK\r\ncontent-length: 5000\r\n\r\n", start].concat();
        match request.path() {
            "/huge" => Answer::bytes(b"HTTP/1.1 200 OK\r\ncontent-length: 99999999999\r\n\r\n"),
            "/endless" => {
                let first = [b"HTTP/1.1 200 OK\r\n\r\n".as_slice(), &jpeg(1)].concat();
                Answer::Pieces(Box::new(std::iter::once(first).chain(std::iter::repeat(vec![0; 1 << 16]))))
            }
            "/cut" => Answer::bytes(cut()),
            "/slow" => Answer::Stalled(cut()),
            "/drip" => {
                let head = b"HTTP/1.1 200 OK\r\ncontent-length: 5000\r\n\r\n".to_vec();
                let byte_by_byte = jpeg(1).into_iter().map(|byte| {
                    std::thread::sleep(Duration::from_millis(20));
                    vec![byte]
                });
                Answer::Pieces(Box::new(std::iter::once(head).chain(byte_by_byte)))
            }
            path => {
                let (status, headers, body) = whole(path, request.header("if-none-match"));
                Answer::Whole(status, headers, body)
            }
        }
    })
}

/// Status, headers and body of an answer.
fn whole(path: &str, tag: &str) -> (u16, String, Vec<u8>) {
    let to = |target: &str| (302, format!("location: {target}\r\n"), Vec::new());
    let with = |status, body| (status, String::new(), body);
    match path {
        "/By%20the%20sea.jpg" => with(200, jpeg(1)),
        "/depth.png" => with(200, depth_map()),
        "/tagged.jpg" if tag == "\"one\"" => with(304, Vec::new()),
        "/tagged.jpg" => (200, "etag: \"one\"\r\nlast-modified: Sat, 31 Jan 2026 12:00:00 GMT\r\n".into(), jpeg(2)),
        "/text" => with(200, vec![b'x'; 5000]),
        "/torn.jpg" => with(200, jpeg(3)[..1000].to_vec()),
        "/empty" => with(200, Vec::new()),
        "/missing" => with(404, Vec::new()),
        "/broken" => with(500, Vec::new()),
        "/unasked" => with(304, Vec::new()),
        "/nowhere" => with(302, Vec::new()),
        "/once" => to("/By%20the%20sea.jpg"),
        "/for-ever" => to("/for-ever"),
        "/unlisted" => to("http://other.example/"),
        "/port" => to("http://127.0.0.1:1/"),
        "/file" => to("file:///etc/passwd"),
        "/cloud" => to("http://169.254.169.254/latest/meta-data"),
        "/secure" => to("https://127.0.0.1/"),
        other => panic!("{other}"),
    }
}

fn start(hosts: &[String], source_addresses: AddressPolicy) -> Running {
    let limits = Limits { body: 1 << 20, body_read: Duration::from_millis(500), body_rate: 1000, ..Limits::default() };
    let source_hosts = hosts.iter().map(|host| host.parse().unwrap()).collect();
    Running::configured(Arc::new(pipeline()), |config| Config { source_hosts, source_addresses, limits, ..config })
}

fn post(server: &Running, body: &Value) -> Response {
    request(server.addr, "POST", "/v1/photos", &[JSON, ("prefer", "wait=60")], body.to_string().as_bytes())
}

#[test]
fn a_photo_and_its_depth_map_are_fetched() {
    let files = source();
    let server = start(&[files.url("")], AddressPolicy::Any);
    let made = post(&server, &json!({ "source": files.url("/By%20the%20sea.jpg#x"), "quality": 70 })).is(201).json();
    assert_eq!((&made["settings"]["title"], &made["options"]["quality"]), (&"By the sea".into(), &"70".into()));
    // the same bytes by an upload are the same photo
    let uploaded = request(server.addr, "POST", "/v1/photos?quality=70", &[], &jpeg(1)).json();
    assert_eq!(uploaded["id"], made["id"]);
    let redirected = post(&server, &json!({ "source": files.url("/once"), "quality": 70, "title": "Another" })).json();
    assert_eq!((&redirected["id"], &redirected["settings"]["title"]), (&made["id"], &"Another".into()));
    let with_depth =
        post(&server, &json!({ "source": files.url("/By%20the%20sea.jpg"), "depth_source": files.url("/depth.png") })).is(201).json();
    assert_ne!(with_depth["id"], made["id"]);
    wait_until("nothing is left", || incoming(server.data()) == 0);
    assert!(files.answered().iter().all(|asked| asked.header("accept").starts_with("image/*") && asked.header("if-none-match").is_empty()));
}

#[test]
fn a_source_that_has_not_changed_is_not_fetched_again() {
    let files = source();
    let server = start(&[files.url("")], AddressPolicy::Any);
    let order = json!({ "source": files.url("/tagged.jpg") });
    let first = post(&server, &order).json();
    let again = post(&server, &json!({ "source": files.url("/tagged.jpg"), "title": "New" }));
    assert_eq!((again.status, &again.json()["id"], &again.json()["settings"]["title"]), (201, &first["id"], &"New".into()));
    let asked = files.answered();
    let is_conditional = |request: &Request| request.header("if-none-match") == "\"one\"";
    assert!(is_conditional(&asked[1]) && asked[1].header("if-modified-since") == "Sat, 31 Jan 2026 12:00:00 GMT", "{asked:?}");
    // other options are another photo, and a photo that is deleted is fetched anew
    assert_ne!(post(&server, &json!({ "source": files.url("/tagged.jpg"), "quality": 70 })).json()["id"], first["id"]);
    let at = format!("/v1/photos/{}", first["id"].as_str().unwrap());
    assert_eq!(request(server.addr, "DELETE", &at, &[], &[]).status, 204);
    assert_eq!(post(&server, &order).json()["id"], first["id"]);
    let asked = files.answered();
    assert!(asked.len() == 4 && !asked[2..].iter().any(is_conditional), "{asked:?}");
}

#[test]
fn what_a_source_does_wrong_is_named_and_leaves_nothing() {
    let files = source();
    let server = start(&[files.url("")], AddressPolicy::Any);
    for (path, status, kind) in [
        ("/text", 415, "unsupported-photo"),
        ("/torn.jpg", 422, "broken-photo"),
        ("/missing", 422, "source-refused"),
        ("/broken", 502, "source-failed"),
        ("/unasked", 502, "source-failed"),
        ("/for-ever", 502, "source-failed"),
        ("/nowhere", 502, "source-failed"),
        ("/cut", 502, "source-failed"),
        ("/unlisted", 403, "source-host"),
        ("/port", 403, "source-host"),
        ("/file", 403, "source-host"),
        ("/cloud", 403, "source-host"),
        ("/secure", 403, "source-host"),
        ("/huge", 413, "source-too-large"),
        ("/endless", 413, "source-too-large"),
        ("/slow", 504, "source-too-slow"),
        ("/drip", 504, "source-too-slow"),
    ] {
        let refused = post(&server, &json!({ "source": files.url(path) })).problem(status);
        assert_eq!(refused["type"], format!("urn:tmpi:problem:{kind}"), "{path}: {refused}");
        assert!(refused["field"] == "source" || refused["field"] == "photo" && path == "/torn.jpg", "{path}: {refused}");
    }
    assert_eq!(post(&server, &json!({ "source": files.url("/empty") })).problem(400)["field"], "photo");
    wait_until("nothing is left", || incoming(server.data()) == 0);
    assert_eq!(files.answered().iter().filter(|asked| asked.path() == "/for-ever").count(), 4);
}

#[test]
fn only_listed_hosts_at_public_addresses_are_asked() {
    let files = source();
    let port = files.addr.port();
    let others = ["http://[::1]", "http://169.254.169.254", "http://10.0.0.1", "*.b.example"].map(str::to_owned);
    let hosts = [vec![files.url(""), format!("http://localhost:{port}")], others.to_vec()].concat();
    let server = start(&hosts, AddressPolicy::Public);
    for (source, status, kind) in [
        (files.url("/By%20the%20sea.jpg"), 403, "source-address"),
        (format!("http://localhost:{port}/By%20the%20sea.jpg"), 403, "source-address"),
        (format!("http://2130706433:{port}/By%20the%20sea.jpg"), 403, "source-address"),
        ("http://[::1]/".into(), 403, "source-address"),
        ("http://169.254.169.254/latest/meta-data".into(), 403, "source-address"),
        ("http://10.0.0.1/".into(), 403, "source-address"),
        ("http://127.0.0.1/".into(), 403, "source-host"),
        (format!("https://127.0.0.1:{port}/"), 403, "source-host"),
        ("https://a.example/".into(), 403, "source-host"),
        ("https://b.example/".into(), 403, "source-host"),
        ("http://x.b.example/".into(), 403, "source-host"),
        ("https://x.b.example:8443/".into(), 403, "source-host"),
        ("https://x.b.example.evil/".into(), 403, "source-host"),
        ("https://me:secret@x.b.example/".into(), 400, "parameter"),
        ("file:///etc/passwd".into(), 400, "parameter"),
        ("ftp://x.b.example/".into(), 400, "parameter"),
        ("x.b.example/a.jpg".into(), 400, "parameter"),
        (String::new(), 400, "parameter"),
    ] {
        let refused = post(&server, &json!({ "source": source })).problem(status);
        let told = (refused["type"].as_str().unwrap(), refused["field"].as_str());
        assert_eq!(told, (format!("urn:tmpi:problem:{kind}").as_str(), Some("source")), "{source}: {refused}");
        assert!(!refused["detail"].as_str().unwrap().contains("secret"), "{refused}");
    }
    assert_eq!(files.begun(), 0);
    for (body, field) in [
        (json!({}), "source"),
        (json!({ "source": 3 }), "source"),
        (json!({ "source": ["https://x.b.example/"] }), "source"),
        (json!({ "source": "https://x.b.example/", "photo": "x" }), "photo"),
        (json!({ "source": "https://x.b.example/", "planes": "four" }), "planes"),
    ] {
        assert_eq!(post(&server, &body).problem(400)["field"], field, "{body}");
    }
}

#[test]
fn a_server_without_sources_fetches_nothing() {
    let files = source();
    let server = start(&[], AddressPolicy::Any);
    let refused = post(&server, &json!({ "source": files.url("/By%20the%20sea.jpg") })).problem(403);
    assert_eq!(refused["type"], "urn:tmpi:problem:no-sources");
    assert_eq!(files.begun(), 0);
}
