//! Photos by address, with a source in this process.

use std::io::{BufRead, BufReader, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde_json::{Value, json};
use tmpi::server::{AddressPolicy, Config, Limits, Server};
use tmpi_render::Backend;

use crate::client::{Response, request};
use crate::fixture::{Running, depth_map, incoming, jpeg, pipeline, wait_until};

/// A source of files. Each path has its answer.
struct Files {
    addr: SocketAddr,
    /// Heads of requests, in lower case.
    asked: Arc<Mutex<Vec<String>>>,
}

impl Files {
    fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let (addr, asked) = (listener.local_addr().unwrap(), Arc::<Mutex<Vec<String>>>::default());
        let all = Arc::clone(&asked);
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let all = Arc::clone(&all);
                std::thread::spawn(move || answer(&stream.unwrap(), &all));
            }
        });
        Self { addr, asked }
    }

    fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.addr)
    }

    fn asked(&self) -> Vec<String> {
        self.asked.lock().unwrap().clone()
    }
}

/// Reads a request and answers it; the client may have gone.
fn answer(stream: &TcpStream, all: &Mutex<Vec<String>>) {
    let mut head = String::new();
    let mut reader = BufReader::new(stream);
    while !head.ends_with("\r\n\r\n") {
        if reader.read_line(&mut head).unwrap_or(0) == 0 {
            return;
        }
    }
    all.lock().unwrap().push(head.to_lowercase());
    let path = head.split(' ').nth(1).unwrap();
    let mut stream = stream;
    let start = &jpeg(1)[..100];
    match path {
        "/huge" => drop(stream.write_all(b"HTTP/1.1 200 OK\r\ncontent-length: 99999999999\r\n\r\n")),
        "/endless" => {
            let mut bytes = [b"HTTP/1.1 200 OK\r\n\r\n".as_slice(), &jpeg(1)].concat();
            while stream.write_all(&bytes).is_ok() {
                bytes = vec![0; 1 << 16];
            }
        }
        "/cut" => drop(stream.write_all(&[b"HTTP/1.1 200 OK\r\ncontent-length: 5000\r\n\r\n", start].concat())),
        "/slow" => {
            let _ = stream.write_all(&[b"HTTP/1.1 200 OK\r\ncontent-length: 5000\r\n\r\n", start].concat());
            // until the server closes the connection
            let _ = reader.read_line(&mut String::new());
        }
        "/drip" => {
            let _ = stream.write_all(b"HTTP/1.1 200 OK\r\ncontent-length: 5000\r\n\r\n");
            for byte in jpeg(1) {
                if stream.write_all(&[byte]).is_err() {
                    return;
                }
                std::thread::sleep(Duration::from_millis(20));
            }
        }
        path => {
            let (status, headers, body) = whole(path, &head.to_lowercase());
            let head = format!("HTTP/1.1 {status} X\r\nconnection: close\r\ncontent-length: {}\r\n{headers}\r\n", body.len());
            let _ = stream.write_all(&[head.as_bytes(), &body].concat());
        }
    }
}

/// Status, headers and body of an answer.
fn whole(path: &str, head: &str) -> (u16, String, Vec<u8>) {
    let to = |target: &str| (302, format!("location: {target}\r\n"), Vec::new());
    let with = |status, body| (status, String::new(), body);
    match path {
        "/By%20the%20sea.jpg" => with(200, jpeg(1)),
        "/depth.png" => with(200, depth_map()),
        "/tagged.jpg" if head.contains("if-none-match: \"one\"") => with(304, Vec::new()),
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

fn start(data: &Path, hosts: &[String], source_addresses: AddressPolicy) -> Running {
    let limits = Limits { body: 1 << 20, body_read: Duration::from_millis(500), body_rate: 1000, ..Limits::default() };
    let source_hosts = hosts.iter().map(|host| host.parse().unwrap()).collect();
    let config = Config { source_hosts, source_addresses, limits, ..Config::new(([127, 0, 0, 1], 0).into(), data.to_owned()) };
    let renderer = tmpi_render::select(Backend::Cpu).unwrap();
    Running::of(async move { Server::bind(config, Arc::new(pipeline()), renderer).await.unwrap() })
}

fn post(server: &Running, body: &Value) -> Response {
    request(server.addr, "POST", "/v1/photos", &[("content-type", "application/json"), ("prefer", "wait=60")], body.to_string().as_bytes())
}

#[test]
fn a_photo_and_its_depth_map_are_fetched() {
    let (dir, files) = (tempfile::tempdir().unwrap(), Files::start());
    let server = start(dir.path(), &[files.url("")], AddressPolicy::Any);
    let made = post(&server, &json!({ "source": files.url("/By%20the%20sea.jpg#x"), "quality": 70 }));
    assert_eq!(made.status, 201, "{}", String::from_utf8_lossy(&made.body));
    let made = made.json();
    assert_eq!((&made["settings"]["title"], &made["options"]["quality"]), (&"By the sea".into(), &"70".into()));
    // the same bytes by an upload are the same photo
    let uploaded = request(server.addr, "POST", "/v1/photos?quality=70", &[], &jpeg(1)).json();
    assert_eq!(uploaded["id"], made["id"]);
    let redirected = post(&server, &json!({ "source": files.url("/once"), "quality": 70, "title": "Another" })).json();
    assert_eq!((&redirected["id"], &redirected["settings"]["title"]), (&made["id"], &"Another".into()));
    let with_depth = post(&server, &json!({ "source": files.url("/By%20the%20sea.jpg"), "depth_source": files.url("/depth.png") }));
    assert_eq!(with_depth.status, 201);
    assert_ne!(with_depth.json()["id"], made["id"]);
    wait_until("nothing is left", || incoming(dir.path()) == 0);
    assert!(files.asked().iter().all(|head| head.contains("accept: image/*") && !head.contains("if-none-match")));
}

#[test]
fn a_source_that_has_not_changed_is_not_fetched_again() {
    let (dir, files) = (tempfile::tempdir().unwrap(), Files::start());
    let server = start(dir.path(), &[files.url("")], AddressPolicy::Any);
    let order = json!({ "source": files.url("/tagged.jpg") });
    let first = post(&server, &order).json();
    let again = post(&server, &json!({ "source": files.url("/tagged.jpg"), "title": "New" }));
    assert_eq!((again.status, &again.json()["id"], &again.json()["settings"]["title"]), (201, &first["id"], &"New".into()));
    let asked = files.asked();
    let is_conditional = |head: &String| head.contains("if-none-match: \"one\"");
    assert!(is_conditional(&asked[1]) && asked[1].contains("if-modified-since: sat, 31 jan 2026 12:00:00 gmt"), "{asked:?}");
    // other options are another photo, and a photo that is deleted is fetched anew
    assert_ne!(post(&server, &json!({ "source": files.url("/tagged.jpg"), "quality": 70 })).json()["id"], first["id"]);
    let at = format!("/v1/photos/{}", first["id"].as_str().unwrap());
    assert_eq!(request(server.addr, "DELETE", &at, &[], &[]).status, 204);
    assert_eq!(post(&server, &order).json()["id"], first["id"]);
    let asked = files.asked();
    assert!(asked.len() == 4 && !asked[2..].iter().any(is_conditional), "{asked:?}");
}

#[test]
fn what_a_source_does_wrong_is_named_and_leaves_nothing() {
    let (dir, files) = (tempfile::tempdir().unwrap(), Files::start());
    let server = start(dir.path(), &[files.url("")], AddressPolicy::Any);
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
    wait_until("nothing is left", || incoming(dir.path()) == 0);
    assert_eq!(files.asked().iter().filter(|head| head.starts_with("get /for-ever")).count(), 4);
}

#[test]
fn only_listed_hosts_at_public_addresses_are_asked() {
    let (dir, files) = (tempfile::tempdir().unwrap(), Files::start());
    let port = files.addr.port();
    let others = ["http://[::1]", "http://169.254.169.254", "http://10.0.0.1", "*.b.example"].map(str::to_owned);
    let hosts = [vec![files.url(""), format!("http://localhost:{port}")], others.to_vec()].concat();
    let server = start(dir.path(), &hosts, AddressPolicy::Public);
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
    assert_eq!(files.asked(), Vec::<String>::new());
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
    let (dir, files) = (tempfile::tempdir().unwrap(), Files::start());
    let server = start(dir.path(), &[], AddressPolicy::Any);
    let refused = post(&server, &json!({ "source": files.url("/By%20the%20sea.jpg") })).problem(403);
    assert_eq!(refused["type"], "urn:tmpi:problem:no-sources");
    assert_eq!(files.asked(), Vec::<String>::new());
}
