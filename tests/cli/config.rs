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
        b"# ours\nqueue = 10\nworkers = 3\nviews = 5\npublic-list = true\nhost = [\"a.example\", \"b.example\"]\nlive-budget-ms = 12.5\n",
    );
    let file = ["--config", "tmpi.toml"];
    let variables = [("TMPI_SERVE_WORKERS", "4"), ("TMPI_SERVE_VIEWS", "6")];
    let run = config(&f, &variables, &[&file[..], &["--views", "7"]].concat()).succeeds();
    assert_eq!(run.err, "");
    for line in [
        "queue = 10 # file",
        "workers = 4 # environment",
        "views = 7 # command line",
        "public-list = true # file",
        "host = [\"a.example\", \"b.example\"] # file",
        "live-budget-ms = \"12.5\" # file",
        "# addr = \"127.0.0.1:8080\"",
        "# max-pixels = 50",
        "# lame-duck =",
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
        ("nats-login = \"file\"", &["--nats"]),
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
fn passwords_in_addresses_are_not_told() {
    let f = Folder::new();
    let run = config(&f, &[], &["--nats", "nats://me:secret@127.0.0.1:4222,nats://127.0.0.1:4223"]).succeeds();
    assert!(!run.out.contains("secret") && run.out.contains("…@127.0.0.1:4222") && run.out.contains("127.0.0.1:4223"), "{}", run.out);
}

#[test]
fn a_node_that_works_takes_the_same_settings_and_is_told_of_its_store() {
    let f = Folder::new();
    f.run(&["work"]).fails(2, &["--store"]);
    f.write("tmpi.toml", b"quue = 3");
    f.run(&["work", "--store", "file:///nowhere", "--config", "tmpi.toml"]).fails(2, &["quue"]);
    let help = f.run(&["work", "--help"]).succeeds().out;
    assert!(help.contains("--store") && !help.contains("--role <") && help.contains("127.0.0.1:0"), "{help}");
}
