//! The command line: results on standard output, progress and logs on standard error, exit code 0, 1 (failed) or 2 (usage).

mod bench;
#[cfg(feature = "codecs")]
mod bench_codec;
mod better;
mod check;
mod compare;
mod depth;
mod eval;
mod export;
mod files;
mod flags;
mod info;
mod live;
mod live_client;
mod live_publish;
mod live_watch;
mod make;
mod models;
mod progress;
mod render;
mod serve;
pub mod synth;
mod synth_layers;

use std::io::{IsTerminal, Write};
use std::process::ExitCode;

use clap::error::ErrorKind;
use clap::{CommandFactory, Parser, Subcommand};
use tracing_subscriber::EnvFilter;

/// Turns a photo into a tiled multiplane image and shows it from other places.
#[derive(Debug, Parser)]
#[command(name = "tmpi", version, about, max_term_width = 110)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Make(make::MakeArgs),
    Render(render::RenderArgs),
    Info(info::InfoArgs),
    Depth(depth::DepthArgs),
    Export(export::ExportArgs),
    Serve(serve::ServeArgs),
    Synth(synth::SynthArgs),
    Check(check::CheckArgs),
    Compare(compare::CompareArgs),
    Models(models::ModelsArgs),
    Bench(bench::BenchArgs),
    Eval(eval::EvalArgs),
    Live(live::LiveArgs),
    /// Write a completion script for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

/// A command line that cannot be meant; exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct Usage(String);

/// Runs the program; exit code 0, 1 (failed) or 2 (usage).
#[must_use]
pub fn main() -> ExitCode {
    // SAFETY: the program has no other thread yet
    #[allow(unsafe_code, reason = "the one call before all others")]
    unsafe {
        tmpi_pipeline::networks::keep_to_yourself();
    };
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            // Nothing is left to do where even this cannot be written
            let _ = error.print();
            return ExitCode::from(if error.use_stderr() { 2 } else { 0 });
        }
    };
    log_to_stderr(if matches!(cli.command, Command::Serve(_)) { "info" } else { "error" });
    match run(cli.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) if error.is::<Usage>() => {
            let _ = Cli::command().error(ErrorKind::ValueValidation, error).print();
            ExitCode::from(2)
        }
        // Whoever reads the results has had enough
        Err(error) if error.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe) => {
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("tmpi: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(command: Command) -> anyhow::Result<()> {
    match command {
        Command::Make(args) => make::run(&args),
        Command::Render(args) => render::run(&args),
        Command::Info(args) => info::run(&args),
        Command::Depth(args) => depth::run(&args),
        Command::Export(args) => export::run(&args),
        Command::Serve(args) => serve::run(args),
        Command::Synth(args) => synth::run(&args),
        Command::Check(args) => check::run(&args),
        Command::Compare(args) => compare::run(&args),
        Command::Models(args) => models::run(&args),
        Command::Bench(args) => bench::run(&args),
        Command::Eval(args) => eval::run(&args),
        Command::Live(args) => live::run(&args),
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), "tmpi", &mut script);
            std::io::stdout().write_all(&script)?;
            Ok(())
        }
    }
}

/// Logs to standard error; `RUST_LOG` overrides the level.
fn log_to_stderr(level: &str) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    // A second call, as in tests, changes nothing
    let ansi = std::io::stderr().is_terminal();
    let _ = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(ansi).try_init();
}

/// Writes one line of results.
fn result(line: &str) -> anyhow::Result<()> {
    writeln!(std::io::stdout(), "{line}")?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_definition_is_sound() {
        Cli::command().debug_assert();
    }
}
