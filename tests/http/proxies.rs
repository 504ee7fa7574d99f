//! `--trusted-proxies` and `--client-address`: the address of a client behind a proxy.

use std::io::{Read as _, Write as _};
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;

use tmpi::server::{ClientAddress, Config, Limits, Network, Proxies, Rates, Server};
use tmpi_render::Backend;

use crate::client::{Connection, Response, request};
use crate::fixture::{Running, wait_until};
use crate::makers::pipeline;

/// A server that trusts a proxy at the test's own address to name the client.
fn behind(data: &Path, told: ClientAddress, limits: Limits) -> Running {
    let config = Config {
        hosts: vec!["photos.example".into()],
        proxies: Proxies::new(&["127.0.0.1".parse::<Network>().unwrap()], told),
        limits,
        ..Config::new(([127, 0, 0, 1], 0).into(), data.to_owned())
    };
    Running::of(async move { Server::bind(config, Arc::new(pipeline()), tmpi_render::select(Backend::Cpu).unwrap()).await.unwrap() })
}

/// A connection that begins with this header of the PROXY protocol.
fn begun(addr: SocketAddr, header: &[u8]) -> Connection {
    let mut connection = Connection::open(addr);
    connection.raw().write_all(header).unwrap();
    connection
}

fn from(address: &str) -> Vec<u8> {
    format!("PROXY TCP4 {address} 127.0.0.1 4711 80\r\n").into_bytes()
}

/// True if the server closes a connection without an answer.
fn is_closed(mut connection: Connection) -> bool {
    let _ = connection.raw().write_all(b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n\r\n");
    matches!(connection.raw().read(&mut [0; 9]), Ok(0) | Err(_))
}

fn left(answer: &Response) -> Option<&str> {
    answer.header("ratelimit")
}

const fn only_requests(requests: u32) -> Rates {
    Rates { requests, uploads: 0, views: 0 }
}

#[test]
fn clients_behind_a_trusted_proxy_are_told_apart() {
    let limits = || Limits { rates: only_requests(2), ..Limits::default() };
    for (told, name, values) in [
        (ClientAddress::XForwardedFor, "x-forwarded-for", ["198.51.100.1, 192.0.2.1", "192.0.2.2"]),
        (ClientAddress::Forwarded, "forwarded", ["for=198.51.100.1, for=192.0.2.1;proto=https", "for=\"192.0.2.2:80\""]),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let server = behind(dir.path(), told, limits());
        let ask = |value: &str| request(server.addr, "GET", "/openapi.json", &[(name, value)], &[]);
        let answers: Vec<_> = (0..3).map(|_| ask(values[0])).collect();
        assert_eq!(answers.iter().map(|a| a.status).collect::<Vec<_>>(), [200, 200, 429], "{name}");
        assert!(answers[2].problem(429)["detail"].as_str().unwrap().contains("2 a minute"));
        // addresses that the client wrote itself, before the proxy's, do not count
        let disguised = values[0].replace("198.51.100.1", "198.51.100.77");
        assert_eq!((ask(&disguised).status, ask(values[1]).status), (429, 200), "{name}");
    }
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
    // without a trusted proxy, a header of the PROXY protocol is a wrong request
    assert_eq!(begun(server.addr, &from("192.0.2.1")).receive("GET").unwrap().status, 400);
}

#[test]
fn the_proxy_protocol_names_the_client_of_each_connection() {
    let dir = tempfile::tempdir().unwrap();
    let limits = Limits { rates: only_requests(2), connections_per_address: 2, ..Limits::default() };
    let server = behind(dir.path(), ClientAddress::ProxyProtocol, limits);
    let ask = |connection: &mut Connection| connection.request("GET", "/openapi.json", &[("x-forwarded-for", "198.51.100.3")], &[]);
    let mut two =
        begun(server.addr, &[b"\r\n\r\n\0\r\nQUIT\n".as_slice(), b"\x21\x11\0\x0c\xc0\0\x02\x07\x7f\0\0\x01\x12\x34\0\x50"].concat());
    let answers: Vec<_> = (0..3).map(|_| ask(&mut two)).collect();
    assert_eq!(answers.iter().map(|a| a.status).collect::<Vec<_>>(), [200, 200, 429], "the client's own header does not count");
    let mut one = begun(server.addr, &from("192.0.2.8"));
    assert_eq!(ask(&mut one).status, 200);
    // the limit of connections applies to the client, not to the proxy
    let mut others: Vec<_> = (10..14).map(|n| begun(server.addr, &from(&format!("192.0.2.{n}")))).collect();
    assert!(others.iter_mut().all(|c| ask(c).status == 200));
    let mut second = begun(server.addr, &from("192.0.2.8"));
    assert_eq!(ask(&mut second).status, 200);
    assert!(is_closed(begun(server.addr, &from("192.0.2.8"))), "a third connection of one client");
    drop(one);
    wait_until("another one is let in", || !is_closed(begun(server.addr, &from("192.0.2.8"))));
}

#[test]
fn clients_of_the_proxy_protocol_are_not_this_machines_own_user() {
    let dir = tempfile::tempdir().unwrap();
    let server = behind(dir.path(), ClientAddress::ProxyProtocol, Limits::default());
    let list = |header: &[u8]| begun(server.addr, header).request("GET", "/v1/photos", &[], &[]).status;
    assert_eq!(list(&from("192.0.2.1")), 403, "even under a loopback name and without a proxy's headers");
    // the proxy's own health check, or a client whose address the proxy does not know
    assert_eq!(list(b"PROXY UNKNOWN\r\n"), 403);
    assert_eq!(begun(server.addr, b"PROXY UNKNOWN\r\n").request("GET", "/healthz", &[], &[]).status, 200);
    let began = std::time::Instant::now();
    assert!(is_closed(Connection::open(server.addr)), "a connection without the header is refused");
    assert!(began.elapsed() < Limits::HEADER_READ);
}

#[test]
fn a_silent_proxy_is_disconnected() {
    let dir = tempfile::tempdir().unwrap();
    let limits = Limits { header_read: std::time::Duration::from_millis(200), ..Limits::default() };
    let server = behind(dir.path(), ClientAddress::ProxyProtocol, limits);
    let mut silent = begun(server.addr, b"PROXY TCP4 192.0.2.1 ");
    assert!(matches!(silent.raw().read(&mut [0; 9]), Ok(0) | Err(_)), "closed after `header_read`");
}
