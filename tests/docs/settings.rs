//! Pages that the program's own help and schema generate.

use std::process::Command;

use serde_json::Value;

use crate::check_generated;

/// The page with the help of every command.
const CLI: &str = "docs/reference/command-line.md";

/// The output of `--help`, with an empty environment.
fn help(command: &[String]) -> String {
    let out = Command::new(env!("CARGO_BIN_EXE_tmpi")).env_clear().args(command).arg("--help").output().unwrap();
    assert!(out.status.success(), "{command:?}");
    let lines = String::from_utf8(out.stdout).unwrap();
    lines.lines().map(|l| l.trim_end().to_owned() + "\n").collect()
}

/// Commands that take all options of `tmpi serve`.
const LIKE_SERVE: [&str; 2] = ["work", "config"];

/// The help of a command, with a reference to `tmpi serve` in place of the same options.
fn without_options_of_serve(command: &[String], text: &str) -> String {
    if !matches!(command, [name] if LIKE_SERVE.contains(&name.as_str())) {
        return text.to_owned();
    }
    let options = |text: &str| text.lines().filter_map(|l| l.trim().strip_prefix("--")).map(str::to_owned).collect::<Vec<_>>();
    let of_serve = options(&help(&["serve".to_owned()]));
    let own: String = options(text).into_iter().filter(|o| !of_serve.contains(o)).map(|o| [", and --", &o].concat()).collect();
    [text.split("\nOptions:\n").next().unwrap(), "\nOptions: those of `tmpi serve`", &own, "\n"].concat()
}

/// Adds the help of a command and its subcommands.
fn add_help(command: &[String], page: &mut String) {
    let text = help(command);
    let text = without_options_of_serve(command, &text);
    let name = std::iter::once("tmpi").chain(command.iter().map(String::as_str)).collect::<Vec<_>>().join(" ");
    page.push_str(&["\n## ", &name, "\n\n```text\n", &text, "```\n"].concat());
    let list = text.split_once("\nCommands:\n").map(|(_, rest)| rest.split("\n\n").next().unwrap());
    let names = list.into_iter().flat_map(str::lines).filter(|l| l.starts_with("  ") && !l.starts_with("   "));
    for below in names.filter_map(|l| l.split_whitespace().next()).filter(|n| *n != "help") {
        add_help(&[command, &[below.to_owned()]].concat(), page);
    }
}

#[test]
fn the_command_line_reference_is_current() {
    let mut page = "# Command line reference\n\nThis page is generated: `TMPI_BLESS=docs cargo test --test docs` writes it.\n".to_owned();
    add_help(&[], &mut page);
    check_generated(CLI, &page);
}

/// The page with every setting.
const CONFIGURATION: &str = "docs/reference/configuration.md";
const CONFIGURATION_HEAD: &str = "# Configuration reference

This page is generated from `tmpi config --schema`: `TMPI_BLESS=docs cargo test --test docs` writes it.

`tmpi serve`, `work` and `config` read settings from the command line, from variables, and from the TOML file of `--config` or
`TMPI_CONFIG`. The command line counts first, then variables, then the file, then the default. Unknown names and values out of range are errors.

- Each option of [`tmpi serve`](command-line.md) is a key at the top of the file. Its variable is `TMPI_SERVE_` and its name: `--host` is `host = [\"photos.example.org\"]` and `TMPI_SERVE_HOST`.
- Each setting below is a key of a table. `uploads` of `[rates]` is `TMPI_SERVE_RATES_UPLOADS`, and `--set rates.uploads=30`.

`tmpi config` prints what holds and where it comes from.
";

/// A row for a setting.
fn row(key: &str, setting: &Value) -> String {
    let number = |name: &str| setting[name].as_f64().map(|n| n.to_string());
    let unit = setting["format"].as_str().filter(|format| !format.starts_with("uint") && *format != "double").unwrap_or_default();
    let least = number("minimum").unwrap();
    let range = number("maximum").map_or_else(|| format!("from {least}"), |most| format!("{least} to {most}"));
    format!("| `{key}` | {} | {range} | {unit} | {} |\n", setting["default"], setting["description"].as_str().unwrap().replace('\n', " "))
}

#[test]
fn the_configuration_reference_is_current() {
    let out = Command::new(env!("CARGO_BIN_EXE_tmpi")).env_clear().args(["config", "--schema"]).output().unwrap();
    assert!(out.status.success());
    let schema: Value = serde_json::from_slice(&out.stdout).unwrap();
    let mut page = CONFIGURATION_HEAD.to_owned();
    for (name, table) in schema["properties"].as_object().unwrap().iter().filter(|(_, table)| table["properties"].is_object()) {
        let rows: String = table["properties"].as_object().unwrap().iter().map(|(key, setting)| row(key, setting)).collect();
        let words = table["description"].as_str().unwrap().replace('\n', " ");
        let head = "| key | default | range | unit | what |\n|---|---|---|---|---|\n";
        page.push_str(&["\n## ", name, "\n\n", &words, "\n\n", head, &rows].concat());
    }
    check_generated(CONFIGURATION, &page);
}
