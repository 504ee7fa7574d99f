//! `tmpi serve`.

use std::ffi::OsString;
use std::io::Write as _;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context as _;
use axum::http::HeaderName;
use clap::ArgAction;

use super::settings::{Assignment, applied, assignment};
use super::{Usage, files};
use tmpi_pipeline::networks::cli_flags::{DepthModel, ModelFlags, depth_model};

use crate::live::{self, NodeAddress, Rooms};
use crate::server::{
    AddressPolicy, BasePath, BetterNetwork, Collector, Config, ConfiguredWebhook, Limits, Network, PipelineMaker, Preset, Presets,
    ProcessMaker, Proxies, Rates, Role, Server, SourceHost, Tls, VARIABLE, disable_process_inspection, identity, run_child, stop_signal,
    use_one_malloc_arena,
};
use tmpi_pipeline::Models;
use tmpi_pipeline::networks::models::{self, download::Digest};
use tmpi_render::{self, Backend};

/// Run the server: take photos over HTTP and serve the 3D photos made from them
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ServeArgs {
    #[arg(
        long,
        env = "TMPI_CONFIG",
        value_name = "FILE",
        help = "TOML file of settings: these options, and tables of limits. Variables such as TMPI_SERVE_ADDR and the command line override it"
    )]
    #[allow(dead_code, reason = "`config::complete` reads it")]
    config: Option<PathBuf>,
    /// A setting without an option of its own, for example rates.uploads=30; `tmpi config` lists them; may be repeated
    #[arg(long, value_parser = assignment, value_name = "TABLE.KEY=VALUE")]
    set: Vec<Assignment>,
    /// Address and port to listen on; a port alone listens on loopback, port 0 takes a free one, 0.0.0.0:8080 accepts other machines
    #[arg(long, default_value = "127.0.0.1:8080", value_parser = address, value_name = "ADDR")]
    addr: SocketAddr,
    /// Serve TLS with the certificate chain in this PEM file; reloaded when it changes
    #[arg(long, requires = "tls_key", value_name = "FILE")]
    tls_cert: Option<PathBuf>,
    /// PEM file with the certificate's private key
    #[arg(long, requires = "tls_cert", value_name = "FILE")]
    tls_key: Option<PathBuf>,
    /// Address and port of the admin listener, with /metrics, /healthz, /readyz, POST /drain and POST /purge/ID. It has no authentication
    #[arg(long, value_parser = address, value_name = "ADDR")]
    admin: Option<SocketAddr>,
    /// Directory for photos and everything made from them
    #[arg(long, default_value = "tmpi-data", value_name = "DIR")]
    data: PathBuf,
    #[arg(
        long,
        value_name = "URL",
        help = "Database that several nodes share, postgres://USER:PASSWORD@HOST/NAME; set TMPI_SERVE_DATABASE instead to keep the password off the \
                list of processes. Default: SQLite in DIR"
    )]
    database: Option<String>,
    #[arg(
        long,
        value_name = "URL",
        help = "Object store that several nodes share, s3://BUCKET/PREFIX, with the usual variables AWS_…. Default: a folder in DIR"
    )]
    blobs: Option<String>,
    /// What this node does
    #[arg(long, value_enum, default_value_t, requires = "database")]
    role: Role,
    /// Serve the web pages from this directory instead of the embedded ones
    #[arg(long = "static", value_name = "DIR")]
    pages: Option<PathBuf>,
    /// Host name that the server accepts besides localhost and its address, as it arrives in the Host header; may be repeated
    #[arg(long = "host", value_name = "NAME")]
    hosts: Vec<String>,
    /// Path of the server on its host, such as /3d, if a proxy serves other applications beside it
    #[arg(long, value_name = "PATH")]
    base_path: Option<BasePath>,
    /// Whether requests need authentication; default: private beyond loopback and with --host, else open
    #[arg(long, value_enum, value_name = "WHO")]
    access: Option<Access>,
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "NETWORK[,NETWORK…]",
        help = "Proxies in front of the server, whose X-Forwarded-For it trusts: addresses, networks such as 10.0.0.0/8, or `private` for \
                all private networks and this machine"
    )]
    trusted_proxies: Vec<Network>,
    /// Header in which a trusted proxy names the user whom it has logged in, such as Remote-User; each user is an owner of photos
    #[arg(long, requires = "trusted_proxies", value_name = "NAME")]
    login_header: Option<HeaderName>,
    #[arg(
        long,
        value_name = "NAME=OPTIONS",
        help = "Name for options of views and films (preset=NAME in an address), or of photos to make (the field `preset`), for example \
                card=w=640&format=webp or small=max-size=1600&planes=8; may be repeated"
    )]
    preset: Vec<Preset>,
    /// Take no options of views, films and photos besides presets, except from administrators
    #[arg(long, num_args = 0..=1, require_equals = true, default_missing_value = "true", default_value_t = false, action = ArgAction::Set, value_name = "true|false")]
    presets_only: bool,
    /// Renderer of views
    #[arg(long, value_enum, default_value_t)]
    backend: Backend,
    /// Number of photos to make in parallel
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..), value_name = "N")]
    workers: u16,
    /// Memory of the whole server in MiB, which caches, work and making photos share; a setting for one of them overrides its share
    #[arg(long, value_parser = clap::value_parser!(u32).range(192..), value_name = "MIB")]
    memory: Option<u32>,
    /// Format of the log on standard error
    #[arg(long, value_enum, default_value_t, value_name = "FORM")]
    pub log: super::Log,
    #[arg(
        long,
        value_name = "URL",
        help = "Send traces to this collector by OTLP over HTTP, for example http://127.0.0.1:4318; \
                OTEL_EXPORTER_OTLP_ENDPOINT sets it, too, and OTEL_TRACES_SAMPLER_ARG the share to send, 0 to 1"
    )]
    otlp: Option<String>,
    /// File with a key of at least 32 bytes that signs the tokens of `live token`; without it only this machine's own user may enter rooms
    #[arg(long, value_name = "FILE")]
    live_key: Option<PathBuf>,
    #[arg(
        long,
        requires = "database",
        value_name = "URL",
        help = "URL at which other nodes of the same --database reach this one, for example http://10.0.0.3:8080. Every node then serves its rooms"
    )]
    advertise: Option<NodeAddress>,
    #[arg(
        long,
        value_name = "JSON",
        help = "Webhook for all photos and rooms, {\"url\": …, \"secret\": \"whsec_…\", \"events\": […]}; may be repeated. In the file: tables \
                [[webhooks]]. Set TMPI_SERVE_WEBHOOKS instead to keep the secret off the list of processes"
    )]
    webhooks: Vec<ConfiguredWebhook>,
    /// Let webhooks that callers add have addresses of this machine and of private networks
    #[arg(long, num_args = 0..=1, require_equals = true, default_missing_value = "true", default_value_t = false, action = ArgAction::Set, value_name = "true|false")]
    private_webhooks: bool,
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "HOST[,HOST…]",
        help = "Hosts from which the server fetches photos for callers that name an address: a.example, *.b.example, c.example:8443 or http://d.example"
    )]
    source_hosts: Vec<SourceHost>,
    /// Fetch photos from addresses of this machine and of private networks, too
    #[arg(long, num_args = 0..=1, require_equals = true, default_missing_value = "true", default_value_t = false, action = ArgAction::Set, value_name = "true|false")]
    private_sources: bool,
    /// Depth network of rooms, as for --depth-model; the embedded one keeps up with a camera, networks that take seconds per photo do not
    #[arg(long, value_parser = depth_model, default_value = "tmpi", value_name = "auto|NAME[=FILE]|FILE")]
    live_depth_model: DepthModel,
    /// URL of the better depth network that the page offers to fetch, instead of its publisher's; the digest must still match
    #[arg(long, value_name = "URL")]
    network_url: Option<String>,
    /// SHA-256 of that file if it is a different one, 64 hexadecimal digits
    #[arg(long, requires = "network_url", value_name = "HEX")]
    network_sha256: Option<Digest>,
    #[command(flatten)]
    models: ModelFlags,
    /// Command line of the processes that make photos.
    #[arg(skip)]
    pub for_makers: Vec<OsString>,
}

/// Whether requests need authentication.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Access {
    /// Requests need no authentication; only this machine's own user may list photos
    Open,
    /// Requests need no authentication, and everyone may list photos
    Public,
    /// Only owners have access to their photos (see `tmpi key`)
    Private,
}

/// Share of the traces started here that is sent. Traces from elsewhere follow the sampled flag of their `traceparent`.
const SHARE: &str = "OTEL_TRACES_SAMPLER_ARG";
/// Fewest bytes of the token key.
const MIN_KEY: usize = 32;

impl ServeArgs {
    /// The arguments of `tmpi work`: a node that only makes photos.
    pub(super) fn at_work(self) -> anyhow::Result<Self> {
        if self.database.is_none() {
            return Err(Usage("--database is required: a worker shares the database of the nodes that serve".into()).into());
        }
        Ok(Self { role: Role::Work, ..self })
    }

    /// The rooms; `None` if they are disabled.
    fn rooms(&self, photos: &Models, bounds: live::RoomLimits) -> anyhow::Result<Option<Rooms>> {
        if bounds.rooms == 0 {
            return Ok(None);
        }
        let key = self.room_key()?;
        let models = match self.models.for_rooms(&self.live_depth_model) {
            Some(settings) => models::load(&settings)?,
            None => photos.clone(),
        };
        let rooms = Rooms::new(models, key).with_limits(bounds);
        Ok(Some(match self.advertise.clone() {
            Some(address) => rooms.shared(address),
            None => rooms,
        }))
    }

    fn presets(&self, limits: &Limits) -> anyhow::Result<Presets> {
        Presets::new(&self.preset, self.presets_only, limits).map_err(|e| Usage(format!("--preset: {e}")).into())
    }

    fn room_key(&self) -> anyhow::Result<Option<Vec<u8>>> {
        let key = self.live_key.as_deref().map(files::read).transpose()?;
        if key.as_ref().is_some_and(|k| k.len() < MIN_KEY) {
            return Err(Usage(format!("--live-key: the key must have at least {MIN_KEY} bytes")).into());
        }
        Ok(key)
    }

    fn is_private(&self) -> bool {
        // a host name suggests clients from elsewhere, through a proxy
        let usual = !self.addr.ip().is_loopback() || !self.hosts.is_empty() || self.login_header.is_some();
        self.access.map_or(usual, |access| access == Access::Private)
    }

    fn traces(&self) -> anyhow::Result<Option<Collector>> {
        let variable = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
        let Some(url) = self.otlp.clone().or_else(|| variable(checks::COLLECTOR)) else { return Ok(None) };
        let share = |text: String| text.parse::<f64>().ok().filter(|share| (0.0..=1.0).contains(share));
        let wrong = || Usage(format!("{SHARE}: a number from 0 to 1 is expected"));
        let ratio = variable(SHARE).map_or(Some(1.0), share).ok_or_else(wrong)?;
        Ok(Some(Collector { url, ratio }))
    }

    /// The effective limits: explicit settings override those that follow from the flags.
    fn limits(&self) -> anyhow::Result<Limits> {
        let mut usual = self.memory.map_or_else(Limits::default, |mib| Limits::of_memory(u64::from(mib) << 20));
        let is_local = self.addr.ip().is_loopback();
        if !is_local {
            usual.lame_duck = Limits::LAME_DUCK;
        }
        // behind a proxy all clients share one address, unless the proxy is trusted to name them
        let by_themselves = !is_local && (self.hosts.is_empty() || self.tls_cert.is_some());
        if by_themselves || !self.trusted_proxies.is_empty() {
            usual.rates = Rates::FOR_STRANGERS;
        }
        Ok(Limits { workers: self.workers.into(), ..applied(&usual, &self.set)? })
    }
}

/// Parses an address with a port. A port alone, or `localhost:PORT`, stands for loopback.
fn address(text: &str) -> Result<SocketAddr, String> {
    let port = text.strip_prefix("localhost:").or_else(|| text.strip_prefix(':')).unwrap_or(text);
    match (text.parse(), port.parse()) {
        (Ok(whole), _) => Ok(whole),
        (_, Ok(port)) => Ok(SocketAddr::from((Ipv4Addr::LOCALHOST, port))),
        _ => {
            Err("expected an address and a port, such as 127.0.0.1:8080, 0.0.0.0:8080 or [::1]:8080; 8080 alone listens on loopback".into())
        }
    }
}

/// Serves until SIGTERM or SIGINT; prints the server's URL on stdout once it listens.
pub(super) fn run(args: ServeArgs) -> anyhow::Result<()> {
    let makes_for_another = std::env::var_os(VARIABLE).is_some();
    if !makes_for_another {
        args.check()?;
    }
    let (limits, private, settings, traces) = (args.limits()?, args.is_private(), args.models.settings(), args.traces()?);
    let models = models::load(&settings)?;
    let maker = PipelineMaker::new(models.clone(), limits.photo()).with_identity(&identity(&settings)?);
    if makes_for_another {
        let drawing = || tmpi_render::select_with_cache(args.backend, limits.cache.scenes).map_err(|e| format!("renderer: {e}"));
        run_child(&maker, &limits, &drawing);
        return Ok(());
    }
    disable_process_inspection();
    let (rooms, presets) = (args.rooms(&models, limits.live)?, args.presets(&limits)?);
    use_one_malloc_arena();
    if let Err(error) = tmpi_pipeline::networks::available() {
        tracing::error!("photos without a depth map wait until ONNX Runtime is available. {error}");
    }
    #[cfg(unix)]
    open_files::raise(limits.connections as u64);
    let renderer = tmpi_render::select_with_cache(args.backend, limits.cache.scenes).context("renderer")?;
    let better = BetterNetwork::of(&args.models, args.network_url, args.network_sha256);
    let maker = ProcessMaker::new(maker, args.for_makers, &args.data, better);
    if !private && !args.addr.ip().is_loopback() {
        tracing::warn!(
            "the server has no authentication: every client may see and change every photo whose URL it knows; see --access private"
        );
    }
    let base = args.base_path.unwrap_or_default();
    let reach = |is_private| if is_private { AddressPolicy::Any } else { AddressPolicy::Public };
    let config = Config {
        addr: args.addr,
        admin: args.admin,
        data: args.data,
        database: args.database,
        blobs: args.blobs,
        pages: args.pages,
        hosts: args.hosts.into_iter().chain(args.advertise.map(|address| address.host().to_owned())).collect(),
        base_path: base.clone(),
        proxies: Proxies::new(&args.trusted_proxies).with_login(args.login_header),
        public_list: args.access == Some(Access::Public),
        private,
        role: args.role,
        traces,
        webhooks: args.webhooks,
        webhook_addresses: reach(args.private_webhooks),
        source_hosts: args.source_hosts,
        source_addresses: reach(args.private_sources),
        presets,
        limits,
    };
    let tls = args.tls_cert.zip(args.tls_key).map(|(cert, key)| Tls::open(cert, key)).transpose().context("TLS")?;
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
            tracing::info!("admin listener at http://{admin}");
            if !admin.ip().is_loopback() {
                tracing::warn!(
                    "the admin listener has no authentication: every client that reaches it may delete photos and stop the server"
                );
            }
        }
        // the reader of this line may have gone
        let _ = writeln!(stdout, "{}://{}{base}", server.scheme(), server.addr()).and_then(|()| stdout.flush());
        let stop = async {
            stop_signal().await;
            // a second signal skips draining
            tokio::spawn(async {
                stop_signal().await;
                tracing::warn!("stopping at once");
                #[allow(clippy::disallowed_methods, reason = "the user asked for it; accepted photos are on disk")]
                std::process::exit(1);
            });
        };
        server.run(stop).await;
        anyhow::Ok(())
    })?;
    // the next start resumes a job that outlived the drain time
    runtime.shutdown_background();
    Ok(())
}

mod checks;
#[cfg(unix)]
mod open_files;
#[cfg(test)]
mod tests;
