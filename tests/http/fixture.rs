//! A server on a free port, small photos, and makers that a test can hold.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use serde_json::Value;
use tmpi::live::{Config as RoomConfig, Rooms};
use tmpi::server::{Config, Fault, HeadOf, Limits, Maker, PipelineMaker, Product, Server};
use tmpi_core::{Camera, DisparityMap, Photo, Scene};
use tmpi_pipeline::depth::{DepthError, Estimator};
use tmpi_pipeline::{MakeError, Models, Options, Progress, Sink, photo};
use tmpi_render::{Backend, PictureFormat, RenderError, Renderer, View, encode};

use crate::client;

/// A network whose disparity grows towards the bottom, as in most photos.
struct Ramp;

impl Estimator for Ramp {
    fn name(&self) -> &'static str {
        "ramp"
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        let (width, height) = (photo.width, photo.height);
        let delta = (0..height).flat_map(|y| (0..width).map(move |_| (y + 1) as f32 / height as f32)).collect();
        Ok(DisparityMap { width, height, delta })
    }
}

/// The real pipeline with a ramp as depth network.
pub fn pipeline() -> PipelineMaker {
    way_within(Limits::default().photo())
}

/// The same with other limits.
pub fn way_within(limits: photo::Limits) -> PipelineMaker {
    PipelineMaker::new(Models { depth: Arc::new(Ramp), theta: None, psi: None }, limits)
}

/// The real pipeline behind a gate.
pub struct Gate {
    inner: PipelineMaker,
    open: Mutex<usize>,
    changed: Condvar,
    pub started: AtomicUsize,
    pub finished: AtomicUsize,
}

impl Gate {
    /// A gate that lets `n` photos through.
    pub fn new(n: usize) -> Arc<Self> {
        Arc::new(Self {
            inner: pipeline(),
            open: Mutex::new(n),
            changed: Condvar::new(),
            started: AtomicUsize::new(0),
            finished: AtomicUsize::new(0),
        })
    }

    /// Lets `n` more through.
    pub fn open(&self, n: usize) {
        *self.open.lock().unwrap() += n;
        self.changed.notify_all();
    }

    pub fn wait_started(&self, n: usize) {
        wait_until("a job starts", || self.started.load(Ordering::SeqCst) >= n);
    }
}

impl Maker for Gate {
    fn check(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> Result<(), MakeError> {
        self.inner.check(photo, depth, options)
    }

    fn check_head(&self, of: HeadOf<'_>, head: &[u8]) -> Result<Option<usize>, MakeError> {
        self.inner.check_head(of, head)
    }

    fn memory(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> u64 {
        self.inner.memory(photo, depth, options)
    }

    fn make(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        self.started.fetch_add(1, Ordering::SeqCst);
        sink.progress(&Progress { stage: "photo", step: 1, steps: 9, elapsed_ms: 0.0 });
        let mut open = self.open.lock().unwrap();
        while *open == 0 {
            if sink.cancelled() {
                return Err(Fault::Cancelled);
            }
            open = self.changed.wait_timeout(open, Duration::from_millis(5)).unwrap().0;
        }
        *open -= 1;
        drop(open);
        let product = self.inner.make(photo, depth, options, sink)?;
        self.finished.fetch_add(1, Ordering::SeqCst);
        Ok(product)
    }
}

/// A maker from a closure.
pub struct Does<F>(pub F);

impl<F> Maker for Does<F>
where
    F: Fn(&[u8], &dyn Sink) -> Result<Product, Fault> + Send + Sync + 'static,
{
    fn check(&self, _: &[u8], _: Option<&[u8]>, _: &Options) -> Result<(), MakeError> {
        Ok(())
    }

    fn make(&self, photo: &[u8], _: Option<&[u8]>, _: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        (self.0)(photo, sink)
    }
}

/// Returns plain views at once; those that are [`SlowDrawing::HELD`] pixels wide wait until it is opened.
#[derive(Default)]
pub struct SlowDrawing {
    open: Mutex<bool>,
    changed: Condvar,
    pub begun: AtomicUsize,
    pub held: AtomicUsize,
}

impl SlowDrawing {
    pub const HELD: u32 = 77;

    pub fn open(&self) {
        *self.open.lock().unwrap() = true;
        self.changed.notify_all();
    }
}

impl Renderer for SlowDrawing {
    fn name(&self) -> &'static str {
        "slow"
    }

    fn render(&self, _: &Arc<Scene>, camera: &Camera) -> Result<View, RenderError> {
        self.begun.fetch_add(1, Ordering::SeqCst);
        if camera.width == Self::HELD {
            self.held.fetch_add(1, Ordering::SeqCst);
            let guard = self.changed.wait_while(self.open.lock().unwrap(), |open| !*open).unwrap();
            drop(guard);
            self.held.fetch_sub(1, Ordering::SeqCst);
        }
        std::thread::sleep(Duration::from_millis(5));
        Ok(View { width: camera.width, height: camera.height, rgba: vec![[9; 4]; (camera.width * camera.height) as usize] })
    }
}

/// Count of panics in requests. The server answers such requests, so a test that ignores the answer would miss the panic.
static PANICS: AtomicUsize = AtomicUsize::new(0);

/// Counts panics on the runtime's threads only; some tests make makers panic.
fn count_panics() {
    static ONCE: std::sync::Once = std::sync::Once::new();
    ONCE.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            if std::thread::current().name().is_some_and(|name| name.starts_with("tokio")) {
                PANICS.fetch_add(1, Ordering::SeqCst);
            }
            before(panic);
        }));
    });
}

/// Rooms for this machine's own user.
pub fn rooms() -> Rooms {
    Rooms::new(RoomConfig { models: Models { depth: Arc::new(Ramp), theta: None, psi: None }, frame_ms: 0.0, key: None })
}

/// A running server.
pub struct Running {
    pub addr: SocketAddr,
    stop: Option<tokio::sync::oneshot::Sender<()>>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Running {
    pub fn start(data: &Path, limits: Limits, maker: Arc<dyn Maker>) -> Self {
        Self::drawing(data, limits, maker, tmpi_render::select(Backend::Cpu).unwrap())
    }

    /// A server with another renderer.
    pub fn drawing(data: &Path, limits: Limits, maker: Arc<dyn Maker>, renderer: Arc<dyn Renderer>) -> Self {
        let config = Config { hosts: vec!["photos.example".into()], limits, ..Config::new(([127, 0, 0, 1], 0).into(), data.to_owned()) };
        Self::of(async move { Server::bind(config, maker, renderer).await.unwrap().with_rooms(rooms()) })
    }

    /// Runs a server on a thread of its own.
    pub fn of(bound: impl Future<Output = Server> + Send + 'static) -> Self {
        count_panics();
        let (stop, stopped) = tokio::sync::oneshot::channel();
        let (tell, told) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            // few blocking threads, so that tests notice code that holds one while it waits
            let runtime =
                tokio::runtime::Builder::new_multi_thread().worker_threads(2).max_blocking_threads(24).enable_all().build().unwrap();
            runtime.block_on(async {
                let server = bound.await;
                tell.send(server.addr()).unwrap();
                server.run(async { drop(stopped.await) }).await;
            });
        });
        Self { addr: told.recv().expect("the server starts"), stop: Some(stop), thread: Some(thread) }
    }

    /// Asks it to stop.
    pub fn signal(&mut self) {
        self.stop.take();
    }

    /// Stops it and waits for its end.
    pub fn stop(mut self) {
        self.signal();
        self.thread.take().unwrap().join().expect("the server ends without a panic");
    }

    /// Waits for its end without stopping it.
    pub fn ended(mut self) {
        self.thread.take().unwrap().join().expect("the server ends without a panic");
    }

    /// Uploads a picture and returns its id.
    pub fn upload(&self, photo: &[u8]) -> String {
        let response = client::request(self.addr, "POST", "/v1/photos", &[], photo);
        assert_eq!(response.status, 202, "{}", String::from_utf8_lossy(&response.body));
        response.json()["id"].as_str().unwrap().to_owned()
    }

    pub fn state(&self, id: &str) -> Value {
        client::get(self.addr, &format!("/v1/photos/{id}")).json()
    }

    /// Waits until a photo is in `state`.
    pub fn wait(&self, id: &str, state: &str) -> Value {
        let mut last = Value::Null;
        wait_until(&format!("{id} is {state}"), || {
            last = self.state(id);
            last["state"] == state
        });
        last
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.signal();
        if !std::thread::panicking() {
            assert_eq!(PANICS.load(Ordering::SeqCst), 0, "a request panicked, of this test or another");
        }
    }
}

/// Paths of a photo's blobs in a data folder whose part begins with `part`; of all photos if `id` is empty.
pub fn contents(data: &Path, id: &str, part: &str) -> Vec<PathBuf> {
    let is_wanted = |name: &str| name.starts_with(id) && name.get(32..).is_some_and(|rest| rest.starts_with(&format!("-{part}")));
    let folders = std::fs::read_dir(data.join("blobs")).unwrap().flatten().filter(|folder| folder.file_name().len() == 2);
    let files = folders.flat_map(|folder| std::fs::read_dir(folder.path()).unwrap().flatten());
    files.filter(|file| is_wanted(file.file_name().to_str().unwrap())).map(|file| file.path()).collect()
}

/// Count of uploads in progress in a data folder.
pub fn incoming(data: &Path) -> usize {
    std::fs::read_dir(data.join("blobs").join("incoming")).unwrap().count()
}

/// A value of a server's metrics; `None` if it is missing.
pub fn figure(addr: SocketAddr, name: &str) -> Option<u64> {
    let text = String::from_utf8(client::get(addr, "/metrics").body).unwrap();
    let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ').map(str::to_owned))?;
    Some(line.parse::<f64>().unwrap() as u64)
}

/// Fails after a minute.
#[track_caller]
pub fn wait_until(what: &str, mut true_now: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_mins(1);
    while !true_now() {
        assert!(Instant::now() < end, "a minute is over before {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A small picture, different for each seed.
pub fn picture(seed: u8, format: PictureFormat) -> Vec<u8> {
    let (width, height) = (80, 60);
    let at = |x: u32, y: u32| {
        let edge = if (x / 20 + y / 15).is_multiple_of(2) { 40 } else { 200 };
        [edge, (x * 3) as u8, (y * 4) as u8 ^ seed, 255]
    };
    let rgba = (0..height).flat_map(|y| (0..width).map(move |x| at(x, y))).collect();
    encode(&View { width, height, rgba }, format, 90).unwrap()
}

pub fn jpeg(seed: u8) -> Vec<u8> {
    picture(seed, PictureFormat::Jpeg)
}

/// A depth map with damaged pixels and intact headers.
pub fn spoilt_map() -> Vec<u8> {
    let mut map = depth_map();
    // a wrong zlib header
    let at = map.windows(4).position(|name| name == b"IDAT").unwrap() + 4;
    map[at] ^= 0xff;
    map
}

/// A depth map with two levels.
pub fn depth_map() -> Vec<u8> {
    let (width, height) = (80, 60);
    let delta = (0..height).flat_map(|_| (0..width).map(|x| if x < 40 { 0.25 } else { 0.75 })).collect();
    tmpi_pipeline::depth::to_png(&DisparityMap { width, height, delta }).unwrap()
}
