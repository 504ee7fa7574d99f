//! The command line.

pub mod synth;

/// Runs the program; exit code 0, 1 (failed) or 2 (usage).
#[must_use]
pub fn main() -> std::process::ExitCode {
    std::process::ExitCode::FAILURE
}
