//! Quotas and retention.

use std::sync::Arc;
use std::time::Duration;

use tmpi::server::{Limits, Quotas, Retention};

use crate::access::{ask, private_within, secret};
use crate::client::{Connection, get, request};
use crate::fixture::{Running, contents, jpeg, pipeline, wait_until};

/// Bytes of all blobs of a photo; of all photos if `id` is empty.
fn size(data: &std::path::Path, id: &str) -> u64 {
    contents(data, id, "").iter().map(|file| std::fs::metadata(file).unwrap().len()).sum()
}

#[test]
fn the_quota_of_photos_applies_to_each_owner() {
    let dir = tempfile::tempdir().unwrap();
    let server = private_within(dir.path(), Arc::new(pipeline()), Limits { quotas: Quotas { photos: 2, bytes: 0 }, ..Limits::default() });
    let (ann, bob) = (secret("a"), secret("b"));
    let upload = |who: &str, seed| ask(&server, "POST", "/v1/photos", &[("authorization", who), ("prefer", "wait=60")], &jpeg(seed));
    let first = upload(&ann, 1).json()["id"].as_str().unwrap().to_owned();
    assert!(matches!(upload(&ann, 2).status, 201 | 202));
    let refused = upload(&ann, 3).problem(403);
    assert_eq!(refused["type"], "urn:tmpi:problem:quota");
    assert!(refused["detail"].as_str().unwrap().contains("the limit is 2 (quotas.photos)"), "{refused}");
    // refused before the body is sent
    let mut connection = Connection::open(server.addr);
    let head = format!(
        "POST /v1/photos HTTP/1.1\r\nhost: photos.example\r\nauthorization: {ann}\r\ncontent-length: 1000\r\nexpect: 100-continue\r\n\r\n"
    );
    std::io::Write::write_all(connection.raw(), head.as_bytes()).unwrap();
    connection.receive("POST").unwrap().problem(403);
    assert!(matches!(upload(&bob, 3).status, 201 | 202));
    assert_eq!(ask(&server, "DELETE", &format!("/v1/photos/{first}"), &[("authorization", &ann)], &[]).status, 204);
    assert!(matches!(upload(&ann, 3).status, 201 | 202), "there is room again");
    // quotas do not apply to this machine's own user
    for seed in 10..13 {
        assert_eq!(request(server.addr, "POST", "/v1/photos", &[], &jpeg(seed)).status, 202);
    }
}

#[test]
fn the_quota_of_bytes_holds_after_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let ann = secret("a");
    let headers = [("authorization", ann.as_str()), ("prefer", "wait=60")];
    let server = private_within(dir.path(), Arc::new(pipeline()), Limits::default());
    assert_eq!(ask(&server, "POST", "/v1/photos", &headers, &jpeg(1)).status, 201);
    let taken = size(dir.path(), "");
    server.stop();
    let next = jpeg(2);
    let within =
        |bytes: u64| private_within(dir.path(), Arc::new(pipeline()), Limits { quotas: Quotas { photos: 0, bytes }, ..Limits::default() });
    let server = within(taken + next.len() as u64 - 1);
    let refused = ask(&server, "POST", "/v1/photos", &headers, &next).problem(403);
    assert!(refused["detail"].as_str().unwrap().contains("(quotas.size)"), "{refused}");
    server.stop();
    let server = within(taken + next.len() as u64);
    assert!(matches!(ask(&server, "POST", "/v1/photos", &headers, &next).status, 201 | 202));
}

#[test]
fn photos_expire_by_age_and_the_state_says_when() {
    let dir = tempfile::tempdir().unwrap();
    let limits =
        |age: Duration| Limits { retention: Retention { age, bytes: 0 }, retain_sweep: Duration::from_millis(200), ..Limits::default() };
    let server = Running::start(dir.path(), limits(Duration::from_hours(24)), Arc::new(pipeline()));
    let id = server.upload(&jpeg(1));
    let state = server.wait(&id, "done");
    let (created, expires) = (state["created"].as_str().unwrap(), state["expires"].as_str().unwrap());
    assert!(expires > created && expires[10..] == created[10..], "{created} {expires}");
    std::thread::sleep(Duration::from_millis(600));
    assert_eq!(server.state(&id)["state"], "done", "not before");
    server.stop();
    let server = Running::start(dir.path(), limits(Duration::from_millis(1)), Arc::new(pipeline()));
    wait_until("it is gone", || get(server.addr, &format!("/v1/photos/{id}")).status == 404);
    wait_until("nothing is left", || contents(dir.path(), &id, "").is_empty());
    wait_until("it is counted", || {
        let metrics = String::from_utf8(get(server.addr, "/metrics").body).unwrap();
        metrics.contains("\ntmpi_photos_retired_total{reason=\"age\"} 1\n")
    });
    server.stop();
    let server = Running::start(dir.path(), limits(Duration::ZERO), Arc::new(pipeline()));
    let id = server.upload(&jpeg(1));
    assert!(server.wait(&id, "done")["expires"].is_null());
}

#[test]
fn the_least_recently_viewed_photos_make_room_for_others() {
    let dir = tempfile::tempdir().unwrap();
    let limits = |room| Limits {
        retention: Retention { age: Duration::ZERO, bytes: room },
        retain_sweep: Duration::from_millis(200),
        ..Limits::default()
    };
    let server = Running::start(dir.path(), limits(u64::MAX), Arc::new(pipeline()));
    let ids: Vec<String> = (1..4).map(|seed| server.upload(&jpeg(seed))).collect();
    for id in &ids {
        server.wait(id, "done");
    }
    let sizes: Vec<u64> = ids.iter().map(|id| size(dir.path(), id)).collect();
    server.stop();
    // view the oldest photo last
    for n in [1, 2, 0] {
        let server = Running::start(dir.path(), limits(u64::MAX), Arc::new(pipeline()));
        assert_eq!(get(server.addr, &format!("/v1/photos/{}/thumbnail", ids[n])).status, 200);
        // records the view
        server.stop();
    }
    let server = Running::start(dir.path(), limits(sizes[0] + sizes[2]), Arc::new(pipeline()));
    let there = || -> Vec<String> {
        let list = get(server.addr, "/v1/photos").json();
        list["photos"].as_array().unwrap().iter().map(|p| p["id"].as_str().unwrap().to_owned()).collect()
    };
    wait_until("one is gone", || there().len() == 2);
    assert!(there().contains(&ids[0]) && !there().contains(&ids[1]), "{ids:?}: {:?}", there());
    std::thread::sleep(Duration::from_millis(600));
    assert_eq!(there().len(), 2, "no more than necessary");
}
