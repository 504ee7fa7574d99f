//! Settings of `serve` from the file, environment variables and options.

use super::fixture::{Folder, Run};

fn with(folder: &Folder, variables: &[(&str, &str)], program: &str, args: &[&str]) -> Run {
    let mut command = folder.command();
    command.env_remove("TMPI_CONFIG").envs(variables.iter().copied()).arg(program).args(args);
    Run::from(command.output().unwrap())
}

fn config(folder: &Folder, variables: &[(&str, &str)], args: &[&str]) -> Run {
    with(folder, variables, "config", args)
}

fn has_line(run: &Run, line: &str) {
    assert!(run.out.lines().any(|l| l == line), "{line:?} is not in:\n{}", run.out);
}

#[test]
fn options_override_variables_the_file_and_defaults() {
    let f = Folder::new();
    f.write(
        "tmpi.toml",
        b"# ours\nworkers = 3\nmemory = 500\nhost = [\"a.example\", \"b.example\"]\n\n[limits]\nqueue = 10\nviews = 5\nconnections = 11\n\n\
          [retention]\ndays = 9\n[live]\nbudget-ms = 12.5\n",
    );
    let file = ["--config", "tmpi.toml"];
    let variables = [("TMPI_SERVE_WORKERS", "4"), ("TMPI_SERVE_LIMITS_VIEWS", "6"), ("TMPI_SERVE_LIMITS_QUEUE", "7")];
    let run = config(&f, &variables, &[&file[..], &["--memory", "600", "--set", "limits.views=8"]].concat()).succeeds();
    assert_eq!(run.err, "");
    for line in [
        "workers = 4 # environment",
        "memory = 600 # command line",
        "host = [\"a.example\", \"b.example\"] # file",
        "# addr = \"127.0.0.1:8080\"",
        "# access = \"private\"",
        "[limits]",
        "queue = 7 # environment",
        "views = 8 # command line",
        "connections = 11 # file",
        "# pixels = 50",
        "# lame-duck = 0",
        "# least-free = 0",
        "[rates]",
        "# requests = 0",
        "[quotas]",
        "# photos = 0",
        "days = 9 # file",
        "budget-ms = 12.5 # file",
    ] {
        has_line(&run, line);
    }
    // `tmpi config` prints a valid settings file; TMPI_CONFIG names it
    f.write("again.toml", run.out.as_bytes());
    let again = config(&f, &[("TMPI_CONFIG", "again.toml")], &[]).succeeds();
    has_line(&again, "views = 8 # file");
    let values = |run: &Run| run.out.lines().map(|l| l.split(" #").next().unwrap().to_owned()).collect::<Vec<_>>();
    assert_eq!(values(&again), values(&run));
}

#[test]
fn every_option_of_serve_is_in_the_file_and_the_schema() {
    let f = Folder::new();
    let help = f.run(&["serve", "--help"]).succeeds().out;
    let printed = config(&f, &[], &[]).succeeds().out;
    let schema: serde_json::Value = serde_json::from_str(&config(&f, &[], &["--schema"]).succeeds().out).unwrap();
    let options: Vec<&str> = help.lines().filter_map(|l| l.trim_start().strip_prefix("--")?.split([' ', '[']).next()).collect();
    assert!((20..40).contains(&options.len()), "{options:?}");
    for option in options.iter().filter(|o| !["config", "set", "help"].contains(*o)) {
        assert!(printed.lines().any(|l| l.trim_start_matches("# ").starts_with(&format!("{option} ="))), "{option}:\n{printed}");
        assert!(schema["properties"][option]["description"].is_string(), "{option}");
    }
    assert_eq!(schema["properties"]["limits"]["properties"]["body"]["format"], "MiB");
}

#[test]
fn invalid_settings_are_rejected_by_name() {
    let f = Folder::new();
    for (text, words) in [
        ("quue = 3", &["tmpi.toml", "quue", "tmpi config"][..]),
        ("[limits]\nquue = 3", &["tmpi.toml", "limits.quue", "tmpi config"]),
        ("[quue]\nqueue = 3", &["tmpi.toml", "quue.queue"]),
        ("config = \"b.toml\"", &["config"]),
        ("[limits]\nqueue = \"many\"", &["tmpi.toml", "limits.queue", "many"]),
        ("[limits]\nqueue = true", &["limits.queue", "number"]),
        ("[limits]\nqueue = [1, 2]", &["limits.queue"]),
        ("limits = 3", &["limits"]),
        ("queue = 3", &["queue"]),
        ("host = \"\"", &["host"]),
        ("[limits]\npixels = 100000", &["tmpi.toml", "limits.pixels", "1 to 50", "100000"]),
        ("[limits]\nqueue = 1\nqueue = 2", &["tmpi.toml", "queue"]),
        ("queue =", &["tmpi.toml"]),
        // `serve` checks these before it starts
        ("[quotas]\nphotos = 3", &["quotas", "--access private"]),
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
    config(&f, &[("TMPI_SERVE_LIMITS_QUEUE", "many")], &[]).fails(2, &["limits.queue", "many"]);
    config(&f, &[("TMPI_SERVE_WORKERS", "many")], &[]).fails(2, &["--workers", "many"]);
    config(&f, &[("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:4318"), ("OTEL_TRACES_SAMPLER_ARG", "2")], &[])
        .fails(2, &["OTEL_TRACES_SAMPLER_ARG", "0 to 1"]);
    config(&f, &[], &["--set", "limits.queue=many"]).fails(2, &["--set", "limits.queue", "many"]);
    config(&f, &[("TMPI_SERVE_QUUE", "3")], &[]).fails(2, &["TMPI_SERVE_QUUE", "tmpi config"]);
    // other commands do not read the file
    f.write("tmpi.toml", b"quue = 3");
    Run::from(f.command().args(["models", "list"]).env("TMPI_CONFIG", f.path("tmpi.toml")).output().unwrap()).succeeds();
}

#[test]
fn config_rejects_files_that_serve_cannot_use() {
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
fn derived_settings_are_shown_with_their_values() {
    let f = Folder::new();
    let run = config(&f, &[("OTEL_EXPORTER_OTLP_ENDPOINT", "http://me:secret@127.0.0.1:4318")], &["--addr", ":8081", "--memory", "200"])
        .succeeds();
    for line in [
        "addr = \"127.0.0.1:8081\" # command line",
        "# access = \"open\"",
        "# scenes = 6",
        "# otlp = \"http://…@127.0.0.1:4318\" # OTEL_EXPORTER_OTLP_ENDPOINT",
        "# rooms = 16",
        "# link-days = 366",
    ] {
        has_line(&run, line);
    }
    let run = config(&f, &[], &["--addr", "0.0.0.0:80", "--data", "photos"]).succeeds();
    for line in ["# access = \"private\"", "# lame-duck = 5", "# requests = 6000", "data = \"photos\" # command line"] {
        has_line(&run, line);
    }
}

#[test]
fn secrets_in_urls_are_hidden() {
    let f = Folder::new();
    let args =
        ["--database", "postgres://me:secret@127.0.0.1:5432/tmpi", "--blobs", "s3://bucket", "--otlp", "http://me:secret@127.0.0.1:4318"];
    let run = config(&f, &[], &[&args[..], &["--network-url", "https://me:secret@host/net.onnx?signature=secret"]].concat()).succeeds();
    assert!(!run.out.contains("secret") && run.out.contains("…@127.0.0.1:5432"), "{}", run.out);
    has_line(&run, "network-url = \"https://…@host/net.onnx?signature=…\" # command line");
    // error messages hide them too
    for (name, value) in [("--otlp", "ftp://me:secret@127.0.0.1"), ("--database", "postgres://me:secret@host")] {
        let error = config(&f, &[], &[name, value]).fails(2, &[name]);
        assert!(!error.contains("secret"), "{error}");
    }
}

fn key(folder: &Folder, variables: &[(&str, &str)], args: &[&str]) -> Run {
    with(folder, variables, "key", args)
}

#[test]
fn key_commands_use_the_servers_settings() {
    let f = Folder::new();
    let add = ["add", "me", "--scope", "read"];
    // a folder without a library
    std::fs::create_dir_all(f.path("other")).unwrap();
    for folder in ["tmpi-data", "other"] {
        let data = ["--data", folder];
        key(&f, &[], &[&add[..], &data].concat()).fails(2, &[folder, "--create"]);
        key(&f, &[], &[&["list"][..], &data].concat()).fails(2, &[folder, "--config"]);
        key(&f, &[], &[&["remove", "me"][..], &data].concat()).fails(2, &[folder]);
    }
    assert!(!f.path("tmpi-data").exists() && !f.path("other/library.db").exists());
    key(&f, &[], &[&add[..], &["--data", "served", "--create"]].concat()).succeeds();
    let count =
        |variables: &[(&str, &str)], args: &[&str]| key(&f, variables, &[&["list"][..], args].concat()).succeeds().out.lines().count();
    assert_eq!(count(&[("TMPI_SERVE_DATA", "served")], &[]), 1);
    // the file and variables name the data folder; the command line overrides both
    f.write("tmpi.toml", b"data = \"served\"\n[limits]\nqueue = 3\n");
    key(&f, &[("TMPI_CONFIG", "tmpi.toml")], &add).succeeds();
    assert_eq!((count(&[("TMPI_CONFIG", "tmpi.toml")], &[]), count(&[], &["--data", "served"])), (2, 2));
    key(&f, &[("TMPI_CONFIG", "tmpi.toml")], &["list", "--data", "other"]).fails(2, &["other"]);
    // `fsck` and `gc` read the file too
    for command in ["fsck", "gc"] {
        let run = f.run(&[command, "--config", "tmpi.toml"]).succeeds();
        assert!(run.out.starts_with("0 "), "{}", run.out);
        f.run(&[command, "--data", "other"]).fails(2, &["other"]);
    }
    // unknown names are errors, as in `serve`
    f.write("tmpi.toml", b"quue = 3");
    key(&f, &[], &["list", "--config", "tmpi.toml"]).fails(2, &["quue"]);
    key(&f, &[("TMPI_SERVE_QUUE", "3")], &["list", "--data", "served"]).fails(2, &["TMPI_SERVE_QUUE"]);
    // options of `key` are not settings
    key(&f, &[("TMPI_SERVE_DATA", "served"), ("TMPI_SERVE_DAYS", "3")], &add).fails(2, &["TMPI_SERVE_DAYS"]);
}

#[test]
fn work_accepts_settings_of_serve_and_needs_a_database() {
    let f = Folder::new();
    f.run(&["work"]).fails(2, &["--database"]);
    f.write("tmpi.toml", b"quue = 3");
    f.run(&["work", "--database", "postgres://nowhere/tmpi", "--config", "tmpi.toml"]).fails(2, &["quue"]);
    let help = f.run(&["work", "--help"]).succeeds().out;
    assert!(help.contains("--database") && !help.contains("--role <") && help.contains("127.0.0.1:0"), "{help}");
}

#[test]
fn webhooks_are_tables_of_the_file_and_their_secrets_are_hidden() {
    let f = Folder::new();
    let secret = format!("whsec_{}", "A".repeat(32));
    let file = "private-webhooks = true\n[[webhooks]]\nurl = \"http://10.0.0.7/x?key=hidden\"\nsecret = \"SECRET\"\nevents = [\"photo.done\"]\n\
                [[webhooks]]\nurl = \"https://b.example/\"\nsecret = \"SECRET\"\n";
    f.write("tmpi.toml", file.replace("SECRET", &secret).as_bytes());
    let run = config(&f, &[], &["--config", "tmpi.toml"]).succeeds();
    has_line(
        &run,
        "webhooks = [{ url = \"http://10.0.0.7/x?key=…\", secret = \"…\", events = [\"photo.done\"] }, \
         { url = \"https://b.example/\", secret = \"…\" }] # file",
    );
    has_line(&run, "private-webhooks = \"true\" # file");
    for (webhook, word) in [
        ("url = \"ftp://a\"\nsecret = \"SECRET\"", "url"),
        ("url = \"http://a\"\nsecret = \"SECRET SECRET\"", "secret"),
        ("url = \"http://a\"\nsecret = \"SECRET\"\nevents = [\"photo.eaten\"]", "photo.done"),
        ("url = \"http://a\"", "url, secret and events"),
    ] {
        f.write("tmpi.toml", format!("[[webhooks]]\n{webhook}").replace("SECRET", &secret).as_bytes());
        let refused = config(&f, &[], &["--config", "tmpi.toml"]).fails(2, &["--webhooks", word]);
        assert!(!refused.contains("AAAA"), "{refused}");
    }
}
