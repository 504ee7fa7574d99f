//! Measurements without assertions: `cargo test --release --test http throughput -- --ignored --nocapture`.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use crate::client::{Connection, get};
use crate::fixture::wait_until;
use crate::process::{Process, large, upload};

const CONNECTIONS: usize = 8;
const SECONDS: u64 = 3;

/// Requests per second over a few keep-alive connections.
fn rate(server: &Process, path: &(dyn Fn(usize) -> String + Sync), seconds: u64) -> (f64, f64) {
    let (count, bytes) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let start = Instant::now();
    std::thread::scope(|scope| {
        for _ in 0..CONNECTIONS {
            scope.spawn(|| {
                let mut connection = Connection::open(server.addr);
                while start.elapsed() < Duration::from_secs(seconds) {
                    let n = count.fetch_add(1, Ordering::Relaxed);
                    let answer = connection.request("GET", &path(n), &[], &[]);
                    assert_eq!(answer.status, 200, "{:?}", String::from_utf8_lossy(&answer.body));
                    bytes.fetch_add(answer.body.len(), Ordering::Relaxed);
                }
            });
        }
    });
    let took = start.elapsed().as_secs_f64();
    (count.into_inner() as f64 / took, bytes.into_inner() as f64 / took / 1e6)
}

#[test]
#[ignore = "takes a while and asserts no bound"]
fn measure_the_server() {
    let dir = tempfile::tempdir().unwrap();
    let server = Process::start(dir.path());
    let rss = || server.resident_mib();
    println!("resident at start: {:.1} MiB", rss());
    let id = upload(server.addr, &large(1)).unwrap();
    wait_until("it is done", || get(server.addr, &format!("/v1/photos/{id}")).json()["state"] == "done");
    println!("resident after one photo of 480×360: {:.1} MiB", rss());
    for path in ["/healthz".to_owned(), format!("/v1/photos/{id}"), format!("/v1/photos/{id}/atlas"), format!("/v1/photos/{id}/thumbnail")]
    {
        let (requests, megabytes) = rate(&server, &|_| path.clone(), SECONDS);
        println!("{path}: {requests:.0} requests/s, {megabytes:.1} MB/s");
    }
    println!("resident after those: {:.1} MiB", rss());
    for format in ["jpeg", "png", "webp"] {
        let view = |n: usize| format!("/v1/photos/{id}/view?tx={}&format={format}", (n % 400) as f64 / 1e4 - 0.02);
        let (requests, _) = rate(&server, &view, SECONDS);
        println!("views of 480×360 as {format}: {requests:.1} a second");
    }
    for n in 0..200 {
        let path = format!("/v1/photos/{id}/view?ty={}&w=1280&format=jpeg", f64::from(n) / 1e4);
        assert_eq!(get(server.addr, &path).status, 200);
    }
    println!("resident after 200 views of 1280×960: {:.1} MiB", rss());
    let metrics = String::from_utf8(get(server.addr, "/metrics").body).unwrap();
    for line in metrics.lines().filter(|l| l.starts_with("tmpi_view_seconds_sum") || l.starts_with("tmpi_view_seconds_count")) {
        println!("{line}");
    }
}
