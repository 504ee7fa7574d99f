//! `cargo xtask test`: all checks, with one build.

use crate::command::{Fault, cargo, run};
use crate::steps::{self, AfterFailure, Lane, Step};
use crate::{browser, python, runtime, rust_tests, skipped, spelling, tools};

/// Runs in parallel with the build: the build needs the cores, these steps wait for the network.
const STATIC_CHECKS: Lane<'static> = &[
    Step { name: "tools", run: tools::fetch },
    Step { name: "ONNX Runtime", run: runtime::fetch },
    Step { name: "format", run: || run(cargo(&["fmt", "--all", "--check"])) },
    Step { name: "spelling", run: spelling::check },
    Step { name: "pages", run: browser::check },
    Step { name: "training tests", run: python::training },
];
const BUILD: Lane<'static> = &[Step { name: "lint and build", run: rust_tests::build }];
const RUST: Lane<'static> = &[Step { name: "Rust tests", run: rust_tests::run_all }];
const BROWSER: Lane<'static> = &[Step { name: "browser tests", run: browser::test }];
const DEPLOYMENT: Lane<'static> =
    &[Step { name: "deployment files", run: python::deployment }, Step { name: "OpenAPI", run: python::openapi }];

/// Runs all checks, or the named steps, and prints how long each took and which tests were skipped.
pub fn test(names: &[String]) -> Result<(), Fault> {
    skipped::clear()?;
    let result = steps::run(&[&[BUILD, STATIC_CHECKS], &[RUST, DEPLOYMENT], &[BROWSER]], names, AfterFailure::Stop);
    skipped::print()?;
    result
}
