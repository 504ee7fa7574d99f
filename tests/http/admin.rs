//! The admin listener, and caches that are emptied when idle.

use crate::prelude::*;

/// A server with `--access private`, and the address of its admin listener.
fn start() -> (Running, SocketAddr) {
    let (tell, told) = std::sync::mpsc::channel();
    let server = Running::owning(|data| {
        let config = Config { admin: Some(([127, 0, 0, 1], 0).into()), private: true, ..usual(data) };
        Running::launch(config, Arc::new(pipeline()), drawn_by_cpu(), move |server| {
            tell.send(server.admin_addr().unwrap()).unwrap();
            server
        })
    });
    (server, told.recv().unwrap())
}

#[test]
fn admin_routes_are_on_their_own_listener() {
    let (server, admin) = start();
    let id = server.make(&jpeg(1));
    get(server.addr, "/metrics").problem(404);
    for path in ["/drain", &format!("/purge/{id}")] {
        assert!(matches!(request(server.addr, "POST", path, &[], &[]).status, 404 | 405), "{path} is on the admin listener only");
    }
    assert_eq!((get(admin, "/healthz").status, get(admin, "/readyz").status), (200, 200));
    assert_eq!(figure(admin, "tmpi_photos_done"), 1);
    let described = get(admin, "/openapi.json").json();
    let paths: Vec<_> = described["paths"].as_object().unwrap().keys().cloned().collect();
    assert_eq!(paths, ["/drain", "/healthz", "/metrics", "/purge/{id}", "/readyz"]);
    // nothing else is there
    for path in ["/", "/v1/photos", &format!("/v1/photos/{id}/atlas")] {
        get(admin, path).problem(404);
    }
    get(admin, "/drain").problem(405);
    // pages of other sites and rebound names change nothing
    let at = format!("/purge/{id}");
    for path in ["/drain", &at] {
        request(admin, "POST", path, &[("origin", "https://evil.example")], &[]).problem(403);
        request(admin, "POST", path, &[("host", "evil.example")], &[]).problem(421);
        request(admin, "POST", &format!("{path}?now=1"), &[], &[]).problem(400);
    }
    assert_eq!(server.state(&id)["state"], "done");
    for wrong in ["/purge/nothing", "/purge/00000000000000000000000000000000"] {
        request(admin, "POST", wrong, &[], &[]).problem(404);
    }
    // `purge` works for photos of any owner
    assert_eq!(request(admin, "POST", &at, &[("host", "photos.example")], &[]).status, 204);
    get(server.addr, &format!("/v1/photos/{id}")).problem(404);
    get(server.addr, &format!("/v1/photos/{id}/atlas")).problem(404);
    request(admin, "POST", &at, &[], &[]).problem(404);
    assert_eq!(request(admin, "POST", "/drain", &[], &[]).status, 202);
    server.ended();
}

#[test]
fn idle_caches_are_emptied() {
    let limits = Limits { idle: Duration::from_millis(500), ..Limits::default() };
    let server = Running::with(limits, Arc::new(pipeline()));
    let id = server.make(&jpeg(1));
    let path = |what: &str| format!("/v1/photos/{id}/{what}");
    let kept = || ["scene", "file", "view", "level"].map(|of| server.metric(&format!("tmpi_{of}_cache_bytes")));
    let ask = || ["view?w=32", "atlas", "atlas?level=1"].map(|what| get(server.addr, &path(what)).is(200).body);
    let (mut before, mut asked) = (None, false);
    wait_until("all caches are filled", || {
        let now = ask();
        assert_eq!(before.get_or_insert_with(|| now.clone()), &now);
        asked |= kept().iter().all(|bytes| *bytes > 0);
        asked
    });
    wait_until("all caches are empty", || kept() == [0; 4]);
    assert_eq!(before, Some(ask()), "made anew");
}
