//! Tasks around the program: `cargo xtask serve`, `cargo xtask test`, `cargo xtask fetch`, `cargo xtask shaders`, `cargo xtask wasm`,
//! `cargo xtask fuzz`, `cargo xtask release`, `cargo xtask npm`.

mod browser;
mod command;
mod engines;
mod fuzz;
mod release;
mod runtime;
mod shaders;
mod spelling;
mod wasm;
mod wheel;

use std::process::ExitCode;
use std::time::Instant;

use command::{Fault, cargo, run};

const HELP: &str = "\
usage: cargo xtask <task>

  serve [--offline] [ARGS]
                fetch ONNX Runtime where it is missing, build, fetch a depth network that is better than the embedded one (50 MB, once;
                not with --offline, nor where another one is named), and run `tmpi serve ARGS`
  test [--full] formatting, spelling, lints, types of the pages' scripts, all tests, browser tests; installs what these need where it may;
                --full: also docker/ by the tools that read it, as far as they are here, unit tests with overflow checks, and the fuzzer, a
                minute for each target
  fuzz [--seconds N] [TARGET…]
                run the fuzzer on what reads foreign bytes (containers, photos, depth maps, forms, queries), N seconds each
  shaders       make the GLSL of static/draw/glsl.js from the WGSL
  wasm          build the pages' decoders, static/*/*.wasm, from crates/decoder, crates/unpacker and crates/live-decoder
  release [--offline]
                an archive with the program, ONNX Runtime, the depth network that is worth fetching, and licences, in target/archive; unpacked
                and tried without anything else of this machine
  npm           pack the element <tmpi-viewer> with all that it needs for npm, in target/npm
  fetch         fetch ONNX Runtime into .tmpi/onnxruntime where it is missing";

/// Variable that says what tests must not be skipped without, and what it is here (`crates/testing`).
const REQUIRE: &str = "TMPI_REQUIRE";
const REQUIRED: &str = "gpu,onnx";

fn main() -> ExitCode {
    let mut args = std::env::args().skip(1);
    let task = args.next();
    let rest: Vec<String> = args.collect();
    let done = match task.as_deref() {
        Some("serve") => serve(&rest),
        Some("release") if rest.iter().all(|a| a == OFFLINE) => release::release(&rest),
        Some("fuzz") => fuzz::fuzz(&rest),
        Some("test") if rest.is_empty() => test(&STEPS),
        Some("test") if rest == ["--full"] => test(&[&STEPS[..], &FULL].concat()),
        Some("shaders") if rest.is_empty() => shaders::write(),
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

/// Flag of `serve` and `release`: nothing is fetched but what cannot be done without.
const OFFLINE: &str = "--offline";

fn serve(args: &[String]) -> Result<(), Fault> {
    runtime::fetch().map_err(|e| e.in_step("ONNX Runtime"))?;
    run(cargo(&["build", "--release"])).map_err(|e| e.in_step("build"))?;
    let chosen = |a: &String| a.starts_with("--depth-model") || a == OFFLINE;
    if !args.iter().any(chosen) && std::env::var_os("TMPI_DEPTH_MODEL").is_none() {
        let mut models = std::process::Command::new(command::program());
        // where there is no network it says so in a line, and what is here is used
        models.args(["models", "get", "auto"]).stdout(std::process::Stdio::null());
        run(models).map_err(|e| e.in_step("depth network"))?;
    }
    // The server prints its URL itself, once it listens
    let mut server = std::process::Command::new(command::program());
    server.arg("serve").args(args.iter().filter(|a| *a != OFFLINE));
    runtime::name_to(&mut server);
    command::become_it(server).map_err(|e| e.in_step("serve"))
}

/// The tests; what the steps before them have fetched or installed must be found, so that no test is skipped for it.
fn tests() -> Result<(), Fault> {
    engines::fetch();
    let mut command = cargo(&["test", "--workspace", "--release"]);
    let required = engines::name_to(&mut command, REQUIRED);
    if std::env::var_os(REQUIRE).is_none() {
        command.env(REQUIRE, required);
    }
    run(command)
}

/// A named step of the tests.
type Step = (&'static str, fn() -> Result<(), Fault>);

/// What every change is held against.
const STEPS: [Step; 8] = [
    ("format", || run(cargo(&["fmt", "--all", "--check"]))),
    ("spelling", spelling::check),
    ("lint", || run(cargo(&["clippy", "--workspace", "--release", "--all-targets", "--all-features", "--", "-D", "warnings"]))),
    ("ONNX Runtime", runtime::fetch),
    ("tools", browser::tools),
    ("pages", browser::check),
    ("tests", tests),
    ("browser", browser::test),
];
/// What takes longer.
const FULL: [Step; 3] = [("deployment", deployment), ("overflow", overflow), ("fuzz", || fuzz::fuzz(&[]))];

/// What lies in docker/, by those of its tools that are here; it says which are not.
fn deployment() -> Result<(), Fault> {
    let mut check = std::process::Command::new("python3");
    check.arg("docker/check.py").current_dir(command::root()).env("TMPI", command::program());
    run(check)
}

/// Unit tests of a program in which a sum that wraps is a fault.
fn overflow() -> Result<(), Fault> {
    let mut tests = cargo(&["test", "--workspace", "--release", "--lib"]);
    tests.env("CARGO_PROFILE_RELEASE_OVERFLOW_CHECKS", "true");
    run(tests)
}

/// Runs every step in order, stops at the first that fails, and tells how long each took.
fn test(steps: &[Step]) -> Result<(), Fault> {
    let mut times = Vec::new();
    let mut failed = None;
    for (name, step) in steps {
        println!("── {name}");
        let start = Instant::now();
        let result = step();
        times.push((name, start.elapsed().as_secs_f64()));
        if let Err(fault) = result {
            failed = Some(fault.in_step(name));
            break;
        }
    }
    println!();
    for (i, (name, seconds)) in times.iter().enumerate() {
        let word = if failed.is_some() && i + 1 == times.len() { "FAILED" } else { "ok" };
        println!("{name:<14} {word:<7} {seconds:7.1} s");
    }
    failed.map_or(Ok(()), Err)
}
