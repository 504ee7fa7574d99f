//! Settings of `serve` by file, environment and options.

use std::process::Command;

use super::fixture::{Folder, Run};

fn config(folder: &Folder, variables: &[(&str, &str)], args: &[&str]) -> Run {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
    command.current_dir(folder.path("")).env_remove("TMPI_CONFIG").envs(variables.iter().copied()).arg("config").args(args);
    Run::from(command.output().unwrap())
}

fn has(run: &Run, line: &str) {
    assert!(run.out.lines().any(|l| l == line), "{line:?} is not in:\n{}", run.out);
}

#[test]
fn options_count_before_variables_those_before_the_file_and_that_before_defaults() {
    let f = Folder::new();
    f.write(
        "tmpi.toml",
        b"# ours\nqueue = 10\nworkers = 3\nviews = 5\nretain-days = 9\nhost = [\"a.example\", \"b.example\"]\nlive-budget-ms = 12.5\n",
    );
    let file = ["--config", "tmpi.toml"];
    let variables = [("TMPI_SERVE_WORKERS", "4"), ("TMPI_SERVE_VIEWS", "6")];
    let run = config(&f, &variables, &[&file[..], &["--views", "7"]].concat()).succeeds();
    assert_eq!(run.err, "");
    for line in [
        "queue = 10 # file",
        "workers = 4 # environment",
        "views = 7 # command line",
        "retain-days = 9 # file",
        "host = [\"a.example\", \"b.example\"] # file",
        "live-budget-ms = \"12.5\" # file",
        "# addr = \"127.0.0.1:8080\"",
        "# max-pixels = 50",
        "# lame-duck = 0",
        "# access = \"private\"",
        "# rate-requests = 0",
        "# least-free = 64 # or a twentieth of a smaller disk",
        "# quota-photos =",
    ] {
        has(&run, line);
    }
    // the file by the environment; and what is told is a file that says the same
    f.write("again.toml", run.out.as_bytes());
    let again = config(&f, &[("TMPI_CONFIG", "again.toml")], &[]).succeeds();
    has(&again, "views = 7 # file");
    let values = |run: &Run| run.out.lines().map(|l| l.split(" #").next().unwrap().to_owned()).collect::<Vec<_>>();
    assert_eq!(values(&again), values(&run));
    has(&config(&f, &[("TMPI_SERVE_PUBLIC_LIST", "true")], &[]).succeeds(), "public-list = true # environment");
}

#[test]
fn every_option_of_serve_may_stand_in_a_file() {
    let f = Folder::new();
    let help = f.run(&["serve", "--help"]).succeeds().out;
    let told = config(&f, &[], &[]).succeeds().out;
    let options: Vec<&str> = help.lines().filter_map(|l| l.trim_start().strip_prefix("--")?.split([' ', '[']).next()).collect();
    assert!(options.len() > 20);
    for option in options.iter().filter(|o| !["config", "help"].contains(*o)) {
        assert!(told.lines().any(|l| l.trim_start_matches("# ").starts_with(&format!("{option} ="))), "{option}:\n{told}");
    }
}

#[test]
fn what_cannot_be_meant_is_refused_with_its_name() {
    let f = Folder::new();
    for (text, words) in [
        ("quue = 3", &["tmpi.toml", "quue", "--help"][..]),
        ("config = \"b.toml\"", &["config"]),
        ("queue = \"many\"", &["queue", "many"]),
        ("queue = true", &["queue", "number"]),
        ("queue = [1, 2]", &["queue"]),
        ("public-list = 1", &["public-list", "true or false"]),
        ("host = \"\"", &["host"]),
        ("max-pixels = 100000", &["max-pixels", "100000"]),
        ("[limits]\nqueue = 1", &["limits"]),
        ("queue = 1\nqueue = 2", &["tmpi.toml", "queue"]),
        ("queue =", &["tmpi.toml"]),
        // what serve looks at before it begins
        ("public-list = true\naccess = \"private\"", &["--public-list", "--access open"]),
        ("quota-photos = 3", &["--quota-photos", "--access private"]),
        ("advertise = \"http://127.0.0.1:8080\"", &["--database"]),
        ("blobs = \"s3://host/folder\"", &["--blobs", "--database"]),
        ("otlp = \"127.0.0.1\"", &["--otlp", "http://127.0.0.1:4318"]),
        ("static = \"nowhere\"", &["--static", "nowhere"]),
    ] {
        f.write("tmpi.toml", text.as_bytes());
        config(&f, &[], &["--config", "tmpi.toml"]).fails(2, words);
        f.run(&["serve", "--config", "tmpi.toml"]).fails(2, words);
    }
    config(&f, &[], &["--config", "nowhere.toml"]).fails(2, &["nowhere.toml"]);
    config(&f, &[("TMPI_SERVE_QUEUE", "many")], &[]).fails(2, &["queue", "many"]);
    config(&f, &[("TMPI_SERVE_QUUE", "3")], &[]).fails(2, &["TMPI_SERVE_QUUE", "--help"]);
    // other commands have nothing to do with it
    f.write("tmpi.toml", b"quue = 3");
    let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
    Run::from(command.args(["models", "list"]).env("TMPI_CONFIG", f.path("tmpi.toml")).output().unwrap()).succeeds();
}

#[test]
fn files_that_serve_would_fail_on_are_an_error() {
    let f = Folder::new();
    f.write("short", b"too short for a key");
    f.write("no.pem", b"no certificate");
    for (args, code, words) in [
        (&["--live-key", "short"][..], 2, &["--live-key", "32"][..]),
        (&["--live-key", "nowhere"], 1, &["nowhere"]),
        (&["--tls-cert", "no.pem", "--tls-key", "no.pem"], 1, &["TLS", "no.pem"]),
        (&["--depth-model", "tmpi=nowhere.onnx"], 1, &["--depth-model", "nowhere.onnx"]),
        (&["--live-depth-model", "tmpi=nowhere.onnx"], 1, &["--live-depth-model", "nowhere.onnx"]),
    ] {
        config(&f, &[], args).fails(code, words);
    }
}

#[test]
fn what_follows_from_others_is_shown_as_it_is_used() {
    let f = Folder::new();
    let run = config(&f, &[("OTEL_EXPORTER_OTLP_ENDPOINT", "http://me:secret@127.0.0.1:4318")], &["--addr", ":8081", "--memory", "200"])
        .succeeds();
    for line in [
        "addr = \"127.0.0.1:8081\" # command line",
        "# access = \"open\"",
        "# scene-cache = 6 # 6553600 bytes",
        "# otlp = \"http://…@127.0.0.1:4318\" # OTEL_EXPORTER_OTLP_ENDPOINT",
        "# live-rooms = 16",
        "# max-header = 32",
        "# streams-at-once = 64",
        "# link-days = 366",
    ] {
        has(&run, line);
    }
    let run = config(&f, &[], &["--addr", "0.0.0.0:80", "--data", "photos"]).succeeds();
    for line in ["# access = \"private\"", "# lame-duck = 5", "# rate-requests = 6000", "data = \"photos\" # command line"] {
        has(&run, line);
    }
}

#[test]
fn secrets_in_addresses_are_not_told() {
    let f = Folder::new();
    let args =
        ["--database", "postgres://me:secret@127.0.0.1:5432/tmpi", "--blobs", "s3://bucket", "--otlp", "http://me:secret@127.0.0.1:4318"];
    let run = config(&f, &[], &[&args[..], &["--network-url", "https://me:secret@host/net.onnx?signature=secret"]].concat()).succeeds();
    assert!(!run.out.contains("secret") && run.out.contains("…@127.0.0.1:5432"), "{}", run.out);
    has(&run, "network-url = \"https://…@host/net.onnx?signature=…\" # command line");
    // nor in what is wrong with them
    for (name, value) in [("--otlp", "ftp://me:secret@127.0.0.1"), ("--database", "postgres://me:secret@host")] {
        let said = config(&f, &[], &[name, value]).fails(2, &[name]);
        assert!(!said.contains("secret"), "{said}");
    }
}

fn key(folder: &Folder, variables: &[(&str, &str)], args: &[&str]) -> Run {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
    command.current_dir(folder.path("")).env_remove("TMPI_CONFIG").envs(variables.iter().copied()).arg("key").args(args);
    Run::from(command.output().unwrap())
}

#[test]
fn keys_are_those_of_the_server_that_the_settings_are_of() {
    let f = Folder::new();
    let add = ["add", "me", "--scope", "read"];
    // a folder of nobody's
    std::fs::create_dir_all(f.path("other")).unwrap();
    for folder in ["tmpi-data", "other"] {
        let named = ["--data", folder];
        key(&f, &[], &[&add[..], &named].concat()).fails(2, &[folder, "--create"]);
        key(&f, &[], &[&["list"][..], &named].concat()).fails(2, &[folder, "--config"]);
        key(&f, &[], &[&["remove", "me"][..], &named].concat()).fails(2, &[folder]);
    }
    assert!(!f.path("tmpi-data").exists() && !f.path("other/library.db").exists());
    key(&f, &[], &[&add[..], &["--data", "served", "--create"]].concat()).succeeds();
    let of = |variables: &[(&str, &str)], args: &[&str]| key(&f, variables, &[&["list"][..], args].concat()).succeeds().out.lines().count();
    assert_eq!(of(&[("TMPI_SERVE_DATA", "served")], &[]), 1);
    // by the file and by variables; what the line says counts first
    f.write("tmpi.toml", b"data = \"served\"\nqueue = 3\n");
    key(&f, &[("TMPI_CONFIG", "tmpi.toml")], &add).succeeds();
    assert_eq!((of(&[("TMPI_CONFIG", "tmpi.toml")], &[]), of(&[], &["--data", "served"])), (2, 2));
    key(&f, &[("TMPI_CONFIG", "tmpi.toml")], &["list", "--data", "other"]).fails(2, &["other"]);
    // so do those that look the library over
    for command in ["fsck", "gc"] {
        let run = f.run(&[command, "--config", "tmpi.toml"]).succeeds();
        assert!(run.out.starts_with("0 "), "{}", run.out);
        f.run(&[command, "--data", "other"]).fails(2, &["other"]);
    }
    // as serve reads it
    f.write("tmpi.toml", b"quue = 3");
    key(&f, &[], &["list", "--config", "tmpi.toml"]).fails(2, &["quue"]);
    key(&f, &[("TMPI_SERVE_QUUE", "3")], &["list", "--data", "served"]).fails(2, &["TMPI_SERVE_QUUE"]);
    // a name of a key is none of a setting
    key(&f, &[("TMPI_SERVE_DATA", "served"), ("TMPI_SERVE_DAYS", "3")], &add).fails(2, &["TMPI_SERVE_DAYS"]);
}

#[test]
fn a_node_that_works_takes_the_same_settings_and_is_told_of_its_database() {
    let f = Folder::new();
    f.run(&["work"]).fails(2, &["--database"]);
    f.write("tmpi.toml", b"quue = 3");
    f.run(&["work", "--database", "postgres://nowhere/tmpi", "--config", "tmpi.toml"]).fails(2, &["quue"]);
    let help = f.run(&["work", "--help"]).succeeds().out;
    assert!(help.contains("--database") && !help.contains("--role <") && help.contains("127.0.0.1:0"), "{help}");
}
