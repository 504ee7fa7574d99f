//! Quotas and retention.

use tmpi::server::{Exports, Quotas, Retention};

use crate::prelude::*;

/// Bytes of all blobs of a photo; of all photos if `id` is empty.
fn size(data: &std::path::Path, id: &str) -> u64 {
    contents(data, id, "").iter().map(|file| std::fs::metadata(file).unwrap().len()).sum()
}

/// These rules, applied often; the server deletes files without downloads at once.
fn often(retention: Retention) -> Limits {
    let often = Duration::from_millis(50);
    Limits { retention, retain_sweep: often, exports: Exports { keep: often, ..Exports::default() }, ..Limits::default() }
}

/// Waits until the rules were applied once more. A sweep deletes files last, so a whole one lies between two deletions.
fn wait_for_a_sweep(server: &Running, photo: &str) {
    for _ in 0..2 {
        let ordered = request(server.addr, "POST", &format!("/v1/photos/{photo}/exports?format=glb"), &[], &[]);
        let location = ordered.header("location").unwrap();
        wait_until("the file is deleted", || get(server.addr, location).status == 404);
    }
}

#[test]
fn the_quota_of_photos_applies_to_each_owner() {
    let server = private_with(Limits { quotas: Quotas { photos: 2, bytes: 0 }, ..Limits::default() }, Arc::new(pipeline()));
    let (ann, bob) = (secret("a"), secret("b"));
    let upload = |who: &str, seed| ask(&server, "POST", "/v1/photos", &[("authorization", who), ("prefer", "wait=60")], &jpeg(seed));
    let first = id(&upload(&ann, 1).json());
    assert!(matches!(upload(&ann, 2).status, 201 | 202));
    let refused = upload(&ann, 3).problem(403);
    assert_eq!(refused["type"], "urn:tmpi:problem:quota");
    assert!(refused["detail"].as_str().unwrap().contains("the limit is 2 (quotas.photos)"), "{refused}");
    // refused before the body is sent
    let head = format!(
        "POST /v1/photos HTTP/1.1\r\nhost: photos.example\r\nauthorization: {ann}\r\ncontent-length: 1000\r\nexpect: 100-continue\r\n\r\n"
    );
    send_raw(server.addr, head.as_bytes()).problem(403);
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
    let ann = secret("a");
    let headers = [("authorization", ann.as_str()), ("prefer", "wait=60")];
    let server = private();
    assert_eq!(ask(&server, "POST", "/v1/photos", &headers, &jpeg(1)).status, 201);
    let taken = size(server.data(), "");
    let next = jpeg(2);
    let within = |server: Running, bytes: u64| {
        server.again(Limits { quotas: Quotas { photos: 0, bytes }, ..Limits::default() }, Arc::new(pipeline()))
    };
    let server = within(server, taken + next.len() as u64 - 1);
    let refused = ask(&server, "POST", "/v1/photos", &headers, &next).problem(403);
    assert!(refused["detail"].as_str().unwrap().contains("(quotas.size)"), "{refused}");
    let server = within(server, taken + next.len() as u64);
    assert!(matches!(ask(&server, "POST", "/v1/photos", &headers, &next).status, 201 | 202));
}

#[test]
fn photos_expire_by_age_and_the_state_says_when() {
    let limits = |age: Duration| often(Retention { age, bytes: 0 });
    let server = Running::with(limits(Duration::from_hours(24)), Arc::new(pipeline()));
    let id = server.upload(&jpeg(1));
    let state = server.wait(&id, "done");
    let (created, expires) = (state["created"].as_str().unwrap(), state["expires"].as_str().unwrap());
    assert!(expires > created && expires[10..] == created[10..], "{created} {expires}");
    wait_for_a_sweep(&server, &id);
    assert_eq!(server.state(&id)["state"], "done", "not before");
    let server = server.again(limits(Duration::from_millis(1)), Arc::new(pipeline()));
    wait_until("it is gone", || get(server.addr, &format!("/v1/photos/{id}")).status == 404);
    wait_until("nothing is left", || contents(server.data(), &id, "").is_empty());
    wait_until("it is counted", || server.metric("tmpi_photos_retired_total{reason=\"age\"}") == 1);
    let server = server.again(limits(Duration::ZERO), Arc::new(pipeline()));
    let id = server.upload(&jpeg(1));
    assert!(server.wait(&id, "done")["expires"].is_null());
}

#[test]
fn the_least_recently_viewed_photos_make_room_for_others() {
    let limits = |room| often(Retention { age: Duration::ZERO, bytes: room });
    let mut server = Running::with(limits(u64::MAX), Arc::new(pipeline()));
    let ids: Vec<String> = (1..4).map(|seed| server.make(&jpeg(seed))).collect();
    let sizes: Vec<u64> = ids.iter().map(|id| size(server.data(), id)).collect();
    // view the oldest photo last
    for n in [1, 2, 0] {
        assert_eq!(get(server.addr, &format!("/v1/photos/{}/thumbnail", ids[n])).status, 200);
        // records the view
        server = server.again(limits(u64::MAX), Arc::new(pipeline()));
    }
    let server = server.again(limits(sizes[0] + sizes[2]), Arc::new(pipeline()));
    wait_until("one is gone", || server.listed().len() == 2);
    let there = server.listed();
    assert!(there.contains(&ids[0]) && !there.contains(&ids[1]), "{ids:?}: {there:?}");
    wait_for_a_sweep(&server, &ids[0]);
    assert_eq!(server.listed().len(), 2, "no more than necessary");
}
