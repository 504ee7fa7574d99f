//! Every route × method × kind of caller (Origin, Sec-Fetch-Site, Host) on an open server.

use tmpi::server::{Access, Route, routes};

use crate::origins::start;
use crate::prelude::*;

/// A kind of caller, by its headers.
struct Caller {
    what: &'static str,
    host: Option<&'static str>,
    headers: Vec<(&'static str, String)>,
    /// Status of a request that changes something.
    changes: u16,
    /// Status of a request for the list.
    lists: u16,
}

fn callers(server: &Running) -> Vec<Caller> {
    let own = format!("http://{}", server.addr);
    let site = |site: &str| ("sec-fetch-site", site.to_owned());
    let origin = |origin: &str| ("origin", origin.to_owned());
    let caller = |what, host, headers, changes, lists| Caller { what, host, headers, changes, lists };
    vec![
        caller("curl", None, vec![], 200, 200),
        caller("curl under a loopback name", Some("localhost"), vec![], 200, 200),
        caller("our page", None, vec![site("same-origin"), origin(&own)], 200, 200),
        caller("our page, old browser", None, vec![origin(&own)], 200, 200),
        caller("the address bar", None, vec![site("none")], 200, 200),
        caller("another site", None, vec![site("cross-site"), origin("https://evil.example")], 403, 200),
        caller("another site, no Origin", None, vec![site("cross-site")], 403, 200),
        caller("another site, old browser or no TLS", None, vec![origin("https://evil.example")], 403, 200),
        caller("another port of localhost", None, vec![site("same-site"), origin("http://localhost:3000")], 403, 200),
        caller("another port, old browser", None, vec![origin("http://127.0.0.1:1")], 403, 200),
        caller("a sandboxed frame", None, vec![origin("null")], 403, 200),
        caller("a rebound name", Some("evil.example"), vec![site("same-origin"), origin("http://evil.example")], 421, 421),
        caller("a rebound name, old browser", Some("evil.example:8080"), vec![origin("http://evil.example:8080")], 421, 421),
        caller("an address that is not ours", Some("192.0.2.1"), vec![], 421, 421),
        caller("a configured name, by a proxy", Some("photos.example"), vec![("x-forwarded-for", "192.0.2.1".into())], 200, 403),
        caller("a configured name", Some("photos.example"), vec![origin("http://photos.example")], 200, 403),
        caller("another site by a proxy", Some("photos.example"), vec![origin("http://evil.example")], 403, 403),
        caller("a proxy that hides the name", None, vec![("x-forwarded-for", "192.0.2.1".into())], 200, 403),
    ]
}

/// Methods to try on each route besides its own: preflights, and a method that no route has.
pub const MORE: [&str; 2] = ["OPTIONS", "PUT"];
/// An unknown photo.
pub const NONE: &str = "00000000000000000000000000000000";

/// A path and query for a route that changes no photo for others: of no photo, if it deletes or makes it again.
pub fn target(route: &Route, method: &str, id: &str) -> String {
    let harms = method == "DELETE" || route.path.ends_with("/remake") || route.path.ends_with("/exports");
    address(route, if harms { NONE } else { id })
}

/// A path and query for a route of a photo.
pub fn address(route: &Route, id: &str) -> String {
    let query = match route.path.as_str() {
        "/v1/photos/{id}/view" => "?w=8",
        "/v1/photos/{id}/export" => "?format=glb",
        "/oembed" => &format!("?url=http://localhost/view/{id}"),
        _ => "",
    };
    let path = route
        .path
        .replace("{id}", id)
        .replace("{key}", &NONE[..16])
        .replace("{*name}", "view/viewer.js")
        .replace("{room}", "attic")
        .replace("{group}", "1-0")
        + query;
    assert!(!path.contains('{'), "a new route: add a target for {}", route.path);
    path
}

/// The expected status and kind of problem.
fn expected(route: &Route, method: &str, caller: &Caller) -> (u16, Option<&'static str>) {
    let safe = matches!(method, "GET" | "HEAD" | "OPTIONS");
    match method {
        _ if caller.changes == 421 => (421, Some("host")),
        _ if !safe && caller.changes == 403 => (403, Some("cross-site")),
        "OPTIONS" if matches!(route.access, Access::Open | Access::Token) => (200, None),
        "OPTIONS" => (204, None),
        "PUT" => (405, Some("method")),
        "POST" if route.path == "/v1/live/{room}/token" && caller.lists == 403 => (403, Some("token")),
        "POST" if route.path == "/v1/live/{room}/token" => (200, None),
        // browsers let pages of other sites open sockets, so these need a token even to watch
        "GET" | "HEAD" if route.path.starts_with("/v1/live/") => match (caller.changes, caller.lists) {
            (403, _) if route.path.ends_with("/publish") => (403, Some("cross-site")),
            (403, _) | (_, 403) => (403, Some("token")),
            _ if route.path == "/v1/live/{room}" => (200, None),
            _ if route.path.ends_with("/publish") || route.path.ends_with("/subscribe") => (426, Some("upgrade")),
            _ => (404, Some("not-found")),
        },
        _ if route.path.starts_with("/v1/webhooks") && caller.lists == 403 => (403, Some("not-yours")),
        "POST" if route.path == "/v1/webhooks" => (400, Some("parameter")),
        _ if route.path.starts_with("/v1/webhooks/") => (404, Some("not-found")),
        "GET" | "HEAD" if route.path == "/v1/photos" && caller.lists == 403 => (403, Some("list-closed")),
        "GET" | "HEAD" | "POST" if route.path == "/v1/network" && caller.lists == 403 => (403, Some("not-yours")),
        "POST" if route.path == "/v1/network" => (200, None),
        "POST" if route.path.ends_with("/remake") || route.path.ends_with("/exports") => (404, Some("not-found")),
        "GET" | "HEAD" if route.path.starts_with("/v1/photos/{id}/exports/{key}") => (404, Some("not-found")),
        "GET" | "HEAD" | "PATCH" => (200, None),
        "POST" if route.path.ends_with("/links") => (200, None),
        "POST" if route.path == "/v1/owner/ticket" => (403, Some("no-owner")),
        "POST" if route.path == "/v1/owner" || route.path.ends_with("/manage") => (204, None),
        "POST" => (202, None),
        "DELETE" => (404, Some("not-found")),
        other => panic!("a new method: add the answer to {other} {}", route.path),
    }
}

/// Sends what a route takes.
pub fn send(server: &Running, route: &Route, method: &str, path: &str, mut headers: Vec<(&str, &str)>) -> Response {
    let takes_json = method == "PATCH" || method == "POST" && route.path == "/v1/webhooks";
    let body = match method {
        "POST" if route.path == "/v1/photos" => jpeg(1),
        _ if takes_json => b"{}".to_vec(),
        _ => Vec::new(),
    };
    if takes_json {
        headers.push(JSON);
    }
    if method == "OPTIONS" {
        headers.push(("access-control-request-method", "GET"));
    }
    request(server.addr, method, path, &headers, &body)
}

#[test]
fn every_route_answers_every_caller_as_it_should() {
    let (server, id) = start();
    let all = routes();
    assert!(all.iter().any(|r| r.access == Access::Open) && all.iter().any(|r| r.access == Access::Own), "{all:?}");
    let callers = callers(&server);
    for route in &all {
        let own = route.methods.iter().flat_map(|m| if m == "GET" { vec!["GET", "HEAD"] } else { vec![m.as_str()] });
        for method in own.chain(MORE) {
            let path = target(route, method, &id);
            for caller in &callers {
                let what = format!("{}: {method} {path}", caller.what);
                let own = caller.headers.iter().map(|(n, v)| (*n, v.as_str()));
                let answer = send(&server, route, method, &path, own.chain(caller.host.map(|host| ("host", host))).collect());
                let (status, problem) = expected(route, method, caller);
                assert_eq!(answer.status, status, "{what}: {}", String::from_utf8_lossy(&answer.body));
                if let Some(kind) = problem.filter(|_| method != "HEAD") {
                    assert_eq!(answer.problem(status)["type"], format!("urn:tmpi:problem:{kind}"), "{what}");
                }
                // pages under a rebound name may not read the refusal either; cross-site requests are refused before the route is known
                let read = matches!(route.access, Access::Open | Access::Token) && !matches!(problem, Some("host" | "cross-site"));
                assert_eq!(answer.header("access-control-allow-origin"), read.then_some("*"), "{what}");
                let taken = matches!(route.access, Access::Open | Access::Framed) && status == 200 && method != "OPTIONS";
                let policy = if taken { "cross-origin" } else { "same-origin" };
                // no caller here has a token of a room
                if taken || matches!(route.access, Access::Own | Access::Token) {
                    assert_eq!(answer.header("cross-origin-resource-policy"), Some(policy), "{what}");
                }
                if method == "OPTIONS" && status == 200 {
                    assert_eq!(answer.all("access-control-allow-methods"), "GET,HEAD", "{what}");
                }
            }
        }
    }
    assert_eq!(server.state(&id)["state"], "done", "nothing was changed");
}
