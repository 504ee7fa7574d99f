//! Checks the names in `docker/` and the threat model: options and their values, metrics, tests.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Files that start the server, and how often.
const CALLERS: [(&str, usize); 7] = [
    ("Dockerfile", 1),
    ("compose.yaml", 1),
    ("compose.cluster.yaml", 2),
    ("tmpi.service", 1),
    ("kubernetes/deployment.yaml", 1),
    ("kubernetes/cluster/serve.yaml", 1),
    ("kubernetes/cluster/work.yaml", 1),
];
/// Texts that mention options.
const TEXTS: [&str; 3] = ["docker/README.md", "docker/prometheus/alerts.yaml", "docs/threat-model.md"];
/// Options of other programs in these texts: `tmpi key`, cargo, kubectl, systemd-analyze, docker and `docker/check.py`.
const OF_OTHERS: [&str; 12] = [
    "--scope",
    "--create",
    "--release",
    "--workspace",
    "--test",
    "--offline",
    "--strict",
    "--build",
    "--build-arg",
    "--check",
    "--detach",
    "--require",
];
/// Suffixes of counters and histograms.
const ENDS: [&str; 4] = ["_total", "_bucket", "_sum", "_count"];

fn read(file: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
    fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The text of all files below a folder of the repository.
fn below(folder: &str) -> String {
    let mut folders: Vec<PathBuf> = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join(folder)];
    let mut all = String::new();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                all.push_str(&String::from_utf8_lossy(&fs::read(&path).unwrap()));
                all.push('\n');
            }
        }
    }
    all
}

/// Words that begin with `start` and a letter, and consist of lower-case letters, digits and `also`.
fn words(text: &str, start: &str, also: char) -> BTreeSet<String> {
    let is_of = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == also;
    let begins = |at: usize| !text[..at].ends_with(|c: char| c.is_ascii_alphanumeric() || "-_.".contains(c));
    let whole = |at: usize| text[at..].chars().take_while(|c| is_of(*c)).collect::<String>();
    let goes_on = |at: usize| text[at + start.len()..].starts_with(|c: char| c.is_ascii_lowercase());
    text.match_indices(start).filter(|(at, _)| begins(*at) && goes_on(*at)).map(|(at, _)| whole(at)).collect()
}

/// The arguments of each call of the server in a file, from `serve` or `work` on: in YAML, a systemd unit or a Dockerfile.
fn calls(text: &str) -> Vec<Vec<String>> {
    let owned = |words: Vec<&str>| words.into_iter().map(str::to_owned).collect::<Vec<String>>();
    let mut all: Vec<Vec<String>> = Vec::new();
    let mut list: Option<Vec<String>> = None;
    for line in text.lines().map(str::trim) {
        if line.starts_with('#') {
            continue;
        }
        if let Some(command) = line.strip_prefix("ExecStart=") {
            all.push(owned(command.split_whitespace().skip_while(|word| *word != "serve").collect()));
        } else if let Some(command) = line.strip_prefix("CMD [") {
            let quoted: Vec<&str> = command.split('"').skip(1).step_by(2).collect();
            all.push(owned(quoted.into_iter().skip_while(|word| *word != "serve").collect()));
        } else if let Some(command @ ("serve" | "work")) = line.strip_prefix("- ") {
            all.extend(list.replace(vec![command.to_owned()]));
        } else if let (Some(list), Some(argument)) = (&mut list, line.strip_prefix("- --")) {
            list.push(format!("--{argument}"));
        } else {
            all.extend(list.take());
        }
    }
    all.extend(list);
    all
}

/// Parses a call without starting anything: whether the program accepts it, and its output.
fn asked(call: &[String]) -> (bool, String) {
    // clap parses each argument with its value before `--help`
    let out = Command::new(env!("CARGO_BIN_EXE_tmpi")).args(call).arg("--help").output().unwrap();
    let said = if out.status.success() { out.stdout } else { out.stderr };
    (out.status.success(), String::from_utf8_lossy(&said).into_owned())
}

#[test]
fn every_call_of_the_server_is_valid() {
    for (file, count) in CALLERS {
        let calls = calls(&read(&format!("docker/{file}")));
        assert_eq!(calls.len(), count, "{file}: {calls:?}");
        for call in calls {
            // a node that only works has no public address
            let door = if call[0] == "work" { "--admin" } else { "--addr" };
            assert!(call.iter().any(|argument| argument.starts_with(door)), "{file}: {call:?}");
            let (taken, said) = asked(&call);
            assert!(taken, "{file}: {said}");
        }
    }
    let wrong = |argument: &str| !asked(&["serve".to_owned(), argument.to_owned()]).0;
    assert!(wrong("--nonsense") && wrong("--set=limits.pixels=0"), "wrong options and wrong values are noticed");
}

#[test]
fn every_mentioned_option_exists() {
    let known = words(&asked(&["serve".to_owned()]).1, "--", '-');
    assert!(known.contains("--data"), "{known:?}");
    for file in TEXTS {
        let unknown: Vec<String> =
            words(&read(file), "--", '-').into_iter().filter(|o| !known.contains(o) && !OF_OTHERS.contains(&o.as_str())).collect();
        assert!(unknown.is_empty(), "{file}: {unknown:?}");
    }
}

#[test]
fn every_metric_of_alerts_and_dashboard_exists() {
    let sources = below("src");
    for folder in ["docker/prometheus", "docker/grafana"] {
        let named = words(&below(folder), "tmpi_", '_');
        assert!(named.len() > 10, "{folder}: {named:?}");
        let registered = |name: &str| sources.contains(&format!("\"{name}\""));
        let unknown: Vec<&String> = named
            .iter()
            .filter(|name| !registered(name) && !ENDS.iter().any(|end| name.strip_suffix(end).is_some_and(registered)))
            .collect();
        assert!(unknown.is_empty(), "{folder}: {unknown:?}");
    }
}

#[test]
fn every_metric_of_the_program_is_on_the_dashboard() {
    let (sources, dashboard) = (below("src"), words(&below("docker/grafana"), "tmpi_", '_'));
    // in either form in which the sources register metrics
    let given = sources.match_indices("(\"tmpi_").filter_map(|(at, _)| sources[at + 2..].split_once("\", \"").map(|(name, _)| name));
    let names: BTreeSet<&str> = given.filter(|name| name.chars().all(|c| c.is_ascii_lowercase() || c == '_')).collect();
    assert!(names.len() > 30 && names.contains("tmpi_requests"), "{names:?}");
    let shown = |name: &str| dashboard.contains(name) || ENDS.iter().any(|end| dashboard.contains(&format!("{name}{end}")));
    let missing: Vec<&&str> = names.iter().filter(|name| !shown(name)).collect();
    assert!(missing.is_empty(), "{missing:?}");
}

#[test]
fn every_test_in_the_threat_model_exists() {
    let sources = below("tests/http") + &below("src");
    let text = read("docs/threat-model.md");
    let quoted = text.split('`').skip(1).step_by(2);
    let is_test = |word: &str| {
        word.matches('_').count() > 2
            && !word.starts_with("tmpi_")
            && word.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
    };
    let named: BTreeSet<&str> = quoted.filter(|word| is_test(word)).collect();
    assert!(named.len() > 20, "{named:?}");
    let missing: Vec<&&str> = named.iter().filter(|name| !sources.contains(&format!("fn {name}()"))).collect();
    assert!(missing.is_empty(), "{missing:?}");
}
