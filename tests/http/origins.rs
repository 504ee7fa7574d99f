//! Which sites may do what: Origin × Sec-Fetch-Site × Host × method × route.

use std::sync::Arc;

use tmpi::server::Limits;

use crate::client::{Connection, Response, get, request};
use crate::fixture::{Running, jpeg, pipeline};

fn start() -> (tempfile::TempDir, Running, String) {
    let dir = tempfile::tempdir().unwrap();
    let server = Running::start(dir.path(), Limits::default(), Arc::new(pipeline()));
    let id = server.upload(&jpeg(1));
    server.wait(&id, "done");
    (dir, server, id)
}

/// Who a request comes from, by the headers that tell.
struct Caller {
    what: &'static str,
    host: Option<&'static str>,
    headers: Vec<(&'static str, String)>,
    /// May change things.
    changes: u16,
    /// May read the list.
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
        caller("a name that was given, by a proxy", Some("photos.example"), vec![("x-forwarded-for", "192.0.2.1".into())], 200, 403),
        caller("a name that was given", Some("photos.example"), vec![origin("http://photos.example")], 200, 403),
        caller("another site by a proxy", Some("photos.example"), vec![origin("http://evil.example")], 403, 403),
        caller("a proxy that hides the name", None, vec![("x-forwarded-for", "192.0.2.1".into())], 200, 403),
    ]
}

fn call(server: &Running, caller: &Caller, method: &str, path: &str, more: &[(&str, &str)], body: &[u8]) -> Response {
    let mut headers: Vec<(&str, &str)> = caller.headers.iter().map(|(n, v)| (*n, v.as_str())).collect();
    headers.extend(caller.host.map(|host| ("host", host)));
    headers.extend(more);
    request(server.addr, method, path, &headers, body)
}

/// Routes that any site may read, and those that only our own pages may.
const OPEN: [&str; 8] =
    ["atlas", "atlas?level=1", "view?w=8", "thumbnail", "report", "settings", "export?format=glb", "atlas?sections=photo"];
const OWN: [&str; 6] = ["/v1/photos", "/v1/photos/ID", "/v1/photos/ID/depth", "/metrics", "/readyz", "/openapi.json"];

#[test]
fn who_may_change_what() {
    let (_dir, server, id) = start();
    let photo = format!("/v1/photos/{id}");
    for caller in callers(&server) {
        let what = caller.what;
        let allowed = caller.changes == 200;
        let upload = call(&server, &caller, "POST", "/v1/photos", &[], &jpeg(1));
        assert_eq!(upload.status, if allowed { 202 } else { caller.changes }, "{what}: POST");
        let patch = call(&server, &caller, "PATCH", &photo, &[("content-type", "application/json")], b"{}");
        assert_eq!(patch.status, if allowed { 200 } else { caller.changes }, "{what}: PATCH");
        let delete = call(&server, &caller, "DELETE", "/v1/photos/00000000000000000000000000000000", &[], &[]);
        assert_eq!(delete.status, if allowed { 404 } else { caller.changes }, "{what}: DELETE");
        if !allowed {
            let kind = if caller.changes == 403 { "urn:tmpi:problem:cross-site" } else { "urn:tmpi:problem:host" };
            assert_eq!(upload.problem(caller.changes)["type"], kind, "{what}");
        }
        assert_eq!(server.state(&id)["state"], "done", "{what}");
    }
}

#[test]
fn who_may_read_what() {
    let (_dir, server, id) = start();
    for caller in callers(&server) {
        let what = caller.what;
        let list = call(&server, &caller, "GET", "/v1/photos", &[], &[]);
        assert_eq!(list.status, caller.lists, "{what}");
        if caller.lists == 403 {
            assert_eq!(list.problem(403)["type"], "urn:tmpi:problem:list-closed");
        }
        let ours = caller.lists != 421;
        for path in OPEN
            .map(|part| format!("/v1/photos/{id}/{part}"))
            .iter()
            .map(String::as_str)
            .chain(["/tmpi-viewer.js", "/static/view/viewer.js"])
        {
            for method in ["GET", "HEAD"] {
                let answer = call(&server, &caller, method, path, &[], &[]);
                assert_eq!(answer.status, if ours { 200 } else { 421 }, "{what}: {method} {path}");
                // a rebound name is an origin of its own: it may not even read the refusal
                assert_eq!(answer.header("access-control-allow-origin"), ours.then_some("*"), "{what}: {method} {path}");
                if ours {
                    assert_eq!(answer.header("cross-origin-resource-policy"), Some("cross-origin"), "{what}: {path}");
                }
            }
        }
        for path in OWN.map(|path| path.replace("ID", &id)) {
            let answer = call(&server, &caller, "GET", &path, &[], &[]);
            assert_eq!(answer.header("access-control-allow-origin"), None, "{what}: {path}");
            assert_eq!(answer.header("cross-origin-resource-policy"), Some("same-origin"), "{what}: {path}");
        }
    }
}

#[test]
fn preflights_are_answered_only_where_other_sites_may_read() {
    let (_dir, server, id) = start();
    let preflight = |path: &str, method: &str| {
        let headers = [("origin", "https://evil.example"), ("access-control-request-method", method)];
        request(server.addr, "OPTIONS", path, &headers, &[])
    };
    let open = preflight(&format!("/v1/photos/{id}/atlas"), "GET");
    assert_eq!((open.status, open.header("access-control-allow-origin")), (200, Some("*")));
    assert!(open.header("x-request-id").is_some());
    for (path, method) in [("/v1/photos".to_owned(), "POST"), (format!("/v1/photos/{id}"), "DELETE"), (format!("/v1/photos/{id}"), "PATCH")]
    {
        let closed = preflight(&path, method);
        closed.problem(405);
        assert_eq!(closed.header("access-control-allow-origin"), None);
    }
    preflight("/nothing", "GET").problem(404);
    let methods = preflight(&format!("/v1/photos/{id}/view"), "DELETE").header("access-control-allow-methods").unwrap().to_owned();
    assert!(!methods.contains("DELETE"), "{methods}");
}

#[test]
fn a_request_has_one_host() {
    let (_dir, server, _) = start();
    for headers in ["", "host: localhost\r\nhost: localhost\r\n", "host: a b\r\n"] {
        let mut connection = Connection::open(server.addr);
        std::io::Write::write_all(connection.raw(), format!("GET /healthz HTTP/1.1\r\n{headers}\r\n").as_bytes()).unwrap();
        assert_eq!(connection.receive("GET").unwrap().status, 400, "{headers:?}");
    }
    // a target with a host of its own is meant for that
    let mut connection = Connection::open(server.addr);
    let target = b"GET http://evil.example/healthz HTTP/1.1\r\nhost: localhost\r\n\r\n";
    std::io::Write::write_all(connection.raw(), target).unwrap();
    assert_eq!(connection.receive("GET").unwrap().status, 421);
}

#[test]
fn frames_of_other_sites_show_the_photo_alone() {
    let (_dir, server, id) = start();
    let ancestors = |path: &str| {
        let policy = get(server.addr, path).header("content-security-policy").unwrap().to_owned();
        policy.split("frame-ancestors ").nth(1).unwrap().split(';').next().unwrap().trim().to_owned()
    };
    for own in ["/".to_owned(), format!("/view/{id}"), "/demo".to_owned()] {
        assert_eq!(ancestors(&own), "'self'", "{own}");
    }
    assert_eq!(ancestors("/healthz"), "'none'");
    let embed = format!("/embed/{id}");
    assert_eq!(ancestors(&embed), "*");
    assert_eq!(server.state(&id)["links"]["embed"], embed);
    // it has nothing that changes anything: no form, no button, and no script that knows how
    let page = String::from_utf8(get(server.addr, &embed).body).unwrap();
    let script = String::from_utf8(get(server.addr, "/static/app/embed-page.js").body).unwrap();
    for word in ["<form", "<button", "<input", "PATCH", "DELETE", "POST", "api.js"] {
        assert!(!page.contains(word) && !script.contains(word), "{word}");
    }
}
