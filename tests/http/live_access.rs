//! Tokens of rooms, and pages of other sites.

use std::io::Read as _;

use tmpi::live::Grant::{Publish, Watch};
use tmpi::live::room_token;
use tmpi_core::live::schema::message::Kind;

use crate::client;
use crate::live::{Client, KEY, Publisher, frame, hello, server};
use crate::prelude::*;

#[test]
fn strangers_need_a_token_and_pages_of_other_sites_are_refused() {
    let server = server();
    let mut publisher = Publisher::new(server.addr, "attic");
    publisher.publish(frame(10));
    let status = |path: &str, headers: &[(&'static str, &str)]| Client::at(server.addr, path, headers).err();
    let watch = "/v1/live/attic/subscribe";
    assert_eq!(status(watch, &[]), None);
    let own = format!("http://{}", server.addr);
    assert_eq!(status(watch, &[("origin", own.as_str())]), None);
    assert_eq!(status(watch, &[("origin", "https://example.org")]), Some(403));
    assert_eq!(status(watch, &[("host", "photos.example")]), Some(403));
    assert_eq!(status("/v1/live/attic/publish", &[("host", "photos.example")]), Some(403));
    assert_eq!(status(watch, &[("host", "elsewhere.example")]), Some(421));
    assert_eq!(status("/v1/live/cellar/subscribe", &[]), Some(404));
    assert_eq!(status("/v1/live/no%20room/publish", &[]), Some(404));
    let token = |role, expires| room_token(KEY, role, "attic", expires);
    let with = |token: String| status(&format!("{watch}?token={token}"), &[("host", "photos.example")]);
    assert_eq!(with(token(Watch, u64::MAX)), None);
    assert_eq!(with(token(Watch, 1)), Some(403));
    assert_eq!(client::get(server.addr, watch).status, 426, "not without an upgrade");
}

#[test]
fn a_socket_closes_when_its_token_expires() {
    let server = server();
    let ends = seconds_now() + 3;
    let token = |role| format!("Bearer {}", room_token(KEY, role, "attic", ends));
    let come = |path: &str, role| {
        let headers = [("host", "photos.example"), ("authorization", &token(role))];
        Client::at(server.addr, &format!("/v1/live/attic/{path}"), &headers)
    };
    let mut publisher = come("publish", Publish).unwrap();
    publisher.send(Kind::Hello(hello()));
    assert!(matches!(publisher.next(), Some(Kind::Credit(_))));
    let mut viewer = come("subscribe", Watch).unwrap();
    assert!(matches!(viewer.next(), Some(Kind::Hello(_))));
    for client in [viewer, publisher] {
        assert_eq!(client.bye(), "the token has expired");
    }
    assert_eq!(come("subscribe", Watch).err(), Some(403));
}

#[test]
fn a_group_of_pictures_breaks_off_when_its_token_expires() {
    let server = server();
    let mut publisher = Publisher::new(server.addr, "attic");
    publisher.publish(frame(10));
    let token = |ends| room_token(KEY, Watch, "attic", ends);
    let mut newest = None;
    wait_until("a group has begun", || {
        newest = client::get(server.addr, &format!("/v1/live/attic/gops/latest?token={}", token(u64::MAX)))
            .header("location")
            .map(str::to_owned);
        newest.is_some()
    });
    let group = newest.unwrap();
    let group = group.split('?').next().unwrap();
    // the publisher is silent, so the group does not end before the token
    let mut reader = client::Connection::asking(server.addr, &format!("/v1/live/attic/gops/{group}?token={}", token(seconds_now() + 3)));
    let mut all = Vec::new();
    reader.raw().read_to_end(&mut all).unwrap();
    // a whole group ends with an empty chunk
    assert!(all.starts_with(b"HTTP/1.1 200 ") && !all.ends_with(b"\r\n0\r\n\r\n"), "{}", String::from_utf8_lossy(&all));
}

#[test]
fn pages_of_other_sites_watch_with_a_token_and_never_publish() {
    let server = server();
    let mut publisher = Publisher::new(server.addr, "attic");
    publisher.publish(frame(10));
    let token = |role, room| room_token(KEY, role, room, u64::MAX);
    let (watch, publish) = (token(Watch, "attic"), token(Publish, "attic"));
    let foreign = [("origin", "https://example.org"), ("sec-fetch-site", "cross-site")];
    let status = |path: &str, protocols: &str| {
        let headers = [&foreign[..], &[("sec-websocket-protocol", protocols)]].concat();
        Client::at(server.addr, &format!("/v1/live/attic/{path}"), &headers).err()
    };
    assert_eq!(status("subscribe", &format!("tmpi.live.v1, token.{watch}")), None);
    let cellar = token(Watch, "cellar");
    let wrong = [("subscribe", "1-ab"), ("subscribe", cellar.as_str()), ("publish", watch.as_str()), ("publish", publish.as_str())];
    for (path, token) in wrong {
        assert_eq!(status(path, &format!("tmpi.live.v1, token.{token}")), Some(403), "{path} {token}");
    }
    assert_eq!(status("subscribe", "tmpi.live.v1"), Some(403), "this machine's own browser, on another site's page");
    // preflights: the browser may send the token and read the answer
    let ask = |method: &str, path: &str, more: &[(&str, &str)]| {
        client::request(server.addr, method, &format!("/v1/live/attic{path}"), &[&foreign[..], more].concat(), &[])
    };
    let preflight = [("access-control-request-method", "GET"), ("access-control-request-headers", "authorization")];
    for path in ["", "/frames/latest/atlas", "/gops/latest"] {
        let answer = ask("OPTIONS", path, &preflight);
        assert_eq!((answer.status, answer.header("access-control-allow-origin")), (200, Some("*")), "{path}");
        assert!(answer.header("access-control-allow-headers").is_some_and(|h| h.contains("authorization")), "{path}");
    }
    assert_eq!(ask("OPTIONS", "/token", &preflight).header("access-control-allow-origin"), None);
    let refused = ask("GET", "", &[]);
    assert_eq!(refused.problem(403)["type"], "urn:tmpi:problem:token");
    assert_eq!(refused.header("access-control-allow-origin"), Some("*"));
    let bearer = format!("Bearer {watch}");
    let state = ask("GET", "", &[("authorization", &bearer)]);
    assert_eq!((state.status, state.json()["publishing"].as_bool(), state.json()["may_publish"].as_bool()), (200, Some(true), Some(false)));
    // a publishing token can watch, too; on another site `may_publish` is false
    let bearer = format!("Bearer {publish}");
    assert_eq!(ask("GET", "", &[("authorization", &bearer)]).json()["may_publish"].as_bool(), Some(false));
    assert_eq!(ask("POST", "/token", &[("authorization", &bearer)]).status, 403);
    // a server without `--live-key` accepts no token
    let keyless = Running::open();
    let headers = [&foreign[..], &[("authorization", bearer.as_str())]].concat();
    assert_eq!(client::request(keyless.addr, "GET", "/v1/live/attic", &headers, &[]).status, 403);
}
