//! Webhooks, with a receiver in this process.

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::AtomicBool;

use tmpi::server::{AddressPolicy, Problem};
use tmpi_testing::Answer;

use crate::key_fixture;
use crate::live::{Publisher, frame};
use crate::prelude::*;
use crate::receiver::{Delivery as _, Receiver};

/// Retries of which even an unlucky delivery does not use up all.
const MANY: usize = 60;

/// A server whose webhooks may have any address.
fn server(limits: Limits) -> Running {
    Running::configured(Arc::new(pipeline()), |config| Config { webhook_addresses: AddressPolicy::Any, limits, ..config })
}

fn quick(times: usize) -> Limits {
    Limits { retries: vec![Duration::from_millis(1); times], ..Limits::default() }
}

fn send(server: &Running, method: &str, path: &str, body: &Value) -> Response {
    let body = if body.is_null() { String::new() } else { body.to_string() };
    request(server.addr, method, path, &[JSON], body.as_bytes())
}

/// Adds a webhook; returns its id and secret.
fn add(server: &Running, fields: &Value) -> (String, String) {
    let answer = send(server, "POST", "/v1/webhooks", fields).is(201);
    let added = answer.json();
    let text = |name: &str| added[name].as_str().unwrap().to_owned();
    assert_eq!(answer.header("location"), Some(format!("/v1/webhooks/{}", text("id")).as_str()));
    assert!(get(server.addr, answer.header("location").unwrap()).json()["secret"].is_null(), "the secret is told once");
    (text("id"), text("secret"))
}

fn ping(server: &Running, webhook: &str) -> String {
    let told = send(server, "POST", &format!("/v1/webhooks/{webhook}/test"), &Value::Null).is(202).json();
    told["delivery"].as_str().unwrap().to_owned()
}

/// All deliveries of a webhook, newest first, page by page.
fn log(server: &Running, webhook: &str) -> Vec<Value> {
    let (mut all, mut next) = (Vec::new(), Some(format!("/v1/webhooks/{webhook}/deliveries?limit=200")));
    while let Some(path) = next {
        let page = get(server.addr, &path).json();
        all.extend(page["deliveries"].as_array().unwrap().clone());
        next = page["next"].as_str().map(str::to_owned);
    }
    all
}

#[test]
fn the_life_of_a_photo_is_told_and_signed() {
    let (server, receiver) = (server(quick(3)), Receiver::start(|_| Answer::of(204)));
    let (webhook, secret) = add(&server, &json!({ "url": receiver.url }));
    let photo = server.upload(&jpeg(1));
    let done = receiver.wait("photo.done", 1);
    assert_eq!(done[0].json()["data"]["path"], format!("/v1/photos/{photo}"));
    let order = send(&server, "POST", &format!("/v1/photos/{photo}/exports?format=glb"), &Value::Null);
    let written = receiver.wait("export.done", 1)[0].json()["data"].clone();
    assert_eq!((&written["key"], &written["format"], &written["photo"]), (&order.json()["key"], &"glb".into(), &photo.as_str().into()));
    assert_eq!(get(server.addr, written["file"].as_str().unwrap()).status, 200);
    assert_eq!(send(&server, "DELETE", &format!("/v1/photos/{photo}"), &Value::Null).status, 204);
    assert_eq!(receiver.wait("photo.deleted", 1)[0].json()["data"], json!({ "id": photo, "state": "deleted" }));
    for got in receiver.got() {
        assert_eq!(got.header("content-type"), "application/json");
        assert!(got.is_signed_by(&secret) && !got.is_signed_by("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"), "{got:?}");
    }
    wait_until("all is recorded", || log(&server, &webhook).iter().all(|one| one["state"] == "delivered"));
    let told: Vec<String> = log(&server, &webhook).iter().map(|one| one["type"].as_str().unwrap().to_owned()).collect();
    assert_eq!(told, ["photo.deleted", "export.done", "photo.done"]);
    assert_eq!(server.metric("tmpi_deliveries_total{outcome=\"delivered\"}"), 3);
}

#[test]
fn a_failed_photo_is_told_with_its_problem() {
    let torn = Fault::Photo(Problem::new(axum::http::StatusCode::UNPROCESSABLE_ENTITY, "broken-photo", "it is torn"));
    let server = Running::configured(failing(vec![torn]), |config| Config { webhook_addresses: AddressPolicy::Any, ..config });
    let (failed, done) = (Receiver::start(|_| Answer::of(200)), Receiver::start(|_| Answer::of(200)));
    add(&server, &json!({ "url": failed.url, "events": ["photo.failed"] }));
    let (other, _) = add(&server, &json!({ "url": done.url, "events": ["photo.done"] }));
    server.upload(&jpeg(1));
    let data = failed.wait("photo.failed", 1)[0].json()["data"].clone();
    assert_eq!(data["problem"], json!({ "type": "urn:tmpi:problem:broken-photo", "detail": "it is torn" }));
    assert_eq!(log(&server, &other), Vec::<Value>::new());
}

#[test]
fn an_attempt_that_fails_is_made_again_with_the_same_id() {
    let receiver = Receiver::start(|before: usize| if before < 2 { Answer::of(500) } else { Answer::of(200) });
    let server = server(quick(3));
    let (webhook, secret) = add(&server, &json!({ "url": receiver.url, "secret": "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw" }));
    assert_eq!(secret, "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw");
    let delivery = ping(&server, &webhook);
    wait_until("it is delivered", || log(&server, &webhook)[0]["state"] == "delivered");
    let got = receiver.got();
    assert_eq!(got.len(), 3);
    assert!(got.iter().all(|got| got.header("webhook-id") == delivery && got.body == got.body && got.is_signed_by(&secret)));
    assert_eq!(got[0].body, got[2].body);
    let one = &log(&server, &webhook)[0];
    assert_eq!((&one["attempts"], &one["status"], &one["error"]), (&3.into(), &200.into(), &Value::Null));
    assert!(one["ended"].is_string() && one["next"].is_null() && one["took_ms"].is_number());
}

#[test]
fn what_is_never_taken_fails_and_redirects_are_not_followed() {
    let elsewhere = Receiver::start(|_| Answer::of(200));
    let to = format!("location: {}\r\n", elsewhere.url);
    let receiver = Receiver::start(move |_| Answer::Whole(307, to.clone(), Vec::new()));
    let server = server(quick(2));
    let (webhook, _) = add(&server, &json!({ "url": receiver.url }));
    ping(&server, &webhook);
    wait_until("it has failed", || log(&server, &webhook)[0]["state"] == "failed");
    let one = log(&server, &webhook)[0].clone();
    assert_eq!((&one["attempts"], &one["status"]), (&3.into(), &307.into()));
    assert!(one["error"].as_str().unwrap().contains("307"), "{one}");
    assert!(receiver.got().len() == 3 && elsewhere.got().is_empty());
    assert!(get(server.addr, &format!("/v1/webhooks/{webhook}")).json()["failing_since"].is_string());
    // a receiver that is away, and one that is busy
    drop(receiver);
    let busy = Receiver::start(|_| Answer::Whole(503, "retry-after: 3600\r\n".into(), Vec::new()));
    let (webhook, _) = add(&server, &json!({ "url": busy.url }));
    ping(&server, &webhook);
    wait_until("it is recorded", || log(&server, &webhook)[0]["attempts"] == 1 && log(&server, &webhook)[0]["status"] == 503);
    let one = log(&server, &webhook)[0].clone();
    assert!(one["state"] == "pending" && one["next"].as_str() > one["created"].as_str(), "{one}");
}

#[test]
fn two_deliveries_of_a_webhook_are_under_way_in_order() {
    // one gate for the first two requests, and one for the others
    let open = Arc::new([const { AtomicBool::new(false) }; 2]);
    let gates = Arc::clone(&open);
    let held = Receiver::start(move |before| {
        wait_until("the gate opens", || gates[usize::from(before >= 2)].load(Ordering::SeqCst));
        Answer::of(200)
    });
    let free = Receiver::start(|_| Answer::of(200));
    let server = server(quick(3));
    let ((slow, _), (fast, _)) = (add(&server, &json!({ "url": held.url })), add(&server, &json!({ "url": free.url })));
    let pings: Vec<String> = (0..6).map(|_| ping(&server, &slow)).collect();
    wait_until("two are under way", || held.begun() == 2);
    // another webhook does not wait
    ping(&server, &fast);
    free.wait("ping", 1);
    assert_eq!(held.begun(), 2);
    open[0].store(true, Ordering::SeqCst);
    let mut got: Vec<String> = held.wait("ping", 2).iter().map(|got| got.header("webhook-id").to_owned()).collect();
    got.sort();
    assert_eq!(got, pings[..2]);
    open[1].store(true, Ordering::SeqCst);
    held.wait("ping", 6);
}

#[test]
fn a_thousand_deliveries_arrive_though_half_of_the_attempts_fail() {
    // a fair coin, the same for each run
    let receiver =
        Receiver::start(|before: usize| Answer::of(if tmpi_testing::pictures::noise(before as u32, 0) < 0.5 { 200 } else { 500 }));
    let server = server(quick(MANY));
    let webhooks: Vec<String> = (0..8).map(|_| add(&server, &json!({ "url": receiver.url })).0).collect();
    let mut connection = Connection::open(server.addr);
    let mut sent = Vec::new();
    for n in 0..1000 {
        let answer = connection.request("POST", &format!("/v1/webhooks/{}/test", webhooks[n % 8]), &[], &[]);
        sent.push(answer.json()["delivery"].as_str().unwrap().to_owned());
    }
    let end = Instant::now() + Duration::from_mins(5);
    let is_over = || webhooks.iter().all(|webhook| log(&server, webhook).iter().all(|one| one["state"] != "pending"));
    while !is_over() {
        assert!(Instant::now() < end, "deliveries are still pending");
        std::thread::sleep(Duration::from_millis(50));
    }
    let mut taken: HashMap<String, usize> = HashMap::new();
    for got in receiver.got().iter().filter(|got| got.status == 200) {
        *taken.entry(got.header("webhook-id").to_owned()).or_default() += 1;
    }
    assert!(sent.iter().all(|id| taken.get(id) == Some(&1)), "each is taken once");
    let (all, failed) = (receiver.got().len(), receiver.got().iter().filter(|got| got.status == 500).count());
    assert!((800..1250).contains(&failed) && all == 1000 + failed, "{failed} of {all} attempts failed");
}

#[test]
fn a_restart_loses_no_delivery() {
    let open = Arc::new(AtomicBool::new(false));
    let gate = Arc::clone(&open);
    let receiver = Receiver::start(move |_| {
        wait_until("the gate opens", || gate.load(Ordering::SeqCst));
        Answer::of(200)
    });
    let first = server(quick(3));
    let (webhook, _) = add(&first, &json!({ "url": receiver.url }));
    let pings: Vec<String> = (0..3).map(|_| ping(&first, &webhook)).collect();
    wait_until("two are under way", || receiver.begun() == 2);
    let second = first.again(quick(3), Arc::new(pipeline()));
    open.store(true, Ordering::SeqCst);
    wait_until("all are delivered", || log(&second, &webhook).iter().all(|one| one["state"] == "delivered"));
    let mut got: BTreeMap<String, usize> = BTreeMap::new();
    for one in receiver.got() {
        *got.entry(one.header("webhook-id").to_owned()).or_default() += 1;
    }
    // those that were under way come again
    assert_eq!(got, pings.into_iter().zip([2, 2, 1]).collect());
}

#[test]
fn a_webhook_that_is_gone_is_disabled_until_somebody_enables_it() {
    let receiver = Receiver::start(|before: usize| Answer::of(if before == 0 { 410 } else { 200 }));
    let server = server(quick(3));
    let (webhook, _) = add(&server, &json!({ "url": receiver.url }));
    let at = format!("/v1/webhooks/{webhook}");
    ping(&server, &webhook);
    wait_until("it is disabled", || get(server.addr, &at).json()["enabled"] == false);
    assert_eq!(get(server.addr, &at).json()["reason"], "it answers 410 Gone");
    assert_eq!(log(&server, &webhook)[0]["state"], "failed");
    assert_eq!(send(&server, "POST", &format!("{at}/test"), &Value::Null).problem(409)["type"], "urn:tmpi:problem:disabled");
    server.wait(&server.upload(&jpeg(1)), "done");
    assert_eq!(log(&server, &webhook).len(), 1, "it gets no events");
    let enabled = send(&server, "PATCH", &at, &json!({ "enabled": true, "events": ["photo.deleted"] })).json();
    assert_eq!((&enabled["enabled"], &enabled["reason"], &enabled["events"]), (&true.into(), &Value::Null, &json!(["photo.deleted"])));
    ping(&server, &webhook);
    receiver.wait("ping", 2);
    assert_eq!(send(&server, "DELETE", &at, &Value::Null).status, 204);
    get(server.addr, &at).problem(404);
}

#[test]
fn webhooks_of_callers_reach_public_addresses_alone() {
    let receiver = Receiver::start(|_| Answer::of(200));
    let server = Running::with(quick(0), Arc::new(pipeline()));
    for wrong in [
        receiver.url.as_str(),
        "http://[::1]/",
        "http://169.254.169.254/latest/meta-data",
        "http://10.0.0.1/",
        "http://2130706433/",
        "ftp://example.org/",
        "https://me:secret@example.org/",
        "example.org",
        "",
    ] {
        let refused = send(&server, "POST", "/v1/webhooks", &json!({ "url": wrong })).problem(400);
        assert_eq!((&refused["field"], refused["detail"].to_string().contains("secret")), (&"url".into(), false), "{wrong}");
    }
    // a name is checked when it is resolved
    let (webhook, _) = add(&server, &json!({ "url": receiver.url.replace("127.0.0.1", "localhost") }));
    ping(&server, &webhook);
    wait_until("it has failed", || log(&server, &webhook)[0]["state"] == "failed");
    assert_eq!(log(&server, &webhook)[0]["error"], "the name has no public address");
    assert_eq!(receiver.begun(), 0);
    let refused = send(&server, "PATCH", &format!("/v1/webhooks/{webhook}"), &json!({ "url": receiver.url })).problem(400);
    assert_eq!(refused["field"], "url");
}

#[test]
fn wrong_fields_are_named() {
    let server = server(quick(1));
    let url = "https://nowhere.invalid/";
    for (body, field) in [
        (json!({}), "url"),
        (json!({ "url": 3 }), "url"),
        (json!({ "url": url, "events": ["photo.eaten"] }), "events"),
        (json!({ "url": url, "events": ["ping"] }), "events"),
        (json!({ "url": url, "events": "photo.done" }), "events"),
        (json!({ "url": url, "secret": "short" }), "secret"),
        (json!({ "url": url, "more": 1 }), "more"),
    ] {
        assert_eq!(send(&server, "POST", "/v1/webhooks", &body).problem(400)["field"], field, "{body}");
    }
    send(&server, "POST", "/v1/webhooks", &json!([])).problem(400);
    request(server.addr, "POST", "/v1/webhooks", &[], b"{}").problem(415);
    request(server.addr, "POST", "/v1/webhooks", &[JSON], &vec![b' '; 20_000]).problem(413);
    let (webhook, _) = add(&server, &json!({ "url": url, "events": [] }));
    let at = format!("/v1/webhooks/{webhook}");
    assert_eq!(get(server.addr, &at).json()["events"].as_array().unwrap().len(), 7);
    assert_eq!(send(&server, "PATCH", &at, &json!({ "enabled": 1 })).problem(400)["field"], "enabled");
    assert_eq!(send(&server, "PATCH", &at, &json!({ "secret": "x" })).problem(400)["field"], "secret");
    assert_eq!(get(server.addr, &format!("{at}/deliveries?limit=201")).problem(400)["field"], "limit");
    for _ in 1..16 {
        add(&server, &json!({ "url": url }));
    }
    let refused = send(&server, "POST", "/v1/webhooks", &json!({ "url": url })).problem(403);
    assert_eq!(refused["type"], "urn:tmpi:problem:too-many-webhooks");
}

#[test]
fn webhooks_of_the_configuration_have_any_address_and_follow_it() {
    let receiver = Receiver::start(|_| Answer::of(200));
    let secret = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw";
    let configured = json!({ "url": receiver.url, "secret": secret, "events": ["photo.done"] }).to_string().parse().unwrap();
    let server = Running::configured(Arc::new(pipeline()), |config| Config { webhooks: vec![configured], ..config });
    let all = get(server.addr, "/v1/webhooks").json()["webhooks"].clone();
    assert_eq!((all.as_array().unwrap().len(), &all[0]["configured"], &all[0]["all"]), (1, &true.into(), &true.into()));
    let at = format!("/v1/webhooks/{}", all[0]["id"].as_str().unwrap());
    server.upload(&jpeg(1));
    assert!(receiver.wait("photo.done", 1)[0].is_signed_by(secret));
    for (method, body) in [("PATCH", json!({ "events": [] })), ("DELETE", Value::Null)] {
        assert_eq!(send(&server, method, &at, &body).problem(409)["type"], "urn:tmpi:problem:configured");
    }
    assert_eq!(send(&server, "PATCH", &at, &json!({ "enabled": false })).json()["reason"], "a caller disabled it");
    let server = server.changed(Arc::new(pipeline()), |config| Config { webhooks: Vec::new(), ..config });
    get(server.addr, &at).problem(404);
}

#[test]
fn a_room_is_told_when_it_starts_and_ends() {
    let receiver = Receiver::start(|_| Answer::of(200));
    let first = server(quick(3));
    add(&first, &json!({ "url": receiver.url, "events": ["room.started", "room.ended"] }));
    let mut publisher = Publisher::new(first.addr, "attic");
    publisher.publish(frame(10));
    assert_eq!(receiver.wait("room.started", 1)[0].json()["data"], json!({ "room": "attic", "path": "/live/attic" }));
    let _second = first.again(quick(3), Arc::new(pipeline()));
    assert_eq!(receiver.wait("room.ended", 1)[0].json()["data"]["room"], "attic");
    let all = receiver.got();
    assert_eq!(all.len(), 2, "{all:?}");
}

#[test]
fn owners_are_told_of_their_photos_and_administrators_of_all() {
    let server =
        Running::configured(Arc::new(pipeline()), |config| Config { private: true, webhook_addresses: AddressPolicy::Any, ..config });
    let send = |who: &str, method: &str, path: &str, body: &Value| {
        let body = if body.is_null() { String::new() } else { body.to_string() };
        ask(&server, method, path, &[("authorization", who), JSON], body.as_bytes())
    };
    let add = |who: &str, url: &str| id(&send(who, "POST", "/v1/webhooks", &json!({ "url": url })).is(201).json());
    let key = |name: &str, scopes: &[Scope]| key_fixture::add(server.data(), name, scopes);
    let (ann, site, boss) = (secret("a"), key("site", &[Scope::Upload]), key("boss", &[Scope::Admin]));
    let receivers: Vec<Receiver> = (0..3).map(|_| Receiver::start(|_| Answer::of(200))).collect();
    let [of_ann, of_site, of_boss] = [(&ann, 0), (&site, 1), (&boss, 2)].map(|(who, n)| add(who, &receivers[n].url));
    let (photo, other) = (id(&upload(&server, Some(&ann), 1)), id(&upload(&server, Some(&site), 2)));
    receivers[2].wait("photo.done", 2);
    receivers[1].wait("photo.done", 1);
    receivers[0].wait("photo.done", 1);
    let photos = |receiver: &Receiver| {
        let mut all: Vec<String> = receiver.got().iter().map(|got| id(&got.json()["data"])).collect();
        all.sort();
        all
    };
    let mut both = vec![photo.clone(), other.clone()];
    both.sort();
    assert_eq!([&receivers[0], &receivers[1], &receivers[2]].map(photos), [vec![photo], vec![other], both]);
    let listed = |who: &str| {
        let list = send(who, "GET", "/v1/webhooks", &Value::Null).json();
        list["webhooks"].as_array().unwrap().iter().map(id).collect::<Vec<_>>()
    };
    assert_eq!((listed(&ann), listed(&site)), (vec![of_ann.clone()], vec![of_site.clone()]));
    assert_eq!(listed(&boss), [of_ann.clone(), of_site.clone(), of_boss.clone()]);
    for (method, path, body) in [
        ("GET", String::new(), Value::Null),
        ("PATCH", String::new(), json!({ "enabled": false })),
        ("DELETE", String::new(), Value::Null),
        ("GET", "/deliveries".into(), Value::Null),
        ("POST", "/test".into(), Value::Null),
    ] {
        for (who, webhook) in [(&ann, &of_site), (&ann, &of_boss), (&site, &of_ann)] {
            send(who, method, &format!("/v1/webhooks/{webhook}{path}"), &body).problem(404);
        }
    }
    // an administrator manages those of others
    assert_eq!(send(&boss, "DELETE", &format!("/v1/webhooks/{of_ann}"), &Value::Null).status, 204);
    assert!(listed(&ann).is_empty());
    let refused = ask(&server, "GET", "/v1/webhooks", &[], &[]).problem(403);
    assert_eq!(refused["type"], "urn:tmpi:problem:no-owner");
    let reads = key("site", &[Scope::Read]);
    assert_eq!(send(&reads, "GET", "/v1/webhooks", &Value::Null).problem(403)["type"], "urn:tmpi:problem:scope");
}
