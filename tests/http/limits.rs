//! Limits: each value at the limit and one over.

use std::io::{Read, Write};

use tmpi_pipeline::photo;

use crate::prelude::*;

#[test]
fn the_body_at_its_limit_and_one_byte_over() {
    let photo = jpeg(1);
    let server = Running::with(Limits { body: photo.len(), ..Limits::default() }, Arc::new(pipeline()));
    assert_eq!(request(server.addr, "POST", "/v1/photos", &[], &photo).status, 202);
    let mut over = photo.clone();
    over.push(0);
    assert!(request(server.addr, "POST", "/v1/photos", &[], &over).problem(413)["detail"].as_str().unwrap().contains("limit"));
    post_form(server.addr, &[], &[("photo", &photo)]).problem(413);
    // without `Content-Length` the server has to count
    let head = format!("POST /v1/photos HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: chunked\r\n\r\n{:x}\r\n", over.len());
    send_raw(server.addr, &[head.as_bytes(), &over, b"\r\n0\r\n\r\n"].concat()).problem(413);
}

#[test]
fn the_default_body_limit_is_answered_before_the_whole_body_is_read() {
    let server = Running::open();
    let over = vec![0; Limits::BODY + 1];
    request(server.addr, "POST", "/v1/photos", &[], &over).problem(413);
    // at the limit the body is read; it is no picture
    request(server.addr, "POST", "/v1/photos", &[], &over[1..]).problem(415);
}

#[test]
fn the_photo_at_its_limits_and_one_over() {
    let (pixels, side) = (80 * 60, 80);
    let with = |photo| Running::with(Limits::default(), Arc::new(way_within(photo)));
    let at = with(photo::Limits { pixels, side, ..photo::Limits::default() });
    at.make(&jpeg(1));
    for limits in [photo::Limits { pixels: pixels - 1, ..Default::default() }, photo::Limits { side: side - 1, ..Default::default() }] {
        let over = with(limits);
        assert_eq!(request(over.addr, "POST", "/v1/photos", &[], &jpeg(1)).problem(413)["field"], "photo");
    }
}

#[test]
fn a_header_that_does_not_arrive_closes_the_connection() {
    let server = Running::with(Limits { header_read: Duration::from_millis(300), ..Limits::default() }, Arc::new(pipeline()));
    let mut slow = Connection::open(server.addr);
    let start = Instant::now();
    slow.raw().write_all(b"GET /healthz HTTP/1.1\r\nhost:").unwrap();
    let mut rest = Vec::new();
    let _ = slow.raw().read_to_end(&mut rest);
    let took = start.elapsed();
    assert!(took >= Duration::from_millis(290) && took < Duration::from_secs(10), "{took:?}");
    assert!(!rest.starts_with(b"HTTP/1.1 200"));
    // a header in pieces within the time is fine
    let mut fine = Connection::open(server.addr);
    for piece in b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n\r\n".chunks(1) {
        fine.raw().write_all(piece).unwrap();
    }
    assert_eq!(fine.receive("GET").unwrap().status, 200);
}

#[test]
fn a_header_that_is_too_large_is_refused() {
    let server = Running::open();
    let send = |bytes: usize| request(server.addr, "GET", "/healthz", &[("x-long", &"a".repeat(bytes))], &[]).status;
    assert_eq!(send(Limits::HEADER_BYTES - 1000), 200);
    assert_eq!(send(Limits::HEADER_BYTES + 1), 431);
}

#[test]
fn the_configured_disk_space_stays_free() {
    for (least_free, least_free_files) in [(u64::MAX, 0), (0, u64::MAX)] {
        let server = Running::with(Limits { least_free, least_free_files, ..Limits::default() }, Arc::new(pipeline()));
        assert!(server.metric("tmpi_data_free_bytes") > 0);
        if least_free_files > 0 && server.metric("tmpi_data_free_files") == 0 {
            // a file system without a limit on files
            continue;
        }
        request(server.addr, "POST", "/v1/photos", &[], &jpeg(1)).problem(507);
        wait_until("it is not ready", || get(server.addr, "/readyz").status == 503);
    }
}

#[test]
fn a_full_disk_drops_what_can_be_made_again() {
    let server = Running::open();
    let id = server.make(&jpeg(1));
    // nothing is dropped for not being used
    let limits = Limits { least_free: u64::MAX, idle: Duration::from_hours(1), ..Limits::default() };
    let server = server.again(limits, Arc::new(pipeline()));
    let is_drawn = || get(server.addr, &format!("/v1/photos/{id}/view?w=40")).all("server-timing").contains("render;dur=");
    assert!(is_drawn());
    wait_until("it is kept", || !is_drawn());
    wait_until("it is dropped, and drawn again", is_drawn);
}

#[test]
fn a_body_that_stops_is_408_and_leaves_nothing() {
    let server = Running::with(Limits { body_read: Duration::from_millis(200), ..Limits::default() }, Arc::new(pipeline()));
    for content_type in ["image/jpeg", "multipart/form-data; boundary=x"] {
        let head =
            format!("POST /v1/photos HTTP/1.1\r\nhost: localhost\r\ncontent-type: {content_type}\r\ncontent-length: 1000\r\n\r\n--x\r\n");
        send_raw(server.addr, head.as_bytes()).problem(408);
    }
    wait_until("nothing is left", || incoming(server.data()) == 0);
}

#[test]
fn a_request_that_takes_too_long_is_ended() {
    let limits = Limits { request: Duration::from_secs(1), ..Limits::default() };
    let gate = Gate::new(0);
    let server = Running::with(limits, gate.clone());
    // `Prefer: wait` ends before the request's timeout
    request(server.addr, "POST", "/v1/photos", &[("prefer", "wait=60")], &jpeg(1)).is(202);
    gate.open(1);
}

#[test]
fn connections_over_the_limit_wait_their_turn() {
    let server = Running::with(Limits { connections: 2, ..Limits::default() }, Arc::new(pipeline()));
    let (mut a, mut b) = (Connection::open(server.addr), Connection::open(server.addr));
    assert_eq!((a.request("GET", "/healthz", &[], &[]).status, b.request("GET", "/healthz", &[], &[]).status), (200, 200));
    let mut third = Connection::asking(server.addr, "/healthz");
    // meanwhile the server serves the open connections
    for _ in 0..100 {
        let metrics = b.request("GET", "/metrics", &[], &[]).text();
        assert!(metrics.lines().any(|l| l == "tmpi_connections 2"), "{metrics}");
    }
    third.raw().set_nonblocking(true).unwrap();
    assert_eq!(third.raw().peek(&mut [0]).unwrap_err().kind(), std::io::ErrorKind::WouldBlock, "not served while two are open");
    third.raw().set_nonblocking(false).unwrap();
    drop(a);
    assert_eq!(third.receive("GET").unwrap().status, 200);
}

#[test]
fn a_client_that_sends_a_whole_refused_upload_still_gets_the_answer() {
    let server = Running::with(Limits { body: 1 << 20, ..Limits::default() }, Arc::new(pipeline()));
    for _ in 0..5 {
        let refused = request(server.addr, "POST", "/v1/photos", &[], &vec![7; (1 << 20) + 500_000]);
        refused.problem(413);
    }
}

#[test]
fn a_stopping_server_is_not_ready_and_goes_on_for_a_while() {
    let for_a_while = |lame_duck| Running::with(Limits { lame_duck, ..Limits::default() }, Arc::new(pipeline()));
    // longer than the test: it ends with the test's process
    let mut server = for_a_while(Duration::from_hours(1));
    assert_eq!(get(server.addr, "/readyz").status, 200);
    server.signal();
    wait_until("it says so", || get(server.addr, "/readyz").status == 503);
    // new connections are still served
    assert!(get(server.addr, "/readyz").problem(503)["detail"].as_str().unwrap().contains("stopping"));
    assert_eq!(get(server.addr, "/healthz").status, 200);
    server.make(&jpeg(1));

    let short = Duration::from_millis(300);
    let server = for_a_while(short);
    let (addr, told) = (server.addr, Instant::now());
    server.stop();
    assert!(told.elapsed() >= short);
    assert!(std::net::TcpStream::connect(addr).is_err());
}

#[test]
fn a_running_job_ends_within_the_drain_time() {
    let gate = Gate::new(0);
    let mut server = Running::with(Limits::default(), gate.clone());
    let id = server.upload(&jpeg(1));
    let queued = server.upload(&jpeg(2));
    gate.wait_started(1);
    server.signal();
    wait_until("no new connections are accepted", || std::net::TcpStream::connect(server.addr).is_err());
    gate.open(1);
    let server = server.again(Limits::default(), Gate::new(0));
    assert_eq!((gate.finished.load(Ordering::SeqCst), gate.started.load(Ordering::SeqCst)), (1, 1), "the queued one waits");
    assert_eq!(server.state(&id)["state"], "done");
    assert_ne!(server.state(&queued)["state"], "done");
}

#[test]
fn a_photo_that_keeps_crashing_its_process_fails() {
    let limits = || Limits { attempts: 2, drain: Duration::from_millis(100), ..Limits::default() };
    let gate = Gate::new(0);
    let server = Running::with(limits(), gate.clone());
    let id = server.upload(&jpeg(1));
    gate.wait_started(1);
    // an orderly stop does not count
    let crash = || Fault::Crashed("signal 9".into());
    let server = server.again(limits(), failing(vec![crash(), crash()]));
    assert_eq!(server.wait(&id, "failed")["problem"]["type"], "urn:tmpi:problem:gave-up");
    // other photos and another try are made
    server.make(&jpeg(2));
    server.make(&jpeg(1));
}

#[test]
fn a_server_fault_is_reported_and_the_photo_waits_until_it_is_fixed() {
    let faults = (0..3).map(|_| Fault::Server("no library".into())).collect();
    let server = Running::with(Limits { attempts: 1, ..Limits::default() }, failing(faults));
    let id = server.upload(&jpeg(1));
    wait_until("the state has the reason", || server.state(&id)["waits_for"] == "no library");
    assert_eq!(get(server.addr, "/readyz").is(503).json()["detail"], "no library");
    server.wait(&id, "done");
    assert_eq!(get(server.addr, "/readyz").status, 200);
}

#[cfg(unix)]
#[test]
fn stored_files_are_readable_by_the_servers_user_only() {
    use std::os::unix::fs::PermissionsExt;
    let server = Running::with(Limits::default(), failing(Vec::new()));
    let id = server.make(&jpeg(1));
    let mode = |path: &std::path::Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
    let blobs = server.data().join("blobs");
    assert_eq!((mode(&blobs), mode(&blobs.join(&id[..2]))), (0o700, 0o700));
    let files = contents(server.data(), &id, "");
    assert!(files.len() >= 5, "{files:?}");
    for path in files {
        assert_eq!(mode(&path), 0o600, "{}", path.display());
    }
}

#[test]
fn a_body_on_a_route_that_reads_none_is_refused_and_the_answer_names_the_query() {
    let server = Running::open();
    let id = server.make(&jpeg(1));
    let at = |part: &str| format!("/v1/photos/{id}/{part}");
    for path in
        [at("links"), at("manage"), at("remake"), "/v1/owner".to_owned(), "/v1/network".to_owned(), "/v1/live/attic/token".to_owned()]
    {
        for body in [&br#"{"seconds": 60}"#[..], b"{}", b" "] {
            let refused = request(server.addr, "POST", &path, &[JSON], body).problem(400);
            assert!(refused["detail"].as_str().unwrap().contains("query"), "{path}: {refused}");
        }
        // chunked, without a length in the header
        let chunked = |body: &str| {
            let head = format!("POST {path} HTTP/1.1\r\nhost: {}\r\ntransfer-encoding: chunked\r\n\r\n", server.addr);
            send_raw(server.addr, (head + body).as_bytes())
        };
        chunked("2\r\n{}\r\n0\r\n\r\n").problem(400);
        assert!(chunked("0\r\n\r\n").status < 300, "{path}");
        server.wait(&id, "done");
    }
}
