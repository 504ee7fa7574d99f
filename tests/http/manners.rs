//! HTTP semantics with `--access private`.

use crate::prelude::*;

#[test]
fn an_unknown_key_is_answered_with_www_authenticate() {
    let server = private();
    for path in ["/v1/photos", "/healthz"] {
        let answer = ask(&server, "GET", path, &[("authorization", "Bearer tmpi_k_none")], &[]);
        assert_eq!((answer.status, answer.header("www-authenticate")), (401, Some("Bearer error=\"invalid_token\"")), "{path}");
    }
}

#[test]
fn if_match_protects_a_changed_photo_from_deletion_and_again_answers_a_location() {
    let server = private();
    let ann = secret("a");
    let at = format!("/v1/photos/{}", id(&upload(&server, Some(&ann), 1)));
    let own = |method: &str, path: &str, more: &[(&str, &str)], body: &[u8]| {
        ask(&server, method, path, &[&[("authorization", ann.as_str())], more].concat(), body)
    };
    let again = own("POST", &format!("{at}/remake"), &[("prefer", "wait=60")], &[]);
    assert_eq!((again.status, again.header("location")), (200, Some(at.as_str())));
    let seen = own("GET", &at, &[], &[]).header("etag").unwrap().to_owned();
    assert_eq!(own("PATCH", &at, &[JSON], br#"{"title": "The attic"}"#).status, 200);
    assert_eq!(own("DELETE", &at, &[("if-match", &seen)], &[]).problem(412)["field"], "If-Match");
    let now = own("GET", &at, &[], &[]).header("etag").unwrap().to_owned();
    assert_eq!(own("DELETE", &at, &[("if-match", &now)], &[]).status, 204);
    assert_eq!(own("GET", &at, &[], &[]).status, 404);
}

#[test]
fn pages_are_only_at_their_own_addresses() {
    let server = private();
    for name in ["upload-page.html", "view-page.html", "embed-page.html", "VIEW-PAGE.HTML"] {
        assert_eq!(ask(&server, "GET", &format!("/static/app/{name}"), &[], &[]).status, 404, "{name}");
    }
    let page = ask(&server, "GET", "/", &[], &[]);
    assert!(page.status == 200 && page.header("content-security-policy").unwrap().contains("frame-ancestors 'self'"));
    assert_eq!(ask(&server, "GET", "/tmpi-viewer.js", &[], &[]).status, 200);
}
