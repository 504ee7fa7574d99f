//! ARCHITECTURE.md holds: the picture of the crates is what cargo says, arrows run one way, every place named is there.
//!
//! `TMPI_BLESS=architecture cargo test --release --workspace --test architecture` draws the picture anew.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

/// The crates along the way of a photo: each may know those before it alone.
const ORDER: [&str; 11] = [
    "tmpi-core",
    "tmpi-client",
    "tmpi-decoder",
    "tmpi-live-decoder",
    "tmpi-unpacker",
    "tmpi-library",
    "tmpi-render",
    "tmpi-pipeline",
    "tmpi-live",
    "tmpi-lab",
    "tmpi",
];
const OPENS: &str = "```mermaid\ngraph LR\n";
const CLOSES: &str = "```\n<!-- /crates -->";

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Pairs (who, whom) of crates of this workspace, of which the first knows the second in ordinary builds.
fn arrows() -> BTreeSet<(String, String)> {
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".into());
    let out = Command::new(cargo)
        .current_dir(root())
        .args(["metadata", "--no-deps", "--offline", "--format-version", "1"])
        .output()
        .expect("cargo runs");
    let metadata: Value = serde_json::from_slice(&out.stdout).expect("metadata is JSON");
    let text = |v: &Value| v.as_str().unwrap_or_default().to_owned();
    let packages = metadata["packages"].as_array().expect("a list of packages");
    let dependencies = |p: &Value| {
        let own = text(&p["name"]);
        let all = p["dependencies"].as_array().cloned().unwrap_or_default();
        all.into_iter().filter(|d| d["path"].is_string() && d["kind"].is_null()).map(move |d| (own.clone(), text(&d["name"])))
    };
    packages.iter().flat_map(dependencies).collect()
}

#[test]
fn the_picture_of_the_crates_is_what_cargo_says() {
    let drawn = arrows().iter().map(|(who, whom)| format!("  {whom} --> {who}\n")).collect::<Vec<_>>().concat();
    let path = root().join("ARCHITECTURE.md");
    let page = std::fs::read_to_string(&path).unwrap();
    let from = page.find(OPENS).expect("the picture's begin") + OPENS.len();
    let to = from + page[from..].find(CLOSES).expect("the picture's end");
    if std::env::var("TMPI_BLESS").is_ok_and(|v| v == "architecture") {
        std::fs::write(&path, [&page[..from], &drawn, &page[to..]].concat()).unwrap();
    } else {
        assert_eq!(page[from..to], drawn);
    }
}

#[test]
fn arrows_run_one_way() {
    let place = |name: &str| ORDER.iter().position(|o| *o == name);
    let arrows = arrows();
    assert!(arrows.len() >= 6, "{arrows:?}");
    for (who, whom) in arrows.iter().filter(|(who, _)| who != "xtask") {
        let (Some(a), Some(b)) = (place(who), place(whom)) else { panic!("{who} or {whom} has no place in the order") };
        assert!(b < a, "{who} knows {whom}");
    }
}

#[test]
fn the_program_links_nothing_of_the_lab() {
    let arrows = arrows();
    let mut linked = BTreeSet::from(["tmpi"]);
    let mut reached = 0;
    while reached < linked.len() {
        reached = linked.len();
        let next: Vec<&str> = arrows.iter().filter(|(who, _)| linked.contains(who.as_str())).map(|(_, whom)| whom.as_str()).collect();
        linked.extend(next);
    }
    assert!(linked.contains("tmpi-core") && linked.contains("tmpi-pipeline"), "{linked:?}");
    assert!(!linked.contains("tmpi-lab"), "{linked:?}");
}

#[test]
fn every_place_that_is_named_is_there() {
    let page = std::fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap();
    let named: Vec<&str> = page.split('`').skip(1).step_by(2).filter(|n| n.contains('/') && !n.contains(' ')).collect();
    assert!(named.len() > 20, "{named:?}");
    for name in named {
        assert!(root().join(name).exists(), "{name}");
    }
}
