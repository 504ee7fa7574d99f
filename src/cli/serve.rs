//! `tmpi serve`.

use std::ffi::OsString;
use std::io::Write as _;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;

use super::better::BetterNetwork;
use super::bounds::BoundArgs;
use super::clients::ClientArgs;
use super::{Usage, files};
pub(super) use checks::Effect;
use sha2::{Digest as _, Sha256};
use tmpi_pipeline::networks::flags::{DepthModel, ModelFlags, depth_model};

use crate::live::{self, NodeAddress, Rooms};
use crate::server::{
    Better, Collector, Config, Limits, PipelineMaker, ProcessMaker, Role, Server, Tls, VARIABLE, allocate_in_one_place, hex,
    keep_from_others, make_for_a_server, stop_signal,
};
use tmpi_pipeline::Models;
use tmpi_pipeline::networks::models::{self, download::Digest};
use tmpi_render::{self, Backend};

/// More than readers of a container take would be made and never shown.
const MOST_MEGAPIXELS: i64 = (tmpi_core::container::MAX_PIXELS / 1_000_000) as i64;

/// Open files besides connections.
#[cfg(unix)]
const SPARE_FILES: u64 = 512;
/// Milliseconds that the geometry of a room's frame may take, where nothing else is said. `tmpi-lab live-bench --only still --budget-ms 8,12,20,30` compares: 8.4, 10.3,
/// 13.1 and 17.5 ms of processor a frame, views of 23.4, 23.3, 23.4 and 23.3 dB, flicker .070, .064, .054 and .080 levels, edges 2.1, 2.2, 2.1 and 2.2 pixels short.
/// At 640×480 12, 20, 30 and 45 (`--size 640x480 --frames 120`) have edges 2.2, 1.6, 1.6 and 1.7 pixels short. With 20 instead of 30 pictures come a sixth sooner where all
/// share two cores (`glass-to-glass.mjs`); but at 640×480 there more tiles wait, and what moves is seen torn where they meet others more often.
const LIVE_BUDGET_MS: f64 = 20.0;

/// Take photos over HTTP and serve what is made of them
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ServeArgs {
    #[arg(
        long,
        env = "TMPI_CONFIG",
        value_name = "FILE",
        help = "File of settings, TOML with the names of these options; what is said here, or by variables like TMPI_SERVE_QUEUE, counts more"
    )]
    #[allow(dead_code, reason = "read before all else, with what is in it")]
    config: Option<PathBuf>,
    /// Address and port to listen on, or the port alone for this machine; port 0 takes a free one, 0.0.0.0:8080 lets others in
    #[arg(long, default_value = "127.0.0.1:8080", value_parser = address, value_name = "ADDR")]
    addr: SocketAddr,
    /// Speak TLS: file of the certificate and those that signed it, in PEM; read again when it changes
    #[arg(long, requires = "tls_key", value_name = "FILE")]
    tls_cert: Option<PathBuf>,
    /// File of its private key, in PEM
    #[arg(long, requires = "tls_cert", value_name = "FILE")]
    tls_key: Option<PathBuf>,
    /// Address and port for operators, who ask for /metrics, /healthz, /readyz, POST /drain and POST /purge/ID there: everybody who reaches it may
    #[arg(long, value_parser = address, value_name = "ADDR")]
    admin: Option<SocketAddr>,
    /// Directory that keeps photos and what is made of them
    #[arg(long, default_value = "tmpi-data", value_name = "DIR")]
    data: PathBuf,
    #[arg(
        long,
        value_name = "URL",
        help = "Database that several nodes share, postgres://USER:PASSWORD@HOST/NAME; the variable TMPI_SERVE_DATABASE keeps the password off the \
                list of processes. SQLite in DIR without it"
    )]
    database: Option<String>,
    #[arg(
        long,
        value_name = "URL",
        help = "Object store that several nodes share, s3://BUCKET/PREFIX, gs://BUCKET/PREFIX or az://CONTAINER/PREFIX, with the usual variables AWS_…, \
                GOOGLE_… or AZURE_…; a folder in DIR without it"
    )]
    blobs: Option<String>,
    /// What this node of several does
    #[arg(long, value_enum, default_value_t, requires = "database")]
    role: Role,
    /// Seconds after which a job is taken up again where nothing is heard of its worker
    #[arg(long, default_value_t = Limits::LEASE.as_secs() as u32, value_parser = clap::value_parser!(u32).range(2..=600), value_name = "S")]
    lease: u32,
    /// Read the pages from this directory instead of from the program
    #[arg(long = "static", value_name = "DIR")]
    pages: Option<PathBuf>,
    /// Name under which the server answers besides localhost and its address, as a proxy passes it on in Host; may be repeated
    #[arg(long = "host", value_name = "NAME")]
    hosts: Vec<String>,
    /// Let everybody who can reach the server list all photos, not only this machine's own user
    #[arg(long)]
    public_list: bool,
    /// Whether to ask who comes: `open`, or `private`, where photos are their owners' alone (see `tmpi key`); private beyond loopback and with --host, else open
    #[arg(long, value_enum, value_name = "WHO")]
    access: Option<Access>,
    /// What draws views
    #[arg(long, value_enum, default_value_t)]
    backend: Backend,
    /// Photos that are made at a time
    #[arg(long, default_value_t = Limits::WORKERS as u16, value_parser = clap::value_parser!(u16).range(1..), value_name = "N")]
    workers: u16,
    /// Photos that may wait; one more is answered 429
    #[arg(long, default_value_t = Limits::QUEUE, value_name = "N")]
    queue: usize,
    /// Largest body of a request, in MiB
    #[arg(long, default_value_t = (Limits::BODY >> 20) as u32, value_parser = clap::value_parser!(u32).range(1..=4096), value_name = "MIB")]
    max_body: u32,
    /// Largest photo, in megapixels
    #[arg(long, default_value_t = (tmpi_pipeline::photo::Limits::PIXELS / 1_000_000) as u32, value_parser = clap::value_parser!(u32).range(1..=MOST_MEGAPIXELS), value_name = "MP")]
    max_pixels: u32,
    /// Views that are drawn at a time
    #[arg(long, default_value_t = Limits::VIEWS as u16, value_parser = clap::value_parser!(u16).range(1..), value_name = "N")]
    views: u16,
    /// Memory of the machine for all of the server, in MiB: caches, work and making photos share it; what is said of one of them counts more
    #[arg(long, value_parser = clap::value_parser!(u32).range(192..), value_name = "MIB")]
    memory: Option<u32>,
    /// Memory for decoded scenes, in MiB, and as much again for what views are drawn from on the processor [default: 256]
    #[arg(long, value_name = "MIB")]
    scene_cache: Option<u32>,
    /// Connections at a time
    #[arg(long, default_value_t = Limits::CONNECTIONS as u32, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    connections: u32,
    /// Connections at a time from one address; a proxy is one, unless it is trusted
    #[arg(long, default_value_t = Limits::CONNECTIONS_PER_ADDRESS as u32, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    connections_per_address: u32,
    #[command(flatten)]
    clients: ClientArgs,
    /// Memory for work on scenes that are not kept, in MiB, and as much again for films and files; one that needs more is worked on alone [default: 1024]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..), value_name = "MIB")]
    work_memory: Option<u32>,
    /// Disk for files to download that were written already, in MiB
    #[arg(long, default_value_t = (Limits::EXPORT_CACHE >> 20) as u32, value_name = "MIB")]
    export_cache: u32,
    /// Seconds that a request may take, from the end of its body
    #[arg(long, default_value_t = Limits::REQUEST.as_secs() as u32, value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    request_timeout: u32,
    /// Seconds that making a photo of up to 12 megapixels may take; larger ones have as much more
    #[arg(long, default_value_t = Limits::JOB.as_secs() as u32, value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    job_timeout: u32,
    /// Memory that making photos may take, in MiB: larger ones are made smaller, or refused, and side by side are made as many as fit [default: 6144]
    #[arg(long, value_parser = clap::value_parser!(u32).range(160..), value_name = "MIB")]
    job_memory: Option<u32>,
    /// Seconds after which unused memory returns to the system: scenes, files, processes that made photos
    #[arg(long, default_value_t = Limits::REST.as_secs() as u32, value_parser = clap::value_parser!(u32).range(1..), value_name = "S")]
    rest: u32,
    /// Seconds after SIGTERM for which everything is still served but /readyz says 503, so that proxies look elsewhere; 5, on loopback 0
    #[arg(long, value_parser = clap::value_parser!(u32).range(0..=3600), value_name = "S")]
    lame_duck: Option<u32>,
    /// Seconds that requests and jobs under way have left after that
    #[arg(long, default_value_t = Limits::DRAIN.as_secs() as u32, value_name = "S")]
    drain: u32,
    /// How the log on standard error is written
    #[arg(long, value_enum, default_value_t, value_name = "FORM")]
    pub log: super::Log,
    #[arg(
        long,
        value_name = "URL",
        help = "Send traces to the collector at this address by OTLP over HTTP, as http://127.0.0.1:4318; \
                OTEL_EXPORTER_OTLP_ENDPOINT names it, too"
    )]
    otlp: Option<String>,
    /// Share of the traces that begin here that are sent, 0 to 1; those that began elsewhere are sent where their traceparent says so
    #[arg(long, default_value_t = 1.0, value_parser = share, value_name = "SHARE")]
    otlp_ratio: f64,
    /// Have no rooms for moving photos
    #[arg(long)]
    no_live: bool,
    /// File with a key of at least 32 bytes, by which `live token` lets others into rooms; without it they are for this machine's own user
    #[arg(long, value_name = "FILE", conflicts_with = "no_live")]
    live_key: Option<PathBuf>,
    #[arg(
        long,
        requires = "database",
        value_name = "URL",
        help = "Address at which other nodes of the same --database reach this one, as http://10.0.0.3:8080: rooms can be watched at all of them then"
    )]
    advertise: Option<NodeAddress>,
    /// Depth network of rooms, named as for --depth-model; the embedded one keeps up with a camera, those that take seconds for a photo do not
    #[arg(long, value_parser = depth_model, default_value = "tmpi", value_name = "auto|NAME[=FILE]|FILE", conflicts_with = "no_live")]
    live_depth_model: DepthModel,
    /// Milliseconds that the geometry of a room's frame may take: where depth, planes or tiles took longer there are fewer of them
    #[arg(long, default_value_t = LIVE_BUDGET_MS, value_name = "MS")]
    live_budget_ms: f64,
    /// Address of the better depth network that the page offers to fetch, in place of its publisher's; the digest stays
    #[arg(long, value_name = "URL")]
    network_url: Option<String>,
    /// Digest of that file where it is another, 64 hexadecimal digits
    #[arg(long, requires = "network_url", value_name = "HEX")]
    network_sha256: Option<Digest>,
    #[command(flatten)]
    models: ModelFlags,
    #[command(flatten)]
    bounds: BoundArgs,
    /// The command line of processes that make photos.
    #[arg(skip)]
    pub for_makers: Vec<OsString>,
}

/// Whether to ask who comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Access {
    /// Requests need no authentication.
    Open,
    /// Photos are their owners' alone.
    Private,
}

/// Bytes that the key of tokens has at least.
const LEAST_KEY: usize = 32;

impl ServeArgs {
    /// The same of a node that makes photos alone.
    pub(super) fn at_work(self) -> anyhow::Result<Self> {
        if self.database.is_none() {
            return Err(Usage("--database: a node that makes photos has to be told of the database that they are in".into()).into());
        }
        Ok(Self { role: Role::Work, ..self })
    }

    /// What rooms are made with; none where there are to be none.
    fn rooms(&self, photos: &Models) -> anyhow::Result<Option<Rooms>> {
        if self.no_live {
            return Ok(None);
        }
        let key = self.room_key()?;
        let models = match self.models.for_rooms(&self.live_depth_model) {
            Some(settings) => models::load(&settings)?,
            None => photos.clone(),
        };
        let rooms = Rooms::new(live::Config { models, frame_ms: self.live_budget_ms, key }).bounded(self.bounds.rooms());
        Ok(Some(match self.advertise.clone() {
            Some(address) => rooms.shared(address),
            None => rooms,
        }))
    }

    /// The key of tokens.
    fn room_key(&self) -> anyhow::Result<Option<Vec<u8>>> {
        let key = self.live_key.as_deref().map(files::read).transpose()?;
        if key.as_ref().is_some_and(|k| k.len() < LEAST_KEY) {
            return Err(Usage(format!("--live-key: a key has {LEAST_KEY} bytes at least")).into());
        }
        Ok(key)
    }

    /// Whether to ask who comes.
    fn is_private(&self) -> bool {
        // names are for those who come by a proxy
        let usual = !self.addr.ip().is_loopback() || !self.hosts.is_empty();
        self.access.map_or(usual, |access| access == Access::Private)
    }

    /// Where traces go; nowhere where nobody said so.
    fn traces(&self) -> Option<Collector> {
        let usual = || std::env::var(checks::COLLECTOR).ok().filter(|url| !url.is_empty());
        self.otlp.clone().or_else(usual).map(|url| Collector { url, ratio: self.otlp_ratio })
    }

    /// The limits that the arguments give.
    fn limits(&self) -> Limits {
        let body = (self.max_body as usize) << 20;
        let shared = self.memory.map_or_else(Limits::default, |mib| Limits::of_memory(u64::from(mib) << 20));
        let mib = |said: Option<u32>, usual: usize| said.map_or(usual, |mib| (mib as usize) << 20);
        let job_memory = self.job_memory.map_or(shared.job_memory, |mib| u64::from(mib) << 20);
        let pixels = u64::from(self.max_pixels) * 1_000_000;
        let photo = tmpi_pipeline::photo::Limits { bytes: body, pixels, memory: job_memory, ..Default::default() };
        let mut limits = Limits {
            photo,
            body,
            queue: self.queue,
            workers: usize::from(self.workers),
            views: usize::from(self.views),
            scene_cache: mib(self.scene_cache, shared.scene_cache),
            job: Duration::from_secs(u64::from(self.job_timeout)),
            job_memory,
            connections: self.connections as usize,
            connections_per_address: self.connections_per_address as usize,
            work_memory: mib(self.work_memory, shared.work_memory),
            export_cache: (self.export_cache as usize) << 20,
            request: Duration::from_secs(u64::from(self.request_timeout)),
            lame_duck: match self.lame_duck {
                Some(seconds) => Duration::from_secs(u64::from(seconds)),
                None if self.addr.ip().is_loopback() => Duration::ZERO,
                None => Limits::LAME_DUCK,
            },
            drain: Duration::from_secs(u64::from(self.drain)),
            rest: Duration::from_secs(u64::from(self.rest)),
            lease: Duration::from_secs(u64::from(self.lease)),
            ..shared
        };
        // all who come by a proxy have one address
        let by_themselves = !self.addr.ip().is_loopback() && (self.hosts.is_empty() || self.tls_cert.is_some());
        self.clients.put(&mut limits, by_themselves);
        self.bounds.put(&mut limits);
        limits
    }
}

/// An address with its port; a port alone, or that of `localhost`, is this machine's own.
fn address(text: &str) -> Result<SocketAddr, String> {
    let port = text.strip_prefix("localhost:").or_else(|| text.strip_prefix(':')).unwrap_or(text);
    match (text.parse(), port.parse()) {
        (Ok(whole), _) => Ok(whole),
        (_, Ok(port)) => Ok(SocketAddr::from((Ipv4Addr::LOCALHOST, port))),
        _ => Err("an address and a port are wanted, as 127.0.0.1:8080, 0.0.0.0:8080 or [::1]:8080; 8080 alone is this machine's".into()),
    }
}

/// A share of a whole.
fn share(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|share| (0.0..=1.0).contains(share)).ok_or_else(|| "a number from 0 to 1 is wanted".into())
}

/// Serves until SIGTERM or SIGINT; prints the server's URL on stdout once it listens.
pub(super) fn run(args: ServeArgs) -> anyhow::Result<()> {
    let makes_for_another = std::env::var_os(VARIABLE).is_some();
    if !makes_for_another {
        args.check()?;
    }
    let (limits, private) = (args.limits(), args.is_private());
    let (settings, traces, proxies) = (args.models.settings(), args.traces(), args.clients.proxies());
    let models = models::load(&settings)?;
    let maker = PipelineMaker::new(models.clone(), &limits).identified(&identity(&settings)?);
    if makes_for_another {
        let drawing = || tmpi_render::select_within(args.backend, limits.scene_cache).map_err(|e| format!("renderer: {e}"));
        make_for_a_server(&maker, &limits, &drawing);
        return Ok(());
    }
    keep_from_others();
    let rooms = args.rooms(&models)?;
    allocate_in_one_place();
    if let Err(error) = tmpi_pipeline::networks::available() {
        tracing::error!("photos without a depth map of their own wait until ONNX Runtime is there. {error}");
    }
    #[cfg(unix)]
    open_files(u64::from(args.connections) + SPARE_FILES);
    let renderer = tmpi_render::select_within(args.backend, limits.scene_cache).context("renderer")?;
    let better = BetterNetwork::of(&args.models, args.network_url, args.network_sha256);
    let maker = ProcessMaker::new(maker, args.for_makers, &args.data).with_better(better.map(|b| Box::new(b) as Box<dyn Better>));
    if !private && !args.addr.ip().is_loopback() {
        tracing::warn!(
            "everybody who can reach the server may see and change every photo whose address they know; --access private asks who comes"
        );
    }
    let ServeArgs { addr, admin, data, database, blobs, role, pages, mut hosts, public_list, tls_cert, tls_key, advertise, .. } = args;
    hosts.extend(advertise.map(|address| address.host().to_owned()));
    let config = Config { addr, admin, data, database, blobs, pages, hosts, proxies, public_list, private, role, traces, limits };
    let tls = tls_cert.zip(tls_key).map(|(cert, key)| Tls::open(cert, key)).transpose().context("TLS")?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().thread_name("tmpi-http").build()?;
    runtime.block_on(async {
        let mut server = Server::bind(config, Arc::new(maker), renderer).await?;
        if let Some(rooms) = rooms {
            server = server.with_rooms(rooms);
        }
        if let Some(tls) = tls {
            server = server.with_tls(tls);
        }
        let mut stdout = std::io::stdout();
        if let Some(admin) = server.admin_addr() {
            tracing::info!("operators ask at http://{admin}");
        }
        // whoever waits for this line may have gone
        let _ = writeln!(stdout, "{}://{}", server.scheme(), server.addr()).and_then(|()| stdout.flush());
        let stop = async {
            stop_signal().await;
            // whoever asks twice does not want to wait
            tokio::spawn(async {
                stop_signal().await;
                tracing::warn!("stopping at once");
                #[allow(clippy::disallowed_methods, reason = "that is what was asked for; what was accepted is on disk")]
                std::process::exit(1);
            });
        };
        server.run(stop).await;
        anyhow::Ok(())
    })?;
    // a job that outlived the drain time is taken up at the next start
    runtime.shutdown_background();
    Ok(())
}

/// Has the process open as many files as it may need, as far as the system lets it: each connection is one.
#[cfg(unix)]
#[allow(unsafe_code, reason = "two calls of libc on a struct of ours")]
#[allow(clippy::unnecessary_cast, clippy::useless_conversion, reason = "the width differs by system")]
fn open_files(wanted: u64) {
    let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: the struct outlives the call, which only writes it
    if unsafe { libc::getrlimit(libc::RLIMIT_NOFILE, &raw mut limit) } != 0 {
        return;
    }
    let most = (limit.rlim_max as u64).min(wanted);
    if (limit.rlim_cur as u64) < most {
        limit.rlim_cur = most as libc::rlim_t;
        // SAFETY: the struct outlives the call, which only reads it
        let _ = unsafe { libc::setrlimit(libc::RLIMIT_NOFILE, &raw const limit) };
    }
    if most < wanted {
        tracing::warn!(most, wanted, "the system lets this process open fewer files than it may need: raise it, or lower --connections");
    }
}

/// What photos depend on besides the program: a better network makes them anew.
pub(super) fn identity(settings: &models::Settings) -> anyhow::Result<String> {
    // an embedded network is a part of the program
    let mut digest: Option<String> = None;
    if let Some(file) = &settings.depth_file {
        let weights = models::beside(file)?.into_iter().map(|(_, file)| file);
        for file in std::iter::once(file.clone()).chain(weights) {
            let bytes = std::fs::read(&file).with_context(|| file.display().to_string())?;
            // one digest of a file alone, as it always was; those of several one after another
            digest = Some(digest.unwrap_or_default() + &hex(&Sha256::digest(bytes)));
        }
    }
    let models::Settings { depth, depth_pixels, depth_smoothing, depth_ramp, flip, folder, .. } = settings;
    let mut text = format!("{} {digest:?} {depth_pixels:?} {depth_smoothing:?} {flip:?}", depth.name);
    if let Some(ramp) = depth_ramp {
        text = format!("{text} {ramp:?}");
    }
    // networks that an option may ask for
    for name in [models::THETA, models::PSI] {
        match std::fs::read(folder.join(name)) {
            Ok(bytes) => text = format!("{text} {name} {}", hex(&Sha256::digest(bytes))),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
            Err(e) => return Err(e).with_context(|| folder.join(name).display().to_string()),
        }
    }
    Ok(text)
}

mod checks;
#[cfg(test)]
mod tests;
