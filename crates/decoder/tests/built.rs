//! Checks that the wasm modules are built from the current sources: `crates/decoder/built.txt` has the hashes of sources and modules.
//! `cargo xtask wasm` writes both.
#![allow(clippy::unwrap_used, reason = "a test")]

use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

/// Sources of the modules, without files that only tests use.
const SOURCES: [&str; 12] = [
    "crates/core/Cargo.toml",
    "crates/core/build.rs",
    "crates/core/src",
    "crates/decoder/Cargo.toml",
    "crates/decoder/src",
    "crates/decoder/wasm32-std.sh",
    "crates/live-decoder/Cargo.toml",
    "crates/live-decoder/src",
    "crates/unpacker/Cargo.toml",
    "crates/unpacker/src",
    "proto/live.proto",
    "proto/tmpi.proto",
];
const TESTS: [&str; 3] = ["tests.rs", "fixtures.rs", "fuzzing.rs"];
/// Packages whose code is part of the modules.
const PACKAGES: [&str; 4] = ["h264-reader", "prost", "ruzstd", "thiserror"];

fn files(path: &Path, found: &mut Vec<PathBuf>) {
    if path.is_dir() {
        for entry in std::fs::read_dir(path).unwrap() {
            files(&entry.unwrap().path(), found);
        }
    } else if !TESTS.iter().any(|name| path.ends_with(name)) {
        found.push(path.to_owned());
    }
}

/// A source without the unit tests at its end, which are not part of a module.
fn shipped(source: &str) -> &str {
    source.split_once("\n#[cfg(test)]\nmod tests {").map_or(source, |(code, _)| code)
}

fn hex(hash: Sha256) -> String {
    hash.finalize().iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"))
}

#[test]
fn the_modules_are_built_from_the_current_sources() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut found = Vec::new();
    for name in SOURCES {
        files(&root.join(name), &mut found);
    }
    let name = |path: &Path| path.strip_prefix(&root).unwrap().to_string_lossy().replace('\\', "/");
    found.sort_by_key(|path| name(path));
    let mut hash = Sha256::new();
    for path in found {
        hash.update(name(&path));
        hash.update(shipped(&std::fs::read_to_string(&path).unwrap().replace("\r\n", "\n")));
    }
    let lock = std::fs::read_to_string(root.join("Cargo.lock")).unwrap();
    for package in PACKAGES {
        let named = format!("name = \"{package}\"\n");
        hash.update(lock.split("[[package]]\n").find(|p| p.starts_with(&named)).unwrap());
    }
    let module = |name: &str| hex(Sha256::new_with_prefix(std::fs::read(root.join("static").join(name)).unwrap()));
    let [decoder, unpacker, live] = ["decode/decoder.wasm", "decode/unpacker.wasm", "live/decoder.wasm"].map(module);
    let now = format!("sources {}\ndecoder {decoder}\nunpacker {unpacker}\nlive {live}\n", hex(hash));
    let kept = root.join("crates/decoder/built.txt");
    if std::env::var("TMPI_BLESS").is_ok_and(|v| v == "wasm") {
        std::fs::write(&kept, &now).unwrap();
    }
    let then = std::fs::read_to_string(&kept).unwrap();
    assert_eq!(now, then, "static/*/*.wasm are stale: `cargo xtask wasm` builds them");
}
