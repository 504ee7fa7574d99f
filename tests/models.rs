//! Fetching depth networks from a server that breaks off or sends wrong bytes, and which network is used afterwards.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

use std::io::{BufRead, BufReader, Write};
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use tmpi_render::{PictureFormat, View, encode};

#[path = "http/client.rs"]
#[allow(dead_code, reason = "the tests of the HTTP interface use more of it")]
mod client;

use client::{get, request};

/// Stands in for a depth network: the mean of a picture's channels.
const NETWORK: &[u8] = include_bytes!("onnx/mean.onnx");
/// The network that `auto` fetches.
const NAME: &str = "depth-anything-v2-small-fp16";

#[derive(Clone, Copy, PartialEq)]
enum Mood {
    Well,
    Cuts,
    Spoils,
}

struct Standin {
    url: String,
    mood: Arc<Mutex<Mood>>,
    /// Offsets of the requests.
    asked: Arc<Mutex<Vec<usize>>>,
}

/// A server on loopback with one file.
fn standin() -> Standin {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}/model.onnx", listener.local_addr().unwrap());
    let (mood, asked) = (Arc::new(Mutex::new(Mood::Well)), Arc::new(Mutex::new(Vec::new())));
    let (m, a) = (Arc::clone(&mood), Arc::clone(&asked));
    std::thread::spawn(move || {
        for mut stream in listener.incoming().map_while(Result::ok) {
            let lines = BufReader::new(&stream).lines().map_while(Result::ok).take_while(|l| !l.is_empty());
            let from = lines.fold(0, |from, l| {
                let range = l.to_ascii_lowercase();
                range.strip_prefix("range: bytes=").and_then(|r| r.trim_end_matches('-').parse().ok()).unwrap_or(from)
            });
            a.lock().unwrap().push(from);
            let mood = *m.lock().unwrap();
            let mut body = NETWORK[from..].to_vec();
            if mood == Mood::Spoils {
                body[10] ^= 1;
            }
            let status = if from > 0 {
                format!("206 Partial Content\r\nContent-Range: bytes {from}-{0}/{0}", NETWORK.len())
            } else {
                "200 OK".into()
            };
            let head = format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", body.len());
            let sent = if mood == Mood::Cuts { body.len() / 2 } else { body.len() };
            let _ = stream.write_all(head.as_bytes()).and_then(|()| stream.write_all(&body[..sent]));
        }
    });
    Standin { url, mood, asked }
}

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        let rgba = (0..64 * 48u32).map(|i| [(i % 64 * 4) as u8, (i / 64 * 5) as u8, 99, 255]).collect();
        let photo = encode(&View { width: 64, height: 48, rgba }, PictureFormat::Png, 90).unwrap();
        std::fs::write(place.0.path().join("photo.png"), photo).unwrap();
        place
    }

    fn models(&self) -> PathBuf {
        self.0.path().join("models")
    }

    /// The built program in this folder, with only its networks.
    fn command(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_tmpi"));
        let library = Path::new(env!("CARGO_MANIFEST_DIR")).join(".tmpi/onnxruntime/libonnxruntime.so");
        if std::env::var_os("ORT_DYLIB_PATH").is_none() && library.is_file() {
            command.env("ORT_DYLIB_PATH", library);
        }
        command.env("TMPI_MODELS", self.models()).env_remove("TMPI_DEPTH_MODEL").env_remove("RUST_LOG").current_dir(self.0.path());
        command
    }

    /// Standard output and standard error of a successful run.
    fn run(&self, args: &[&str]) -> (String, String) {
        let output = self.command().args(args).output().unwrap();
        let text = |b| String::from_utf8(b).unwrap();
        let (out, err) = (text(output.stdout), text(output.stderr));
        assert!(output.status.success(), "{args:?}: {err}");
        (out, err)
    }

    fn get(&self, server: &Standin, mood: Mood, sha256: &str) -> (String, String) {
        *server.mood.lock().unwrap() = mood;
        self.run(&["models", "get", "auto", "--url", &server.url, "--sha256", sha256, "-q"])
    }

    /// The network in the report of a new run.
    fn used(&self, more: &[&str]) -> String {
        self.run(&[&["make", "photo.png", "-o", "photo.tmpi", "-qf", "--report", "report.json"], more].concat());
        let report: serde_json::Value = serde_json::from_slice(&std::fs::read(self.0.path().join("report.json")).unwrap()).unwrap();
        report["depth_model"].as_str().unwrap().to_owned()
    }
}

/// A server that fetches its network from a stand-in.
struct Serving {
    child: Child,
    addr: SocketAddr,
}

impl Serving {
    fn start(place: &Place, url: &str, sha256: &str) -> Self {
        let mut command = place.command();
        command.args(["serve", "--addr", "127.0.0.1:0", "--data", "data", "--network-url", url, "--network-sha256", sha256]);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
        let addr = line.trim().strip_prefix("http://").and_then(|a| a.parse().ok());
        Self { child, addr: addr.unwrap_or_else(|| panic!("no address: {line:?}")) }
    }

    fn network(&self) -> Value {
        let answer = get(self.addr, "/v1/network");
        assert_eq!(answer.status, 200);
        answer.json()
    }

    /// Starts fetching the network and waits for the end.
    fn fetch(&self) -> Value {
        assert_eq!(request(self.addr, "POST", "/v1/network", &[], &[]).status, 202);
        let end = Instant::now() + Duration::from_mins(1);
        loop {
            let now = self.network();
            if now.get("fetched_bytes").is_none() {
                return now;
            }
            assert!(Instant::now() < end, "{now}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Sends a request and waits for its photo; returns the photo's id, its version, and the network of its report.
    fn made(&self, path: &str, body: &[u8]) -> [String; 3] {
        let answer = request(self.addr, "POST", path, &[("prefer", "wait=25")], body);
        assert!(matches!(answer.status, 200 | 201), "{}", String::from_utf8_lossy(&answer.body));
        let state = answer.json();
        let text = |value: &Value| value.as_str().unwrap().to_owned();
        let report = get(self.addr, &text(&state["links"]["report"])).json();
        [text(&state["id"]), text(&state["version"]), text(&report["depth_model"])]
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn a_server_fetches_a_better_network_while_it_runs() {
    let (place, standin) = (Place::new(), standin());
    let digest = Sha256::digest(NETWORK).iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"));
    let photo = std::fs::read(place.0.path().join("photo.png")).unwrap();
    let there = tmpi_testing::Need::Onnx.or_skip(tmpi_pipeline::networks::available()).is_some();
    let server = Serving::start(&place, &standin.url, &digest);
    let before = server.network();
    assert_eq!((&before["name"], &before["better"]["name"], before.get("problem")), (&json!("tmpi"), &json!(NAME), None));
    let old = there.then(|| server.made("/v1/photos", &photo));

    // strangers behind a proxy, and pages of other sites, are refused
    let proxied = ("x-forwarded-for", "203.0.113.1");
    assert_eq!(request(server.addr, "GET", "/v1/network", &[proxied], &[]).status, 403);
    assert_eq!(request(server.addr, "POST", "/v1/network", &[proxied], &[]).status, 403);
    assert_eq!(request(server.addr, "POST", "/v1/network", &[("sec-fetch-site", "cross-site")], &[]).status, 403);
    assert!(standin.asked.lock().unwrap().is_empty(), "no refused request fetches anything");

    // a download that breaks off is reported and continued
    *standin.mood.lock().unwrap() = Mood::Cuts;
    let cut = server.fetch();
    assert!(cut["problem"].as_str().unwrap().contains("broke off") && cut["better"]["name"] == NAME, "{cut}");
    *standin.mood.lock().unwrap() = Mood::Well;
    let after = server.fetch();
    assert_eq!((&after["name"], after.get("better"), after.get("problem")), (&json!(NAME), None, None));
    assert_eq!(*standin.asked.lock().unwrap(), [0, NETWORK.len() / 2]);
    assert_eq!(request(server.addr, "POST", "/v1/network", &[], &[]).status, 200, "there is nothing more to fetch");

    if let Some([id, version, network]) = old {
        assert_eq!(network, "tmpi");
        let [same, newer, network] = server.made(&format!("/v1/photos/{id}/again"), &[]);
        assert_eq!((&same, network.as_str()), (&id, NAME));
        assert_ne!(newer, version);
        let [other, _, network] = server.made("/v1/photos", &photo);
        assert_eq!((other != id, network.as_str()), (true, NAME), "an upload is another photo with another network");
    }

    // after a restart the fetched network is used, and no better one is offered
    drop(server);
    let server = Serving::start(&place, &standin.url, &digest);
    assert_eq!((&server.network()["name"], server.network().get("better")), (&json!(NAME), None));
}

#[test]
fn auto_uses_the_best_installed_network_and_works_without() {
    let (place, server) = (Place::new(), standin());
    let digest = Sha256::digest(NETWORK).iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"));
    let there = tmpi_testing::Need::Onnx.or_skip(tmpi_pipeline::networks::available()).is_some();

    // no answer: one line of error, and the embedded network is used
    let unreachable = "http://127.0.0.1:1/model.onnx";
    let auto = |more: &[&str]| place.run(&[&["models", "get", "auto", "--sha256", digest.as_str()], more].concat());
    for more in [&["--url", unreachable][..], &["--url", unreachable, "-q"]] {
        let (out, err) = auto(more);
        assert!(out.is_empty() && err.lines().count() == 1 && err.contains("embedded") && err.contains(unreachable), "{err}");
    }
    if there {
        assert_eq!(place.used(&[]), "tmpi");
    }

    // a file with a wrong digest leaves nothing
    let (_, err) = place.get(&server, Mood::Spoils, &digest);
    assert!(err.contains("digest") && err.contains("embedded"), "{err}");
    assert_eq!(std::fs::read_dir(place.models()).unwrap().count(), 0);

    // a download that breaks off is kept, and the next one requests the rest
    let (_, err) = place.get(&server, Mood::Cuts, &digest);
    assert!(err.contains("broke off"), "{err}");
    let file = place.models().join(format!("{NAME}.onnx"));
    assert!(!file.exists());
    let (out, err) = place.get(&server, Mood::Well, &digest);
    assert_eq!((Path::new(out.trim()), err.as_str()), (file.as_path(), ""));
    assert_eq!(*server.asked.lock().unwrap(), [0, 0, NETWORK.len() / 2]);
    assert_eq!(std::fs::read(&file).unwrap(), NETWORK);

    // without `-q` the address is printed
    std::fs::remove_file(&file).unwrap();
    let (_, err) = auto(&["--url", &server.url]);
    assert_eq!(err.trim(), server.url);
    server.asked.lock().unwrap().pop();

    // an installed network is not fetched again
    let (out, _) = place.get(&server, Mood::Well, &digest);
    assert_eq!((Path::new(out.trim()), server.asked.lock().unwrap().len()), (file.as_path(), 3));
    if there {
        assert_eq!(place.used(&[]), NAME);
        assert_eq!(place.used(&["--depth-model", "tmpi"]), "tmpi");
    }
}

#[test]
fn a_worse_installed_network_does_not_prevent_fetching_a_better_one() {
    let (place, standin) = (Place::new(), standin());
    let digest = Sha256::digest(NETWORK).iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"));
    let worse = place.models().join("dpt-large.onnx");
    std::fs::create_dir_all(place.models()).unwrap();
    std::fs::write(&worse, NETWORK).unwrap();

    // the server offers the better network and lists those that it is better than
    let server = Serving::start(&place, &standin.url, &digest);
    let now = server.network();
    assert_eq!((&now["name"], &now["better"]["name"], &now["better_than"][0]), (&json!("dpt-large"), &json!(NAME), &json!("dpt-hybrid")));
    drop(server);

    // if it cannot be fetched, the installed network is used
    let (out, err) = place.run(&["models", "get", "auto", "--url", "http://127.0.0.1:1/model.onnx", "--sha256", &digest]);
    assert_eq!((Path::new(out.trim()), err.lines().count()), (worse.as_path(), 1), "{err}");
    assert!(err.contains("using ") && err.contains("dpt-large.onnx"), "{err}");
    let (out, _) = place.get(&standin, Mood::Well, &digest);
    assert_eq!(Path::new(out.trim()), place.models().join(format!("{NAME}.onnx")));

    // an equally good network is enough
    std::fs::rename(out.trim(), place.models().join("moge-2-small.onnx")).unwrap();
    let (out, _) = place.get(&standin, Mood::Well, &digest);
    assert_eq!((Path::new(out.trim()), standin.asked.lock().unwrap().len()), (place.models().join("moge-2-small.onnx").as_path(), 1));
    assert_eq!(Serving::start(&place, &standin.url, &digest).network().get("better"), None);
}
