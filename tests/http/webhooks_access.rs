//! Webhooks of owners on a server with `--access private`.

use tmpi::server::AddressPolicy;
use tmpi_testing::Answer;

use crate::key_fixture;
use crate::prelude::*;
use crate::receiver::{Delivery as _, Receiver};

fn start() -> Running {
    Running::configured(Arc::new(pipeline()), |config| Config { private: true, webhook_addresses: AddressPolicy::Any, ..config })
}

fn send(server: &Running, who: &str, method: &str, path: &str, body: &Value) -> Response {
    let body = if body.is_null() { String::new() } else { body.to_string() };
    ask(server, method, path, &[("authorization", who), JSON], body.as_bytes())
}

fn add(server: &Running, who: &str, url: &str) -> String {
    id(&send(server, who, "POST", "/v1/webhooks", &json!({ "url": url })).is(201).json())
}

fn photos(receiver: &Receiver) -> Vec<String> {
    let mut all: Vec<String> = receiver.got().iter().map(|got| id(&got.json()["data"])).collect();
    all.sort();
    all
}

#[test]
fn owners_are_told_of_their_photos_and_administrators_of_all() {
    let server = start();
    let key = |name: &str, scopes: &[Scope]| key_fixture::add(server.data(), name, scopes);
    let (ann, site, boss) = (secret("a"), key("site", &[Scope::Upload]), key("boss", &[Scope::Admin]));
    let receivers: Vec<Receiver> = (0..3).map(|_| Receiver::start(|_| Answer::of(200))).collect();
    let [of_ann, of_site, of_boss] = [(&ann, 0), (&site, 1), (&boss, 2)].map(|(who, n)| add(&server, who, &receivers[n].url));
    let (photo, other) = (id(&upload(&server, Some(&ann), 1)), id(&upload(&server, Some(&site), 2)));
    receivers[2].wait("photo.done", 2);
    receivers[1].wait("photo.done", 1);
    receivers[0].wait("photo.done", 1);
    let mut both = vec![photo.clone(), other.clone()];
    both.sort();
    assert_eq!([&receivers[0], &receivers[1], &receivers[2]].map(photos), [vec![photo], vec![other], both]);
    let listed = |who: &str| {
        let list = send(&server, who, "GET", "/v1/webhooks", &Value::Null).json();
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
            send(&server, who, method, &format!("/v1/webhooks/{webhook}{path}"), &body).problem(404);
        }
    }
    // an administrator manages those of others
    assert_eq!(send(&server, &boss, "DELETE", &format!("/v1/webhooks/{of_ann}"), &Value::Null).status, 204);
    assert!(listed(&ann).is_empty());
    let refused = ask(&server, "GET", "/v1/webhooks", &[], &[]).problem(403);
    assert_eq!(refused["type"], "urn:tmpi:problem:no-owner");
    let reads = key("site", &[Scope::Read]);
    assert_eq!(send(&server, &reads, "GET", "/v1/webhooks", &Value::Null).problem(403)["type"], "urn:tmpi:problem:scope");
}
