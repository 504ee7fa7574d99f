//! `--trusted-proxies`: the address of a client behind a proxy.

use std::path::Path;
use std::sync::Arc;

use tmpi::server::{Config, Limits, Network, Proxies, Rates, Server};
use tmpi_render::Backend;

use crate::client::{Response, request};
use crate::fixture::Running;
use crate::makers::pipeline;

/// A server that trusts a proxy at the test's own address to name the client.
fn behind(data: &Path, limits: Limits) -> Running {
    let config = Config {
        hosts: vec!["photos.example".into()],
        proxies: Proxies::new(&["127.0.0.1".parse::<Network>().unwrap()]),
        limits,
        ..Config::new(([127, 0, 0, 1], 0).into(), data.to_owned())
    };
    Running::of(async move { Server::bind(config, Arc::new(pipeline()), tmpi_render::select(Backend::Cpu).unwrap()).await.unwrap() })
}

fn left(answer: &Response) -> Option<&str> {
    answer.header("ratelimit")
}

const fn only_requests(requests: u32) -> Rates {
    Rates { requests, uploads: 0, views: 0 }
}

#[test]
fn clients_behind_a_trusted_proxy_are_told_apart() {
    let dir = tempfile::tempdir().unwrap();
    let server = behind(dir.path(), Limits { rates: only_requests(2), ..Limits::default() });
    let ask = |way: &str| request(server.addr, "GET", "/openapi.json", &[("x-forwarded-for", way)], &[]);
    let answers: Vec<_> = (0..3).map(|_| ask("198.51.100.1, 192.0.2.1")).collect();
    assert_eq!(answers.iter().map(|a| a.status).collect::<Vec<_>>(), [200, 200, 429]);
    assert!(answers[2].problem(429)["detail"].as_str().unwrap().contains("2 a minute"));
    // addresses that the client wrote itself, before the proxy's, do not count
    assert_eq!((ask("198.51.100.77, 192.0.2.1").status, ask("192.0.2.2").status), (429, 200));
}

#[test]
fn headers_of_untrusted_proxies_change_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let server = Running::start(dir.path(), Limits { rates: only_requests(1), ..Limits::default() }, Arc::new(pipeline()));
    for n in 0..3 {
        // requests from loopback are not counted, and the header does not change that
        let answer = request(server.addr, "GET", "/healthz", &[("x-forwarded-for", "192.0.2.1")], &[]);
        assert_eq!((answer.status, left(&answer)), (200, None), "{n}");
    }
}
