//! Checks that options, metrics and tests named in `docker/` and the threat model exist.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Command;

/// Files that start the server, with the number of calls in each.
const CALLERS: [(&str, usize); 7] = [
    ("Dockerfile", 1),
    ("compose.yaml", 1),
    ("compose.cluster.yaml", 2),
    ("tmpi.service", 1),
    ("kubernetes/deployment.yaml", 1),
    ("kubernetes/cluster/serve.yaml", 1),
    ("kubernetes/cluster/work.yaml", 1),
];
/// Files that mention options.
const TEXTS: [&str; 3] = ["docker/README.md", "docker/prometheus/alerts.yaml", "docs/threat-model.md"];
/// Options of other commands in these files: `tmpi key`, cargo, kubectl, systemd-analyze, docker and `docker/lint.py`.
const OPTIONS_OF_OTHERS: [&str; 12] = [
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
/// Suffixes that Prometheus adds to counters and histograms.
const SUFFIXES: [&str; 4] = ["_total", "_bucket", "_sum", "_count"];

fn read(file: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
    fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The text of all files in a folder of the repository, recursively.
fn read_folder(folder: &str) -> String {
    let files = tmpi_testing::files_below(&Path::new(env!("CARGO_MANIFEST_DIR")).join(folder));
    files.iter().map(|path| String::from_utf8_lossy(&fs::read(path).unwrap()).into_owned() + "\n").collect()
}

/// Words that start with `start` and a letter, and consist of lower-case letters, digits and `also`.
fn words(text: &str, start: &str, also: char) -> BTreeSet<String> {
    let is_of = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == also;
    let begins = |at: usize| !text[..at].ends_with(|c: char| c.is_ascii_alphanumeric() || "-_.".contains(c));
    let whole = |at: usize| text[at..].chars().take_while(|c| is_of(*c)).collect::<String>();
    let goes_on = |at: usize| text[at + start.len()..].starts_with(|c: char| c.is_ascii_lowercase());
    text.match_indices(start).filter(|(at, _)| begins(*at) && goes_on(*at)).map(|(at, _)| whole(at)).collect()
}

/// The arguments of each server call in a YAML file, systemd unit or Dockerfile, starting with `serve` or `work`.
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

/// Whether the program accepts the arguments, and its output; starts no server.
fn parse_only(call: &[String]) -> (bool, String) {
    // clap parses each argument with its value before `--help`
    let out = Command::new(env!("CARGO_BIN_EXE_tmpi")).args(call).arg("--help").output().unwrap();
    let output = if out.status.success() { out.stdout } else { out.stderr };
    (out.status.success(), String::from_utf8_lossy(&output).into_owned())
}

#[test]
fn deployment_files_start_the_server_with_valid_options() {
    for (file, count) in CALLERS {
        let calls = calls(&read(&format!("docker/{file}")));
        assert_eq!(calls.len(), count, "{file}: {calls:?}");
        for call in calls {
            // a worker node has no public address
            let listens = if call[0] == "work" { "--admin" } else { "--addr" };
            assert!(call.iter().any(|argument| argument.starts_with(listens)), "{file}: {call:?}");
            let (accepted, output) = parse_only(&call);
            assert!(accepted, "{file}: {output}");
        }
    }
    let wrong = |argument: &str| !parse_only(&["serve".to_owned(), argument.to_owned()]).0;
    assert!(wrong("--nonsense") && wrong("--set=limits.pixels=0"), "the test detects invalid options and values");
}

#[test]
fn every_option_in_the_documents_exists() {
    let known = words(&parse_only(&["serve".to_owned()]).1, "--", '-');
    assert!(known.contains("--data"), "{known:?}");
    for file in TEXTS {
        let unknown: Vec<String> =
            words(&read(file), "--", '-').into_iter().filter(|o| !known.contains(o) && !OPTIONS_OF_OTHERS.contains(&o.as_str())).collect();
        assert!(unknown.is_empty(), "{file}: {unknown:?}");
    }
}

#[test]
fn every_metric_of_alerts_and_dashboard_exists() {
    let sources = read_folder("src");
    for folder in ["docker/prometheus", "docker/grafana"] {
        let names = words(&read_folder(folder), "tmpi_", '_');
        assert!(names.len() > 10, "{folder}: {names:?}");
        let registered = |name: &str| sources.contains(&format!("\"{name}\""));
        let unknown: Vec<&String> = names
            .iter()
            .filter(|name| !registered(name) && !SUFFIXES.iter().any(|suffix| name.strip_suffix(suffix).is_some_and(registered)))
            .collect();
        assert!(unknown.is_empty(), "{folder}: {unknown:?}");
    }
}

#[test]
fn every_metric_of_the_program_is_on_the_dashboard() {
    let dashboard = words(&read_folder("docker/grafana"), "tmpi_", '_');
    // the sources register metrics as ("tmpi_NAME", "HELP"), also on lines of their own
    let sources = read_folder("src").split_whitespace().collect::<Vec<_>>().join(" ").replace("( \"", "(\"");
    let registered = sources.match_indices("(\"tmpi_").filter_map(|(at, _)| sources[at + 2..].split_once("\", \"").map(|(name, _)| name));
    let names: BTreeSet<&str> = registered.filter(|name| name.chars().all(|c| c.is_ascii_lowercase() || c == '_')).collect();
    assert!(names.len() > 30 && names.contains("tmpi_requests"), "{names:?}");
    let shown = |name: &str| dashboard.contains(name) || SUFFIXES.iter().any(|suffix| dashboard.contains(&format!("{name}{suffix}")));
    let missing: Vec<&&str> = names.iter().filter(|name| !shown(name)).collect();
    assert!(missing.is_empty(), "{missing:?}");
}

#[test]
fn every_test_in_the_threat_model_exists() {
    let sources = read_folder("tests/http") + &read_folder("src");
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

#[test]
fn proxies_log_no_tokens_and_no_links() {
    for file in ["one", "cluster"] {
        let text = read(&format!("docker/caddy/{file}.Caddyfile"));
        for line in ["replace token", "replace signature", "replace url", "Sec-Websocket-Protocol delete", "resp_headers>Location delete"] {
            assert!(text.contains(line), "{file}: {line}");
        }
    }
}

#[test]
fn nodes_of_a_cluster_may_reach_database_and_store() {
    let policy = read("docker/kubernetes/cluster/network.yaml");
    let egress = policy.split_once("  egress:").unwrap().1;
    for port in ["443", "5432"] {
        assert!(egress.contains(&format!("{{protocol: TCP, port: {port}}}")), "{port}");
    }
}
