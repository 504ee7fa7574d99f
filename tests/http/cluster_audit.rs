//! `tmpi fsck` and `tmpi gc` on a store of objects that nodes use.

use std::net::SocketAddr;
use std::process::Command;

use serde_json::{Value, json};
use tmpi_render::PictureFormat;
use tmpi_testing::Engine;

use crate::client::{get, request};
use crate::cluster::{start, upload, wait_done};
use crate::fixture::picture;

const STORE: &str = "s3://photos/tmpi";
/// The engine looks at who signs, and at no signature.
const SIGNED: (&str, &str) =
    ("authorization", "AWS4-HMAC-SHA256 Credential=test/20260101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=0");

/// Runs one of the two and gives whether it succeeded and what it found.
fn asked(engine: SocketAddr, arguments: &[&str]) -> (bool, Value) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
    command.args(arguments).args(["--store", STORE, "--json"]).envs(Engine::s3_variables(engine));
    let out = command.output().unwrap();
    let found = serde_json::from_slice(&out.stdout);
    (out.status.success(), found.unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&out.stderr))))
}

/// Names of all objects.
fn objects(engine: SocketAddr) -> Vec<String> {
    let listed = String::from_utf8(get(engine, "/photos?list-type=2&prefix=tmpi/").body).unwrap();
    listed.split("<Key>tmpi/").skip(1).map(|rest| rest.split_once("</Key>").unwrap().0.to_owned()).collect()
}

#[test]
fn a_store_of_objects_is_checked_mended_and_cleaned() {
    let Some(engine) = Engine::s3() else { return };
    let dir = tempfile::tempdir().unwrap();
    let node = |name: &str| start(&dir.path().join(name), STORE, &["--role", name], &Engine::s3_variables(engine.addr));
    let put =
        |name: &str, bytes: &[u8]| assert_eq!(request(engine.addr, "PUT", &format!("/photos/tmpi/{name}"), &[SIGNED], bytes).status, 200);
    let serve = node("serve");
    let id = upload(serve.addr, &picture(1, PictureFormat::Jpeg)).expect("it is accepted");
    let (sound, found) = asked(engine.addr, &["fsck"]);
    assert!(sound && found["photos"] == 1 && found["pending"] == 1, "{found}");
    let marker = objects(engine.addr).into_iter().find(|name| name.starts_with("pending/")).unwrap();
    put(&marker, b"{\"version\": 1");
    let (sound, found) = asked(engine.addr, &["fsck"]);
    assert!(!sound && found["damaged"] == json!([marker]) && found["mended"] == 0, "{found}");
    let (sound, found) = asked(engine.addr, &["fsck", "--mend"]);
    assert!(sound && found["damaged"] == json!([marker]) && found["mended"] == 1, "{found}");
    let _worker = node("work");
    wait_done(serve.addr, &id);
    let left = format!("blobs/{id}/0000000000007-ab-1.atlas.tmpi");
    put(&left, b"7");
    for (arguments, removed) in [(&["gc", "--dry-run"][..], 0), (&["gc"][..], 1)] {
        let (done, found) = asked(engine.addr, arguments);
        assert!(done && found["left_over"] == json!([left]) && found["removed"] == removed, "{found}");
    }
    let (sound, found) = asked(engine.addr, &["fsck"]);
    assert!(sound && found["done"] == 1 && found["pending"] == 0 && found["left_over"] == json!([]), "{found}");
    assert_eq!(get(serve.addr, &format!("/v1/photos/{id}/atlas")).status, 200);
    let atlas = objects(engine.addr).into_iter().find(|name| name.ends_with(".atlas.tmpi")).unwrap();
    assert_eq!(request(engine.addr, "DELETE", &format!("/photos/tmpi/{atlas}"), &[SIGNED], &[]).status, 204);
    let (sound, found) = asked(engine.addr, &["fsck", "--mend"]);
    assert!(!sound && found["missing"] == json!([atlas]), "{found}");
}
