//! Checks the documentation: links resolve, every page is in the table of contents, commands have valid options, and blocks marked `<!--
//! runs -->` run.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use tmpi_testing::Need;

/// Checked pages outside `docs`.
const OTHERS: [&str; 6] =
    ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "docker/README.md", "training/README.md", "tests/load/README.md"];
/// Marks the next code block to run, in a folder with `photo.jpg`.
const RUNS: &str = "<!-- runs -->";

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A page of the documentation.
struct Page {
    /// Its path from the root of the repository.
    name: String,
    text: String,
}

/// A code block of a page.
struct Block {
    lines: Vec<String>,
    runs: bool,
}

fn markdown_below(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()) {
        if entry.is_dir() {
            markdown_below(&entry, found);
        } else if entry.extension().is_some_and(|e| e == "md") {
            found.push(entry);
        }
    }
}

fn pages() -> Vec<Page> {
    let mut paths: Vec<PathBuf> = OTHERS.iter().map(|o| root().join(o)).collect();
    markdown_below(&root().join("docs"), &mut paths);
    let page = |path: PathBuf| Page {
        name: path.strip_prefix(root()).unwrap().to_string_lossy().into_owned(),
        text: fs::read_to_string(&path).unwrap(),
    };
    paths.into_iter().map(page).collect()
}

impl Page {
    /// Targets of `[text](target)`, without those in code.
    fn links(&self) -> Vec<&str> {
        let prose = self.text.lines().filter(|l| !l.starts_with("    "));
        prose.flat_map(|l| l.split("](").skip(1).filter_map(|rest| rest.split_once(')').map(|(target, _)| target))).collect()
    }

    /// Anchors of its headings, as forges make them.
    fn anchors(&self) -> Vec<String> {
        let headings = self.text.lines().filter(|l| l.starts_with('#')).map(|l| l.trim_start_matches('#').trim());
        let anchor = |heading: &str| {
            let kept = heading.to_lowercase().chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c)).collect::<String>();
            kept.replace(' ', "-")
        };
        headings.map(anchor).collect()
    }

    /// Blocks that are indented by four spaces.
    fn blocks(&self) -> Vec<Block> {
        let mut blocks: Vec<Block> = Vec::new();
        let (mut is_open, mut runs) = (false, false);
        for line in self.text.lines() {
            if let Some(code) = line.strip_prefix("    ") {
                if !is_open {
                    blocks.push(Block { lines: Vec::new(), runs: std::mem::take(&mut runs) });
                }
                blocks.last_mut().unwrap().lines.push(code.to_owned());
                is_open = true;
            } else if !line.is_empty() {
                is_open = false;
                runs = line == RUNS;
            }
        }
        blocks
    }
}

#[test]
fn internal_links_resolve() {
    let pages = pages();
    let mut count = 0;
    for page in &pages {
        let folder = root().join(&page.name).parent().unwrap().to_owned();
        for link in page.links().into_iter().filter(|l| !l.contains("://")) {
            count += 1;
            let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
            let target = if file.is_empty() { root().join(&page.name) } else { folder.join(file) };
            assert!(target.exists(), "{}: {link}", page.name);
            let target = target.canonicalize().unwrap();
            let of_target = pages.iter().find(|p| root().join(&p.name).canonicalize().unwrap() == target);
            let is_there = anchor.is_empty() || of_target.is_some_and(|p| p.anchors().iter().any(|a| a == anchor));
            assert!(is_there, "{}: {link} names no heading", page.name);
        }
    }
    assert!(count > 20, "{count} links were checked");
}

#[test]
fn every_page_is_in_the_table_of_contents() {
    let pages = pages();
    let summary = pages.iter().find(|p| p.name == "docs/SUMMARY.md").unwrap();
    let listed = summary.links();
    let of_book = pages.iter().filter_map(|p| p.name.strip_prefix("docs/")).filter(|n| *n != "SUMMARY.md");
    let missing: Vec<&str> = of_book.filter(|n| !listed.contains(n)).collect();
    assert!(missing.is_empty(), "{missing:?}");
}

/// Arguments of a line that calls the program, without comments and redirections.
fn arguments(line: &str) -> Option<Vec<String>> {
    let words = line.strip_prefix("tmpi ")?;
    let words = words.split(" #").next()?.split(" > ").next()?;
    Some(words.split_whitespace().map(|w| w.trim_matches('\'').to_owned()).collect())
}

#[test]
fn commands_have_the_options_of_the_program() {
    let folder = tempfile::tempdir().unwrap();
    // the program reads this file while it parses its arguments
    fs::write(folder.path().join("strokes.json"), r#"{"version": 1, "strokes": []}"#).unwrap();
    let mut count = 0;
    for page in pages() {
        for line in page.blocks().iter().flat_map(|b| &b.lines) {
            let Some(arguments) = arguments(line) else { continue };
            count += 1;
            // clap parses each argument with its value before `--help`
            let out = Command::new(env!("CARGO_BIN_EXE_tmpi")).args(arguments).arg("--help").current_dir(&folder).output().unwrap();
            assert!(out.status.success(), "{}: {line}\n{}", page.name, String::from_utf8_lossy(&out.stderr));
        }
    }
    assert!(count > 30, "{count} commands were checked");
    let wrong = Command::new(env!("CARGO_BIN_EXE_tmpi")).args(["make", "--nonsense", "--help"]).output().unwrap();
    assert!(!wrong.status.success(), "a wrong option is noticed");
}

#[test]
fn marked_blocks_run() {
    let library = root().join(".tmpi/onnxruntime/libonnxruntime.so");
    let library = std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from).or_else(|| library.is_file().then_some(library));
    let Some(library) = Need::Onnx.or_skip(library.ok_or("cargo xtask serve fetches it")) else { return };
    let program = Path::new(env!("CARGO_BIN_EXE_tmpi")).parent().unwrap();
    let path = std::env::join_paths(std::iter::once(program.to_owned()).chain(std::env::split_paths(&std::env::var_os("PATH").unwrap())));
    let path = path.unwrap();
    let mut count = 0;
    for page in pages() {
        let folder = tempfile::tempdir().unwrap();
        fs::copy(root().join("docs/sample.jpg"), folder.path().join("photo.jpg")).unwrap();
        for line in page.blocks().iter().filter(|b| b.runs).flat_map(|b| &b.lines) {
            if (line.contains(".mp4") || line.contains(".webp")) && Need::Ffmpeg.or_skip(has_ffmpeg()).is_none() {
                continue;
            }
            let mut command = Command::new("sh");
            command.args(["-e", "-c", line]).current_dir(folder.path()).env("PATH", &path).env("ORT_DYLIB_PATH", &library);
            let out = command.env("TMPI_MODELS", folder.path().join("models")).env_remove("TMPI_DEPTH_MODEL").output().unwrap();
            assert!(out.status.success(), "{}: {line}\n{}", page.name, String::from_utf8_lossy(&out.stderr));
            count += 1;
        }
    }
    assert!(count > 15, "{count} commands ran");
}

fn has_ffmpeg() -> Result<(), String> {
    Command::new("ffmpeg").arg("-version").output().map(drop).map_err(|e| format!("ffmpeg: {e}"))
}

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
    is_written(CLI, &page);
}

/// Compares a generated page with the file, or writes it.
fn is_written(name: &str, page: &str) {
    let path = root().join(name);
    if std::env::var("TMPI_BLESS").is_ok_and(|v| v == "docs") {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, page).unwrap();
    } else {
        let written = fs::read_to_string(&path).unwrap_or_default();
        assert!(written == page, "{name} is stale: TMPI_BLESS=docs cargo test --test docs writes it");
    }
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
    is_written(CONFIGURATION, &page);
}
