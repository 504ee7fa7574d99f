//! `tmpi serve`.

use std::ffi::OsString;
use std::io::Write as _;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context as _;

use super::better::BetterNetwork;
use super::settings::{Assignment, applied, assignment};
use super::{Usage, files};
use sha2::{Digest as _, Sha256};
use tmpi_pipeline::networks::flags::{DepthModel, ModelFlags, depth_model};

use crate::live::{self, NodeAddress, Rooms};
use crate::server::{
    Better, ClientAddress, Collector, Config, Limits, Network, PipelineMaker, ProcessMaker, Proxies, Rates, Role, Server, Tls, VARIABLE,
    allocate_in_one_place, hex, keep_from_others, make_for_a_server, stop_signal,
};
use tmpi_pipeline::Models;
use tmpi_pipeline::networks::models::{self, download::Digest};
use tmpi_render::{self, Backend};

/// Open files besides connections.
#[cfg(unix)]
const SPARE_FILES: u64 = 512;

/// Take photos over HTTP and serve what is made of them
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ServeArgs {
    #[arg(
        long,
        env = "TMPI_CONFIG",
        value_name = "FILE",
        help = "TOML file of settings: these options, and tables of limits. Variables such as TMPI_SERVE_ADDR and this command line count more"
    )]
    #[allow(dead_code, reason = "read before all else, with what is in it")]
    config: Option<PathBuf>,
    /// A setting that has no option of its own, as rates.uploads=30; `tmpi config` lists them; may be repeated
    #[arg(long, value_parser = assignment, value_name = "TABLE.KEY=VALUE")]
    set: Vec<Assignment>,
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
    /// Read the pages from this directory instead of from the program
    #[arg(long = "static", value_name = "DIR")]
    pages: Option<PathBuf>,
    /// Name under which the server answers besides localhost and its address, as a proxy passes it on in Host; may be repeated
    #[arg(long = "host", value_name = "NAME")]
    hosts: Vec<String>,
    /// Whether to ask who comes; private beyond loopback and with --host, else open
    #[arg(long, value_enum, value_name = "WHO")]
    access: Option<Access>,
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "NETWORK[,NETWORK…]",
        help = "Proxies in front, by address, by network as 10.0.0.0/8, or `private` for all private networks and this machine: \
                what they say of who comes counts, so that clients are told apart"
    )]
    trusted_proxies: Vec<Network>,
    /// How those say it; what others say counts for nothing
    #[arg(long, value_enum, requires = "trusted_proxies", default_value_t, value_name = "HOW")]
    client_address: ClientAddress,
    /// What draws views
    #[arg(long, value_enum, default_value_t)]
    backend: Backend,
    /// Photos that are made at a time
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..), value_name = "N")]
    workers: u16,
    /// Memory of the machine for all of the server, in MiB: caches, work and making photos share it; what is set of one of them counts more
    #[arg(long, value_parser = clap::value_parser!(u32).range(192..), value_name = "MIB")]
    memory: Option<u32>,
    /// How the log on standard error is written
    #[arg(long, value_enum, default_value_t, value_name = "FORM")]
    pub log: super::Log,
    #[arg(
        long,
        value_name = "URL",
        help = "Send traces to the collector at this address by OTLP over HTTP, as http://127.0.0.1:4318; \
                OTEL_EXPORTER_OTLP_ENDPOINT names it, too, and OTEL_TRACES_SAMPLER_ARG the share that is sent, 0 to 1"
    )]
    otlp: Option<String>,
    /// File with a key of at least 32 bytes, by which `live token` lets others into rooms; without it they are for this machine's own user
    #[arg(long, value_name = "FILE")]
    live_key: Option<PathBuf>,
    #[arg(
        long,
        requires = "database",
        value_name = "URL",
        help = "Address at which other nodes of the same --database reach this one, as http://10.0.0.3:8080: rooms can be watched at all of them then"
    )]
    advertise: Option<NodeAddress>,
    /// Depth network of rooms, named as for --depth-model; the embedded one keeps up with a camera, those that take seconds for a photo do not
    #[arg(long, value_parser = depth_model, default_value = "tmpi", value_name = "auto|NAME[=FILE]|FILE")]
    live_depth_model: DepthModel,
    /// Address of the better depth network that the page offers to fetch, in place of its publisher's; the digest stays
    #[arg(long, value_name = "URL")]
    network_url: Option<String>,
    /// Digest of that file where it is another, 64 hexadecimal digits
    #[arg(long, requires = "network_url", value_name = "HEX")]
    network_sha256: Option<Digest>,
    #[command(flatten)]
    models: ModelFlags,
    /// The command line of processes that make photos.
    #[arg(skip)]
    pub for_makers: Vec<OsString>,
}

/// Whether to ask who comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Access {
    /// Requests need no authentication; only this machine's own user may list photos
    Open,
    /// Requests need no authentication, and everyone may list photos
    Public,
    /// Photos are their owners' alone (see `tmpi key`)
    Private,
}

/// The variable that says which share of the traces that begin here is sent; those that began elsewhere are sent where their `traceparent` says so.
const SHARE: &str = "OTEL_TRACES_SAMPLER_ARG";
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
    fn rooms(&self, photos: &Models, bounds: live::Bounds) -> anyhow::Result<Option<Rooms>> {
        if bounds.rooms == 0 {
            return Ok(None);
        }
        let key = self.room_key()?;
        let models = match self.models.for_rooms(&self.live_depth_model) {
            Some(settings) => models::load(&settings)?,
            None => photos.clone(),
        };
        let rooms = Rooms::new(live::Config { models, frame_ms: bounds.budget_ms, key }).bounded(bounds);
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
    fn traces(&self) -> anyhow::Result<Option<Collector>> {
        let variable = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
        let Some(url) = self.otlp.clone().or_else(|| variable(checks::COLLECTOR)) else { return Ok(None) };
        let share = |text: String| text.parse::<f64>().ok().filter(|share| (0.0..=1.0).contains(share));
        let wrong = || Usage(format!("{SHARE}: a number from 0 to 1 is expected"));
        let ratio = variable(SHARE).map_or(Some(1.0), share).ok_or_else(wrong)?;
        Ok(Some(Collector { url, ratio }))
    }

    /// The limits that hold: what was set of them, else what follows from the flags.
    fn limits(&self) -> anyhow::Result<Limits> {
        let mut usual = self.memory.map_or_else(Limits::default, |mib| Limits::of_memory(u64::from(mib) << 20));
        let is_local = self.addr.ip().is_loopback();
        if !is_local {
            usual.lame_duck = Limits::LAME_DUCK;
        }
        // all who come by a proxy have one address, unless it tells them apart
        let by_themselves = !is_local && (self.hosts.is_empty() || self.tls_cert.is_some());
        if by_themselves || !self.trusted_proxies.is_empty() {
            usual.rates = Rates::FOR_STRANGERS;
        }
        Ok(Limits { workers: self.workers.into(), ..applied(&usual, &self.set)? })
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

/// Serves until SIGTERM or SIGINT; prints the server's URL on stdout once it listens.
pub(super) fn run(args: ServeArgs) -> anyhow::Result<()> {
    let makes_for_another = std::env::var_os(VARIABLE).is_some();
    if !makes_for_another {
        args.check()?;
    }
    let (limits, private, public_list) = (args.limits()?, args.is_private(), args.access == Some(Access::Public));
    let (settings, traces, proxies) = (args.models.settings(), args.traces()?, Proxies::new(&args.trusted_proxies, args.client_address));
    let models = models::load(&settings)?;
    let maker = PipelineMaker::new(models.clone(), limits.photo()).identified(&identity(&settings)?);
    if makes_for_another {
        let drawing = || tmpi_render::select_within(args.backend, limits.cache.scenes).map_err(|e| format!("renderer: {e}"));
        make_for_a_server(&maker, &limits, &drawing);
        return Ok(());
    }
    keep_from_others();
    let rooms = args.rooms(&models, limits.live)?;
    allocate_in_one_place();
    if let Err(error) = tmpi_pipeline::networks::available() {
        tracing::error!("photos without a depth map of their own wait until ONNX Runtime is there. {error}");
    }
    #[cfg(unix)]
    open_files(limits.connections as u64 + SPARE_FILES);
    let renderer = tmpi_render::select_within(args.backend, limits.cache.scenes).context("renderer")?;
    let better = BetterNetwork::of(&args.models, args.network_url, args.network_sha256);
    let maker = ProcessMaker::new(maker, args.for_makers, &args.data).with_better(better.map(|b| Box::new(b) as Box<dyn Better>));
    if !private && !args.addr.ip().is_loopback() {
        tracing::warn!(
            "everybody who can reach the server may see and change every photo whose address they know; --access private asks who comes"
        );
    }
    let ServeArgs { addr, admin, data, database, blobs, role, pages, mut hosts, tls_cert, tls_key, advertise, .. } = args;
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
        tracing::warn!(
            most,
            wanted,
            "the system lets this process open fewer files than it may need: raise it, or lower limits.connections"
        );
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
