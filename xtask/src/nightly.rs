//! `cargo xtask nightly`: checks that take hours.

use std::fs;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use serde_json::Value;

use crate::command::{Fault, Profile, built, cargo, data, output, root, run, say, target, within_minutes};
use crate::steps::{self, AfterFailure, Step};
use crate::{fuzz, python, runtime, rust_tests, skipped, tools};

const STEPS: [Step; 21] = [
    Step { name: "tools", run: tools::fetch },
    Step { name: "ONNX Runtime", run: runtime::fetch },
    Step { name: "build", run: rust_tests::build },
    Step { name: "deployment files", run: python::deployment },
    Step { name: "OpenAPI", run: python::openapi_requests },
    Step { name: "faults", run: || load("faults.py") },
    Step { name: "crash", run: || load("crash.py") },
    Step { name: "cluster", run: || load("cluster.py") },
    Step { name: "bombs", run: || load("bombs.py") },
    Step { name: "broken files", run: || load("broken_files.py") },
    Step { name: "slow", run: || load("slow.py") },
    Step { name: "views", run: || load("views.py") },
    Step { name: "start time", run: || load("start_time.py") },
    Step { name: "live", run: || load("live.py") },
    Step { name: "extreme options", run: || load("extreme_options.py") },
    Step { name: "report figures", run: || load("report_figures.py") },
    Step { name: "making memory", run: || load("making_memory.py") },
    Step { name: "cgroup", run: || load("cgroup.py") },
    Step { name: "bench", run: bench },
    Step { name: "mutants", run: mutants },
    Step { name: "fuzz", run: || fuzz::fuzz_all(minutes()) },
];

/// Flag: time limit of each step in minutes.
const MINUTES_FLAG: &str = "--minutes";
/// Default limit; the longest script, `making_memory.py`, takes about an hour.
const MINUTES: u64 = 90;
static MAX_MINUTES: AtomicU64 = AtomicU64::new(MINUTES);

/// `[--minutes N] [STEP…]`: runs all steps, or the named ones. A failure does not stop the others.
///
/// The fuzzers share N minutes, and mutants are tested for N minutes. Any other step that takes longer is stopped and fails.
pub fn nightly(args: &[String]) -> Result<(), Fault> {
    let mut names = args.to_vec();
    if let Some(at) = names.iter().position(|a| a == MINUTES_FLAG) {
        let wrong = || Fault::new(format!("{MINUTES_FLAG} takes a whole number"));
        let minutes = names.get(at + 1).and_then(|n| n.parse().ok()).filter(|n| *n > 0).ok_or_else(wrong)?;
        MAX_MINUTES.store(minutes, Ordering::Relaxed);
        names.drain(at..at + 2);
    }
    skipped::clear()?;
    let result = steps::run(&[&[&STEPS]], &names, AfterFailure::GoOn);
    skipped::print()?;
    result
}

fn minutes() -> u64 {
    MAX_MINUTES.load(Ordering::Relaxed)
}

/// Runs a script of `tests/load` with its moderate defaults. For a longer run, start the script yourself with `--full`.
fn load(script: &str) -> Result<(), Fault> {
    let mut command = within_minutes(minutes(), "python3");
    command.arg(root().join("tests/load").join(script)).env("TMPI", built(Profile::Checks, "tmpi")).env("TMPI_DATA", data());
    tools::set_env(&mut command);
    runtime::set_env(&mut command);
    run(command)
}

/// Runs every experiment of `tmpi-lab bench` on few scenes, and checks that its results are whole.
fn bench() -> Result<(), Fault> {
    let (lab, folder) = (built(Profile::Checks, "tmpi-lab"), target().join("bench"));
    let lab = lab.to_string_lossy();
    let mut command = within_minutes(minutes(), &lab);
    command.args(["bench", "--quick", "--output"]).arg(&folder);
    runtime::set_env(&mut command);
    run(command)?;
    let file = folder.join("results.json");
    let text = fs::read_to_string(&file).map_err(|e| Fault::at(&file, &e))?;
    let results: Value = serde_json::from_str(&text).map_err(|e| Fault::new(format!("{}: {e}", file.display())))?;
    for reason in results["skipped"].as_array().into_iter().flatten().filter_map(Value::as_str) {
        skipped::add("network", "tmpi-lab bench", reason)?;
    }
    let help = output(&lab, &["bench", "--help"]).unwrap_or_default();
    let only = help.split_once("--only").and_then(|(_, rest)| rest.split_once("[possible values: "));
    let names = only.and_then(|(_, rest)| rest.split_once(']')).map_or("", |(names, _)| names);
    // `photos` needs a folder of photos
    let wrong: Vec<&str> = names.split(", ").filter(|name| *name != "photos" && !is_whole(&results, name)).collect();
    if wrong.is_empty() {
        Ok(())
    } else {
        Err(Fault::new(format!("no results, no default, or figures that are not finite: {}", wrong.join(", "))))
    }
}

/// Experiments that compare what no option chooses.
const WITHOUT_DEFAULT: [&str; 3] = ["scaling", "ramps", "discretisation"];

/// Whether the results of a benchmark have an experiment, or skipped some, its default is marked, and its figures are finite.
fn is_whole(results: &Value, name: &str) -> bool {
    let list = |of: &Value| of.as_array().cloned().unwrap_or_default();
    let Some(experiment) = list(&results["experiments"]).into_iter().find(|e| e["id"] == name) else {
        return !list(&results["skipped"]).is_empty();
    };
    let points: Vec<Value> = list(&experiment["curves"]).iter().flat_map(|curve| list(&curve["points"])).collect();
    // JSON has null for a number that is not finite
    let is_finite = |p: &Value| p["x"].is_number() && p["y"].is_number() && list(&p["figures"]).iter().all(|figure| figure[1].is_number());
    let has_default = WITHOUT_DEFAULT.contains(&name) || points.iter().any(|p| p["default"] == true);
    has_default && !points.is_empty() && points.iter().all(is_finite)
}

/// Mutates the core and checks that a test catches each mutant, until the time is up. Each day tests other mutants.
fn mutants() -> Result<(), Fault> {
    if output("cargo", &["mutants", "--version"]).is_none() {
        run(cargo(&["install", "cargo-mutants", "--locked", "--quiet"]))?;
    }
    let list =
        output("cargo", &["mutants", "--package", "tmpi-core", "--list"]).ok_or_else(|| Fault::new("`cargo mutants --list` failed"))?;
    let all = list.lines().count().max(1);
    let day = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |t| t.as_secs() / (24 * 60 * 60));
    // about two mutants a minute: choose the number of shards so that one fits the time
    let parts = (all as u64).div_ceil(2 * minutes()).max(1);
    let mut command = within_minutes(minutes(), "cargo");
    command.args(["mutants", "--package", "tmpi-core", "--sharding", "round-robin", "--output", "target"]);
    command.arg("--shard").arg(format!("{}/{parts}", day % parts));
    // missed mutants count even if the time ran out
    let result = run(command);
    let lines = |name: &str| fs::read_to_string(target().join("mutants.out").join(name)).unwrap_or_default();
    let (caught, missed) = (lines("caught.txt"), lines("missed.txt"));
    say(&format!("{} of {all} mutants tested, {} caught", caught.lines().count() + missed.lines().count(), caught.lines().count()));
    if missed.is_empty() && !caught.is_empty() {
        Ok(())
    } else {
        result.and_then(|()| Err(Fault::new(format!("no test catches\n{missed}"))))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn results_lack_nothing_but_what_was_skipped() {
        let of = |y: f64, default: bool, skipped: &[&str]| {
            let point = json!({ "x": 1.0, "y": y, "default": default, "figures": [["ms", 2.0]] });
            json!({ "experiments": [{ "id": "planes", "curves": [{ "points": [point] }] }], "skipped": skipped })
        };
        assert!(is_whole(&of(3.0, true, &[]), "planes") && is_whole(&of(3.0, true, &["no network"]), "depth"));
        assert!(!is_whole(&of(3.0, true, &[]), "depth"));
        assert!(!is_whole(&of(f64::NAN, true, &[]), "planes") && !is_whole(&of(3.0, false, &[]), "planes"));
    }
}
