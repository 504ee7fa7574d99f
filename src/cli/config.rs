//! Settings of `tmpi serve` from a file and from the environment, and `tmpi config`, which tells what holds and where it comes from.
//!
//! A file is TOML with the names of the options: `queue = 200`, `host = ["photos.example.org"]`, `public-list = true`. What the command
//! line says counts first, then `TMPI_SERVE_QUEUE` and the like, then the file, then the default. Values of the file go the way of the
//! command line, so that they are checked alike and refused in the same words.

use std::ffi::{OsStr, OsString};
use std::fmt::Write as _;
use std::path::Path;

use clap::error::ErrorKind;
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Command};
use toml::{Table, Value};

use super::serve::ServeArgs;

/// Show the settings that `serve` would have, as a file that --config takes, and where each comes from
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ConfigArgs {
    #[command(flatten)]
    #[allow(dead_code, reason = "its options are read as they were given")]
    serve: ServeArgs,
    /// What is told.
    #[arg(skip)]
    pub shown: String,
}

/// Commands that take these settings.
const COMMANDS: [&str; 3] = ["serve", "work", "config"];
/// What the variables of settings begin with.
const PREFIX: &str = "TMPI_SERVE_";
/// The option that names the file.
const FILE: &str = "config";

/// Longest file, bytes.
const LONGEST: u64 = 1 << 20;

/// The definition with every option of `serve` open to the environment.
pub(super) fn with_environment(all: Command) -> Command {
    COMMANDS.iter().fold(all, |all, name| {
        all.mut_subcommand(name, |command| {
            command.mut_args(|arg| match variable(&arg) {
                Some(variable) => arg.env(variable).hide_env(true),
                None => arg,
            })
        })
    })
}

/// The variable of an option that has none yet.
fn variable(arg: &Arg) -> Option<String> {
    let long = arg.get_long().filter(|_| arg.get_env().is_none())?;
    Some(format!("{PREFIX}{}", long.replace('-', "_").to_uppercase()))
}

/// The command line with what the file adds that it names, and the options that come from there.
///
/// # Errors
/// A file that cannot be read or is no TOML, a name that is no option, a value that is no text, number, or list of them.
pub(super) fn with_file(all: &Command, mut line: Vec<OsString>) -> Result<(Vec<OsString>, Vec<String>), clap::Error> {
    // what is wrong with the rest is told when it is read whole
    let Ok(given) = all.clone().ignore_errors(true).try_get_matches_from(&line) else { return Ok((line, Vec::new())) };
    let Some((name, given)) = given.subcommand().filter(|(name, _)| COMMANDS.contains(name)) else { return Ok((line, Vec::new())) };
    let Some(command) = all.find_subcommand(name) else { return Ok((line, Vec::new())) };
    only_settings(command, std::env::vars_os().map(|(name, _)| name))?;
    let Some(file) = given.get_one::<std::path::PathBuf>(FILE) else { return Ok((line, Vec::new())) };
    let refused = |why: String| command.clone().error(ErrorKind::ValueValidation, format!("{}: {why}", file.display()));
    let mut named = Vec::new();
    for (key, value) in read(file).map_err(refused)? {
        let option = command.get_arguments().find(|a| a.get_long() == Some(&key) && key != FILE && !a.is_hide_set());
        let option = option.ok_or_else(|| refused(format!("`{key}` is no setting; `tmpi serve --help` lists them as options")))?;
        let id = option.get_id().as_str();
        if matches!(given.value_source(id), Some(ValueSource::CommandLine | ValueSource::EnvVariable)) {
            continue;
        }
        let values = values(option, &value).map_err(|why| refused(format!("`{key}`: {why}")))?;
        for value in &values {
            line.push(if value.is_empty() { format!("--{key}") } else { format!("--{key}={value}") }.into());
        }
        if !values.is_empty() {
            named.push(id.to_owned());
        }
    }
    Ok((line, named))
}

/// # Errors
/// A variable that begins as those of settings do, and is none: as a rule it is misspelt.
fn only_settings(command: &Command, mut names: impl Iterator<Item = OsString>) -> Result<(), clap::Error> {
    let known: Vec<&OsStr> = command.get_arguments().filter_map(Arg::get_env).collect();
    match names.find(|name| name.to_str().is_some_and(|n| n.starts_with(PREFIX)) && !known.contains(&name.as_os_str())) {
        Some(name) => {
            let text = format!("the variable {} is no setting; `tmpi serve --help` lists them as options", name.display());
            Err(command.clone().error(ErrorKind::ValueValidation, text))
        }
        None => Ok(()),
    }
}

fn read(file: &Path) -> Result<Table, String> {
    let length = std::fs::metadata(file).map_err(|e| e.to_string())?.len();
    if length > LONGEST {
        return Err(format!("{length} bytes, over {LONGEST}"));
    }
    let text = std::fs::read_to_string(file).map_err(|e| e.to_string())?;
    text.parse::<Table>().map_err(|e| e.to_string().trim_end().to_owned())
}

/// What a value of a file is on the command line; a switch has no value there.
fn values(option: &Arg, value: &Value) -> Result<Vec<String>, String> {
    if matches!(option.get_action(), ArgAction::SetTrue) {
        return match value {
            Value::Boolean(true) => Ok(vec![String::new()]),
            Value::Boolean(false) => Ok(Vec::new()),
            _ => Err("true or false is expected".into()),
        };
    }
    let one = |value: &Value| match value {
        // an empty one would read as a switch
        Value::String(text) if !text.is_empty() => Ok(text.clone()),
        Value::Integer(n) => Ok(n.to_string()),
        Value::Float(x) => Ok(x.to_string()),
        _ => Err("a text or a number is expected".to_owned()),
    };
    match value {
        Value::Array(all) if matches!(option.get_action(), ArgAction::Append) || option.get_value_delimiter().is_some() => {
            all.iter().map(one).collect()
        }
        value => one(value).map(|v| vec![v]),
    }
}

/// What holds, as a file that `--config` takes, each line with where its value comes from; defaults are comments.
pub(super) fn shown(command: &Command, given: &ArgMatches, from_file: &[String]) -> String {
    let mut text = String::new();
    for option in command.get_arguments().filter(|a| !a.is_hide_set()) {
        let (id, Some(long)) = (option.get_id().as_str(), option.get_long()) else { continue };
        if [FILE, "help"].contains(&long) {
            continue;
        }
        let source = match given.value_source(id) {
            _ if from_file.iter().any(|f| f == id) => "file",
            Some(ValueSource::CommandLine) => "command line",
            Some(ValueSource::EnvVariable) => "environment",
            _ => "",
        };
        // some defaults may not be said where what they belong to is not
        let (begin, end) = if source.is_empty() { ("# ", String::new()) } else { ("", format!(" # {source}")) };
        let raw: Vec<&OsStr> = given.get_raw(id).map_or_else(Vec::new, Iterator::collect);
        let told = raw.iter().map(|v| literal(&v.to_string_lossy(), option)).collect::<Vec<_>>();
        let _ = match told.as_slice() {
            [] => writeln!(text, "# {long} ="),
            [one] if !matches!(option.get_action(), ArgAction::Append) => writeln!(text, "{begin}{long} = {one}{end}"),
            all => writeln!(text, "{begin}{long} = [{}]{end}", all.join(", ")),
        };
    }
    text
}

/// A value as TOML; passwords in addresses are left out.
fn literal(value: &str, option: &Arg) -> String {
    let whole = value.parse::<i64>().is_ok_and(|n| n.to_string() == value);
    if matches!(option.get_action(), ArgAction::SetTrue) || whole {
        return value.to_owned();
    }
    let address = value.split_once("://").and_then(|(scheme, rest)| Some((scheme, rest.rsplit_once('@')?.1)));
    let shown = address.map_or_else(|| value.to_owned(), |(scheme, host)| format!("{scheme}://…@{host}"));
    // texts of JSON are texts of TOML
    serde_json::Value::String(shown).to_string()
}
