//! The command line. Results go to standard output, progress and logs to standard error; exit code 0, 1 (failed) or 2 (usage).

mod bench;
mod check;
mod compare;
mod eval;
mod ghosts;
mod live_bench;
mod psi_training_data;
mod synth;
mod tears;

use std::io::Write;
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use tracing_subscriber::EnvFilter;

/// Measures and tests tmpi
#[derive(Debug, Parser)]
#[command(name = "tmpi-lab", version, about, max_term_width = 110)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Compare(compare::CompareArgs),
    Check(check::CheckArgs),
    Bench(bench::BenchArgs),
    Eval(eval::EvalArgs),
    Ghosts(ghosts::GhostArgs),
    LiveBench(Box<live_bench::LiveBenchArgs>),
    Synth(synth::SynthArgs),
    Tears(tears::TearsArgs),
}

/// Runs the program; exit code 0, 1 (failed) or 2 (usage).
pub fn main() -> ExitCode {
    // SAFETY: the program has no other thread yet
    #[allow(unsafe_code, reason = "sets environment variables before any thread starts")]
    unsafe {
        tmpi_pipeline::networks::disable_telemetry();
        tmpi_render::without_a_display();
    };
    let cli = Cli::parse();
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("error"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    let done = match cli.command {
        Command::Compare(args) => compare::run(&args),
        Command::Check(args) => check::run(&args),
        Command::Bench(args) => bench::run(args),
        Command::Eval(args) => eval::run(&args),
        Command::Ghosts(args) => ghosts::run(&args),
        Command::LiveBench(args) => live_bench::run(&args),
        Command::Synth(args) => synth::run(&args),
        Command::Tears(args) => tears::run(&args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            note(&format!("tmpi-lab: {error:#}"));
            ExitCode::FAILURE
        }
    }
}

/// Writes a line to standard error and ignores failures.
fn note(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Writes a line of results to standard output.
fn result(line: &str) -> anyhow::Result<()> {
    writeln!(std::io::stdout(), "{line}")?;
    Ok(())
}

/// Parses a picture size, `WxH`, of at most `most` pixels.
fn size(text: &str, most: u64) -> Result<(u32, u32), String> {
    let (w, h) = text.split_once(['x', 'X']).ok_or("expected WIDTHxHEIGHT")?;
    let side = |v: &str| v.parse::<u32>().ok().filter(|&v| v > 0).ok_or("width and height must be whole numbers of at least 1");
    let size = (side(w)?, side(h)?);
    if u64::from(size.0) * u64::from(size.1) > most {
        return Err(format!("the picture may have at most {most} pixels"));
    }
    Ok(size)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn sizes_are_read_and_bounded() {
        assert_eq!(size("1280x720", 1_000_000), Ok((1280, 720)));
        for bad in ["", "12", "0x4", "4x0", "-1x4", "1000x1001", "99999x99999", "ax4"] {
            assert!(size(bad, 1_000_000).is_err(), "{bad}");
        }
    }
}
