//! The fuzzer: the targets of `src/fuzzing.rs` on what libFuzzer finds, from the seeds on.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::Mutex;

use crate::command::{self, Fault, cargo, output, root, run_quietly};

/// Those of `src/fuzzing.rs`; a test there holds this list against them.
const TARGETS: [&str; 20] = [
    "container",
    "labels",
    "planes",
    "message",
    "units",
    "video",
    "vp9",
    "measured",
    "query",
    "jpeg",
    "png",
    "webp",
    "exif",
    "icc",
    "depth",
    "carried",
    "multipart",
    "patch",
    "strokes",
];
const SECONDS: u32 = 60;
/// Of a target in `cargo xtask nightly`.
pub const NIGHTLY_SECONDS: u32 = 300;
/// An input that takes longer is a finding.
const TIMEOUT: &str = "-timeout=20";
const MEMORY: &str = "-rss_limit_mb=2048";
/// What cargo-fuzz passes, but for the sanitizer of addresses: it needs a nightly compiler.
const COVERAGE: [&str; 7] = [
    "-Coverflow-checks=on",
    "-Cpasses=sancov-module",
    "-Cllvm-args=-sanitizer-coverage-level=4",
    "-Cllvm-args=-sanitizer-coverage-inline-8bit-counters",
    "-Cllvm-args=-sanitizer-coverage-pc-table",
    "-Cllvm-args=-sanitizer-coverage-trace-compares",
    "--cfg=fuzzing",
];

/// `[--seconds N] [TARGET…]`: every target, or those named, for so long each.
pub fn fuzz(args: &[String]) -> Result<(), Fault> {
    let (mut seconds, mut targets) = (SECONDS, Vec::new());
    let mut args = args.iter();
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--seconds" => {
                let wrong = || Fault::new("--seconds takes a whole number");
                seconds = args.next().and_then(|n| n.parse().ok()).ok_or_else(wrong)?;
            }
            other if TARGETS.contains(&other) => targets.extend(TARGETS.into_iter().filter(|t| *t == other)),
            other => return Err(Fault::new(format!("there is no target {other:?}; there are {}", TARGETS.join(", ")))),
        }
    }
    run(&targets, seconds)
}

/// Fuzzes the targets named, all of them where none is, for so many seconds each.
pub fn run(targets: &[&'static str], seconds: u32) -> Result<(), Fault> {
    let targets = if targets.is_empty() { TARGETS.to_vec() } else { targets.to_vec() };
    let triple = output("rustc", &["-vV"]).and_then(|v| v.lines().find_map(|l| l.strip_prefix("host: ").map(str::to_owned)));
    let triple = triple.ok_or_else(|| Fault::new("`rustc -vV` names no host"))?;
    // with a target named, build scripts are not instrumented
    let mut build =
        cargo(&["build", "--release", "--manifest-path", "fuzz/Cargo.toml", "--target-dir", "target/fuzz", "--target", &triple]);
    build.env("RUSTFLAGS", COVERAGE.join(" "));
    command::run(build)?;
    let program = root().join("target/fuzz").join(&triple).join("release/fuzz");
    // as many side by side as there are cores
    let all = Mutex::new(targets.into_iter());
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let worker = || {
        loop {
            let Some(name) = all.lock().map_or(None, |mut all| all.next()) else { return Ok(()) };
            one(&program, name, seconds)?;
        }
    };
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..cores).map(|_| scope.spawn(worker)).collect();
        workers.into_iter().try_for_each(|w| w.join().unwrap_or_else(|_| Err(Fault::new("a thread that fuzzes has ended"))))
    })
}

/// One target for so many seconds; what it says is shown where it finds something.
fn one(program: &Path, name: &str, seconds: u32) -> Result<(), Fault> {
    let (found, crashes) = (root().join("target/fuzz/corpus").join(name), root().join("target/fuzz/crashes").join(name));
    for folder in [&found, &crashes] {
        fs::create_dir_all(folder).map_err(|e| Fault::new(format!("{}: {e}", folder.display())))?;
    }
    let mut command = Command::new(program);
    command.env("TMPI_FUZZ", name).current_dir(root()).args([TIMEOUT, MEMORY, "-print_final_stats=1", "-verbosity=0"]);
    command.arg(format!("-max_total_time={seconds}")).arg(format!("-artifact_prefix={}/", crashes.display()));
    command.arg(&found).arg(root().join("fuzz/seeds").join(name));
    run_quietly(command)?;
    println!("{name}: {seconds} s, nothing found");
    Ok(())
}
