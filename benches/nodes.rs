//! How making photos scales with nodes that make them: `cargo bench --workspace --bench nodes`.
//!
//! All nodes are in this process and share a PostgreSQL database and a folder of blobs. Making a photo takes a simulated time, so the figure
//! is the cost of what nodes share: finding work, leases, and storing results. The benchmark exits with status 1 if four nodes make less than
//! 1.8 times as many photos as two, or 64 nodes less than 90 % of the ideal.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "bench")]

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::process::ExitCode;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use tmpi::server::{Config, Fault, Limits, Maker, PipelineMaker, Product, Role, Server};
use tmpi_core::{DisparityMap, Photo};
use tmpi_pipeline::{MakeError, Models, Options, Silent, Sink};
use tmpi_render::{Backend, PictureFormat, View, encode};

/// Simulated time to make a photo.
const COST: Duration = Duration::from_secs(4);
/// Counted photos per worker; there are more, so that no worker runs out of work before the end.
const EACH: usize = 5;
const MORE: usize = 2;
/// Least ratio of four workers to two.
const DOUBLED: f64 = 1.8;
/// Least share of the ideal for 64 workers.
const LINEAR: f64 = 0.9;

/// Gives the same product after a while, once it may begin.
struct Slow {
    product: Product,
    open: Mutex<bool>,
    changed: Condvar,
    begun: AtomicUsize,
    made: AtomicUsize,
}

impl Slow {
    fn open(&self) {
        *self.open.lock().unwrap() = true;
        self.changed.notify_all();
    }
}

impl Maker for Slow {
    fn check(&self, _: &[u8], _: Option<&[u8]>, _: &Options) -> Result<(), MakeError> {
        Ok(())
    }

    fn make(&self, _: &[u8], _: Option<&[u8]>, _: &Options, _: &dyn Sink) -> Result<Product, Fault> {
        self.begun.fetch_add(1, Ordering::SeqCst);
        drop(self.changed.wait_while(self.open.lock().unwrap(), |open| !*open).unwrap());
        std::thread::sleep(COST);
        self.made.fetch_add(1, Ordering::SeqCst);
        Ok(self.product.clone())
    }
}

fn picture(seed: usize) -> Vec<u8> {
    let rgba = (0..48 * 32_usize).map(|k| [(k % 48 * 5) as u8, (k / 48 * 7 + seed / 256) as u8, (seed % 256) as u8, 255]).collect();
    encode(&View { width: 48, height: 32, rgba }, PictureFormat::Png, 90).unwrap()
}

/// Status and body.
fn ask(addr: SocketAddr, method: &str, path: &str, body: &[u8]) -> (u16, String) {
    let mut stream = TcpStream::connect(addr).unwrap();
    write!(stream, "{method} {path} HTTP/1.1\r\nhost: {addr}\r\nconnection: close\r\ncontent-length: {}\r\n\r\n", body.len()).unwrap();
    stream.write_all(body).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let answer = String::from_utf8_lossy(&answer).into_owned();
    let status = answer.get(9..12).and_then(|s| s.parse().ok()).unwrap_or(0);
    (status, answer)
}

fn wait(what: &str, mut true_now: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_mins(2);
    while !true_now() {
        assert!(Instant::now() < end, "two minutes are over before {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Photos a second of `workers` nodes, of what they could make at best.
fn rate(runtime: &tokio::runtime::Runtime, workers: usize, product: &Product) -> (f64, f64) {
    let folder = tempfile::tempdir().unwrap();
    let database = tmpi_testing::database();
    let contents = folder.path().join("contents");
    std::fs::create_dir(&contents).unwrap();
    let maker = Arc::new(Slow {
        product: product.clone(),
        open: Mutex::new(false),
        changed: Condvar::new(),
        begun: AtomicUsize::new(0),
        made: AtomicUsize::new(0),
    });
    let (stop, _) = tokio::sync::broadcast::channel::<()>(1);
    let mut running = Vec::new();
    let mut start = |name: String, role| {
        let data = folder.path().join(name);
        std::fs::create_dir(&data).unwrap();
        std::os::unix::fs::symlink(&contents, data.join("blobs")).unwrap();
        let limits = Limits { workers: 1, queue: 10_000, ..Limits::default() };
        let config = Config { database: database.clone(), role, limits, ..Config::new(([127, 0, 0, 1], 0).into(), data) };
        let renderer = tmpi_render::select(Backend::Cpu).unwrap();
        let server = runtime.block_on(Box::pin(Server::bind(config, maker.clone(), renderer))).unwrap();
        let (addr, mut stopped) = (server.addr(), stop.subscribe());
        running.push(runtime.spawn(server.run(async move { drop(stopped.recv().await) })));
        addr
    };
    let front = start("front".into(), Role::Serve);
    for n in 0..workers {
        start(format!("work-{n}"), Role::Work);
    }
    for n in 0..workers * (EACH + MORE) {
        let (status, answer) = ask(front, "POST", "/v1/photos", &picture(n));
        assert_eq!(status, 202, "{answer}");
    }
    wait("all have one", || maker.begun.load(Ordering::SeqCst) >= workers);
    let (photos, began) = (workers * EACH, Instant::now());
    maker.open();
    wait("they are made", || maker.made.load(Ordering::SeqCst) >= photos);
    let took = began.elapsed().as_secs_f64();
    drop(stop);
    runtime.block_on(async {
        for node in running {
            node.await.unwrap();
        }
    });
    (photos as f64 / took, EACH as f64 * COST.as_secs_f64() / took)
}

fn main() -> ExitCode {
    if tmpi_testing::database().is_none() {
        println!("PostgreSQL is not installed");
        return ExitCode::FAILURE;
    }
    let ramp = |photo: &Photo| Ok(DisparityMap::from_fn(photo.width, photo.height, |_, y| (y + 1) as f32 / photo.height as f32));
    let models = Models { depth: Arc::new(("ramp", ramp)), theta: None, psi: None };
    let product =
        PipelineMaker::new(models, tmpi_pipeline::photo::Limits::default()).make(&picture(0), None, &Options::default(), &Silent).unwrap();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    println!("a photo takes {} s; {EACH} photos a worker", COST.as_secs());
    println!("| workers | photos a second | of linear |");
    println!("|---|---|---|");
    let mut all = BTreeMap::new();
    for workers in [1, 2, 4, 16, 64] {
        let (rate, share) = rate(&runtime, workers, &product);
        println!("| {workers} | {rate:.2} | {:.1} % |", share * 100.0);
        all.insert(workers, (rate, share));
    }
    let (doubled, linear) = (all[&4].0 / all[&2].0, all[&64].1);
    println!(
        "four make {doubled:.2} times what two do, wanted are {DOUBLED}; 64 {:.1} % of linear, wanted are {:.0} %",
        linear * 100.0,
        LINEAR * 100.0
    );
    if doubled >= DOUBLED && linear >= LINEAR { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
