//! Cross-origin requests: hosts and frames. `open_matrix.rs` has preflights, and every route.

use crate::prelude::*;

/// A server with a finished photo.
pub fn start() -> (Running, String) {
    let server = Running::open();
    let id = server.make(&jpeg(1));
    (server, id)
}

#[test]
fn a_request_has_one_host() {
    let (server, _) = start();
    for headers in ["", "host: localhost\r\nhost: localhost\r\n", "host: a b\r\n"] {
        let answer = send_raw(server.addr, format!("GET /healthz HTTP/1.1\r\n{headers}\r\n").as_bytes());
        assert_eq!(answer.status, 400, "{headers:?}");
    }
    // the host of an absolute target counts, not `Host`
    send_raw(server.addr, b"GET http://evil.example/healthz HTTP/1.1\r\nhost: localhost\r\n\r\n").is(421);
}

#[test]
fn frames_of_other_sites_show_only_the_photo() {
    let (server, id) = start();
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
    // the page contains no form, no button and no script that changes anything
    let page = get(server.addr, &embed).text();
    let script = get(server.addr, "/static/app/embed-page.js").text();
    for word in ["<form", "<button", "<input", "PATCH", "DELETE", "POST", "api.js"] {
        assert!(!page.contains(word) && !script.contains(word), "{word}");
    }
}
