//! How uploads arrive: slowly but steadily, too slowly, to a full queue, and with odd headers.

use std::io::Write;

use crate::prelude::*;

/// Sends an upload in `pieces` over `time`, until the server answers.
fn drip(server: &Running, headers: &str, body: &[u8], pieces: usize, time: Duration) -> Connection {
    let mut connection = Connection::open(server.addr);
    let head = format!("POST /v1/photos HTTP/1.1\r\nhost: localhost\r\n{headers}content-length: {}\r\n\r\n", body.len());
    let raw = connection.raw();
    raw.write_all(head.as_bytes()).unwrap();
    let patience = raw.read_timeout().unwrap();
    raw.set_read_timeout(Some(time / pieces as u32)).unwrap();
    for piece in body.chunks(body.len().div_ceil(pieces)) {
        // the pause before the next piece ends with an answer
        if raw.write_all(piece).is_err() || raw.peek(&mut [0]).is_ok() {
            break;
        }
    }
    raw.set_read_timeout(patience).unwrap();
    connection
}

#[test]
fn a_slow_but_steady_upload_succeeds_however_long_it_takes() {
    let limits = Limits { request: Duration::from_secs(1), body_read: Duration::from_millis(900), body_rate: 500, ..Limits::default() };
    let server = Running::with(limits, Arc::new(pipeline()));
    let photo = jpeg(1);
    let began = Instant::now();
    let mut raw = drip(&server, "prefer: wait=20\r\n", &photo, 20, Duration::from_millis(1500));
    // the request's own timeout begins after the body, while it waits for the result
    let answer = raw.receive("POST").unwrap().any_of(&[201, 202]);
    assert!(began.elapsed() > Duration::from_secs(1));
    let (content_type, body) = form(&[("photo", &photo)]);
    let mut multipart = drip(&server, &format!("content-type: {content_type}\r\n"), &body, 20, Duration::from_millis(1500));
    assert_eq!(multipart.receive("POST").unwrap().json()["id"], answer.json()["id"]);
}

#[test]
fn an_upload_below_the_least_rate_is_408_and_leaves_nothing() {
    let limits = Limits { body_read: Duration::from_millis(300), body_rate: 50_000, ..Limits::default() };
    let server = Running::with(limits, Arc::new(pipeline()));
    // no single pause is too long, and the first bytes are a valid picture
    let mut photo = jpeg(1);
    photo.resize(5000, 7);
    let mut slow = drip(&server, "", &photo, 50, Duration::from_secs(2));
    let problem = slow.receive("POST").unwrap().problem(408);
    assert!(problem["detail"].as_str().unwrap().contains("bytes a second"), "{problem}");
    wait_until("nothing is left", || incoming(server.data()) == 0);
}

#[test]
fn a_full_queue_is_reported_before_the_body_is_sent() {
    let gate = Gate::new(0);
    let server = Running::with(Limits { queue: 1, uploads_beyond: 1, ..Limits::default() }, gate.clone());
    let _running = server.upload(&jpeg(1));
    gate.wait_started(1);
    let queued = server.upload(&jpeg(2));
    // one upload beyond the queue is read, because its photo may be known
    let mut known = Connection::open(server.addr);
    let photo = jpeg(2);
    let head = format!("POST /v1/photos HTTP/1.1\r\nhost: localhost\r\ncontent-length: {}\r\n\r\n", photo.len());
    known.raw().write_all(head.as_bytes()).unwrap();
    wait_until("it comes in", || incoming(server.data()) == 1);
    let answer = send_raw(server.addr, b"POST /v1/photos HTTP/1.1\r\nhost: localhost\r\ncontent-length: 30000000\r\n\r\n");
    let seconds: u64 = answer.header("retry-after").unwrap().parse().unwrap();
    assert_eq!(answer.problem(429)["retry_after"], seconds);
    assert!((1..=120).contains(&seconds));
    assert_eq!(get(server.addr, "/readyz").status, 200, "photos are still shown");
    assert_eq!(incoming(server.data()), 1, "the refused upload wrote nothing");
    known.raw().write_all(&photo).unwrap();
    assert_eq!(known.receive("POST").unwrap().json()["id"], queued.as_str());
    gate.open(2);
    server.wait(&queued, "done");
    assert_eq!(request(server.addr, "POST", "/v1/photos", &[], &jpeg(3)).status, 202, "there is room again");
    gate.open(1);
}

#[test]
fn retry_after_grows_with_what_waits() {
    let after = |queue: u8| {
        let gate = Gate::new(0);
        let server = Running::with(Limits { queue: queue.into(), ..Limits::default() }, gate.clone());
        server.upload(&jpeg(0));
        gate.wait_started(1);
        for seed in 1..=queue {
            server.upload(&jpeg(seed));
        }
        let refused = request(server.addr, "POST", "/v1/photos", &[], &jpeg(99));
        refused.problem(429)["retry_after"].as_u64().unwrap()
    };
    let (few, many) = (after(1), after(10));
    assert!(many > 3 * few && many <= 120, "{few} s, {many} s");
}

#[test]
fn any_wait_is_accepted_however_long() {
    let gate = Gate::new(1);
    let server = Running::with(Limits::default(), gate);
    for seconds in [u64::MAX.to_string(), "99999999999999999999".into(), "1e9".into()] {
        let answer = request(server.addr, "POST", "/v1/photos", &[("prefer", &format!("wait={seconds}"))], &jpeg(1));
        assert!(matches!(answer.status, 201 | 202), "{seconds}: {}", String::from_utf8_lossy(&answer.body));
    }
}

#[test]
fn headers_and_names_of_forms_are_bounded() {
    let server = Running::open();
    for name in ["n".repeat(65), "n".repeat(4000)] {
        let answer = post_form(server.addr, &[], &[(&name, b"1"), ("photo", &jpeg(1))]);
        assert!(answer.body.len() < 2000, "{} bytes", answer.body.len());
        answer.problem(400);
    }
    let answer = post_form(server.addr, &[], &[(&"n".repeat(1 << 20), b"1"), ("photo", &jpeg(1))]);
    assert!(answer.body.len() < 2000, "{} bytes", answer.body.len());
    assert!(answer.problem(400)["detail"].as_str().unwrap().contains("header of a part"));
    let answer = request(server.addr, "POST", &format!("/v1/photos?{}=1", "q".repeat(20_000)), &[], &jpeg(1));
    assert!(answer.body.len() < 2000, "{} bytes", answer.body.len());
    answer.problem(400);
    // a name at the limit is refused as an unknown field only
    assert_eq!(post_form(server.addr, &[], &[(&"n".repeat(64), b"1")]).problem(400)["field"], "n".repeat(64));
    wait_until("nothing is left", || incoming(server.data()) == 0);
}

#[test]
fn an_answer_does_not_wait_for_an_unread_body() {
    let server = Running::open();
    let began = Instant::now();
    send_raw(server.addr, b"GET /healthz HTTP/1.1\r\nhost: localhost\r\ncontent-length: 100\r\n\r\n").is(200);
    assert!(began.elapsed() < Limits::default().body_read, "{:?}", began.elapsed());
}

#[test]
fn a_body_in_an_unsupported_transfer_coding_is_refused() {
    let server = Running::open();
    for coding in ["gzip, chunked", "x, chunked"] {
        let head = format!("POST /v1/photos HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: {coding}\r\n\r\n3\r\nabc\r\n0\r\n\r\n");
        assert_eq!(send_raw(server.addr, head.as_bytes()).problem(501)["field"], "Transfer-Encoding", "{coding}");
    }
    let photo = jpeg(1);
    let head = format!("POST /v1/photos HTTP/1.1\r\nhost: localhost\r\nTransfer-Encoding: Chunked\r\n\r\n{:x}\r\n", photo.len());
    send_raw(server.addr, &[head.as_bytes(), &photo, b"\r\n0\r\n\r\n"].concat()).is(202);
    wait_until("nothing else is left", || incoming(server.data()) == 0);
}
