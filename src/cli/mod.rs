//! The command line: results on standard output, progress and logs on standard error, exit code 0, 1 (failed) or 2 (usage).

mod batch;
mod config;
mod depth;
mod depth_pairs;
mod export;
mod files;
mod flags;
mod info;
mod integrity;
mod key;
mod library_args;
mod live;
mod live_client;
mod live_input;
mod live_program;
mod live_publish;
mod live_rtp;
mod live_source;
mod live_watch;
mod make;
mod models;
mod progress;
mod render;
mod serve;
mod settings;
mod watch;

use std::io::{IsTerminal, Write};
use std::process::ExitCode;

#[doc(hidden)]
pub use config::fuzz as fuzz_config;

use clap::error::ErrorKind;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
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
    /// Make photos that other nodes serve, like `serve --role work`
    Work(serve::ServeArgs),
    Config(config::ConfigArgs),
    /// Check that every file of every photo exists and is intact; servers may run meanwhile
    Fsck(integrity::IntegrityArgs),
    /// Remove files that no photo refers to and that are at least a day old; servers may run meanwhile
    Gc(integrity::IntegrityArgs),
    /// List and fetch published depth networks
    #[command(subcommand)]
    Models(models::ModelsCommand),
    /// Publish and watch moving 3D photos
    #[command(subcommand)]
    Live(live::LiveCommand),
    /// Create, list and revoke API keys of a server with `--access private`
    #[command(subcommand)]
    Key(key::KeyCommand),
    /// Write a completion script for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

fn command() -> clap::Command {
    // `work` fixes the role; its own address and folder let it run beside a node that serves
    let all = Cli::command().mut_subcommand("work", |c| {
        let c = c.mut_arg("role", |a| a.hide(true)).mut_arg("addr", |a| a.default_value("127.0.0.1:0"));
        c.mut_arg("data", |a| a.default_value("tmpi-work"))
    });
    config::with_environment(all)
}

/// A usage error; exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct Usage(String);

/// Parses the command line and the settings that the file and the environment add. Returns the name of the subcommand, too.
fn parsed() -> Result<(Option<String>, Cli), clap::Error> {
    let definition = command();
    let (line, sources) = config::complete(&definition, std::env::args_os().collect())?;
    let all = definition.clone().try_get_matches_from(line)?;
    let mut cli = Cli::from_arg_matches(&all)?;
    if let Some((name, given)) = all.subcommand()
        && let Some(called) = definition.find_subcommand(name)
    {
        match &mut cli.command {
            Command::Config(args) if args.schema => args.shown = format!("{:#}", config::schema(called)),
            Command::Config(args) => {
                let wrong = |error: anyhow::Error| called.clone().error(ErrorKind::ValueValidation, error);
                args.shown = config::shown(called, given, &sources, &args.serve).map_err(wrong)?;
            }
            Command::Serve(args) | Command::Work(args) => args.for_makers = config::for_makers(called, given),
            _ => {}
        }
    }
    Ok((all.subcommand_name().map(str::to_owned), cli))
}

/// Runs the program; exit code 0, 1 (failed) or 2 (usage).
pub fn main() -> ExitCode {
    // SAFETY: the program has no other thread yet
    #[allow(unsafe_code, reason = "the one call before all others")]
    unsafe {
        tmpi_pipeline::networks::disable_telemetry();
        tmpi_render::without_a_display();
    };
    let (name, cli) = match parsed() {
        Ok(parsed) => parsed,
        Err(error) => {
            let error = config::told_without_secrets(error);
            // nothing is left to do if this fails
            let _ = error.print();
            return ExitCode::from(if error.use_stderr() { 2 } else { 0 });
        }
    };
    match &cli.command {
        Command::Serve(args) | Command::Work(args) => log_to_stderr("info", args.log),
        _ => log_to_stderr("error", Log::Text),
    }
    match run(cli.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) if error.is::<Usage>() => {
            let mut all = command();
            // show the usage of the subcommand
            all.build();
            let called = name.as_deref().and_then(|name| all.find_subcommand(name)).cloned();
            let _ = called.unwrap_or(all).error(ErrorKind::ValueValidation, error).print();
            ExitCode::from(2)
        }
        Err(error) if is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            fault(&error);
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
        Command::Work(args) => serve::run(args.at_work()?),
        Command::Config(args) => {
            if !args.schema {
                args.serve.check()?;
            }
            result(args.shown.trim_end())
        }
        Command::Fsck(args) => integrity::fsck(&args),
        Command::Gc(args) => integrity::gc(&args),
        Command::Models(command) => models::run(&command),
        Command::Live(command) => live::run(&command),
        Command::Key(command) => key::run(&command),
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), "tmpi", &mut script);
            std::io::stdout().write_all(&script)?;
            Ok(())
        }
    }
}

/// Format of the log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
enum Log {
    /// Lines of text
    #[default]
    Text,
    /// One JSON object per line
    Json,
}

/// Logs to standard error; `RUST_LOG` overrides the level.
fn log_to_stderr(level: &str, form: Log) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let ansi = std::io::stderr().is_terminal();
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(ansi);
    // if standard error is closed, reporting that would end the program
    let log = log.log_internal_errors(false);
    let _ = match form {
        Log::Text => log.try_init(),
        Log::Json => log.json().flatten_event(true).with_span_list(false).try_init(),
    };
}

/// Writes one line to standard error; ignores errors.
fn note(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

fn fault(error: &anyhow::Error) {
    note(&format!("tmpi: {}", reasons(error)));
}

/// An error and its causes, each once: some messages include those of their causes.
fn reasons(error: &anyhow::Error) -> String {
    let mut all = String::new();
    for reason in error.chain().map(ToString::to_string) {
        if all.is_empty() {
            all = reason;
        } else if !all.contains(&reason) {
            all = format!("{all}: {reason}");
        }
    }
    all
}

/// Whether the reader of the results has closed the pipe.
fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe)
}

/// Writes one line of results: an object, or text for people.
fn result_as(is_json: bool, object: &serde_json::Value, text: &str) -> anyhow::Result<()> {
    if is_json { result(&object.to_string()) } else { result(text) }
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
    fn clap_accepts_the_command_line() {
        Cli::command().debug_assert();
        command().debug_assert();
    }

    #[test]
    fn each_reason_is_printed_once() {
        let io = || std::io::Error::other("in use");
        let once = anyhow::Error::new(io()).context("cannot listen");
        assert_eq!(reasons(&once), "cannot listen: in use");
        let twice = anyhow::Error::new(io()).context("cannot listen: in use").context("server");
        assert_eq!(reasons(&twice), "server: cannot listen: in use");
    }
}
