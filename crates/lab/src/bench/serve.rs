//! Load test of the server: throughput and latency of views by number of clients, and memory over time.

use std::fmt::Write;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use serde::Serialize;
use serde_json::Value;

/// Numbers of concurrent clients, measured in turn.
pub const CLIENTS: [usize; 3] = [1, 8, 64];
/// Views between two readings of the server's memory.
const READING: usize = 500;
/// Time limit for processing the photo.
const TIMEOUT: Duration = Duration::from_mins(2);

/// The server to measure.
#[derive(Clone, Debug)]
pub enum Target {
    /// A running server; requests views of its newest photo.
    Url(String),
    /// A new server on a free port, with this photo.
    Photo(Vec<u8>),
}

/// The load to generate.
#[derive(Clone, Copy, Debug)]
pub struct Load {
    /// Views for each number of clients.
    pub views: usize,
    /// Additional views by 8 clients, during which memory is recorded.
    pub memory_views: usize,
    /// Width of the views in pixels.
    pub width: u32,
}

/// Results for one number of clients.
#[derive(Clone, Debug, Serialize)]
pub struct LoadResult {
    /// Number of concurrent clients.
    pub clients: usize,
    /// Received views.
    pub views: usize,
    /// Responses with status 503, after which a client waits and retries.
    pub refused: usize,
    /// Views per second.
    pub rate: f64,
    /// Median latency in milliseconds, from request to complete picture.
    pub p50_ms: f64,
    /// 99th percentile of the latency in milliseconds.
    pub p99_ms: f64,
}

/// Results of a load test.
#[derive(Clone, Debug, Serialize)]
pub struct ServeResults {
    /// Size of the views.
    pub size: [u32; 2],
    /// Results by number of clients.
    pub served: Vec<LoadResult>,
    /// Number of requested views so far, and the server's resident memory in MiB; empty if unknown.
    pub memory: Vec<(usize, f64)>,
}

impl ServeResults {
    /// The results as a text table.
    #[must_use]
    pub fn table(&self) -> String {
        let mut out = format!("views of {}×{}, each with a different pose, JPEG\n", self.size[0], self.size[1]);
        out += "clients   views  refused  views/s   p50 ms   p99 ms\n";
        for s in &self.served {
            // writing to a String cannot fail
            let _ = writeln!(out, "{:7} {:7} {:8} {:8.1} {:8.1} {:8.1}", s.clients, s.views, s.refused, s.rate, s.p50_ms, s.p99_ms);
        }
        for (views, mib) in &self.memory {
            let _ = writeln!(out, "after {views} views: {mib:.1} MiB resident");
        }
        out
    }
}

/// Why a load test failed.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The server could not be started, or a request failed.
    #[error("{0}")]
    Server(String),
    /// The server's folder could not be created.
    #[error("cannot create the folder {path}")]
    Folder {
        /// The folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
}

fn failed(what: &str, why: impl std::fmt::Display) -> ServeError {
    ServeError::Server(format!("{what}: {why}"))
}

/// A server started for the test. Dropping this stops it and deletes its folder.
struct TestServer {
    child: Child,
    folder: PathBuf,
}

impl TestServer {
    /// Starts `tmpi serve`; returns it with its address.
    fn start() -> Result<(Self, String), ServeError> {
        let folder = std::env::temp_dir().join(format!("tmpi-bench-{}", std::process::id()));
        std::fs::create_dir_all(&folder).map_err(|source| ServeError::Folder { path: folder.clone(), source })?;
        let mut command = Command::new(super::program().map_err(|e| failed("the server", e))?);
        command.args(["serve", "--addr", "127.0.0.1:0", "--data"]).arg(&folder).env("RUST_LOG", "error").stdout(Stdio::piped());
        let child = command.spawn().map_err(|e| failed("cannot start the server", e))?;
        let mut server = Self { child, folder };
        let mut line = String::new();
        let out = server.child.stdout.take().ok_or_else(|| failed("the server", "no output"))?;
        BufReader::new(out).read_line(&mut line).map_err(|e| failed("the server's address", e))?;
        if line.trim().is_empty() {
            return Err(failed("the server", "it exited before it printed its address"));
        }
        Ok((server, line.trim().to_owned()))
    }

    /// Resident memory in MiB; `None` if unknown.
    fn memory(&self) -> Option<f64> {
        Some(tmpi_pipeline::usage::resident_bytes(Some(self.child.id()))? as f64 / f64::from(1 << 20))
    }
}

impl Drop for TestServer {
    fn drop(&mut self) {
        // its data is temporary
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

/// A client that keeps its connection open.
fn agent() -> ureq::Agent {
    ureq::Agent::config_builder().http_status_as_error(false).timeout_global(Some(Duration::from_mins(1))).build().into()
}

fn json(agent: &ureq::Agent, url: &str) -> Result<Value, ServeError> {
    let mut answer = agent.get(url).call().map_err(|e| failed(url, e))?;
    let body = answer.body_mut().read_to_vec().map_err(|e| failed(url, e))?;
    serde_json::from_slice(&body).map_err(|e| failed(url, e))
}

/// Uploads a photo, waits until it is processed, and returns its state.
fn upload(agent: &ureq::Agent, url: &str, photo: &[u8]) -> Result<Value, ServeError> {
    let address = format!("{url}/v1/photos");
    let request = agent.post(&address).header("content-type", "application/octet-stream");
    let mut answer = request.send(photo).map_err(|e| failed("upload", e))?;
    let body = answer.body_mut().read_to_vec().map_err(|e| failed("upload", e))?;
    let mut state: Value = serde_json::from_slice(&body).map_err(|e| failed("upload", e))?;
    let start = Instant::now();
    loop {
        match state["state"].as_str() {
            Some("done") => return Ok(state),
            Some("queued" | "working") if start.elapsed() < TIMEOUT => {}
            _ => return Err(failed("the photo was not processed", state)),
        }
        std::thread::sleep(Duration::from_millis(50));
        state = json(agent, &format!("{address}/{}", state["id"].as_str().unwrap_or_default()))?;
    }
}

/// Runs the load test; calls `progress` at each step.
///
/// # Errors
/// [`ServeError`].
pub fn run(target: &Target, load: &Load, progress: &dyn Fn(&str)) -> Result<ServeResults, ServeError> {
    let agent = agent();
    let (server, url) = match target {
        Target::Url(url) => (None, url.trim_end_matches('/').to_owned()),
        Target::Photo(_) => TestServer::start().map(|(server, url)| (Some(server), url))?,
    };
    let photo = match target {
        Target::Photo(file) => {
            progress("processing the photo");
            upload(&agent, &url, file)?
        }
        Target::Url(_) => {
            let list = json(&agent, &format!("{url}/v1/photos"))?;
            let all = list["photos"].as_array().map(Vec::as_slice).unwrap_or_default();
            all.iter().find(|p| p["state"] == "done").cloned().ok_or_else(|| failed(&url, "there is no finished photo"))?
        }
    };
    let side = |name: &str| photo[name].as_f64().filter(|v| *v > 0.0).ok_or_else(|| failed("the photo", format!("it has no {name}")));
    let height = (f64::from(load.width) * side("height")? / side("width")?).round().max(1.0) as u32;
    let view = format!("{url}{}?w={}&h={height}&format=jpeg", photo["links"]["view"].as_str().unwrap_or_default(), load.width);
    let asked = AtomicUsize::new(0);
    // the scene is decoded before the clock starts
    ask(&agent, &view, &asked)?;
    let mut memory = Vec::new();
    let mut read =
        |asked: &AtomicUsize| memory.extend(server.as_ref().and_then(TestServer::memory).map(|m| (asked.load(Ordering::Relaxed), m)));
    let mut served = Vec::new();
    for clients in CLIENTS {
        progress(&format!("{clients} clients"));
        served.push(run_clients(&view, clients, load.views, &asked)?);
    }
    read(&asked);
    let mut left = load.memory_views;
    while left > 0 {
        let some = left.min(READING);
        run_clients(&view, 8, some, &asked)?;
        left -= some;
        read(&asked);
        progress(&format!("{left} views left"));
    }
    Ok(ServeResults { size: [load.width, height], served, memory })
}

/// Requests the next view; returns whether it came, or false if the server is busy.
fn ask(agent: &ureq::Agent, view: &str, asked: &AtomicUsize) -> Result<bool, ServeError> {
    // poses inside the view box that are not cached yet
    let n = asked.fetch_add(1, Ordering::Relaxed);
    let (x, y) = ((n % 600) as f64 / 1e4 - 0.03, (n / 600 % 600) as f64 / 1e4 - 0.03);
    let mut answer = agent.get(format!("{view}&tx={x:.5}&ty={y:.5}")).call().map_err(|e| failed("view", e))?;
    let body = answer.body_mut().read_to_vec().map_err(|e| failed("view", e))?;
    match answer.status().as_u16() {
        200 => Ok(true),
        503 => Ok(false),
        status => Err(failed("view", format!("{status} {}", String::from_utf8_lossy(&body)))),
    }
}

/// Requests `views` views with `clients` concurrent clients.
fn run_clients(view: &str, clients: usize, views: usize, asked: &AtomicUsize) -> Result<LoadResult, ServeError> {
    let (left, refused) = (AtomicUsize::new(views), AtomicUsize::new(0));
    let start = Instant::now();
    let one = || {
        let agent = agent();
        let mut times = Vec::new();
        while left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |n| n.checked_sub(1)).is_ok() {
            let begun = Instant::now();
            while !ask(&agent, view, asked)? {
                refused.fetch_add(1, Ordering::Relaxed);
                std::thread::sleep(Duration::from_millis(100));
            }
            times.push(begun.elapsed().as_secs_f64() * 1e3);
        }
        Ok::<_, ServeError>(times)
    };
    let all = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..clients).map(|_| scope.spawn(one)).collect();
        threads.into_iter().map(|t| t.join().unwrap_or_else(|_| Err(failed("a client", "it panicked")))).collect::<Result<Vec<_>, _>>()
    })?;
    let seconds = start.elapsed().as_secs_f64();
    let mut times = all.concat();
    times.sort_by(f64::total_cmp);
    let at = |share: f64| times.get(((times.len() as f64 * share) as usize).min(times.len().saturating_sub(1))).copied().unwrap_or(0.0);
    Ok(LoadResult {
        clients,
        views: times.len(),
        refused: refused.into_inner(),
        rate: times.len() as f64 / seconds,
        p50_ms: at(0.5),
        p99_ms: at(0.99),
    })
}
