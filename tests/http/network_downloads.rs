//! Downloads depth networks from a server that interrupts transfers or sends wrong bytes, and checks which network is used.

use std::path::PathBuf;
use std::process::Stdio;
use std::sync::Mutex;

use sha2::{Digest, Sha256};
use tmpi::server::hex;
use tmpi_testing::program::{self, Run};
use tmpi_testing::{Answer, Need, Request, StandIn};

use crate::prelude::*;
use crate::process::Process;

/// Replaces a depth network: computes the mean of a picture's channels.
const NETWORK: &[u8] = include_bytes!("../onnx/mean.onnx");
/// The network that `auto` downloads.
const NAME: &str = "depth-anything-v2-small-fp16";

#[derive(Clone, Copy, PartialEq)]
enum Behaviour {
    Correct,
    Truncates,
    Corrupts,
}

/// Serves one file on loopback.
struct FileServer {
    url: String,
    behaviour: Arc<Mutex<Behaviour>>,
    server: StandIn,
}

impl FileServer {
    fn start() -> Self {
        let behaviour = Arc::new(Mutex::new(Behaviour::Correct));
        let now = Arc::clone(&behaviour);
        let server = StandIn::start(move |request| {
            let (from, mut body) = (offset(request), NETWORK[offset(request)..].to_vec());
            let (status, range) =
                if from > 0 { (206, format!("Content-Range: bytes {from}-{0}/{0}\r\n", NETWORK.len())) } else { (200, String::new()) };
            match *now.lock().unwrap() {
                Behaviour::Correct => {}
                Behaviour::Corrupts => body[10] ^= 1,
                Behaviour::Truncates => {
                    let head = format!("HTTP/1.1 {status} OK\r\n{range}Content-Length: {}\r\n\r\n", body.len());
                    return Answer::bytes([head.as_bytes(), &body[..body.len() / 2]].concat());
                }
            }
            Answer::Whole(status, range, body)
        });
        Self { url: server.url("/model.onnx"), behaviour, server }
    }

    /// Start offsets of the requests.
    fn offsets(&self) -> Vec<usize> {
        self.server.answered().iter().map(offset).collect()
    }
}

/// The first byte that a request is for.
fn offset(request: &Request) -> usize {
    request.header("range").trim_start_matches("bytes=").trim_end_matches('-').parse().unwrap_or(0)
}

/// The digest of the file.
fn digest() -> String {
    hex(&Sha256::digest(NETWORK))
}

/// A temporary folder with a photo, in which tests run the program with only the networks of this folder.
struct Folder(program::Folder);

impl Folder {
    fn new() -> Self {
        Self(program::Folder::of(env!("CARGO_BIN_EXE_tmpi")).with_box())
    }

    fn models(&self) -> PathBuf {
        self.0.path("models")
    }

    /// Returns standard output and standard error of a successful run.
    fn run(&self, args: &[&str]) -> (String, String) {
        let Run { out, err, .. } = self.0.run(args).succeeds();
        (out, err)
    }

    fn get(&self, server: &FileServer, behaviour: Behaviour, sha256: &str) -> (String, String) {
        *server.behaviour.lock().unwrap() = behaviour;
        self.run(&["models", "get", "auto", "--url", &server.url, "--sha256", sha256, "-q"])
    }

    /// The network that `make` reports.
    fn used(&self, more: &[&str]) -> String {
        self.run(&[&["make", "box.png", "-o", "box.tmpi", "-qf", "--report", "report.json"], more].concat());
        let report: Value = serde_json::from_slice(&std::fs::read(self.0.path("report.json")).unwrap()).unwrap();
        report["depth_model"].as_str().unwrap().to_owned()
    }
}

/// Starts `tmpi serve`, which downloads its network from a [`FileServer`].
fn serve(folder: &Folder, url: &str, sha256: &str) -> Process {
    let log = tempfile::NamedTempFile::new().unwrap();
    let mut command = folder.0.command();
    command.args(["serve", "--addr", "127.0.0.1:0", "--data", "data", "--network-url", url, "--network-sha256", sha256]);
    Process::listening(command.stdout(Stdio::piped()).stderr(log.reopen().unwrap()).spawn().unwrap(), log)
}

fn network(server: &Process) -> Value {
    get(server.addr, "/v1/network").is(200).json()
}

/// Downloads the network and waits until it is done.
fn fetch(server: &Process) -> Value {
    request(server.addr, "POST", "/v1/network", &[], &[]).is(202);
    let mut state = Value::Null;
    wait_until("the download has ended", || {
        state = network(server);
        state.get("fetched_bytes").is_none()
    });
    state
}

/// Posts and waits for the photo; returns its id, version, and network.
fn make(server: &Process, path: &str, body: &[u8]) -> [String; 3] {
    let state = request(server.addr, "POST", path, &[("prefer", "wait=25")], body).any_of(&[200, 201]).json();
    let text = |value: &Value| value.as_str().unwrap().to_owned();
    let report = get(server.addr, &text(&state["links"]["report"])).json();
    [text(&state["id"]), text(&state["version"]), text(&report["depth_model"])]
}

#[test]
fn a_running_server_downloads_a_better_network() {
    let (folder, files) = (Folder::new(), FileServer::start());
    let digest = digest();
    let photo = std::fs::read(folder.0.path("box.png")).unwrap();
    let has_onnx = Need::Onnx.or_skip(tmpi_pipeline::networks::available()).is_some();
    let server = serve(&folder, &files.url, &digest);
    let before = network(&server);
    assert_eq!((&before["name"], &before["better"]["name"], before.get("problem")), (&json!("tmpi"), &json!(NAME), None));
    let old = has_onnx.then(|| make(&server, "/v1/photos", &photo));

    // clients behind a proxy and pages of other sites are rejected
    let proxied = ("x-forwarded-for", "203.0.113.1");
    assert_eq!(request(server.addr, "GET", "/v1/network", &[proxied], &[]).status, 403);
    assert_eq!(request(server.addr, "POST", "/v1/network", &[proxied], &[]).status, 403);
    assert_eq!(request(server.addr, "POST", "/v1/network", &[("sec-fetch-site", "cross-site")], &[]).status, 403);
    assert!(files.offsets().is_empty(), "rejected requests download nothing");

    // the server reports an interrupted download and resumes it
    *files.behaviour.lock().unwrap() = Behaviour::Truncates;
    let interrupted = fetch(&server);
    assert!(interrupted["problem"].as_str().unwrap().contains("broke off") && interrupted["better"]["name"] == NAME, "{interrupted}");
    *files.behaviour.lock().unwrap() = Behaviour::Correct;
    let after = fetch(&server);
    assert_eq!((&after["name"], after.get("better"), after.get("problem")), (&json!(NAME), None, None));
    assert_eq!(files.offsets(), [0, NETWORK.len() / 2]);
    assert_eq!(request(server.addr, "POST", "/v1/network", &[], &[]).status, 200, "there is nothing more to download");

    if let Some([id, version, network]) = old {
        assert_eq!(network, "tmpi");
        let [same, newer, network] = make(&server, &format!("/v1/photos/{id}/remake"), &[]);
        assert_eq!((&same, network.as_str()), (&id, NAME));
        assert_ne!(newer, version);
        let [other, _, network] = make(&server, "/v1/photos", &photo);
        assert_eq!((other != id, network.as_str()), (true, NAME), "with another network the same upload gives another photo");
    }

    // after a restart the server uses the downloaded network and offers no better one
    drop(server);
    let server = serve(&folder, &files.url, &digest);
    assert_eq!((&network(&server)["name"], network(&server).get("better")), (&json!(NAME), None));
}

#[test]
fn auto_uses_the_best_installed_network_or_the_embedded_one() {
    let (folder, files) = (Folder::new(), FileServer::start());
    let digest = digest();
    let has_onnx = Need::Onnx.or_skip(tmpi_pipeline::networks::available()).is_some();

    // without a response the program prints one line and uses the embedded network
    let unreachable = "http://127.0.0.1:1/model.onnx";
    let auto = |more: &[&str]| folder.run(&[&["models", "get", "auto", "--sha256", digest.as_str()], more].concat());
    for more in [&["--url", unreachable][..], &["--url", unreachable, "-q"]] {
        let (out, err) = auto(more);
        assert!(out.is_empty() && err.lines().count() == 1 && err.contains("embedded") && err.contains(unreachable), "{err}");
    }
    if has_onnx {
        assert_eq!(folder.used(&[]), "tmpi");
    }

    // a file with a wrong digest is deleted
    let (_, err) = folder.get(&files, Behaviour::Corrupts, &digest);
    assert!(err.contains("digest") && err.contains("embedded"), "{err}");
    assert_eq!(std::fs::read_dir(folder.models()).unwrap().count(), 0);

    // an interrupted download is kept, and the next one requests the rest
    let (_, err) = folder.get(&files, Behaviour::Truncates, &digest);
    assert!(err.contains("broke off"), "{err}");
    let file = folder.models().join(format!("{NAME}.onnx"));
    assert!(!file.exists());
    let (out, err) = folder.get(&files, Behaviour::Correct, &digest);
    assert_eq!((Path::new(out.trim()), err.as_str()), (file.as_path(), ""));
    assert_eq!(files.offsets(), [0, 0, NETWORK.len() / 2]);
    assert_eq!(std::fs::read(&file).unwrap(), NETWORK);

    // without `-q` the program prints the URL
    std::fs::remove_file(&file).unwrap();
    let (_, err) = auto(&["--url", &files.url]);
    assert_eq!(err.trim(), files.url);

    // an installed network is not downloaded again
    let (out, _) = folder.get(&files, Behaviour::Correct, &digest);
    assert_eq!((Path::new(out.trim()), files.offsets().len()), (file.as_path(), 4));
    if has_onnx {
        assert_eq!(folder.used(&[]), NAME);
        assert_eq!(folder.used(&["--depth-model", "tmpi"]), "tmpi");
    }
}

#[test]
fn a_worse_installed_network_does_not_block_a_better_one() {
    let (folder, files) = (Folder::new(), FileServer::start());
    let digest = digest();
    let worse = folder.models().join("dpt-large.onnx");
    std::fs::create_dir_all(folder.models()).unwrap();
    std::fs::write(&worse, NETWORK).unwrap();

    // the server offers the better network and lists the networks that it beats
    let server = serve(&folder, &files.url, &digest);
    let state = network(&server);
    assert_eq!([&state["name"], &state["better"]["name"], &state["better_than"][0]], ["dpt-large", NAME, "dpt-hybrid"]);
    drop(server);

    // if the download fails, the program uses the installed network
    let (out, err) = folder.run(&["models", "get", "auto", "--url", "http://127.0.0.1:1/model.onnx", "--sha256", &digest]);
    assert_eq!((Path::new(out.trim()), err.lines().count()), (worse.as_path(), 1), "{err}");
    assert!(err.contains("using ") && err.contains("dpt-large.onnx"), "{err}");
    let (out, _) = folder.get(&files, Behaviour::Correct, &digest);
    assert_eq!(Path::new(out.trim()), folder.models().join(format!("{NAME}.onnx")));

    // an equally good network is enough
    std::fs::rename(out.trim(), folder.models().join("moge-2-small.onnx")).unwrap();
    let (out, _) = folder.get(&files, Behaviour::Correct, &digest);
    assert_eq!((Path::new(out.trim()), files.offsets().len()), (folder.models().join("moge-2-small.onnx").as_path(), 1));
    assert_eq!(network(&serve(&folder, &files.url, &digest)).get("better"), None);
}
