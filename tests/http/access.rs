//! Permissions on a server with `--access private`.

use crate::key_fixture;
use crate::prelude::*;

/// A host name under which requests from loopback count as strangers, not as this machine's own user.
pub const HOST: (&str, &str) = ("host", "photos.example");

/// A server with `--access private`.
pub fn private() -> Running {
    private_with(Limits::default(), Arc::new(pipeline()))
}

/// The same with other limits and another maker.
pub fn private_with(limits: Limits, maker: Arc<dyn Maker>) -> Running {
    Running::configured(maker, |config| Config { private: true, limits, ..config })
}

pub fn secret(letter: &str) -> String {
    format!("Bearer tmpi_o_{}", letter.repeat(40))
}

pub fn ask(server: &Running, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Response {
    let mut all = vec![HOST];
    all.extend(headers);
    request(server.addr, method, path, &all, body)
}

/// Uploads with `who` as `Authorization`, if given; returns the state.
pub fn upload(server: &Running, who: Option<&str>, photo: u8) -> Value {
    let headers: Vec<_> = who.map(|who| ("authorization", who)).into_iter().chain([("prefer", "wait=60")]).collect();
    ask(server, "POST", "/v1/photos", &headers, &jpeg(photo)).any_of(&[201, 202]).json()
}

/// A response without the parts that differ from request to request.
pub fn plain(answer: &Response, id: &str) -> String {
    let headers = ["content-type", "cache-control", "vary", "etag", "access-control-allow-origin", "content-security-policy", "set-cookie"];
    let headers: Vec<_> = headers.iter().map(|name| answer.all(name)).collect();
    let mut body = String::from_utf8_lossy(&answer.body).into_owned();
    if let Ok(mut problem) = serde_json::from_str::<Value>(&body) {
        problem["request_id"] = Value::Null;
        body = problem.to_string();
    }
    format!("{} {headers:?} {body}", answer.status).replace(id, "ID")
}

#[test]
fn photos_are_private_to_their_owner() {
    let server = private();
    let (ann, bob) = (secret("a"), secret("b"));
    let (of_ann, of_bob) = (upload(&server, Some(&ann), 1), upload(&server, Some(&bob), 1));
    let (a, b) = (id(&of_ann), id(&of_bob));
    assert_ne!(a, b, "equal photos of two owners are two");
    assert_eq!(id(&upload(&server, Some(&ann), 1)), a, "the same upload of one is one");
    assert_eq!(of_ann["visibility"], "private");
    let list = |who: &str| ids(&ask(&server, "GET", "/v1/photos", &[("authorization", who)], &[]));
    assert_eq!((list(&ann), list(&bob)), (vec![a.clone()], vec![b.clone()]));
    assert_eq!(ids(&ask(&server, "GET", "/v1/photos", &[], &[])).len(), 0, "a stranger has none");
    let refused = ask(&server, "GET", &format!("/v1/photos?after={a}"), &[("authorization", &bob)], &[]);
    assert_eq!(refused.status, 400, "not even as a place in the list");
    // a parameter is not judged before the caller may see the photo; access_matrix.rs has every route
    let none = "0".repeat(32);
    let of = |id: &str| plain(&ask(&server, "GET", &format!("/v1/photos/{id}/atlas?level=9"), &[("authorization", &bob)], &[]), id);
    assert!(of(&a).starts_with("404") && of(&a) == of(&none), "{}", of(&a));
    // only the owner's own browser may cache a private photo
    let atlas = of_ann["links"]["atlas"].as_str().unwrap();
    let own = ask(&server, "GET", atlas, &[("authorization", &ann)], &[]);
    assert_eq!((own.status, own.header("cache-control")), (200, Some("private, no-cache")));
    assert!(own.all("vary").contains("authorization"));
    // with `visibility: link` everyone with the address sees it, and still only the owner may change it
    let change = |body: &[u8]| ask(&server, "PATCH", &format!("/v1/photos/{a}"), &[("authorization", &ann), JSON], body).status;
    assert_eq!(change(br#"{"visibility": "link"}"#), 200);
    assert_eq!(ask(&server, "GET", atlas, &[], &[]).header("cache-control"), Some("public, max-age=31536000, immutable"));
    assert_eq!(ask(&server, "DELETE", &format!("/v1/photos/{a}"), &[("authorization", &bob)], &[]).status, 404);
    assert_eq!(list(&bob), vec![b], "but no other owner's list shows it");
    assert_eq!((change(br#"{"visibility": null}"#), ask(&server, "GET", atlas, &[], &[]).status), (200, 404));
    // the same holds after a restart; this machine's own user sees everything
    let server = server.restarted();
    assert_eq!(ids(&get(server.addr, "/v1/photos")).len(), 2);
    assert_eq!(ask(&server, "GET", atlas, &[("authorization", &bob)], &[]).status, 404);
    assert_eq!(ask(&server, "GET", atlas, &[("authorization", &ann)], &[]).status, 200);
}

#[test]
fn an_upload_without_a_secret_is_answered_with_the_photos_token() {
    let server = private();
    let state = upload(&server, None, 1);
    let manage = state["links"]["manage"].as_str().unwrap();
    let token = manage.strip_prefix(&format!("/view/{}#manage=", id(&state))).unwrap();
    assert!(!state.to_string().contains("tmpi_o_"), "the photo's token, not an owner's secret");
    let secret = &secret("c")["Bearer ".len()..];
    let photo = id(&upload(&server, Some(&format!("Bearer {secret}")), 1));
    let address = format!("/v1/photos/{photo}");
    let of = |at: &str, bearer: &str| ask(&server, "GET", at, &[("authorization", &format!("Bearer {bearer}"))], &[]);
    let told = of(&format!("/v1/photos/{}", id(&state)), token);
    assert_eq!((told.status, of(&address, secret).status, ask(&server, "GET", &address, &[], &[]).status), (200, 200, 404));
    assert!(told.json()["links"]["manage"].is_null(), "told once");
    for wrong in [&secret[..secret.len() - 1], token, &token[..token.len() - 1], "tmpi_o_short", "tmpi_o_", "tmpi_k_0", "1000-ab", ""] {
        assert!(matches!(of(&address, wrong).status, 401 | 404), "{wrong}");
    }
    // a browser keeps the secret as a cookie; pages of other sites cannot use it
    let cookie = ask(&server, "POST", "/v1/owner", &[("authorization", &format!("Bearer {secret}"))], &[]).is(204);
    let cookie = cookie.header("set-cookie").unwrap().to_owned();
    assert!(cookie.contains("; HttpOnly; SameSite=Lax") && !cookie.contains("Secure"), "{cookie}");
    let pair = cookie.split(';').next().unwrap();
    let by_cookie = |headers: &[(&str, &str)]| ask(&server, "GET", &address, &[&[("cookie", pair)], headers].concat(), &[]).status;
    assert_eq!(by_cookie(&[("sec-fetch-site", "same-origin")]), 200);
    for site in ["cross-site", "same-site"] {
        assert_eq!(by_cookie(&[("sec-fetch-site", site)]), 404, "{site}");
    }
    assert_eq!((by_cookie(&[("origin", "https://evil.example")]), by_cookie(&[("origin", "http://photos.example")])), (404, 200));
    // the page gives a browser without a secret a new one
    let page = ask(&server, "GET", "/", &[("x-forwarded-proto", "https")], &[]);
    let set = page.header("set-cookie").unwrap().to_owned();
    // `__Host-`: browsers accept it over TLS only, from the host itself and for all its paths
    assert!(set.starts_with("__Host-tmpi_owner=tmpi_o_") && set.contains("; Path=/;"), "{set}");
    assert!(set.ends_with("; HttpOnly; SameSite=Lax; Secure") && !set.contains("Domain"), "{set}");
    let by_tls = |name: &str| {
        let pair = format!("{name}={secret}");
        ask(&server, "GET", &address, &[("cookie", &pair), ("x-forwarded-proto", "https")], &[]).status
    };
    assert_eq!((by_tls("__Host-tmpi_owner"), by_tls("tmpi_owner")), (200, 404), "another host of the domain may have set it");
    assert_eq!(page.header("cache-control"), Some("private, no-store"));
}

#[test]
fn links_last_no_longer_than_the_configured_limit() {
    let server = private_with(Limits { link: Duration::from_hours(1), ..Limits::default() }, Arc::new(pipeline()));
    let ann = secret("a");
    let one = id(&upload(&server, Some(&ann), 1));
    let links = |query: &str| ask(&server, "POST", &format!("/v1/photos/{one}/links{query}"), &[("authorization", &ann)], &[]);
    let refused = links("?seconds=3601").problem(400);
    assert!(refused["detail"].as_str().unwrap().contains("1 to 3600"), "{refused}");
    let now = seconds_now();
    for query in ["", "?seconds=3600"] {
        let expires = links(query).json()["expires"].as_u64().unwrap();
        assert!((now + 3600..now + 3660).contains(&expires), "{query}");
    }
    let document = get(server.addr, "/openapi.json").json();
    let parameters = document["paths"]["/v1/photos/{id}/links"]["post"]["parameters"].as_array().unwrap().clone();
    let seconds = parameters.iter().find(|p| p["name"] == "seconds").unwrap();
    assert_eq!(seconds["schema"]["maximum"], 3600);
    assert!(seconds["description"].as_str().unwrap().contains("1 to 3600"));
}

#[test]
fn links_are_valid_for_one_photo_until_they_expire() {
    let server = private();
    let ann = secret("a");
    let (one, two) = (id(&upload(&server, Some(&ann), 1)), id(&upload(&server, Some(&ann), 2)));
    let links = |query: &str| ask(&server, "POST", &format!("/v1/photos/{one}/links{query}"), &[("authorization", &ann)], &[]);
    for wrong in ["?seconds=0", "?seconds=31622401", "?seconds=soon", "?minutes=1"] {
        links(wrong).problem(400);
    }
    let link = links("?seconds=600").json();
    let query = link["query"].as_str().unwrap();
    assert!(!link.to_string().contains("tmpi_o_") && !link.to_string().contains(&"a".repeat(40)), "no owner's secret");
    let (expires, signature) = query.strip_prefix("expires=").unwrap().split_once("&signature=").unwrap();
    let of = |photo: &str, path: &str, query: &str| ask(&server, "GET", &format!("/v1/photos/{photo}{path}{query}"), &[], &[]);
    for path in ["?", "/atlas?", "/atlas?level=1&", "/view?w=8&", "/thumbnail?", "/settings?"] {
        assert_eq!(of(&one, path, query).status, 200, "{path}");
    }
    let turned = format!("signature={signature}&expires={expires}");
    let (a, b) = (of(&one, "/view?w=8&", query), of(&one, "/view?", &format!("{turned}&w=8")));
    assert_eq!((a.status, a.header("etag")), (200, b.header("etag")), "the link is not part of the cache key");
    assert_eq!(a.header("cache-control"), Some("private, no-cache"));
    assert!(b.header("server-timing").is_some_and(|t| !t.contains("render")), "drawn once: {:?}", b.header("server-timing"));
    let later = (expires.parse::<u64>().unwrap() + 1).to_string();
    let forged = format!("{}{}", &signature[..63], if signature.ends_with('0') { '1' } else { '0' });
    let none = plain(&of(&one, "?", ""), &one);
    assert!(none.starts_with("404"));
    for wrong in [
        format!("expires={later}&signature={signature}"),
        format!("expires=1&signature={signature}"),
        format!("expires={expires}&signature={forged}"),
        format!("expires={expires}&expires={expires}&signature={signature}"),
        format!("expires={expires}"),
        format!("signature={signature}"),
    ] {
        assert_eq!(plain(&of(&one, "?", &wrong), &one), none, "{wrong}");
    }
    // it expires
    let short = links("?seconds=1").json();
    let short = short["query"].as_str().unwrap();
    wait_until("the link has expired", || of(&one, "?", short).status == 404);
    assert_eq!(plain(&of(&one, "?", short), &one), none);
    // the page that a link opens sets a cookie for the photo's other addresses
    let page = ask(&server, "GET", link["page"].as_str().unwrap(), &[], &[]);
    let cookie = page.header("set-cookie").unwrap().to_owned();
    assert!(cookie.contains(&format!("; Path=/v1/photos/{one}; Max-Age=")), "{cookie}");
    let with =
        |photo: &str| ask(&server, "GET", &format!("/v1/photos/{photo}"), &[("cookie", cookie.split(';').next().unwrap())], &[]).status;
    assert_eq!((with(&one), with(&two)), (200, 404));
    assert!(ask(&server, "GET", &format!("/view/{two}?{query}"), &[], &[]).header("set-cookie").is_none());
}

#[test]
fn keys_list_the_photos_of_their_name_and_are_replaced_while_the_server_runs() {
    let server = private();
    let key = |name: &str, scopes: &[Scope]| key_fixture::add(server.data(), name, scopes);
    let (up, read, admin) = (key("site", &[Scope::Upload]), key("site", &[Scope::Read]), key("boss", &[Scope::Admin]));
    let photo = id(&upload(&server, Some(&up), 1));
    let by = |who: &str, path: &str| ask(&server, "GET", path, &[("authorization", who)], &[]);
    assert_eq!((ids(&by(&read, "/v1/photos")), ids(&by(&admin, "/v1/photos"))), (vec![photo.clone()], vec![photo.clone()]));
    // replace the key: the photos stay
    let (new, at) = (key("site", &[Scope::Upload, Scope::Read]), format!("/v1/photos/{photo}"));
    assert_eq!((by(&new, &at).status, by(&read, &at).status), (200, 200));
    for old in key_fixture::read(server.data()).iter().filter(|k| k.name == "site" && k.scopes.len() == 1) {
        assert_eq!(key_fixture::remove(server.data(), "site", Some(&old.id)), 1);
    }
    assert_eq!((by(&new, &at).status, by(&read, &at).status), (200, 401));
}

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

/// What the server logs while the tests of this program run.
static LOG: std::sync::Mutex<Vec<u8>> = std::sync::Mutex::new(Vec::new());

struct Log;

impl std::io::Write for Log {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        LOG.lock().unwrap().extend(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[test]
fn no_secret_is_logged() {
    tracing_subscriber::fmt().with_max_level(tracing_subscriber::filter::LevelFilter::DEBUG).with_writer(|| Log).try_init().unwrap();
    let server = private();
    let ann = secret("z");
    let photo = id(&upload(&server, Some(&ann), 1));
    let key = key_fixture::add(server.data(), "site", &[Scope::Read]);
    let manage = upload(&server, None, 2)["links"]["manage"].as_str().unwrap().to_owned();
    let link = ask(&server, "POST", &format!("/v1/photos/{photo}/links"), &[("authorization", &ann)], &[]).json();
    let query = link["query"].as_str().unwrap().to_owned();
    for who in [&ann, &key] {
        ask(&server, "GET", &format!("/v1/photos/{photo}?{query}"), &[("authorization", who)], &[]);
        ask(&server, "GET", &format!("/v1/photos/{photo}?wrong=1&{query}"), &[("authorization", who)], &[]);
        ask(&server, "GET", &format!("/v1/photos/{photo}"), &[("authorization", &format!("{who}x"))], &[]);
        ask(&server, "GET", "/", &[("cookie", &who.replace("Bearer ", "tmpi_owner="))], &[]);
    }
    let token = format!("Bearer {}", manage.split("#manage=").nth(1).unwrap());
    let managed = manage["/view/".len()..].split('#').next().unwrap();
    for method in ["GET", "PUT"] {
        ask(&server, method, &format!("/v1/photos/{managed}"), &[("authorization", &token)], &[]);
        ask(&server, method, &format!("/v1/photos/{managed}"), &[("cookie", &token.replace("Bearer ", "tmpi_manage="))], &[]);
    }
    let server = server.restarted();
    let mut kept: Vec<(String, String)> = ["library.db", "library.db-wal"]
        .map(|file| (file.to_owned(), String::from_utf8_lossy(&std::fs::read(server.data().join(file)).unwrap_or_default()).into_owned()))
        .into();
    let log = String::from_utf8_lossy(&LOG.lock().unwrap()).into_owned();
    assert!(log.contains(&photo) && log.contains("request"), "the log has something: {log}");
    kept.push(("the log".into(), log));
    let secrets = [
        &ann["Bearer tmpi_o_".len()..],
        &key["Bearer tmpi_k_".len()..],
        manage.split("tmpi_m_").nth(1).unwrap(),
        query.split("signature=").nth(1).unwrap(),
    ];
    for (place, text) in kept {
        for secret in secrets {
            assert!(!text.contains(secret), "{place} has {secret}");
        }
    }
}
