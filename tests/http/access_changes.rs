//! Open event streams and known tags after keys, links and settings have changed.

use crate::events::Events;
use crate::key_fixture;
use crate::prelude::*;

/// A stream ends within this time after its credential: the pause between two checks, and some for a busy machine.
const SOON: Duration = Duration::from_secs(20);

/// True if a stream ends before its photo is done.
fn ends(mut events: Events) -> bool {
    let start = Instant::now();
    let mut last = String::new();
    while let Some((name, _)) = events.next() {
        last = name;
    }
    assert!(start.elapsed() < SOON, "{:?}", start.elapsed());
    !matches!(last.as_str(), "done" | "failed" | "deleted")
}

#[test]
fn event_streams_end_with_their_credential() {
    let gate = Gate::new(0);
    let server = private_with(Limits::default(), gate.clone());
    let key = |scopes: &[Scope]| key_fixture::add(server.data(), "site", scopes);
    let (owner, reader) = (key(&[Scope::Upload, Scope::Read]), key(&[Scope::Read]));
    let photo = id(&ask(&server, "POST", "/v1/photos", &[("authorization", &owner)], &jpeg(1)).is(202).json());
    gate.wait_started(1);
    let show = |visibility: &str| {
        let body = format!("{{\"visibility\": {visibility:?}}}");
        ask(&server, "PATCH", &format!("/v1/photos/{photo}"), &[("authorization", &owner), JSON], body.as_bytes()).is(200);
    };
    let open = |query: &str, who: Option<&str>| {
        let headers: Vec<_> = [HOST].into_iter().chain(who.map(|who| ("authorization", who))).collect();
        let mut events = Events::open_as(server.addr, &photo, query, &headers);
        assert_eq!(events.next().unwrap().0, "stage", "the first event is the photo's stage");
        events
    };
    let (of_owner, of_reader) = (open("", Some(&owner)), open("", Some(&reader)));
    // remove the reader's key; the owner's stays
    let all = key_fixture::read(server.data());
    let gone = all.iter().find(|k| !k.may(Scope::Upload)).unwrap();
    assert_eq!(key_fixture::remove(server.data(), "site", Some(&gone.id)), 1);
    assert!(ends(of_reader), "the key was removed");
    // a link expires
    let link = ask(&server, "POST", &format!("/v1/photos/{photo}/links?seconds=3"), &[("authorization", &owner)], &[]).json();
    assert!(ends(open(&format!("?{}", link["query"].as_str().unwrap()), None)), "the link expired");
    // revoke a photo's token
    let token = format!("Bearer {}", link["manage"].as_str().unwrap().split_once("#manage=").unwrap().1);
    let of_friend = open("", Some(&token));
    assert_eq!(ask(&server, "DELETE", &format!("/v1/photos/{photo}/manage"), &[("authorization", &owner)], &[]).status, 204);
    assert!(ends(of_friend), "the token was revoked");
    // make a visible photo private again
    show("link");
    let of_stranger = open("", None);
    show("private");
    assert!(ends(of_stranger), "it is private");
    // the owner's stream goes on to the end
    gate.open(1);
    assert!(!ends(of_owner), "the owner's key is still valid");
}

#[test]
fn visibility_is_a_setting_like_others() {
    let server = private();
    let ann = secret("a");
    let at = format!("/v1/photos/{}", id(&upload(&server, Some(&ann), 1)));
    let own = |method: &str, path: &str, more: &[(&str, &str)], body: &[u8]| {
        ask(&server, method, path, &[&[("authorization", ann.as_str())], more].concat(), body)
    };
    let tag = |path: &str| own("GET", path, &[], &[]).header("etag").unwrap().to_owned();
    let state = tag(&at);
    // `If-Match` accepts the tag of a read and the tag of a change's answer
    let shown = own("PATCH", &at, &[JSON, ("if-match", &state)], br#"{"visibility": "link"}"#);
    assert_eq!((shown.status, shown.json()["visibility"].as_str()), (200, Some("link")));
    let answered = shown.header("etag").unwrap();
    assert_eq!((tag(&at).as_str(), own("GET", &at, &[("if-none-match", answered)], &[]).status), (answered, 304));
    assert_eq!(own("PATCH", &at, &[JSON, ("if-match", answered)], br#"{"title": "The attic"}"#).status, 200);
    // older tags no longer match
    assert_eq!(own("PATCH", &at, &[JSON, ("if-match", &state)], br#"{"title": "B"}"#).problem(412)["type"], "urn:tmpi:problem:changed");
    assert_eq!(own("GET", &at, &[("if-none-match", &state)], &[]).status, 200);
    // a stranger who knows a tag gets 404, not 304
    let (page, settings, atlas) = (at.replace("/v1/photos", "/view"), format!("{at}/settings"), format!("{at}/atlas"));
    let seen = |path: &str| ask(&server, "GET", path, &[], &[]).header("etag").map(str::to_owned);
    let known: Vec<_> = [&at, &page, &settings, &atlas].map(|path| (path.clone(), seen(path).unwrap())).into();
    assert_eq!(own("PATCH", &at, &[JSON], br#"{"visibility": "private"}"#).status, 200);
    for (path, tag) in &known {
        let answer = ask(&server, "GET", path, &[("if-none-match", tag)], &[]);
        assert_eq!(answer.status, 404, "{path}");
        assert!(!String::from_utf8_lossy(&answer.body).contains("attic"), "{path} tells no title");
    }
    // a list depends on the caller and has no tag
    let bobs = ask(&server, "GET", "/v1/photos", &[("authorization", &secret("b")), ("if-none-match", "*")], &[]);
    assert_eq!((bobs.status, bobs.header("cache-control"), bobs.header("etag")), (200, Some("private, no-cache"), None));
    assert!(bobs.all("vary").contains("cookie") && server.listed().len() == 1);
}
