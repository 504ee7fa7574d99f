//! Development tasks; `cargo xtask help` lists them.

mod browser;
mod command;
mod fuzz;
mod nightly;
mod python;
mod release;
mod runtime;
mod rust_tests;
mod skipped;
mod spelling;
mod steps;
mod test;
mod tools;
mod wasm;
mod wheel;

use std::process::ExitCode;

use command::{Fault, Profile, built, cargo, run};

const HELP: &str = "\
usage: cargo xtask <task>

  serve [--offline] [ARGS]
                fetch ONNX Runtime, build, fetch a depth network that is better than the embedded one (50 MB, once), and run
                `tmpi serve ARGS`; with --offline, or if ARGS name a depth network, fetch no depth network
  test [--skip-missing] [STEP…]
                run all checks: format, spelling, lint, Rust tests, browser tests, deployment files, OpenAPI, training; install missing
                tools; with --skip-missing install nothing and list the skipped tests
  nightly [--minutes N] [STEP…]
                run the checks that take hours: load and fault scripts, requests against OpenAPI, mutants, fuzzers; no step takes longer
                than N minutes (90)
  fuzz [--seconds N] [TARGET…]
                fuzz the readers of untrusted bytes (containers, photos, depth maps, forms, headers, settings), N seconds each
  wasm          build the pages' decoders, static/*/*.wasm
  release [--offline]
                pack the program, ONNX Runtime, a depth network and licences into target/archive, and test the archive
  npm           pack the element <tmpi-viewer> for npm into target/npm
  fetch         fetch ONNX Runtime into .tmpi/onnxruntime";

fn main() -> ExitCode {
    let mut args = std::env::args().skip(1);
    let task = args.next();
    let rest: Vec<String> = args.collect();
    let done = match task.as_deref() {
        Some("serve") => serve(&rest),
        Some("release") if rest.iter().all(|a| a == OFFLINE) => release::release(&rest),
        Some("fuzz") => fuzz::fuzz(&rest),
        Some("test") => {
            let (flags, steps): (Vec<String>, Vec<String>) = rest.into_iter().partition(|a| a == SKIP_MISSING);
            if !flags.is_empty() {
                tools::skip_missing();
            }
            test::test(&steps)
        }
        Some("nightly") => nightly::nightly(&rest),
        Some("wasm") if rest.is_empty() => wasm::build(),
        Some("npm") if rest.is_empty() => browser::pack_element(),
        Some("fetch") if rest.is_empty() => runtime::fetch().map_err(|e| e.in_step("ONNX Runtime")),
        Some("help" | "--help" | "-h") => {
            println!("{HELP}");
            Ok(())
        }
        _ => {
            eprintln!("{HELP}");
            return ExitCode::from(2);
        }
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(fault) => {
            eprintln!("\nxtask: {fault}");
            ExitCode::FAILURE
        }
    }
}

/// Flag of `test`: install nothing.
const SKIP_MISSING: &str = "--skip-missing";
/// Flag of `serve` and `release`: fetch no depth network.
const OFFLINE: &str = "--offline";

fn serve(args: &[String]) -> Result<(), Fault> {
    runtime::fetch().map_err(|e| e.in_step("ONNX Runtime"))?;
    run(cargo(&["build", "--release", "--package", "tmpi"])).map_err(|e| e.in_step("build"))?;
    let chosen = |a: &String| a.starts_with("--depth-model") || a == OFFLINE;
    if !args.iter().any(chosen) && std::env::var_os("TMPI_DEPTH_MODEL").is_none() {
        let mut models = std::process::Command::new(built(Profile::Release, "tmpi"));
        // if the download fails, `tmpi models get` prints why, and the server uses an installed network
        models.args(["models", "get", "auto"]).stdout(std::process::Stdio::null());
        run(models).map_err(|e| e.in_step("depth network"))?;
    }
    // the server prints its URL once it listens
    let mut server = std::process::Command::new(built(Profile::Release, "tmpi"));
    server.arg("serve").args(args.iter().filter(|a| *a != OFFLINE));
    runtime::set_env(&mut server);
    command::exec(server).map_err(|e| e.in_step("serve"))
}
