//! Checks written in Python.

use std::fs;
use std::path::PathBuf;
use std::process::Command;

use crate::command::{Fault, Profile, built, data, output, root, run, run_quietly, say};
use crate::{runtime, skipped, tools};

/// Imports of the training tests beyond the standard library.
const TRAINING: &str = "import cv2, numpy, onnx, onnxruntime, torch";

/// Unit tests of `training/`.
///
/// They need PyTorch, a download of 3 GB. If `CI` is set, this installs it outside the clone; otherwise the tests are skipped, with a hint.
pub fn training() -> Result<(), Fault> {
    let python = if output("python3", &["-c", TRAINING]).is_some() {
        "python3".into()
    } else if std::env::var_os("CI").is_some() {
        environment("training", "training/tests/requirements.txt")?
    } else {
        let reason = "python3 has no torch; install it with `pip install -r training/requirements.txt` (3 GB)";
        return skipped::add("torch", "training/tests", reason);
    };
    let mut tests = Command::new(python);
    tests
        .args(["-m", "unittest", "discover", "--start-directory", "tests", "--top-level-directory", "."])
        .current_dir(root().join("training"));
    // absolute, because the tests run in another folder
    tests.env("TMPI_DATA", data());
    run(tests)
}

/// The Python of a virtual environment with exactly these packages; creates it if it is missing or out of date.
fn environment(name: &str, requirements: &str) -> Result<PathBuf, Fault> {
    let folder = cache(name);
    let python = folder.join("bin/python3");
    let (wanted, installed) = (root().join(requirements), folder.join("requirements.txt"));
    if fs::read(&installed).is_ok_and(|text| Some(text) == fs::read(&wanted).ok()) {
        return Ok(python);
    }
    say(&format!("installing {requirements} into {}", folder.display()));
    let mut venv = Command::new("python3");
    venv.args(["-m", "venv", "--clear"]).arg(&folder);
    run_quietly(venv)?;
    let mut pip = Command::new(&python);
    pip.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--requirement"]).arg(&wanted);
    run_quietly(pip)?;
    // copied last: marks the environment as complete
    fs::copy(&wanted, &installed).map_err(|e| Fault::at(&installed, &e))?;
    Ok(python)
}

/// A folder in this user's cache, which outlives a clone.
fn cache(name: &str) -> PathBuf {
    let named = std::env::var_os("XDG_CACHE_HOME").map(PathBuf::from).filter(|p| p.is_absolute());
    let folder = named.or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".cache")));
    folder.unwrap_or_else(|| root().join(".tmpi")).join("tmpi").join(name)
}

fn openapi_check(python: PathBuf, part: &str) -> Command {
    let mut check = Command::new(python);
    check.args(["tests/openapi/check.py", "--only", part]).current_dir(root()).env("TMPI", built(Profile::Checks, "tmpi"));
    check
}

/// Lints the `OpenAPI` document that a server returns.
pub fn openapi() -> Result<(), Fault> {
    tools::node_packages("tests/openapi")?;
    run(openapi_check("python3".into(), "lint"))
}

/// Sends a server requests that conform to its `OpenAPI` document, and requests that violate it.
pub fn openapi_requests() -> Result<(), Fault> {
    let mut check = openapi_check(environment("schemathesis", "tests/openapi/requirements.txt")?, "play");
    runtime::set_env(&mut check);
    run(check)
}

/// Checks the files in `docker/` with the tools that read them.
pub fn deployment() -> Result<(), Fault> {
    let python = if tools::may_install() { environment("deployment", "docker/requirements.txt")? } else { "python3".into() };
    let mut check = Command::new(python);
    check.arg("docker/lint.py").current_dir(root()).env("TMPI", built(Profile::Checks, "tmpi"));
    tools::set_env(&mut check);
    run(check)
}
