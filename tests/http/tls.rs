//! TLS with `--tls-cert`: HTTP/1.1 and HTTP/2.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError};

use bytes::Bytes;
use h2::client::SendRequest;
use hyper::{Request, Response};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{ClientConfig, ClientConnection, RootCertStore, StreamOwned};
use tmpi::server::Tls;
use tmpi_testing::program::Killed;

use crate::live;
use crate::photo_settings;
use crate::prelude::*;

fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/http/certificates").join(name)
}

/// A server with the example certificate and a finished photo; returns the photo's id and container, too.
fn start(limits: Limits) -> (Running, String, Vec<u8>) {
    start_with(&jpeg(1), limits)
}

fn start_with(photo: &[u8], limits: Limits) -> (Running, String, Vec<u8>) {
    let plain = Running::open();
    let id = plain.make(photo);
    let atlas = get(plain.addr, &format!("/v1/photos/{id}/atlas")).body;
    (over_tls(plain, limits), id, atlas)
}

/// Stops a server and starts one with TLS in its data folder.
fn over_tls(server: Running, limits: Limits) -> Running {
    let tls = Tls::open(example("one.pem"), example("one.key")).unwrap();
    let change = |config| Config { limits, ..config };
    server.completed(Arc::new(pipeline()), change, |server| with_rooms(server).with_tls(tls))
}

/// A client that trusts the example certificate and offers these protocols.
fn trusting(protocols: &[&[u8]]) -> Arc<ClientConfig> {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_file(example("one.pem")).unwrap()).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let client = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions().unwrap();
    let mut client = client.with_root_certificates(roots).with_no_client_auth();
    client.alpn_protocols = protocols.iter().map(|p| p.to_vec()).collect();
    Arc::new(client)
}

/// An HTTP/2 connection with the flow-control windows of `client`.
async fn second(addr: SocketAddr, client: &mut h2::client::Builder) -> SendRequest<Bytes> {
    let stream = tokio::net::TcpStream::connect(addr).await.unwrap();
    let name = ServerName::try_from("localhost").unwrap();
    let stream = tokio_rustls::TlsConnector::from(trusting(&[b"h2"])).connect(name, stream).await.unwrap();
    assert_eq!(stream.get_ref().1.alpn_protocol(), Some(&b"h2"[..]));
    let (sender, connection) = client.handshake(stream).await.unwrap();
    tokio::spawn(async move { drop(connection.await) });
    sender
}

/// An HTTP/1.1 connection.
fn first(addr: SocketAddr) -> StreamOwned<ClientConnection, TcpStream> {
    let name = ServerName::try_from("localhost").unwrap();
    let session = ClientConnection::new(trusting(&[b"http/1.1"]), name).unwrap();
    StreamOwned::new(session, TcpStream::connect(addr).unwrap())
}

fn asks(method: &str, path: &str, host: &str) -> Request<()> {
    Request::builder().method(method).uri(format!("https://{host}{path}")).body(()).unwrap()
}

/// A whole answer.
async fn whole(answer: h2::client::ResponseFuture) -> Result<(Response<()>, Vec<u8>), h2::Error> {
    let (head, mut body) = answer.await?.into_parts();
    let mut all = Vec::new();
    while let Some(piece) = body.data().await {
        let piece = piece?;
        body.flow_control().release_capacity(piece.len())?;
        all.extend_from_slice(&piece);
    }
    Ok((Response::from_parts(head, ()), all))
}

async fn fetch(sender: &SendRequest<Bytes>, request: Request<()>) -> (u16, Vec<u8>) {
    let mut sender = sender.clone().ready().await.unwrap();
    let (answer, _) = sender.send_request(request, true).unwrap();
    let (head, body) = whole(answer).await.unwrap();
    (head.status().as_u16(), body)
}

/// A value of the server's metrics.
async fn metric(sender: &SendRequest<Bytes>, name: &str) -> u64 {
    let (_, text) = fetch(sender, asks("GET", "/metrics", "localhost")).await;
    let text = String::from_utf8(text).unwrap();
    text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.parse::<f64>().ok()).unwrap() as u64
}

#[test]
fn requests_on_a_keep_alive_connection_over_tls() {
    let (server, id, atlas) = start(Limits::default());
    let mut stream = first(server.addr);
    let mut ask = |path: &str, more: &str| {
        write!(stream, "GET {path} HTTP/1.1\r\nhost: localhost\r\n{more}\r\n").unwrap();
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).unwrap();
            head.push(byte[0]);
        }
        let head = String::from_utf8(head).unwrap();
        let length = head.lines().find_map(|line| line.strip_prefix("content-length: ")).unwrap().parse().unwrap();
        let mut body = vec![0; length];
        stream.read_exact(&mut body).unwrap();
        (head, body)
    };
    let (head, body) = ask(&format!("/v1/photos/{id}/atlas"), "");
    assert!(head.starts_with("HTTP/1.1 200 ") && body == atlas);
    let (_, page) = ask(&format!("/view/{id}"), "");
    let page = String::from_utf8(page).unwrap();
    assert!(page.contains("https://localhost") && !page.contains("http://localhost"), "links have the scheme of the connection");
    let (_, page) = ask(&format!("/view/{id}"), "x-forwarded-proto: http\r\n");
    assert!(String::from_utf8(page).unwrap().contains("http://localhost"), "a proxy's header overrides the scheme");
}

#[test]
fn hsts_is_sent_over_tls() {
    let told = |server: Running, limits: Limits, paths: &[&str]| {
        let server = over_tls(server, limits);
        let one = block_on(async {
            let sender = second(server.addr, &mut h2::client::Builder::new()).await;
            let mut sender = sender.ready().await.unwrap();
            let (answer, _) = sender.send_request(asks("GET", "/healthz", "localhost"), true).unwrap();
            answer.await.unwrap().headers().get("strict-transport-security").map(|v| v.to_str().unwrap().to_owned())
        });
        let mut stream = first(server.addr);
        for path in paths {
            write!(stream, "GET {path} HTTP/1.1\r\nhost: localhost\r\n").unwrap();
            stream.write_all(if path == paths.last().unwrap() { &b"connection: close\r\n\r\n"[..] } else { b"\r\n" }).unwrap();
        }
        let mut all = Vec::new();
        let _ = stream.read_to_end(&mut all);
        let all = String::from_utf8_lossy(&all).into_owned();
        (server, one, all.matches("strict-transport-security: max-age=9\r\n").count())
    };
    let (server, id, _) = start(Limits::default());
    let atlas = format!("/v1/photos/{id}/thumbnail");
    // the second thumbnail comes from a cache
    let paths = ["/healthz", &atlas, &atlas, "/nowhere"];
    let (server, header, times) = told(server, Limits { hsts: Duration::from_secs(9), ..Limits::default() }, &paths);
    assert_eq!((header.as_deref(), times), (Some("max-age=9"), 4));
    let (server, header, times) = told(server, Limits { hsts: Duration::ZERO, ..Limits::default() }, &paths);
    assert_eq!((header, times), (None, 0));
    let (server, header, _) = told(server, Limits::default(), &paths[..1]);
    assert_eq!(header.as_deref(), Some("max-age=604800"));
    assert_eq!(get(server.restarted().addr, "/healthz").header("strict-transport-security"), None);
}

#[test]
fn http_2_announces_the_configured_limit_of_streams() {
    let server = over_tls(Running::open(), Limits { streams_at_once: 3, ..Limits::default() });
    block_on(async {
        let sender = second(server.addr, &mut h2::client::Builder::new()).await;
        assert_eq!(fetch(&sender, asks("GET", "/healthz", "localhost")).await.0, 200);
        assert_eq!(sender.current_max_send_streams(), 3);
    });
}

#[test]
fn many_requests_at_a_time_over_http_2() {
    let (server, id, atlas) = start(Limits::default());
    block_on(async {
        let sender = second(server.addr, &mut h2::client::Builder::new()).await;
        let path = format!("/v1/photos/{id}/atlas");
        // a client knows how many requests the server takes at a time from its first answer on
        assert_eq!(fetch(&sender, asks("GET", "/healthz", "localhost")).await.0, 200);
        let many = (0..40).map(|_| fetch(&sender, asks("GET", &path, "localhost")));
        for (status, body) in futures_util::future::join_all(many).await {
            assert!(status == 200 && body == atlas);
        }
        let (_, page) = fetch(&sender, asks("GET", &format!("/view/{id}"), "localhost")).await;
        assert!(String::from_utf8(page).unwrap().contains("https://localhost"));
        assert_eq!(fetch(&sender, asks("GET", &path, "elsewhere.example")).await.0, 421, "the host of `:authority` is checked, too");
        // an upload, and beside it one whose body is refused
        let upload = async |photo: Bytes, path: &str| {
            let mut sender = sender.clone().ready().await.unwrap();
            let (answer, mut body) = sender.send_request(asks("POST", path, "localhost"), false).unwrap();
            // the server may refuse the body before its end
            let _ = body.send_data(photo, true);
            whole(answer).await.map(|(head, body)| (head.status().as_u16(), body))
        };
        let large = [jpeg(3), vec![7; Limits::BODY]].concat();
        let (taken, refused) = tokio::join!(upload(jpeg(2).into(), "/v1/photos"), upload(large.into(), "/v1/photos"));
        let (status, body) = taken.unwrap();
        assert_eq!(status, 202, "{}", String::from_utf8_lossy(&body));
        assert_eq!(refused.map_or_else(|e| panic!("{e}"), |(status, _)| status), 413);
        assert_eq!(fetch(&sender, asks("GET", "/healthz", "localhost")).await.0, 200, "the connection goes on");
    });
}

#[test]
fn the_program_publishes_and_watches_a_room_over_tls() {
    let frames = tempfile::tempdir().unwrap();
    let server = over_tls(Running::open(), Limits::default());
    for n in 0..10 {
        std::fs::write(frames.path().join(format!("{n}.jpg")), live::frame(10 + 5 * n)).unwrap();
    }
    let room = format!("https://localhost:{}/live/attic", server.addr.port());
    let program = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
        command.arg("live").args(args).env("SSL_CERT_FILE", example("one.pem")).stdout(Stdio::piped()).stderr(Stdio::piped());
        Killed(command.spawn().unwrap())
    };
    let _publisher = program(&["publish", frames.path().to_str().unwrap(), "--room", &room, "--times", "1000000"]);
    let seconds = (0..100).find_map(|_| {
        // the publisher may not have started yet
        let lines = std::io::read_to_string(program(&["watch", &room, "--seconds", "2", "--json"]).0.stdout.take().unwrap()).unwrap();
        (!lines.is_empty()).then_some(lines)
    });
    let frames: u64 = seconds
        .expect("the room can be watched")
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap()["frames"].as_u64().unwrap())
        .sum();
    assert!(frames > 0);
    let folder = tempfile::tempdir().unwrap();
    let record = folder.path().join("record");
    std::fs::write(&record, b"an earlier room").unwrap();
    let watch = ["live", "watch", &room, "--seconds", "1", "--record", record.to_str().unwrap()];
    let stranger = Command::new(env!("CARGO_BIN_EXE_tmpi")).args(watch).output().unwrap();
    assert!(!stranger.status.success(), "an unknown issuer is not trusted");
    assert!(String::from_utf8(stranger.stderr).unwrap().contains("certificate"));
    assert_eq!(std::fs::read(&record).unwrap(), b"an earlier room", "nothing came to record");
}

#[test]
fn stalled_silent_and_plain_text_connections_are_closed() {
    let short = Duration::from_millis(300);
    let limits = Limits { write: short, write_rate: 1 << 30, header_read: Duration::from_secs(1), ..Limits::default() };
    let (server, id, atlas) = start(limits);
    // no handshake, and plain HTTP
    let mut silent = TcpStream::connect(server.addr).unwrap();
    let mut plain = TcpStream::connect(server.addr).unwrap();
    write!(plain, "GET / HTTP/1.1\r\nhost: localhost\r\n\r\n").unwrap();
    for stream in [&mut silent, &mut plain] {
        stream.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
        // at most a TLS alert, then the end
        let ended = stream.read_to_end(&mut Vec::new());
        assert!(ended.is_ok_and(|n| n < 100));
    }
    block_on(async {
        let small = atlas.len() as u32 / 4;
        let mut sender = second(server.addr, h2::client::Builder::new().initial_window_size(small)).await.ready().await.unwrap();
        let (answer, _) = sender.send_request(asks("GET", &format!("/v1/photos/{id}/atlas"), "localhost"), true).unwrap();
        let mut body = answer.await.unwrap().into_body();
        // this client does not open its window, but answers pings
        let mut came = 0;
        let cut = loop {
            match tokio::time::timeout(Duration::from_mins(1), body.data()).await.expect("it is cut off") {
                Some(Ok(piece)) => came += piece.len(),
                other => break other,
            }
        };
        assert!(matches!(cut, Some(Err(_))) && came <= small as usize, "{cut:?} after {came} of {}", atlas.len());
        // an idle connection gets GOAWAY
        let sender = second(server.addr, &mut h2::client::Builder::new()).await;
        assert_eq!(fetch(&sender, asks("GET", "/healthz", "localhost")).await.0, 200);
        let began = Instant::now();
        while sender.clone().ready().await.is_ok() {
            assert!(began.elapsed() < Duration::from_mins(1), "never");
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    wait_until("no connection is left", || {
        let connections = block_on(async {
            let sender = second(server.addr, &mut h2::client::Builder::new()).await;
            metric(&sender, "tmpi_connections").await
        });
        connections == 1
    });
}

const HELD: &str = "tmpi_answer_memory_bytes";

/// Held by tests of the memory of answers, which all servers of a process share.
static ANSWER_MEMORY: Mutex<()> = Mutex::new(());

#[test]
fn unread_answers_share_a_bound_of_memory_and_others_are_served_meanwhile() {
    const CONNECTIONS: usize = 40;
    const STREAMS: usize = 32;
    // all pieces together, and two of the least size for each request; a whole piece for each would be 40 MiB
    const BOUND: u64 = (16 << 20) + (CONNECTIONS * STREAMS * 2 * (4 << 10)) as u64;
    let _alone = ANSWER_MEMORY.lock().unwrap_or_else(PoisonError::into_inner);
    let (server, id, atlas) = start_with(&noise(), Limits::default());
    assert!(atlas.len() > 256 << 10, "a file that is read in pieces: {} bytes", atlas.len());
    let path = format!("/v1/photos/{id}/atlas");
    block_on(async {
        let reader = second(server.addr, &mut h2::client::Builder::new()).await;
        let mut unread = Vec::new();
        for _ in 0..CONNECTIONS {
            // this client takes no byte of a body
            let sender = second(server.addr, h2::client::Builder::new().initial_window_size(0)).await;
            for _ in 0..STREAMS {
                let (answer, _) = sender.clone().ready().await.unwrap().send_request(asks("GET", &path, "localhost"), true).unwrap();
                unread.push(answer);
            }
        }
        let unread: Vec<_> = futures_util::future::join_all(unread).await.into_iter().map(Result::unwrap).collect();
        assert!(unread.iter().all(|answer| answer.status() == 200));
        let end = Instant::now() + Duration::from_mins(1);
        while metric(&reader, HELD).await < 15 << 20 {
            assert!(Instant::now() < end, "a minute is over before the unread answers hold their memory");
        }
        for _ in 0..10 {
            let (status, body) = fetch(&reader, asks("GET", &path, "localhost")).await;
            assert!(status == 200 && body == atlas);
            let held = metric(&reader, HELD).await;
            assert!(held <= BOUND, "{held} bytes");
        }
        drop(unread);
        let end = Instant::now() + Duration::from_mins(1);
        while metric(&reader, HELD).await > 1 << 20 {
            assert!(Instant::now() < end, "a minute is over before the memory of clients that have gone is free");
        }
    });
}

#[test]
fn answers_made_for_one_client_count_and_clients_that_do_not_read_them_go_when_memory_is_short() {
    const STREAMS: usize = 32;
    // all connections hold more than four times the bound of 16 MiB
    const SHORT: usize = 64 << 20;
    let _alone = ANSWER_MEMORY.lock().unwrap_or_else(PoisonError::into_inner);
    let plain = Running::open();
    let path = format!("/v1/photos/{}/strokes", plain.make(&jpeg(1)));
    let at = |i: usize| f64::from(i as u32) / 8192.0 * 0.987_654_321;
    let strokes: Vec<Value> = (0..8)
        .map(|n| json!({ "points": (0..1000).map(|i| [at(n * 1000 + i), at(8000 - n * 1000 - i)]).collect::<Vec<_>>(), "radius": 0.002, "by": 0.001 }))
        .collect();
    photo_settings::patch(&plain, &path, &[("prefer", "wait=60")], &json!({ "strokes": strokes })).is(200);
    let bytes = get(plain.addr, &path).body.len();
    let server = over_tls(plain, Limits::default());
    block_on(async {
        let (mut senders, mut unread) = (Vec::new(), Vec::new());
        for _ in 0..=SHORT / (STREAMS * bytes) {
            // this client takes no byte of a body
            let sender = second(server.addr, h2::client::Builder::new().initial_window_size(0)).await;
            for _ in 0..STREAMS {
                let (answer, _) = sender.clone().ready().await.unwrap().send_request(asks("GET", &path, "localhost"), true).unwrap();
                unread.push(answer);
            }
            senders.push(sender);
        }
        let _unread = futures_util::future::join_all(unread).await;
        // with memory to spare they would have 74 seconds
        let end = Instant::now() + Duration::from_secs(30);
        let mut gone = false;
        while !gone {
            assert!(Instant::now() < end, "30 seconds are over before a client that does not read is disconnected");
            tokio::time::sleep(Duration::from_millis(100)).await;
            for sender in &senders {
                gone |= sender.clone().ready().await.is_err();
            }
        }
        let reader = second(server.addr, &mut h2::client::Builder::new()).await;
        let held = metric(&reader, HELD).await;
        assert!(held < SHORT as u64 + (STREAMS * bytes) as u64, "{held} bytes");
        assert_eq!(fetch(&reader, asks("GET", &path, "localhost")).await.1.len(), bytes);
    });
}
