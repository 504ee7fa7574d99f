//! Checks licences, versions and sources of dependencies against deny.toml. `cargo deny` also checks advisories.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

use serde_json::Value;
use spdx::{Expression, LicenseReq, ParseMode};

fn deny_toml() -> toml::Table {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("deny.toml")).unwrap().parse().unwrap()
}

/// All packages in `Cargo.lock`, for all platforms and features.
fn packages() -> Vec<Value> {
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".into());
    let mut command = Command::new(cargo);
    // not `--offline`: packages of other platforms may not be downloaded yet
    command.args(["metadata", "--locked", "--all-features", "--format-version", "1"]).current_dir(env!("CARGO_MANIFEST_DIR"));
    let out = command.output().expect("cargo runs");
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let metadata: Value = serde_json::from_slice(&out.stdout).expect("metadata is JSON");
    metadata["packages"].as_array().expect("a list of packages").clone()
}

/// Packages from outside the workspace.
fn external_packages() -> Vec<Value> {
    packages().into_iter().filter(|p| !p["source"].is_null()).collect()
}

fn text<'a>(value: &'a Value, field: &str) -> &'a str {
    value[field].as_str().unwrap_or_default()
}

/// Strings of a list in deny.toml.
fn words(list: &toml::Value) -> Vec<&str> {
    list.as_array().unwrap().iter().map(|w| w.as_str().unwrap()).collect()
}

/// Whether `allowed` satisfies a licence expression; `A/B` is an old form of `A OR B`.
fn is_permitted(licence: &str, allowed: &[Expression]) -> bool {
    let is_allowed = |req: &LicenseReq| allowed.iter().any(|a| a.requirements().any(|r| r.req == *req));
    Expression::parse_mode(licence, ParseMode::LAX).is_ok_and(|e| e.evaluate(is_allowed))
}

/// Whether an expression contains this licence, including its exceptions.
fn contains_licence(expression: &Expression, licence: &str) -> bool {
    Expression::parse(licence).is_ok_and(|l| l.requirements().all(|l| expression.requirements().any(|r| r.req == l.req)))
}

/// Packages with several versions.
fn duplicates(packages: &[Value]) -> BTreeMap<&str, BTreeSet<&str>> {
    let mut all = BTreeMap::<&str, BTreeSet<&str>>::new();
    for p in packages {
        all.entry(text(p, "name")).or_default().insert(text(p, "version"));
    }
    all.retain(|_, versions| versions.len() > 1);
    all
}

fn expressions(list: &toml::Value) -> Vec<Expression> {
    words(list).into_iter().map(|l| Expression::parse(l).unwrap()).collect()
}

#[test]
fn every_licence_is_allowed_and_every_allowed_one_used() {
    let (deny, packages) = (deny_toml(), external_packages());
    let allowed = expressions(&deny["licenses"]["allow"]);
    assert!(packages.len() > 200, "{}", packages.len());
    let bad: Vec<_> =
        packages.iter().filter(|p| !is_permitted(text(p, "license"), &allowed)).map(|p| (text(p, "name"), text(p, "license"))).collect();
    assert!(bad.is_empty(), "{bad:?}");
    // an unused entry would allow a later dependency unnoticed
    for word in words(&deny["licenses"]["allow"]) {
        let has_licence = |p: &&Value| Expression::parse_mode(text(p, "license"), ParseMode::LAX).is_ok_and(|e| contains_licence(&e, word));
        assert!(packages.iter().any(|p| has_licence(&p)), "no dependency has the licence {word}");
    }
}

#[test]
fn licence_expressions_are_evaluated() {
    let allowed = expressions(&toml::Value::from(vec!["MIT", "ISC"]));
    for (licence, want) in [
        ("MIT", true),
        ("GPL-3.0-only", false),
        ("MIT OR GPL-3.0-only", true),
        ("MIT AND GPL-3.0-only", false),
        ("(MIT OR Apache-2.0) AND ISC", true),
        ("Apache-2.0/MIT", true),
        ("", false),
        ("mine", false),
    ] {
        assert_eq!(is_permitted(licence, &allowed), want, "{licence:?}");
    }
}

#[test]
fn only_listed_crates_have_duplicate_versions() {
    let (deny, packages) = (deny_toml(), external_packages());
    let listed: BTreeSet<&str> = deny["bans"]["skip"].as_array().unwrap().iter().map(|s| s["crate"].as_str().unwrap()).collect();
    let (mut more, mut used) = (Vec::new(), BTreeSet::new());
    for (name, versions) in duplicates(&packages) {
        let all = versions.iter().map(|v| format!("{name}@{v}"));
        let (skipped, rest): (Vec<_>, Vec<_>) = all.partition(|v| listed.contains(v.as_str()));
        used.extend(skipped);
        if rest.len() > 1 {
            more.push(rest);
        }
    }
    assert!(more.is_empty(), "duplicate versions: {more:?}");
    let unused: Vec<_> = listed.iter().filter(|s| !used.contains(**s)).collect();
    assert!(unused.is_empty(), "listed, but not duplicated: {unused:?}");
}

#[test]
fn packages_come_from_crates_io_with_fixed_versions() {
    let deny = deny_toml();
    assert_eq!(deny["sources"]["unknown-registry"].as_str(), Some("deny"));
    for p in external_packages() {
        assert_eq!(text(&p, "source"), "registry+https://github.com/rust-lang/crates.io-index", "{}", text(&p, "name"));
    }
    assert_eq!(deny["bans"]["wildcards"].as_str(), Some("deny"));
    for p in packages().iter().filter(|p| p["source"].is_null()) {
        for d in p["dependencies"].as_array().unwrap().iter().filter(|d| d["path"].is_null()) {
            assert_ne!(text(d, "req"), "*", "{} of {}", text(d, "name"), text(p, "name"));
        }
    }
}

#[test]
fn banned_crates_are_absent() {
    let (deny, packages) = (deny_toml(), external_packages());
    let all = deny["bans"]["deny"].as_array().unwrap();
    assert!(!all.is_empty());
    for banned in all {
        let name = banned["crate"].as_str().unwrap();
        assert!(packages.iter().all(|p| text(p, "name") != name), "{name}: {:?}", banned.get("reason"));
    }
}
