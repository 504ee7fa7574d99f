//! The fuzzer: the targets of `src/fuzzing.rs` on what libFuzzer finds, from the seeds on.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;

use crate::command::{self, Fault, cargo, cores, output, root, run_quietly};

/// The targets of `src/fuzzing.rs`; a test there compares the lists.
const TARGETS: [&str; 28] = [
    "container",
    "built",
    "levels",
    "labels",
    "planes",
    "message",
    "room",
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
    "proxy",
    "forwarded",
    "link",
    "names",
    "onnx",
    "config",
];
const SECONDS: u32 = 60;
/// An input that takes longer is a finding.
const TIMEOUT: &str = "-timeout=20";
/// Largest resident memory. A target needs a tenth of it; the sanitizer's shadow and quarantine need the rest.
const MEMORY: &str = "-rss_limit_mb=3072";
/// Threads of libraries are not joined, so their memory would count as leaked.
const LEAKS: &str = "-detect_leaks=0";
/// Environment variable: the folder of inputs that earlier runs have found; `target/fuzz/corpus` without it.
const CORPUS: &str = "TMPI_FUZZ_CORPUS";
/// What cargo-fuzz passes. The sanitizer needs a nightly compiler, or [`BOOTSTRAP`].
const COVERAGE: [&str; 8] = [
    "-Zsanitizer=address",
    "-Coverflow-checks=on",
    "-Cpasses=sancov-module",
    "-Cllvm-args=-sanitizer-coverage-level=4",
    "-Cllvm-args=-sanitizer-coverage-inline-8bit-counters",
    "-Cllvm-args=-sanitizer-coverage-pc-table",
    "-Cllvm-args=-sanitizer-coverage-trace-compares",
    "--cfg=fuzzing",
];
/// Environment variable that lets a stable compiler take flags of a nightly one.
const BOOTSTRAP: &str = "RUSTC_BOOTSTRAP";
/// The same for what is C: zstd and libwebp.
const C_FLAGS: &str = "-fsanitize=address -fno-omit-frame-pointer -O1";

/// `[--seconds N] [TARGET…]`: runs every target, or those named, for N seconds each.
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

/// Fuzzes the named targets, or all if none is named, for `seconds` each.
pub fn run(targets: &[&'static str], seconds: u32) -> Result<(), Fault> {
    let targets = if targets.is_empty() { TARGETS.to_vec() } else { targets.to_vec() };
    let program = build()?;
    // as many side by side as there are cores
    let all = Mutex::new(targets.into_iter());
    let worker = || {
        let mut faults = Vec::new();
        while let Some(name) = all.lock().ok().and_then(|mut all| all.next()) {
            faults.extend(one(&program, name, seconds).err().map(|fault| fault.to_string()));
        }
        faults
    };
    let faults: Vec<String> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..cores()).map(|_| scope.spawn(worker)).collect();
        workers.into_iter().flat_map(|w| w.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    });
    if faults.is_empty() { Ok(()) } else { Err(Fault::new(faults.join("\n\n"))) }
}

/// Seconds for each target if all together may take `minutes`.
pub fn seconds_each(minutes: u64) -> u32 {
    u32::try_from(minutes * 60 * cores() as u64 / TARGETS.len() as u64).unwrap_or(u32::MAX).max(1)
}

fn build() -> Result<PathBuf, Fault> {
    let triple = output("rustc", &["-vV"]).and_then(|v| v.lines().find_map(|l| l.strip_prefix("host: ").map(str::to_owned)));
    let triple = triple.ok_or_else(|| Fault::new("`rustc -vV` names no host"))?;
    // with a target named, build scripts are not instrumented
    let mut build =
        cargo(&["build", "--release", "--manifest-path", "fuzz/Cargo.toml", "--target-dir", "target/fuzz", "--target", &triple]);
    build.env("RUSTFLAGS", COVERAGE.join(" ")).env(BOOTSTRAP, "1");
    let of_target = triple.replace('-', "_");
    build.env(format!("CFLAGS_{of_target}"), C_FLAGS).env(format!("CXXFLAGS_{of_target}"), C_FLAGS);
    command::run(build)?;
    Ok(root().join("target/fuzz").join(&triple).join("release/fuzz"))
}

/// Runs one target: prints a line of figures, or its whole output if it finds something.
fn one(program: &Path, name: &str, seconds: u32) -> Result<(), Fault> {
    let corpus = std::env::var_os(CORPUS).filter(|v| !v.is_empty()).map_or_else(|| root().join("target/fuzz/corpus"), PathBuf::from);
    let (found, crashes) = (corpus.join(name), root().join("target/fuzz/crashes").join(name));
    for folder in [&found, &crashes] {
        fs::create_dir_all(folder).map_err(|e| Fault::new(format!("{}: {e}", folder.display())))?;
    }
    let mut command = Command::new(program);
    // one thread each: as many targets as cores run side by side
    command.env("TMPI_FUZZ", name).env("RAYON_NUM_THREADS", "1").current_dir(root()).args([TIMEOUT, MEMORY, LEAKS, "-print_final_stats=1"]);
    command.arg(format!("-max_total_time={seconds}")).arg(format!("-artifact_prefix={}/", crashes.display()));
    command.arg(&found).arg(root().join("fuzz/seeds").join(name));
    let said = run_quietly(command)?;
    println!("{}", Figures::read(&said).line(name, seconds));
    Ok(())
}

/// What libFuzzer says of a run at its end.
#[derive(Debug, Default, PartialEq)]
struct Figures {
    runs: u64,
    edges: u64,
}

impl Figures {
    fn read(said: &str) -> Self {
        let number = |text: &str| text.split_whitespace().next().and_then(|n| n.parse().ok());
        let after = |name: &str| said.rmatch_indices(name).find_map(|(at, _)| number(&said[at + name.len()..])).unwrap_or(0);
        Self { runs: after("stat::number_of_executed_units:"), edges: after(" cov: ") }
    }

    fn line(&self, name: &str, seconds: u32) -> String {
        let each = self.runs / u64::from(seconds.max(1));
        format!("{name:<10} {seconds:5} s {:9} inputs {each:6} a second {:6} edges, nothing found", self.runs, self.edges)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_read_from_the_end_of_a_run() {
        let said = "#2\tINITED cov: 12 ft: 13 corp: 1/1b\n#9\tDONE   cov: 345 ft: 900 corp: 7/9b\nstat::number_of_executed_units: 9000\n";
        let figures = Figures::read(said);
        assert_eq!(figures, Figures { runs: 9000, edges: 345 });
        assert!(figures.line("jpeg", 60).contains(" 150 a second"));
    }
}
