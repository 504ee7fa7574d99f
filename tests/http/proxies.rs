//! `--trusted-proxies`: the address of a client behind a proxy, and its user (`--login-header`).

use axum::http::HeaderName;
use tmpi::server::{Network, Proxies, Rates};

use crate::key_fixture;
use crate::prelude::*;

const fn only_requests(requests: u32) -> Rates {
    Rates { requests, uploads: 0, views: 0 }
}

#[test]
fn clients_behind_a_trusted_proxy_are_told_apart() {
    // a server that trusts a proxy at the test's own address to name the client
    let proxies = Proxies::new(&["127.0.0.1".parse::<Network>().unwrap()]);
    let limits = Limits { rates: only_requests(2), ..Limits::default() };
    let server = Running::configured(Arc::new(pipeline()), |config| Config { proxies, limits, ..config });
    let ask = |way: &str| request(server.addr, "GET", "/openapi.json", &[("x-forwarded-for", way)], &[]);
    let answers: Vec<_> = (0..3).map(|_| ask("198.51.100.1, 192.0.2.1")).collect();
    assert_eq!(answers.iter().map(|a| a.status).collect::<Vec<_>>(), [200, 200, 429]);
    assert!(answers[2].problem(429)["detail"].as_str().unwrap().contains("2 a minute"));
    // addresses that the client wrote itself, before the proxy's, do not count
    assert_eq!((ask("198.51.100.77, 192.0.2.1").status, ask("192.0.2.2").status), (429, 200));
}

#[test]
fn headers_of_untrusted_proxies_change_nothing() {
    let server = Running::with(Limits { rates: only_requests(1), ..Limits::default() }, Arc::new(pipeline()));
    for n in 0..3 {
        // requests from loopback are not counted, and the header does not change that
        let answer = request(server.addr, "GET", "/healthz", &[("x-forwarded-for", "192.0.2.1")], &[]);
        assert_eq!((answer.status, answer.header("ratelimit")), (200, None), "{n}");
    }
}

/// Proxies at an address that name users in `Remote-User`.
pub fn with_users(proxy: &str) -> Proxies {
    Proxies::new(&[proxy.parse::<Network>().unwrap()]).with_login(Some(HeaderName::from_static("remote-user")))
}

#[test]
fn users_of_a_trusted_proxy_own_their_photos() {
    let server = Running::configured(Arc::new(pipeline()), |config| Config { private: true, proxies: with_users("127.0.0.1"), ..config });
    let by = |headers: &[(&str, &str)], method: &str, path: &str| ask(&server, method, path, headers, &[]);
    let jane = ("remote-user", "jané");
    let stored = ask(&server, "POST", "/v1/photos", &[jane], &jpeg(1)).is(202);
    assert!(stored.json()["links"]["manage"].is_null(), "she needs no token of the photo");
    let photo = id(&stored.json());
    let at = format!("/v1/photos/{photo}");
    assert_eq!(ids(&by(&[jane], "GET", "/v1/photos")), [photo.as_str()]);
    for other in [&[("remote-user", "jan")][..], &[("remote-user", "")], &[]] {
        assert_eq!((by(other, "GET", &at).status, ids(&by(other, "GET", "/v1/photos")).len()), (404, 0), "{other:?}");
    }
    assert_eq!(by(&[jane, jane], "GET", &at).problem(400)["field"], "remote-user", "the client may have sent one of them");
    assert_eq!(by(&[jane], "GET", "/metrics").status, 403, "a user is no administrator, even on this machine");
    assert_eq!(request(server.addr, "GET", "/metrics", &[jane], &[]).status, 403);
    // the user counts before a cookie, and a bearer before the user
    let cookie = format!("tmpi_owner={}", &secret("b")["Bearer ".len()..]);
    let key = key_fixture::add(server.data(), "jan", &[Scope::Read]);
    assert_eq!((by(&[jane, ("cookie", &cookie)], "GET", &at).status, by(&[jane, ("authorization", &key)], "GET", &at).status), (200, 404));
    assert!(!by(&[jane], "GET", "/").all("set-cookie").contains("tmpi_owner"), "the proxy keeps the session");
    // pages of other sites act without the user, whose session the proxy keeps in a cookie
    for foreign in [("sec-fetch-site", "cross-site"), ("sec-fetch-site", "same-site"), ("origin", "https://evil.example")] {
        let [seen, changed] = ["GET", "DELETE"].map(|method| by(&[jane, foreign], method, &at).status);
        assert_eq!((seen, changed), (404, 403), "{foreign:?}");
    }
    assert_eq!(by(&[jane, ("sec-fetch-site", "same-origin")], "DELETE", &at).status, 204);
}

#[test]
fn others_cannot_claim_to_be_a_user() {
    let server = Running::configured(Arc::new(pipeline()), |config| Config { private: true, proxies: with_users("192.0.2.1"), ..config });
    let claim = [("remote-user", "jane"), ("x-forwarded-for", "192.0.2.1")];
    assert_eq!(ask(&server, "POST", "/v1/photos", &claim, &jpeg(1)).status, 202);
    assert_eq!(ids(&ask(&server, "GET", "/v1/photos", &claim, &[])).len(), 0, "it is the photo of a stranger");
    assert!(ask(&server, "GET", "/", &claim, &[]).all("set-cookie").contains("tmpi_owner"));
    let twice = [claim[0], claim[0]];
    assert_eq!(ask(&server, "GET", "/v1/photos", &twice, &[]).status, 200, "the server ignores it");
}
