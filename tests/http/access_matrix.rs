//! Every route × every kind of caller × visibility of the photo, with `--access private`.

use tmpi::server::{Access, Route, routes};

use crate::access::plain;
use crate::key_fixture;
use crate::open_matrix::{MORE, NONE, address, send, target};
use crate::prelude::*;
use crate::proxies::with_users;
use crate::signed_links::link_to_all;

/// What a caller may do with the requested photo and with the server.
#[derive(Clone, Copy, PartialEq, Eq)]
enum May {
    /// Everything.
    Everything,
    /// Everything with the photo.
    Own,
    /// Upload, and change the photo without seeing it.
    Upload,
    /// See and change the photo.
    Manage,
    /// See the photo and list it.
    Read,
    /// See the photo.
    See,
    /// Nothing with the photo; read the counters.
    Metrics,
    /// Nothing with the photo; sign links to it.
    Sign,
    /// Nothing with the photo.
    Nothing,
}

impl May {
    fn see(self) -> bool {
        matches!(self, Self::Everything | Self::Own | Self::Manage | Self::Read | Self::See)
    }

    fn change(self) -> bool {
        matches!(self, Self::Everything | Self::Own | Self::Manage | Self::Upload)
    }
}

struct Caller {
    what: &'static str,
    headers: Vec<(&'static str, String)>,
    may: May,
    /// The requested photo.
    photo: String,
    /// Parameters of a link.
    link: Option<String>,
}

impl Caller {
    fn linked(self, link: &str) -> Self {
        Self { link: Some(link.to_owned()), ..self }
    }

    /// True if a header of this name has this in its value.
    fn sends(&self, name: &str, text: &str) -> bool {
        self.headers.iter().any(|(n, value)| *n == name && value.contains(text))
    }

    /// True for this machine's own user, who may enter rooms.
    fn here(&self) -> bool {
        self.headers.is_empty() && self.may == May::Everything
    }

    /// True for a page of another site.
    fn foreign(&self) -> bool {
        self.sends("sec-fetch-site", "cross-site")
    }

    /// True if the only credential is a photo's token.
    fn manager(&self) -> bool {
        self.sends("authorization", "tmpi_m_")
    }

    /// True if a header has an owner's secret.
    fn secret(&self) -> bool {
        self.sends("authorization", "tmpi_o_") || self.sends("cookie", "tmpi_o_")
    }

    /// True if it is known as an owner.
    fn is_owner(&self) -> bool {
        let by_bearer = ["tmpi_k_", "tmpi_o_"].iter().any(|prefix| self.sends("authorization", prefix));
        self.here() || by_bearer || (self.sends("cookie", "tmpi_o_") || self.sends("remote-user", "")) && !self.foreign()
    }

    fn asks_for(self, photo: &str) -> Self {
        Self { photo: photo.to_owned(), ..self }
    }

    fn ask(&self, server: &Running, route: &Route, method: &str, mut path: String) -> Response {
        // routes of rooms do not take a link's parameters
        if let Some(link) = self.link.as_ref().filter(|_| !route.path.starts_with("/v1/live/")) {
            path = format!("{path}{}{link}", if path.contains('?') { '&' } else { '?' });
        }
        let mut headers: Vec<(&str, &str)> = self.headers.iter().map(|(n, v)| (*n, v.as_str())).collect();
        if !self.here() && !headers.iter().any(|(name, _)| *name == "host") {
            headers.push(HOST);
        }
        send(server, route, method, &path, headers)
    }
}

fn expected(route: &Route, method: &str, caller: &Caller, shown: bool) -> (u16, Option<&'static str>) {
    let (path, may) = (route.path.as_str(), caller.may);
    let safe = matches!(method, "GET" | "HEAD" | "OPTIONS");
    let if_may = |may: bool, status| if may { (status, None) } else { (404, Some("not-found")) };
    let (here, foreign, manager) = (caller.here(), caller.foreign(), caller.manager());
    if caller.sends("host", "evil.example") {
        return (421, Some("host"));
    }
    match (method, path) {
        ("OPTIONS", _) if matches!(route.access, Access::Open | Access::Token) => (200, None),
        ("OPTIONS", _) => (204, None),
        ("PUT", _) => (405, Some("method")),
        (_, "/metrics") if may == May::Metrics => (200, None),
        (_, "/metrics" | "/v1/network") if may != May::Everything => (403, Some("not-yours")),
        // a photo's token is valid for that photo only
        (_, "/v1/photos") if manager => (403, Some("scope")),
        _ if path.starts_with("/v1/webhooks") && (manager || matches!(may, May::Read | May::Metrics | May::Sign)) => (403, Some("scope")),
        ("POST", "/v1/photos") if matches!(may, May::Read | May::Metrics | May::Sign) => (403, Some("scope")),
        ("GET" | "HEAD", "/v1/photos") if matches!(may, May::Upload | May::Metrics | May::Sign) => (403, Some("scope")),
        _ if foreign && !safe => (403, Some("cross-site")),
        _ if path.starts_with("/v1/webhooks") && !caller.is_owner() => (403, Some("no-owner")),
        ("POST", "/v1/webhooks") => (400, Some("parameter")),
        (_, "/v1/webhooks") => (200, None),
        _ if path.starts_with("/v1/webhooks/") => (404, Some("not-found")),
        (_, "/v1/live/{room}/publish") if foreign => (403, Some("cross-site")),
        _ if path.starts_with("/v1/live/") && (foreign || !here) => (403, Some("token")),
        (_, "/v1/live/{room}" | "/v1/live/{room}/token") => (200, None),
        (_, "/v1/live/{room}/publish" | "/v1/live/{room}/subscribe") => (426, Some("upgrade")),
        _ if path.starts_with("/v1/live/") => (404, Some("not-found")),
        ("POST", "/v1/owner/ticket") if caller.secret() => (200, None),
        ("POST", "/v1/owner/ticket") => (403, Some("no-owner")),
        ("POST", "/v1/owner") => (204, None),
        ("POST", "/v1/photos") => (202, None),
        ("GET" | "HEAD", "/v1/photos") => (200, None),
        // for an unknown photo
        ("DELETE", _)
        | ("POST", "/v1/photos/{id}/remake" | "/v1/photos/{id}/exports")
        // for an export that does not exist
        | ("GET" | "HEAD", "/v1/photos/{id}/exports/{key}" | "/v1/photos/{id}/exports/{key}/file") => (404, Some("not-found")),
        ("POST", "/v1/photos/{id}/manage") => if_may(may.change(), 204),
        ("PATCH", _) | ("POST", "/v1/photos/{id}/links") => if_may(may.change(), 200),
        ("GET" | "HEAD", _) if path.starts_with("/v1/photos/") || path == "/oembed" => if_may(shown || may.see(), 200),
        // pages answer 404 with HTML, not with a problem
        ("GET" | "HEAD", "/view/{id}" | "/embed/{id}") if !(shown || may.see()) => (404, None),
        _ => (200, None),
    }
}

/// What a photo's owner can give to others: the parameters of a link that is valid for `seconds`, and the photo's token.
fn link(server: &Running, owner: &str, photo: &str, seconds: u64) -> (String, String) {
    let path = format!("/v1/photos/{photo}/links?seconds={seconds}");
    let told = request(server.addr, "POST", &path, &[HOST, ("authorization", owner)], &[]).json();
    let token = told["manage"].as_str().unwrap().split_once("#manage=").unwrap().1.to_owned();
    (told["query"].as_str().unwrap().to_owned(), token)
}

/// A wrong method is answered with the allowed ones, and another owner's private photo with the same bytes as an unknown one.
fn refuses_well(server: &Running, route: &Route, method: &str, caller: &Caller) {
    let [answer, unknown] = [caller.photo.as_str(), NONE].map(|photo| caller.ask(server, route, method, address(route, photo)));
    if answer.status == 405 {
        let allowed = answer.all("allow");
        assert!(route.methods.iter().all(|m| allowed.split(',').any(|a| a.trim() == m)), "{method} {}: {allowed}", route.path);
    }
    if route.path.contains("{id}") || route.path == "/oembed" {
        assert_eq!(plain(&answer, &caller.photo), plain(&unknown, NONE), "{method} {}", route.path);
    }
}

#[test]
fn every_route_of_a_private_server_answers_every_caller_as_it_should() {
    let server = Running::configured(Arc::new(pipeline()), |config| Config { private: true, proxies: with_users("127.0.0.1"), ..config });
    let ann = secret("a");
    let key = |name: &str, scopes: &[Scope]| key_fixture::add(server.data(), name, scopes);
    let site = key("site", &[Scope::Upload, Scope::Read]);
    let (of_ann, of_site) = (id(&upload(&server, Some(&ann), 1)), id(&upload(&server, Some(&site), 1)));
    let jane = ("remote-user", "jane".to_owned());
    let of_jane = id(&ask(&server, "POST", "/v1/photos", &[(jane.0, &jane.1), ("prefer", "wait=60")], &jpeg(1)).json());
    let (taken_link, taken_back) = link(&server, &ann, &of_ann, 600);
    request(server.addr, "DELETE", &format!("/v1/photos/{of_ann}/manage"), &[HOST, ("authorization", &ann)], &[]).is(204);
    let [(good, token), (over, _), (other, others_token)] =
        [(&ann, &of_ann, 600), (&ann, &of_ann, 1), (&site, &of_site, 600)].map(|(o, p, s)| link(&server, o, p, s));
    let bearer = |text: String| ("authorization", text);
    let cookie = ("cookie", format!("tmpi_owner={}", &ann["Bearer ".len()..]));
    let kept = ("cookie", format!("tmpi_manage={token}"));
    let evil = [("origin", "https://evil.example".to_owned()), ("sec-fetch-site", "cross-site".to_owned())];
    let caller = |what, headers: Vec<(&'static str, String)>, may| Caller { what, headers, may, photo: of_ann.clone(), link: None };
    let foreign = |what, headers: Vec<_>, may| caller(what, [evil.to_vec(), headers].concat(), may);
    let rebound = |what, headers: Vec<_>| caller(what, [vec![("host", "evil.example".to_owned())], headers].concat(), May::Nothing);
    let with_key = |what, scope, may| caller(what, vec![bearer(key("site", &[scope]))], may).asks_for(&of_site);
    let callers = [
        caller("a stranger", vec![], May::Nothing),
        caller("a stranger with a link", vec![], May::See).linked(&good),
        caller("a stranger with an expired link", vec![], May::Nothing).linked(&over),
        caller("a stranger with another photo's link", vec![], May::Nothing).linked(&other),
        caller("a stranger with a revoked link", vec![], May::Nothing).linked(&taken_link),
        caller("a stranger with a link that the owner's key signed", vec![], May::See)
            .linked(&link_to_all(&key("site", &[Scope::Sign]), &of_site, 600))
            .asks_for(&of_site),
        caller("a stranger with a link that another's key signed", vec![], May::Nothing)
            .linked(&link_to_all(&key("other", &[Scope::Sign]), &of_site, 600))
            .asks_for(&of_site),
        caller("a caller with the photo's token", vec![bearer(format!("Bearer {token}"))], May::Manage),
        caller("a caller with another photo's token", vec![bearer(format!("Bearer {others_token}"))], May::Nothing),
        caller("a caller with a revoked token", vec![bearer(format!("Bearer {taken_back}"))], May::Nothing),
        caller("a browser with the photo's token", vec![kept.clone(), ("sec-fetch-site", "same-origin".into())], May::Manage),
        caller("another owner", vec![bearer(secret("b"))], May::Nothing),
        caller("another's key", vec![bearer(key("other", &[Scope::Upload, Scope::Read]))], May::Nothing),
        caller("the owner", vec![bearer(ann.clone())], May::Own),
        caller("the owner's browser", vec![cookie.clone(), ("sec-fetch-site", "same-origin".into())], May::Own),
        caller("the owner's key", vec![bearer(site.clone())], May::Own).asks_for(&of_site),
        with_key("the owner's key to upload", Scope::Upload, May::Upload),
        with_key("the owner's key to read", Scope::Read, May::Read),
        with_key("the owner's key to sign", Scope::Sign, May::Sign),
        with_key("the owner's key to metrics", Scope::Metrics, May::Metrics),
        caller("the user whom the proxy names", vec![jane.clone()], May::Own).asks_for(&of_jane),
        caller("another user", vec![("remote-user", "bob".to_owned())], May::Nothing).asks_for(&of_jane),
        caller("an admin's key", vec![bearer(key("boss", &[Scope::Admin]))], May::Everything),
        caller("this machine's own user", vec![], May::Everything),
        foreign("another site", vec![], May::Nothing),
        foreign("another site, the owner's browser", vec![cookie.clone()], May::Nothing),
        foreign("another site, the user's browser", vec![jane.clone()], May::Nothing).asks_for(&of_jane),
        foreign("another site, own machine's browser", vec![("host", server.addr.to_string())], May::Nothing),
        foreign("another site, a browser with the photo's token", vec![kept], May::Nothing),
        foreign("another site that has the photo's token", vec![bearer(format!("Bearer {token}"))], May::Manage),
        foreign("another site that has the secret", vec![bearer(ann.clone())], May::Own),
        rebound("a rebound name", vec![]),
        rebound("a rebound name, the owner's browser", vec![cookie]),
        rebound("a rebound name, the user's browser", vec![jane.clone()]),
    ];
    let expiring = format!("/v1/photos/{of_ann}?{over}");
    wait_until("the link of one second has expired", || request(server.addr, "GET", &expiring, &[HOST], &[]).status == 404);
    for visibility in ["private", "link"] {
        let shown = visibility == "link";
        for (who, photo) in [(("authorization", &ann), &of_ann), (("authorization", &site), &of_site), ((jane.0, &jane.1), &of_jane)] {
            let headers = [HOST, (who.0, who.1.as_str()), JSON];
            let body = format!("{{\"visibility\": {visibility:?}}}");
            assert_eq!(request(server.addr, "PATCH", &format!("/v1/photos/{photo}"), &headers, body.as_bytes()).status, 200);
        }
        for route in &routes() {
            let own = route.methods.iter().flat_map(|m| if m == "GET" { vec!["GET", "HEAD"] } else { vec![m.as_str()] });
            for method in own.chain(MORE) {
                for caller in &callers {
                    let answer = caller.ask(&server, route, method, target(route, method, &caller.photo));
                    let (status, problem) = expected(route, method, caller, shown);
                    let what = format!("{visibility}, {}: {method} {}", caller.what, route.path);
                    assert_eq!(answer.status, status, "{what}: {}", String::from_utf8_lossy(&answer.body));
                    if let Some(kind) = problem.filter(|_| method != "HEAD") {
                        assert_eq!(answer.problem(status)["type"], format!("urn:tmpi:problem:{kind}"), "{what}");
                    }
                    if !shown && caller.what == "another owner" {
                        refuses_well(&server, route, method, caller);
                    }
                    let text = String::from_utf8_lossy(&answer.body);
                    let blind = !shown && !caller.may.see() && !caller.may.change();
                    assert!(!blind || !text.contains("\"links\":{\"self\"") || method == "POST", "{what}: {text}");
                    assert!(shown || !answer.all("cache-control").contains("public"), "{what}");
                }
            }
        }
    }
}
