//! Lints and tests the Rust code with a single build.

use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use serde_json::Value;

use crate::command::{Fault, Profile, cargo, command_line, cores, data, in_parallel, not_started, run, say};
use crate::{runtime, tools};

struct TestProgram {
    /// Folder of the package, and target if it has another name: `core codec`.
    name: String,
    executable: PathBuf,
    /// The package's folder; cargo would run it there.
    folder: PathBuf,
}

struct Outcome {
    name: String,
    counts: Counts,
}

/// Counts that a test program prints at its end.
#[derive(Default)]
struct Counts {
    passed: usize,
    failed: usize,
    ignored: usize,
}

/// Lints everything and builds the program and all tests in one pass, with Clippy as the compiler.
///
/// `cargo clippy` would compile all dependencies a second time, because it only checks them.
pub fn build() -> Result<(), Fault> {
    programs()?;
    // benches are not among the default targets of `cargo test`; any other command would build dependencies with different features
    let mut command = cargo(&["test", "--workspace", "--benches", "--no-run", "--quiet", "--profile", Profile::Checks.name()]);
    lint(&mut command);
    run(command)
}

fn programs() -> Result<Vec<TestProgram>, Fault> {
    // libraries, programs, tests and examples; browser tests start the examples
    let mut command = cargo(&["test", "--workspace", "--no-run", "--message-format=json-render-diagnostics"]);
    command.args(["--profile", Profile::Checks.name()]);
    lint(&mut command);
    command.stdout(Stdio::piped());
    let child = command.spawn();
    let output = child.and_then(Child::wait_with_output).map_err(|e| not_started(&command, &e))?;
    if !output.status.success() {
        return Err(Fault::new(format!("`{}`: {}", command_line(&command), output.status)));
    }
    let messages = String::from_utf8_lossy(&output.stdout);
    let mut programs: Vec<_> = messages.lines().filter_map(|line| test_program(&serde_json::from_str(line).ok()?)).collect();
    programs.sort_by(|a, b| a.name.cmp(&b.name));
    if programs.is_empty() { Err(Fault::new("cargo built no test program")) } else { Ok(programs) }
}

/// Makes Clippy the compiler of the workspace's own crates, and its warnings errors.
pub fn lint(command: &mut Command) {
    command.env("RUSTC_WORKSPACE_WRAPPER", "clippy-driver").env("CLIPPY_ARGS", "-Dwarnings");
}

/// The test program in a JSON message of cargo.
fn test_program(message: &Value) -> Option<TestProgram> {
    let is_test = message["profile"]["test"].as_bool()? && message["reason"] == "compiler-artifact";
    let executable = PathBuf::from(message["executable"].as_str()?);
    let folder = PathBuf::from(message["manifest_path"].as_str()?).parent()?.to_owned();
    let is_bench = message["target"]["kind"].as_array()?.iter().any(|k| k == "bench");
    let package = folder.file_name()?.to_string_lossy().into_owned();
    let target = message["target"]["name"].as_str()?;
    let name = if package == target { package } else { format!("{package} {target}") };
    (is_test && !is_bench).then_some(TestProgram { name, executable, folder })
}

impl TestProgram {
    /// Runs its tests and prints their counts, preceded by the output if a test failed.
    fn run(&self) -> Result<Outcome, Fault> {
        let start = Instant::now();
        let mut command = Command::new(&self.executable);
        command.current_dir(&self.folder).env("CARGO_MANIFEST_DIR", &self.folder).env("TMPI_DATA", data());
        // most server tests wait more than they compute
        command.env("RUST_TEST_THREADS", (2 * cores()).to_string());
        runtime::set_env(&mut command);
        tools::set_env(&mut command);
        let output = command.output().map_err(|e| not_started(&command, &e))?;
        let text = [output.stdout, output.stderr].map(|b| String::from_utf8_lossy(&b).into_owned()).concat();
        // a program that prints no counts has crashed
        let aborted = Counts { failed: 1, ..Counts::default() };
        let counts = text.lines().find_map(Counts::parse).filter(|c| output.status.success() || c.failed > 0).unwrap_or(aborted);
        let Counts { passed, failed, ignored } = counts;
        let failures = if failed > 0 { text.as_str() } else { "" };
        let seconds = start.elapsed().as_secs_f64();
        println!("{failures}{:<30} {passed:4} passed, {failed} failed, {ignored} ignored {seconds:7.1} s", self.name);
        Ok(Outcome { name: self.name.clone(), counts })
    }
}

impl Counts {
    /// Parses the last line of a test program: `test result: ok. 12 passed; 0 failed; 1 ignored; …`.
    fn parse(line: &str) -> Option<Self> {
        let counts = line.strip_prefix("test result: ")?.split_once(". ")?.1;
        let of = |word: &str| counts.split("; ").find_map(|part| part.strip_suffix(word)?.trim().parse().ok());
        Some(Self { passed: of("passed")?, failed: of("failed")?, ignored: of("ignored")? })
    }
}

/// Test programs that run at the same time, because some tests wait more than they compute.
const PROGRAMS: usize = 2;

/// Runs all test programs, the largest first. Each uses twice as many threads as the machine has cores.
///
/// # Errors
/// Lists the programs with failed tests.
pub fn run_all() -> Result<(), Fault> {
    let mut programs = programs()?;
    programs.sort_by_key(|p| std::cmp::Reverse(p.executable.metadata().map_or(0, |m| m.len())));
    let results = in_parallel(PROGRAMS, programs.iter(), TestProgram::run).into_iter().collect::<Result<Vec<_>, Fault>>()?;
    let sum = |of: fn(&Counts) -> usize| results.iter().map(|r| of(&r.counts)).sum::<usize>();
    say(&format!("Rust tests: {} passed, {} failed, {} ignored", sum(|c| c.passed), sum(|c| c.failed), sum(|c| c.ignored)));
    let failed: Vec<&str> = results.iter().filter(|r| r.counts.failed > 0).map(|r| r.name.as_str()).collect();
    if failed.is_empty() { documentation() } else { Err(Fault::new(format!("tests failed in {}", failed.join(", ")))) }
}

/// Compiles and runs the examples in doc comments.
fn documentation() -> Result<(), Fault> {
    // only the client has examples, but a build of one package would recompile dependencies with other features
    let mut command = cargo(&["test", "--quiet", "--workspace", "--doc", "--profile", Profile::Checks.name()]);
    lint(&mut command);
    run(command)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_parsed_from_the_last_line() {
        let line = "test result: FAILED. 12 passed; 3 failed; 1 ignored; 0 measured; 7 filtered out; finished in 0.52s";
        let counts = Counts::parse(line).unwrap();
        assert_eq!((counts.passed, counts.failed, counts.ignored), (12, 3, 1));
        assert!(Counts::parse("test a::b ... ok").is_none());
    }

    #[test]
    fn only_test_programs_are_run() {
        let message = |test: bool, kind: &str| {
            let text = format!(
                r#"{{"reason":"compiler-artifact","manifest_path":"/a/crates/core/Cargo.toml","target":{{"kind":["{kind}"],"name":"codec"}},
                "profile":{{"test":{test}}},"executable":"/t/codec-1"}}"#
            );
            test_program(&serde_json::from_str(&text).unwrap()).map(|p| p.name)
        };
        assert_eq!(message(true, "test").as_deref(), Some("core codec"));
        assert_eq!(message(true, "bench"), None);
        assert_eq!(message(false, "bin"), None);
    }
}
