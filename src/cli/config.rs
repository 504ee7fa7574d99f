//! Settings of `tmpi serve` from a file and the environment, and `tmpi config`, which checks them as `serve` does and prints the effective
//! values with their sources. `tmpi key`, `fsck` and `gc` read the library's location from them.
//!
//! The file is TOML with the names of the options, `host = ["photos.example.org"]`, and tables of settings without an option, `[limits]`
//! with `queue = 200`. The command line takes precedence, then `TMPI_SERVE_HOST`, `TMPI_SERVE_LIMITS_QUEUE` and the like, then the file,
//! then the default. Values of the file are appended to the command line, so that clap checks them in the same way.

use std::ffi::{OsStr, OsString};
use std::fmt::Write as _;
use std::path::Path;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Args as _, Command};
use toml::{Table, Value};

use super::serve::ServeArgs;
use super::settings::{self, Assignment, Setting};
use crate::server::Limits;
use tmpi_pipeline::networks::cli_flags::ModelFlags;

/// Show the effective settings of `serve` and their sources, as a file for --config
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ConfigArgs {
    /// Print the JSON schema of the file instead, for editors
    #[arg(long)]
    pub schema: bool,
    #[command(flatten)]
    pub serve: ServeArgs,
    #[arg(skip)]
    pub shown: String,
}

/// The command whose options are the settings.
const SERVE: &str = "serve";
/// Settings that are URLs, which may contain secrets.
const ADDRESSES: [&str; 5] = ["advertise", "blobs", "database", "network-url", "otlp"];
/// Options, besides those of networks, that a server passes to the processes that make photos. None may be a secret.
const FOR_MAKERS: [&str; 4] = ["backend", "log", "memory", SET];
const PREFIX: &str = "TMPI_SERVE_";
/// The option that names the file. Commands that have it take the settings for which they have an option.
const FILE: &str = "config";
/// The option for settings without an option of their own. Commands that have it take all settings.
const SET: &str = "set";
/// The option whose values are tables of the file.
const WEBHOOKS: &str = "webhooks";
/// Options that are not settings.
const NO_SETTINGS: [&str; 4] = [FILE, SET, "schema", "help"];

const LONGEST: u64 = 1 << 20;

/// Gives every option that is a setting an environment variable.
pub(super) fn with_environment(all: Command) -> Command {
    let settings = all.find_subcommand(SERVE).cloned().unwrap_or_default();
    with_variables(all, &settings)
}

fn with_variables(command: Command, settings: &Command) -> Command {
    let command = command.mut_subcommands(|command| with_variables(command, settings));
    if !has(&command, FILE) {
        return command;
    }
    command.mut_args(|arg| match variable(&arg).filter(|_| arg.get_long().is_some_and(|long| has(settings, long))) {
        Some(variable) => arg.env(variable).hide_env(true),
        None => arg,
    })
}

fn has(command: &Command, long: &str) -> bool {
    command.get_arguments().any(|arg| arg.get_long() == Some(long))
}

/// The called command, if it takes settings, with its matches.
fn called<'a>(mut command: &'a Command, mut given: &'a ArgMatches) -> Option<(&'a Command, &'a ArgMatches)> {
    while let Some((name, below)) = given.subcommand() {
        (command, given) = (command.find_subcommand(name)?, below);
    }
    has(command, FILE).then_some((command, given))
}

/// The name of an option's variable; `None` if it has one already or is not a setting.
fn variable(arg: &Arg) -> Option<String> {
    let long = arg.get_long().filter(|long| arg.get_env().is_none() && !NO_SETTINGS.contains(long))?;
    Some(format!("{PREFIX}{}", long.replace('-', "_").to_uppercase()))
}

/// Names of the settings that do not come from the command line.
#[derive(Debug, Default)]
pub(super) struct Sources {
    file: Vec<String>,
    variables: Vec<String>,
}

/// Appends the settings of the variables and the file to the command line, and returns their sources.
///
/// # Errors
/// The file is unreadable or not TOML, a setting is unknown, or its value has the wrong type or is out of range.
pub(super) fn complete(all: &Command, mut line: Vec<OsString>) -> Result<(Vec<OsString>, Sources), clap::Error> {
    let mut sources = Sources::default();
    // errors elsewhere are reported when the whole line is parsed
    let Ok(given) = all.clone().ignore_errors(true).try_get_matches_from(&line) else { return Ok((line, sources)) };
    let Some((command, given)) = called(all, &given) else { return Ok((line, sources)) };
    let refused = |why: String| command.clone().error(ErrorKind::ValueValidation, why);
    let takes_all = has(command, SET);
    let settings = if takes_all { command } else { all.find_subcommand(SERVE).unwrap_or(command) };
    let mut said: Vec<String> =
        given.try_get_many::<Assignment>(SET).ok().flatten().into_iter().flatten().map(|one| one.setting.name()).collect();
    let mut set = |setting: &'static Setting, value: &str, from: &mut Vec<String>| -> Result<(), String> {
        setting.parse(value)?;
        if takes_all && !said.contains(&setting.name()) {
            line.push(format!("--{SET}={}={value}", setting.name()).into());
            from.push(setting.name());
            said.push(setting.name());
        }
        Ok(())
    };
    for (name, value) in variables(settings, std::env::vars_os()).map_err(refused)? {
        set(name, &value, &mut sources.variables).map_err(refused)?;
    }
    let Some(file) = given.get_one::<std::path::PathBuf>(FILE) else { return Ok((line, sources)) };
    let refused = |why: String| refused(format!("{}: {why}", file.display()));
    let unknown = |key: &str| refused(format!("`{key}` is no setting; `tmpi config` lists them"));
    let mut flags = Vec::new();
    for (key, value) in read(file).map_err(refused)? {
        if let Value::Table(table) = &value {
            for (name, value) in table {
                let setting = settings::of_key(&key, name).ok_or_else(|| unknown(&format!("{key}.{name}")))?;
                set(setting, &json(value), &mut sources.file).map_err(refused)?;
            }
            continue;
        }
        setting(settings, &key).ok_or_else(|| unknown(&key))?;
        let Some(option) = setting(command, &key) else { continue };
        let id = option.get_id().as_str();
        if matches!(given.value_source(id), Some(ValueSource::CommandLine | ValueSource::EnvVariable)) {
            continue;
        }
        let values = values(option, &value).map_err(|why| refused(format!("`{key}`: {why}")))?;
        flags.extend(values.iter().map(|value| OsString::from(format!("--{key}={value}"))));
        sources.file.push(id.to_owned());
    }
    line.extend(flags);
    Ok((line, sources))
}

fn setting<'a>(command: &'a Command, key: &str) -> Option<&'a Arg> {
    command.get_arguments().find(|a| a.get_long() == Some(key) && !NO_SETTINGS.contains(&key) && !a.is_hide_set())
}

/// The variables of settings without an option.
///
/// # Errors
/// A variable has the prefix but is not a setting: most likely it is misspelt.
fn variables(command: &Command, all: impl Iterator<Item = (OsString, OsString)>) -> Result<Vec<(&'static Setting, String)>, String> {
    let known: Vec<&OsStr> = command.get_arguments().filter_map(Arg::get_env).collect();
    let ours = all.filter(|(name, _)| name.to_str().is_some_and(|n| n.starts_with(PREFIX)) && !known.contains(&name.as_os_str()));
    ours.map(|(name, value)| {
        let name = name.to_string_lossy();
        let setting = settings::of_variable(PREFIX, &name);
        let setting = setting.ok_or_else(|| format!("the variable {name} is no setting; `tmpi config` lists them"))?;
        Ok((setting, value.to_string_lossy().into_owned()))
    })
    .collect()
}

fn read(file: &Path) -> Result<Table, String> {
    let length = std::fs::metadata(file).map_err(|e| e.to_string())?.len();
    if length > LONGEST {
        return Err(format!("{length} bytes, over {LONGEST}"));
    }
    parse(&std::fs::read_to_string(file).map_err(|e| e.to_string())?)
}

fn parse(text: &str) -> Result<Table, String> {
    text.parse::<Table>().map_err(|e| e.to_string().trim_end().to_owned())
}

/// Fuzz target: parses a file and its values.
///
/// # Panics
/// A refusal has no reason.
pub fn fuzz(text: &str) {
    static DEFINITION: std::sync::OnceLock<Command> = std::sync::OnceLock::new();
    let command = DEFINITION.get_or_init(|| ServeArgs::augment_args(Command::new(SERVE)));
    match parse(text) {
        Err(why) => assert!(!why.is_empty()),
        Ok(table) => {
            for (key, value) in table {
                if let Value::Table(table) = &value {
                    let named = |(name, value): (&String, &Value)| settings::of_key(&key, name)?.parse(&json(value)).err();
                    assert!(table.iter().filter_map(named).all(|why| !why.is_empty()));
                }
                let Some(option) = setting(command, &key) else { continue };
                match values(option, &value) {
                    Err(why) => assert!(!why.is_empty()),
                    Ok(values) => values.iter().for_each(|value| drop(literal(value, option))),
                }
            }
        }
    }
}

fn json(value: &Value) -> String {
    serde_json::to_value(value).map_or_else(|error| error.to_string(), |value| value.to_string())
}

/// A value of the file as values of the command line.
fn values(option: &Arg, value: &Value) -> Result<Vec<String>, String> {
    let one = |value: &Value| match value {
        Value::Boolean(is) => Ok(is.to_string()),
        Value::String(text) if !text.is_empty() => Ok(text.clone()),
        Value::Integer(n) => Ok(n.to_string()),
        Value::Float(x) => Ok(x.to_string()),
        _ => Err("a text, a number, true or false is expected".to_owned()),
    };
    match value {
        Value::Array(all) if matches!(option.get_action(), ArgAction::Append) || option.get_value_delimiter().is_some() => {
            all.iter().map(|value| if value.is_table() && is_webhooks(option) { Ok(json(value)) } else { one(value) }).collect()
        }
        value => one(value).map(|v| vec![v]),
    }
}

/// The command line of the processes that make photos for a server with these settings.
pub(super) fn for_makers(command: &Command, given: &ArgMatches) -> Vec<OsString> {
    let networks = ModelFlags::augment_args(Command::new(""));
    let is_one = |long: &str| FOR_MAKERS.contains(&long) || networks.get_arguments().any(|arg| arg.get_long() == Some(long));
    let mut line = vec![OsString::from(SERVE)];
    for option in command.get_arguments() {
        let (id, Some(long)) = (option.get_id().as_str(), option.get_long().filter(|long| is_one(long))) else { continue };
        if !matches!(given.value_source(id), Some(ValueSource::CommandLine | ValueSource::EnvVariable)) {
            continue;
        }
        for value in given.get_raw(id).into_iter().flatten() {
            let mut text = OsString::from(format!("--{long}="));
            text.push(value);
            line.push(text);
        }
    }
    line
}

/// The effective settings as a file for `--config`, each line with its source. Defaults and derived values are comments.
pub(super) fn shown(command: &Command, given: &ArgMatches, sources: &Sources, args: &ServeArgs) -> anyhow::Result<String> {
    let (limits, effects) = args.effects()?;
    let mut text = String::new();
    for option in command.get_arguments().filter(|a| !a.is_hide_set()) {
        let (id, Some(long)) = (option.get_id().as_str(), option.get_long()) else { continue };
        if NO_SETTINGS.contains(&long) {
            continue;
        }
        let source = match given.value_source(id) {
            _ if sources.file.iter().any(|f| f == id) => "file",
            Some(ValueSource::CommandLine) => "command line",
            Some(ValueSource::EnvVariable) => "environment",
            _ => "",
        };
        let effect = effects.iter().find(|effect| effect.option == long);
        let said: Vec<&str> =
            [source, effect.and_then(|e| e.note.as_deref()).unwrap_or_default()].into_iter().filter(|s| !s.is_empty()).collect();
        // comment defaults out: some options are only valid together with others
        let begin = if source.is_empty() { "# " } else { "" };
        let end = if said.is_empty() { String::new() } else { format!(" # {}", said.join(", ")) };
        let raw = given.get_raw(id).into_iter().flatten().map(|v| v.to_string_lossy().into_owned());
        let values: Vec<String> = effect.and_then(|e| e.value.clone()).map_or_else(|| raw.collect(), |value| vec![value]);
        let told = values.iter().map(|value| literal(value, option)).collect::<Vec<_>>();
        let _ = match told.as_slice() {
            [] => writeln!(text, "# {long} ={end}"),
            [one] if !matches!(option.get_action(), ArgAction::Append) => writeln!(text, "{begin}{long} = {one}{end}"),
            all => writeln!(text, "{begin}{long} = [{}]{end}", all.join(", ")),
        };
    }
    let said: Vec<String> = given.get_many::<Assignment>(SET).into_iter().flatten().map(|one| one.setting.name()).collect();
    text.push_str(&shown_tables(&limits, &said, sources)?);
    Ok(text)
}

fn shown_tables(limits: &Limits, said: &[String], sources: &Sources) -> serde_json::Result<String> {
    let limits = serde_json::to_value(limits)?;
    let (mut text, mut table) = (String::new(), "");
    for setting in settings::all() {
        let (name, Setting { table: of, key, .. }) = (setting.name(), setting);
        if of != table {
            table = of;
            let _ = writeln!(text, "\n[{table}]");
        }
        let value = setting.value(&limits);
        let from = |names: &[String]| names.contains(&name);
        let _ = if !from(said) {
            writeln!(text, "# {key} = {value}")
        } else if from(&sources.file) {
            writeln!(text, "{key} = {value} # file")
        } else {
            writeln!(text, "{key} = {value} # {}", if from(&sources.variables) { "environment" } else { "command line" })
        };
    }
    Ok(text)
}

pub(super) fn schema(command: &Command) -> serde_json::Value {
    settings::file_schema(command, |option| option.get_long().is_some_and(|long| setting(command, long).is_some()))
}

fn is_webhooks(option: &Arg) -> bool {
    option.get_long() == Some(WEBHOOKS)
}

/// A webhook as TOML, with its secret hidden.
fn webhook(value: &str) -> String {
    let webhook: serde_json::Value = serde_json::from_str(value).unwrap_or_default();
    let text = |text: String| serde_json::Value::String(text);
    let url = text(without_secrets(webhook["url"].as_str().unwrap_or_default()));
    let events = if webhook["events"].is_array() { format!(", events = {}", webhook["events"]) } else { String::new() };
    format!("{{ url = {url}, secret = {}{events} }}", text("…".into()))
}

/// A value as TOML, with the secrets in URLs hidden.
fn literal(value: &str, option: &Arg) -> String {
    if is_webhooks(option) {
        return webhook(value);
    }
    let whole = value.parse::<i64>().is_ok_and(|n| n.to_string() == value);
    if whole {
        return value.to_owned();
    }
    let is_address = value.contains("://") || option.get_long().is_some_and(|long| ADDRESSES.contains(&long));
    // JSON strings are valid TOML strings
    serde_json::Value::String(if is_address { without_secrets(value) } else { value.to_owned() }).to_string()
}

/// A URL with user, password, query values and fragment hidden.
pub(super) fn without_secrets(address: &str) -> String {
    let cut =
        |text: &str, at: char| text.split_once(at).map_or_else(|| (text.to_owned(), None), |(a, b)| (a.to_owned(), Some(b.to_owned())));
    let (address, fragment) = cut(address, '#');
    let (address, query) = cut(&address, '?');
    let (scheme, place) = address.split_once("://").map_or((String::new(), address.as_str()), |(s, rest)| (format!("{s}://"), rest));
    let authority = place.split('/').next().unwrap_or_default();
    // a slash in the password ends the authority too early: the "port" is then not a number
    let is_cut = !authority.contains('@') && authority.rsplit_once(':').is_some_and(|(_, port)| !port.bytes().all(|b| b.is_ascii_digit()));
    let users = if is_cut { place } else { authority }.rfind('@');
    let place = users.map_or_else(|| place.to_owned(), |at| format!("…{}", &place[at..]));
    let hidden = |pair: &str| pair.split_once('=').map_or_else(|| "…".to_owned(), |(name, _)| format!("{name}=…"));
    let query = query.map_or_else(String::new, |query| format!("?{}", query.split('&').map(hidden).collect::<Vec<_>>().join("&")));
    format!("{scheme}{place}{query}{}", if fragment.is_some() { "#…" } else { "" })
}

pub(super) fn told_without_secrets(mut error: clap::Error) -> clap::Error {
    if let Some(ContextValue::String(value)) = error.get(ContextKind::InvalidValue)
        && (value.contains('@') || value.contains("://") || value.starts_with('{'))
    {
        // a webhook has a secret
        let value = ContextValue::String(if value.starts_with('{') { "…".to_owned() } else { without_secrets(value) });
        error.insert(ContextKind::InvalidValue, value);
    }
    error
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secrets_in_addresses_are_hidden() {
        for (address, told) in [
            ("postgres://me:secret@127.0.0.1:5432/tmpi", "postgres://…@127.0.0.1:5432/tmpi"),
            ("me:secret@127.0.0.1:4222", "…@127.0.0.1:4222"),
            ("postgres://secret@[::1]:5432", "postgres://…@[::1]:5432"),
            ("postgres://[::1]:5432", "postgres://[::1]:5432"),
            ("http://me:se@cret@host/a@b", "http://…@host/a@b"),
            ("http://me:secret/secret@host/a", "http://…@host/a"),
            ("http://127.0.0.1:4318/a@b", "http://127.0.0.1:4318/a@b"),
            ("https://host/net.onnx?sig=secret&b=secret&secret#secret", "https://host/net.onnx?sig=…&b=…&…#…"),
            ("https://host?a=secret@x:y", "https://host?a=…"),
            ("s3://bucket/prefix", "s3://bucket/prefix"),
            ("file:///var/store", "file:///var/store"),
        ] {
            assert_eq!(without_secrets(address), told, "{address}");
        }
    }
}
