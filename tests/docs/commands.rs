//! Commands in code blocks: their options are valid, and marked blocks run.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use tmpi_testing::Need;
use tmpi_testing::program::Killed;

use crate::{pages, root};

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

/// A server for blocks that need one.
struct Server {
    _process: Killed,
    address: String,
    photo: String,
}

impl Server {
    /// Starts it with data in `tmpi-data` and makes `photo.jpg`.
    fn start(shell: &impl Fn(&str) -> Command) -> Self {
        let mut process = Killed(shell("exec tmpi serve --addr 0 2> server.log").stdout(Stdio::piped()).spawn().unwrap());
        let address = process.first_line();
        let upload = shell(&format!("curl -H 'Prefer: wait=60' -F photo=@photo.jpg {address}/v1/photos")).output().unwrap();
        let state: serde_json::Value = serde_json::from_slice(&upload.stdout).unwrap();
        assert_eq!(state["state"], "done", "{state}");
        Self { _process: process, address, photo: state["id"].as_str().unwrap().to_owned() }
    }

    /// A line with its address and photo.
    fn line(&self, line: &str) -> String {
        line.replace("http://127.0.0.1:8080", &self.address).replace("/ID", &format!("/{}", self.photo))
    }
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
        // otherwise curl succeeds whatever the server answers
        fs::write(folder.path().join(".curlrc"), "fail\nsilent\nshow-error\n").unwrap();
        let shell = |line: &str| {
            let mut command = Command::new("sh");
            command.args(["-e", "-c", line]).current_dir(folder.path()).env("PATH", &path).env("ORT_DYLIB_PATH", &library);
            command.env("CURL_HOME", folder.path()).env("TMPI_MODELS", folder.path().join("models")).env_remove("TMPI_DEPTH_MODEL");
            command
        };
        let mut server = None;
        for block in page.blocks().iter().filter(|b| b.runs) {
            for line in &block.lines {
                if (line.contains("mp4") || line.contains(".webp"))
                    && Need::Ffmpeg.or_skip(Command::new("ffmpeg").arg("-version").output()).is_none()
                {
                    continue;
                }
                let line = if block.needs_server { server.get_or_insert_with(|| Server::start(&shell)).line(line) } else { line.clone() };
                let out = shell(&line).output().unwrap();
                assert!(out.status.success(), "{}: {line}\n{}", page.name, String::from_utf8_lossy(&out.stderr));
                count += 1;
            }
        }
    }
    println!("{count} commands ran");
    assert!(count > 40, "{count} commands ran");
}
