//! Photos of a node alone, brought into a store.

use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use serde_json::Value;
use tmpi::server::{Limits, Role};

use crate::client::{get, post_form, request};
use crate::cluster::node;
use crate::fixture::{Gate, Running, depth_map, jpeg, pipeline};

fn migrate(data: &Path, store: &Path, more: &[&str]) -> (bool, Value) {
    let store = format!("file://{}", store.display());
    let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
    let out = command.arg("migrate").arg("--data").arg(data).args(["--store", &store, "--json"]).args(more).output().unwrap();
    (out.status.success(), serde_json::from_slice(&out.stdout).unwrap_or_else(|_| String::from_utf8_lossy(&out.stderr).into()))
}

fn fsck(store: &Path) -> bool {
    Command::new(env!("CARGO_BIN_EXE_tmpi"))
        .arg("fsck")
        .args(["--store", &format!("file://{}", store.display())])
        .output()
        .unwrap()
        .status
        .success()
}

#[test]
fn photos_go_over_as_they_are_and_are_made_where_they_were_not() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let gate = Gate::new(2);
    let alone = Running::start(&at("alone"), Limits::default(), gate.clone());
    let (working, _) = migrate(&at("alone"), &at("store"), &[]);
    assert!(!working, "a server works there");
    let first = alone.upload(&jpeg(1));
    let second = post_form(alone.addr, &[], &[("photo", &jpeg(2)), ("depth", &depth_map())]).json()["id"].as_str().unwrap().to_owned();
    for id in [&first, &second] {
        alone.wait(id, "done");
    }
    let title =
        request(alone.addr, "PATCH", &format!("/v1/photos/{first}"), &[("content-type", "application/json")], br#"{"title": "Sea"}"#);
    assert_eq!(title.status, 200);
    let waits = alone.upload(&jpeg(3));
    let parts = |server: &Running, id: &str| {
        ["atlas", "depth", "thumbnail", "report"].map(|part| get(server.addr, &format!("/v1/photos/{id}/{part}")).body)
    };
    let before = [parts(&alone, &first), parts(&alone, &second)];
    alone.stop();
    let (told, would) = migrate(&at("alone"), &at("store"), &["--dry-run"]);
    assert!(told && would["brought"] == 3 && would["pending"] == 1 && would["known"] == 0, "{would}");
    assert!(!at("store").join("photos").exists(), "nothing is written");
    let (done, found) = migrate(&at("alone"), &at("store"), &[]);
    assert!(done && found["brought"] == 3 && found["pending"] == 1 && found["bytes"] == would["bytes"], "{found}");
    assert!(fsck(&at("store")));
    let (done, again) = migrate(&at("alone"), &at("store"), &[]);
    assert!(done && again["brought"] == 0 && again["known"] == 3, "{again}");
    // what was made is not made again
    let serve = node(&at("store"), &at("a"), Role::Serve, Gate::new(0));
    assert_eq!([parts(&serve, &first), parts(&serve, &second)], before);
    assert_eq!(serve.state(&first)["settings"]["title"], "Sea");
    assert_eq!(serve.state(&waits)["state"], "queued");
    let _worker = node(&at("store"), &at("b"), Role::Work, Arc::new(pipeline()));
    serve.wait(&waits, "done");
    assert_eq!(serve.upload(&jpeg(1)), first, "the same photo is known");
}

#[test]
fn what_is_damaged_is_made_again_and_what_is_no_data_directory_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (none, said) = migrate(&at("nothing"), &at("store"), &[]);
    assert!(!none && said.as_str().unwrap().contains("no data directory"), "{said}");
    let alone = Running::start(&at("alone"), Limits::default(), Arc::new(pipeline()));
    let id = alone.upload(&jpeg(1));
    alone.wait(&id, "done");
    alone.stop();
    let atlas = at("alone").join("photos").join(&id).join("atlas.tmpi");
    let mut bytes = std::fs::read(&atlas).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&atlas, bytes).unwrap();
    let (done, found) = migrate(&at("alone"), &at("store"), &[]);
    assert!(done && found["pending"] == 1 && found["damaged"].as_array().unwrap().len() == 1, "{found}");
    let node = node(&at("store"), &at("a"), Role::All, Arc::new(pipeline()));
    node.wait(&id, "done");
}
