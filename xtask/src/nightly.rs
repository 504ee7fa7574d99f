//! `cargo xtask nightly`: what needs hours.

use std::process::Command;
use std::time::{SystemTime, UNIX_EPOCH};

use crate::command::{Fault, cargo, output, root, run};
use crate::steps::{self, AfterFailure, Step};
use crate::{fuzz, python, runtime, skipped, tools};

const STEPS: [Step; 18] = [
    Step { name: "tools", run: tools::fetch },
    Step { name: "ONNX Runtime", run: runtime::fetch },
    Step { name: "build", run: || run(cargo(&["build", "--release", "--workspace"])) },
    Step { name: "deployment files", run: python::deployment },
    Step { name: "OpenAPI", run: python::openapi_requests },
    Step { name: "faults", run: || load("faults.py", &[]) },
    Step { name: "crash", run: || load("crash.py", &[]) },
    Step { name: "scale", run: || load("scale.py", &[]) },
    Step { name: "bombs", run: || load("bombs.py", &[]) },
    Step { name: "torture", run: || load("torture.py", &[]) },
    Step { name: "slow", run: || load("slow.py", &[]) },
    Step { name: "views", run: || load("views.py", &[]) },
    Step { name: "start", run: || load("start.py", &[]) },
    Step { name: "live", run: || load("live.py", &[]) },
    Step { name: "options", run: || load("options.py", &[]) },
    Step { name: "memory", run: || load("memory.py", &[]) },
    Step { name: "mutants", run: mutants },
    Step { name: "fuzz", run: || fuzz::run(&[], fuzz::NIGHTLY_SECONDS) },
];

/// Runs all steps, or those named; a failure does not keep the others from running.
pub fn nightly(names: &[String]) -> Result<(), Fault> {
    skipped::clear()?;
    let result = steps::run(&[&[&STEPS]], names, AfterFailure::GoOn);
    skipped::print()?;
    result
}

/// Runs a script of `tests/load` with its moderate defaults; `--full` on the script itself takes longer.
fn load(script: &str, arguments: &[&str]) -> Result<(), Fault> {
    let mut command = Command::new("python3");
    command.arg(root().join("tests/load").join(script)).args(arguments).current_dir(root());
    tools::name_to(&mut command);
    runtime::name_to(&mut command);
    run(command)
}

/// Parts that the mutants of the core are divided into; one is tried each night.
const SHARDS: u64 = 22;

/// Changes the core and checks that a test notices.
fn mutants() -> Result<(), Fault> {
    if output("cargo", &["mutants", "--version"]).is_none() {
        run(cargo(&["install", "cargo-mutants", "--locked", "--quiet"]))?;
    }
    let day = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |t| t.as_secs() / (24 * 60 * 60));
    let shard = format!("{}/{SHARDS}", day % SHARDS);
    run(cargo(&["mutants", "--package", "tmpi-core", "--shard", &shard, "--sharding", "round-robin", "--output", "target"]))
}
