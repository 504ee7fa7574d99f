//! A server on a free port, and small photos.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde_json::Value;
use tmpi::live::{RoomLimits, Rooms};
use tmpi::server::{Config, Limits, Maker, Server};
use tmpi_core::{DisparityMap, Photo};
use tmpi_render::{Backend, PictureFormat, Renderer, View, encode};

use crate::client;
use crate::makers::{models, pipeline, ramp};

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
    Rooms::new(models(ramp()), None).with_limits(unhurried())
}

/// Limits without a time budget.
pub fn unhurried() -> RoomLimits {
    RoomLimits { budget_ms: 0.0, ..RoomLimits::default() }
}

pub fn with_rooms(server: Server) -> Server {
    server.with_rooms(rooms())
}

pub fn drawn_by_cpu() -> Arc<dyn Renderer> {
    tmpi_render::select(Backend::Cpu).unwrap()
}

/// The configuration of an open server with one name besides the loopback names.
pub fn usual(data: &Path) -> Config {
    Config { hosts: vec!["photos.example".into()], ..Config::new(([127, 0, 0, 1], 0).into(), data.to_owned()) }
}

/// A running server, often with a data folder of its own.
pub struct Running {
    pub addr: SocketAddr,
    config: Config,
    dir: Option<tempfile::TempDir>,
    stop: Option<tokio::sync::oneshot::Sender<()>>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Running {
    /// An open server with the real pipeline.
    pub fn open() -> Self {
        Self::with(Limits::default(), Arc::new(pipeline()))
    }

    /// An open server with the real pipeline and a finished photo; returns the photo's address, too.
    pub fn with_photo() -> (Self, String) {
        let server = Self::open();
        let id = server.make(&picture(1, PictureFormat::Png));
        (server, format!("/v1/photos/{id}"))
    }

    /// An open server with other limits and another maker.
    pub fn with(limits: Limits, maker: Arc<dyn Maker>) -> Self {
        Self::configured(maker, |config| Config { limits, ..config })
    }

    /// A server with changed settings.
    pub fn configured(maker: Arc<dyn Maker>, change: impl FnOnce(Config) -> Config) -> Self {
        Self::drawing(drawn_by_cpu(), maker, change)
    }

    /// The same with another renderer.
    pub fn drawing(renderer: Arc<dyn Renderer>, maker: Arc<dyn Maker>, change: impl FnOnce(Config) -> Config) -> Self {
        Self::owning(|data| Self::launch(change(usual(data)), maker, renderer, with_rooms))
    }

    /// Gives a server a data folder of its own.
    pub fn owning(start: impl FnOnce(&Path) -> Self) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut server = start(dir.path());
        server.dir = Some(dir);
        server
    }

    /// A server that `finish` completes, on a thread of its own.
    pub fn launch<F>(config: Config, maker: Arc<dyn Maker>, renderer: Arc<dyn Renderer>, finish: F) -> Self
    where
        F: FnOnce(Server) -> Server + Send + 'static,
    {
        count_panics();
        let kept = config.clone();
        let (stop, stopped) = tokio::sync::oneshot::channel();
        let (tell, told) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            // few blocking threads, so that tests notice code that holds one while it waits
            let runtime =
                tokio::runtime::Builder::new_multi_thread().worker_threads(2).max_blocking_threads(24).enable_all().build().unwrap();
            runtime.block_on(async {
                let server = finish(Server::bind(config, maker, renderer).await.unwrap());
                tell.send(server.addr()).unwrap();
                server.run(async { drop(stopped.await) }).await;
            });
        });
        let addr = told.recv().expect("the server starts");
        Self { addr, config: kept, dir: None, stop: Some(stop), thread: Some(thread) }
    }

    /// Stops it and starts one in its data folder with changed settings.
    pub fn changed(self, maker: Arc<dyn Maker>, change: impl FnOnce(Config) -> Config) -> Self {
        self.completed(maker, change, with_rooms)
    }

    /// The same with other limits.
    pub fn again(self, limits: Limits, maker: Arc<dyn Maker>) -> Self {
        self.changed(maker, |config| Config { limits, ..config })
    }

    /// Like [`Self::changed`] for a server that `finish` completes.
    pub fn completed<F>(mut self, maker: Arc<dyn Maker>, change: impl FnOnce(Config) -> Config, finish: F) -> Self
    where
        F: FnOnce(Server) -> Server + Send + 'static,
    {
        let (dir, config) = (self.dir.take(), self.config.clone());
        self.stop();
        let mut server = Self::launch(change(config), maker, drawn_by_cpu(), finish);
        server.dir = dir;
        server
    }

    /// The same with the usual limits and the real pipeline.
    pub fn restarted(self) -> Self {
        self.again(Limits::default(), Arc::new(pipeline()))
    }

    /// Its own data folder.
    pub fn data(&self) -> &Path {
        self.dir.as_ref().unwrap().path()
    }

    /// Asks it to stop.
    pub fn signal(&mut self) {
        self.stop.take();
    }

    /// Stops it and waits for its end.
    pub fn stop(mut self) {
        self.signal();
        self.ended();
    }

    /// Waits for its end without stopping it.
    pub fn ended(mut self) {
        self.thread.take().unwrap().join().expect("the server ends without a panic");
    }

    /// Uploads a picture and returns its id.
    pub fn upload(&self, photo: &[u8]) -> String {
        id(&client::request(self.addr, "POST", "/v1/photos", &[], photo).is(202).json())
    }

    /// Uploads a picture and waits until it is made; returns its id.
    pub fn make(&self, photo: &[u8]) -> String {
        let id = self.upload(photo);
        self.wait(&id, "done");
        id
    }

    /// Ids of the photos that this machine's own user sees, newest first.
    pub fn listed(&self) -> Vec<String> {
        listed(self.addr)
    }

    /// A value of its metrics; 0 if it is missing.
    pub fn metric(&self, name: &str) -> u64 {
        figure(self.addr, name)
    }

    pub fn state(&self, id: &str) -> Value {
        state(self.addr, id)
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

pub fn block_on<T>(work: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(work)
}

/// Seconds since 1970.
pub fn seconds_now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs()
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

/// State of a photo.
pub fn state(addr: SocketAddr, id: &str) -> Value {
    client::get(addr, &format!("/v1/photos/{id}")).json()
}

/// Ids of the photos that this machine's own user sees, newest first.
pub fn listed(addr: SocketAddr) -> Vec<String> {
    ids(&client::get(addr, "/v1/photos?limit=200"))
}

/// Ids of a list.
pub fn ids(list: &client::Response) -> Vec<String> {
    assert_eq!(list.status, 200, "{}", String::from_utf8_lossy(&list.body));
    list.json()["photos"].as_array().unwrap().iter().map(id).collect()
}

/// The id in a photo's state.
pub fn id(state: &Value) -> String {
    state["id"].as_str().unwrap().to_owned()
}

/// A value of a server's metrics; 0 if it is missing.
pub fn figure(addr: SocketAddr, name: &str) -> u64 {
    let text = client::get(addr, "/metrics").text();
    let value = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.parse::<f64>().ok());
    value.unwrap_or_default() as u64
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

/// Waits until the server has answered many other requests: whatever else it could do by itself, it has done by then.
pub fn serves_others(addr: SocketAddr) {
    let mut client = client::Connection::open(addr);
    for _ in 0..100 {
        assert_eq!(client.request("GET", "/healthz", &[], &[]).status, 200);
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

/// A photo whose container is large.
pub fn noise() -> Vec<u8> {
    let level = |x: u32, y: u32, c: u32| (255.0 * tmpi_testing::pictures::noise(x, y + 1000 * c)) as u8;
    let photo = Photo::from_fn(640, 480, |x, y| [0, 1, 2].map(|c| level(x, y, c)));
    tmpi_core::container::encode_jpeg(640, 480, photo.rgb.as_flattened(), 100).unwrap()
}

/// A depth map with damaged pixels.
pub fn spoilt_map() -> Vec<u8> {
    spoilt(depth_map())
}

/// A PNG with damaged pixels and intact headers.
pub fn spoilt(mut png: Vec<u8>) -> Vec<u8> {
    // a wrong zlib header
    let at = png.windows(4).position(|name| name == b"IDAT").unwrap() + 4;
    png[at] ^= 0xff;
    png
}

/// A depth map with two levels.
pub fn depth_map() -> Vec<u8> {
    tmpi_pipeline::depth::to_png(&DisparityMap::from_fn(80, 60, |x, _| if x < 40 { 0.25 } else { 0.75 })).unwrap()
}
