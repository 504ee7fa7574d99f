//! Runs the targets of `fuzz/targets` under libFuzzer, starting from the seeds in `fuzz/seeds`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::command::{self, Fault, cargo, cores, in_parallel, output, root, run_quietly};

/// Folder with the seeds of each target.
const SEEDS: &str = "fuzz/seeds";
const SECONDS: u32 = 60;
/// An input that takes longer than this counts as a finding.
const TIMEOUT: &str = "-timeout=20";
/// Limit of resident memory. A target needs a tenth of it; the sanitizer's shadow and quarantine need the rest.
const MEMORY: &str = "-rss_limit_mb=3072";
/// Off: libraries do not join their threads, so their memory would count as leaked.
const LEAKS: &str = "-detect_leaks=0";
/// Environment variable that names the folder of inputs from earlier runs; default `target/fuzz/corpus`.
const CORPUS: &str = "TMPI_FUZZ_CORPUS";
/// Flags that cargo-fuzz passes too. The sanitizer needs a nightly compiler, or [`BOOTSTRAP`].
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
/// Environment variable that makes a stable compiler accept nightly flags.
const BOOTSTRAP: &str = "RUSTC_BOOTSTRAP";
/// The same sanitizer for the C libraries zstd and libwebp. GCC takes constant tables of functions, such as one of zstd's, for variables that
/// go out of scope.
const C_FLAGS: &str = "-fsanitize=address -fno-sanitize-address-use-after-scope -fno-omit-frame-pointer -O1";

/// Names of all targets: a test checks that they are those of the folders of seeds.
fn targets() -> Result<Vec<String>, Fault> {
    let folders = fs::read_dir(root().join(SEEDS)).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let folders = folders.map_err(|e| Fault::at(Path::new(SEEDS), &e))?;
    let mut names: Vec<String> = folders.iter().map(|folder| folder.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    Ok(names)
}

/// `[--seconds N] [TARGET…]`: fuzzes the named targets, or all, for N seconds each.
pub fn fuzz(args: &[String]) -> Result<(), Fault> {
    let (all, mut seconds, mut named) = (targets()?, SECONDS, Vec::new());
    let mut args = args.iter();
    while let Some(arg) = args.next() {
        if arg == "--seconds" {
            let wrong = || Fault::new("--seconds takes a whole number");
            seconds = args.next().and_then(|n| n.parse().ok()).ok_or_else(wrong)?;
        } else if all.contains(arg) {
            named.push(arg.clone());
        } else {
            return Err(Fault::new(format!("unknown target {arg:?}; expected one of {}", all.join(", "))));
        }
    }
    run(if named.is_empty() { &all } else { &named }, seconds)
}

/// Fuzzes all targets, which share `minutes`.
pub fn fuzz_all(minutes: u64) -> Result<(), Fault> {
    let all = targets()?;
    let seconds = minutes * 60 * cores() as u64 / all.len().max(1) as u64;
    run(&all, u32::try_from(seconds).unwrap_or(u32::MAX).max(1))
}

/// Fuzzes targets for `seconds` each.
fn run(targets: &[String], seconds: u32) -> Result<(), Fault> {
    let program = build()?;
    let ended = in_parallel(cores(), targets.iter(), |name| one(&program, name, seconds));
    let faults: Vec<String> = ended.into_iter().filter_map(Result::err).map(|fault| fault.to_string()).collect();
    if faults.is_empty() { Ok(()) } else { Err(Fault::new(faults.join("\n\n"))) }
}

fn build() -> Result<PathBuf, Fault> {
    let triple = output("rustc", &["-vV"]).and_then(|v| v.lines().find_map(|l| l.strip_prefix("host: ").map(str::to_owned)));
    let triple = triple.ok_or_else(|| Fault::new("`rustc -vV` names no host"))?;
    // with an explicit target, cargo does not instrument build scripts
    let mut build =
        cargo(&["build", "--release", "--manifest-path", "fuzz/Cargo.toml", "--target-dir", "target/fuzz", "--target", &triple]);
    build.env("RUSTFLAGS", COVERAGE.join(" ")).env(BOOTSTRAP, "1");
    let of_target = triple.replace('-', "_");
    build.env(format!("CFLAGS_{of_target}"), C_FLAGS).env(format!("CXXFLAGS_{of_target}"), C_FLAGS);
    command::run(build)?;
    Ok(root().join("target/fuzz").join(&triple).join("release/fuzz"))
}

/// Runs one target. Prints the number of its inputs, or fails with its whole output if it finds something.
fn one(program: &Path, name: &str, seconds: u32) -> Result<(), Fault> {
    let corpus = std::env::var_os(CORPUS).filter(|v| !v.is_empty()).map_or_else(|| root().join("target/fuzz/corpus"), PathBuf::from);
    let (found, crashes) = (corpus.join(name), root().join("target/fuzz/crashes").join(name));
    for folder in [&found, &crashes] {
        fs::create_dir_all(folder).map_err(|e| Fault::at(folder, &e))?;
    }
    let mut command = Command::new(program);
    // one thread each, because one target runs on each core
    command.env("TMPI_FUZZ", name).env("RAYON_NUM_THREADS", "1").current_dir(root()).args([TIMEOUT, MEMORY, LEAKS, "-print_final_stats=1"]);
    command.arg(format!("-max_total_time={seconds}")).arg(format!("-artifact_prefix={}/", crashes.display()));
    command.arg(&found).arg(root().join(SEEDS).join(name));
    let log = run_quietly(command)?;
    let inputs = log.lines().rev().find_map(|line| line.strip_prefix("stat::number_of_executed_units:")).unwrap_or_default();
    println!("{name:<10} {seconds:5} s {:>9} inputs, nothing found", inputs.trim());
    Ok(())
}
