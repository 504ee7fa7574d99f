//! Checks of the pages' scripts, browser tests, and the npm package of the element.

use std::process::Command;

use crate::command::{Fault, Profile, built, data, root, run};
use crate::{runtime, tools};

/// Packs the element for npm into `target/npm`.
pub fn pack_element() -> Result<(), Fault> {
    let mut node = Command::new("node");
    node.arg("npm/pack.mjs").current_dir(root());
    run(node).map_err(|e| e.in_step("npm"))
}

/// Checks types, lints and format of the pages' scripts.
pub fn check() -> Result<(), Fault> {
    let mut command = tools::npm(tools::BROWSER_TESTS);
    command.args(["run", "check", "--silent"]);
    run(command)
}

/// Runs the browser tests against the program that the Rust tests use.
pub fn test() -> Result<(), Fault> {
    let mut command = tools::npm(tools::BROWSER_TESTS);
    command.args(["test", "--silent"]).env("TMPI_BIN", built(Profile::Checks, "tmpi")).env("TMPI_DATA", data());
    tools::set_env(&mut command);
    runtime::set_env(&mut command);
    run(command)
}
