//! The HTTP server: uploads in, containers, views and progress out.
//!
//! It knows no pixels: it calls [`tmpi_pipeline::make`], [`tmpi_core::container::decode`] and a [`tmpi_render::Renderer`].
//! Requests run on tokio; photos are made on named threads ([`Limits::workers`]); views are drawn on a bounded pool.
//! What was answered 202 is on disk, survives a crash, and is taken up again at the next start.

mod accept;
mod access;
mod admission;
mod app;
mod asked;
mod attachment;
mod body;
mod cache;
mod card;
mod child;
mod clock;
mod cluster;
mod compress;
mod conditional;
mod entry;
mod exports;
mod file_name;
mod files;
#[cfg(test)]
mod forgetful;
mod form;
pub(crate) mod fuzzing;
mod hosts;
mod id;
mod identity;
mod jobs;
mod kept;
mod limits;
mod maker;
mod memory;
mod middleware;
mod network;
mod options;
mod pages;
mod part;
mod pool;
mod problem;
mod process;
mod proxies;
mod rates;
mod records;
mod rest;
mod retain;
mod routes;
mod settings;
mod share;
mod source;
mod store;
mod streams;
mod strokes;
mod telemetry;
mod time;
mod timed;
mod tls;
mod traces;
mod upkeep;
mod upload;
mod worker;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use axum::http::HeaderMap;
use tokio::net::TcpListener;

pub use accept::Held;
pub use access::keys;
pub(crate) use access::same;
pub use child::{ProcessMaker, VARIABLE, keep_from_others, serve as make_for_a_server};
pub use cluster::{Audit, Nats, Remedy, Role, Sharing, audit, check_store};
pub(crate) use conditional::{Coding, Entity, respond};
pub use files::Reserve;
pub use id::{PhotoId, hex};
pub use limits::Limits;
pub use maker::{Fault, HeadOf, Maker, PipelineMaker, Product};
pub use network::{Better, Offer, Renewed};
pub use problem::Problem;
pub use proxies::{ClientAddress, Network, Proxies};
pub use rest::allocate_in_one_place;
pub use routes::{Access, Route, openapi, openapi_of, routes};
pub(crate) use routes::{NoBody, Pairs};
pub use tls::{Tls, TlsError};
pub use traces::{Collector, CollectorError, check_collector};

use access::{Guard, Secret};
use app::{App, Shared};
use cluster::Cluster;
use jobs::Jobs;
use store::Store;
use telemetry::Telemetry;
pub(crate) use telemetry::{Figure, gauge};
use traces::Traces;

use tmpi_library::Library;
use tmpi_render::Renderer;

use crate::live::{self, Rooms};

/// Where the server listens and keeps its photos.
#[derive(Clone, Debug)]
pub struct Config {
    /// Address and port; port 0 takes a free one.
    pub addr: SocketAddr,
    /// Address and port at which operators ask for counters, draining and taking down; everybody who reaches it may. Without it counters
    /// are at [`Config::addr`], and the rest is done by signals and by deleting with a key.
    pub admin: Option<SocketAddr>,
    /// Data directory; made where it is missing.
    pub data: PathBuf,
    /// Database that several nodes share, `postgres://…`; SQLite within the data directory where there is none.
    pub database: Option<String>,
    /// Object store that several nodes share, `s3://…`, `gs://…` or `az://…`; a folder within the data directory where there is none.
    pub blobs: Option<String>,
    /// Directory that replaces the embedded pages.
    pub pages: Option<PathBuf>,
    /// Names under which the server answers besides loopback's and its address, without ports: those that proxies pass on.
    pub hosts: Vec<String>,
    /// Proxies that say whose requests they pass on.
    pub proxies: Proxies,
    /// Lists all photos to everybody who can reach the server, not only to this machine's own user.
    pub public_list: bool,
    /// Asks who comes: photos are their owners' alone, see [`access`].
    pub private: bool,
    /// Directory of the keys; that of the data where there is none.
    pub keys: Option<PathBuf>,
    /// Where traces go; nowhere where there is none.
    pub traces: Option<Collector>,
    /// Limits.
    pub limits: Limits,
}

impl Config {
    /// One that asks nobody who they are, with the limits as they are usual.
    #[must_use]
    pub fn new(addr: SocketAddr, data: PathBuf) -> Self {
        Self {
            addr,
            admin: None,
            data,
            database: None,
            blobs: None,
            pages: None,
            hosts: Vec::new(),
            proxies: Proxies::default(),
            public_list: false,
            private: false,
            keys: None,
            traces: None,
            limits: Limits::default(),
        }
    }

    /// Where the library is, and what bounds it.
    fn library(&self) -> tmpi_library::Config {
        let Self { data, database, blobs, limits, .. } = self;
        tmpi_library::Config {
            database: database.clone(),
            blobs: blobs.clone(),
            limits: limits.library(),
            ..tmpi_library::Config::of_folder(data)
        }
    }
}

/// Why the server does not run.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The address cannot be listened on.
    #[error("cannot listen on {addr}")]
    Listen {
        /// The address.
        addr: SocketAddr,
        /// What the system says.
        source: std::io::Error,
    },
    /// The data directory cannot be used.
    #[error("data directory {dir}")]
    Data {
        /// The directory.
        dir: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The store of several nodes cannot be used.
    #[error("store {store}")]
    Store {
        /// Its address.
        store: String,
        /// What is wrong.
        source: std::io::Error,
    },
    /// The library cannot be opened.
    #[error("library")]
    Library(#[from] tmpi_library::LibraryError),
    /// No worker can be started.
    #[error("starting a worker")]
    Worker(#[source] std::io::Error),
    /// Traces cannot go where they are to.
    #[error(transparent)]
    Traces(#[from] CollectorError),
    /// The `OpenAPI` document cannot be written.
    #[error("OpenAPI document")]
    OpenApi(#[from] serde_json::Error),
}

/// A server that listens, has taken up what was unfinished, and waits for [`Server::run`].
pub struct Server {
    listener: TcpListener,
    addr: SocketAddr,
    app: App,
    rooms: Option<Arc<Rooms>>,
    role: Role,
    tls: Option<Tls>,
    /// The door of operators, with its address and the names that count there.
    admin: Option<(TcpListener, SocketAddr, Vec<String>)>,
}

impl Server {
    /// Listens, opens the data directory, and starts the workers.
    ///
    /// # Errors
    /// [`ServerError`].
    pub async fn bind(config: Config, maker: Arc<dyn Maker>, renderer: Arc<dyn Renderer>) -> Result<Self, ServerError> {
        Self::bind_among(None, config, maker, renderer).await
    }

    /// The same as one node of several, which share a store; what it has on its own disk are copies then.
    ///
    /// # Errors
    /// [`ServerError`].
    pub async fn bind_among(
        sharing: Option<Sharing>,
        mut config: Config,
        maker: Arc<dyn Maker>,
        renderer: Arc<dyn Renderer>,
    ) -> Result<Self, ServerError> {
        let (addr, data) = (config.addr, config.data.clone());
        let openapi = openapi_of(&config.limits, config.admin.is_some())?;
        let (listener, addr) = listen(addr).await?;
        let admin = match config.admin {
            Some(addr) => Some(listen(addr).await?).map(|(listener, addr)| (listener, addr, config.hosts.clone())),
            None => None,
        };
        let role = sharing.as_ref().map(|s| s.role).unwrap_or_default();
        if role == Role::Serve {
            config.limits.workers = 0;
        }
        let limits = Arc::new(config.limits.clone());
        let keys = config.private.then(|| config.keys.clone().unwrap_or_else(|| data.clone()));
        let telemetry = Arc::new(Telemetry::of(config.traces.as_ref())?);
        let library = Box::pin(Library::open(config.library())).await?;
        // done once before any request is served
        let (jobs, guard) = if let Some(sharing) = sharing {
            let open = tokio::task::spawn_blocking(move || among(&sharing, &data, keys.as_deref(), maker, limits, telemetry));
            open.await.map_err(|e| ServerError::Worker(std::io::Error::other(e)))??
        } else {
            let wrong = |source| ServerError::Data { dir: data.clone(), source };
            let (store, found) = Store::open(&data, maker.identity()).map_err(wrong)?;
            let store = store.keeping(limits.reserve);
            child::empty_scratch(&data).map_err(wrong)?;
            // with the directory for this process alone
            let secret = keys.is_some().then(|| Secret::of(&data)).transpose().map_err(wrong)?;
            let guard = keys.zip(secret).map(|(keys, secret)| guard(&keys, secret)).transpose()?;
            (Jobs::start(store, found, maker, limits, telemetry).map_err(ServerError::Worker)?, guard)
        };
        exports::start(&jobs, &renderer).map_err(ServerError::Worker)?;
        let app = Arc::new(Shared { guard, ..Shared::new(config, addr, library, jobs, renderer, openapi) });
        Ok(Self { listener, addr, app, rooms: None, role, tls: None, admin })
    }

    /// Has rooms, too.
    #[must_use]
    pub fn with_rooms(mut self, rooms: Rooms) -> Self {
        self.rooms = Some(Arc::new(rooms));
        self
    }

    /// Speaks TLS, and HTTP/2 with who can.
    #[must_use]
    pub fn with_tls(mut self, tls: Tls) -> Self {
        self.tls = Some(tls);
        self
    }

    /// `http` or `https`.
    #[must_use]
    pub const fn scheme(&self) -> &'static str {
        if self.tls.is_some() { "https" } else { "http" }
    }

    /// Address that the server listens on.
    #[must_use]
    pub const fn addr(&self) -> SocketAddr {
        self.addr
    }

    /// Address that operators ask at, where they have one of their own.
    #[must_use]
    pub fn admin_addr(&self) -> Option<SocketAddr> {
        self.admin.as_ref().map(|(_, addr, _)| *addr)
    }

    /// Serves until `stop` is ready or an operator asks it to leave, and for [`Limits::lame_duck`] more; then takes no more connections and gives requests and jobs under
    /// way [`Limits::drain`] to end. Jobs that do not end by then are taken up at the next start.
    pub async fn run(self, stop: impl Future<Output = ()> + Send + 'static) {
        let Self { listener, addr: _, app, rooms, role, tls, admin } = self;
        let token = app.stop.clone();
        let jobs = Arc::clone(&app.jobs);
        let signal = tokio::spawn({
            let (token, app) = (token.clone(), Arc::clone(&app));
            async move {
                tokio::select! {
                    () = stop => {}
                    () = app.asked_to_leave.cancelled() => {}
                }
                tracing::info!("stopping");
                app.leaving.store(true, Ordering::Release);
                tokio::time::sleep(app.limits.lame_duck).await;
                let deadline = Instant::now() + app.limits.drain;
                jobs.stop();
                token.cancel();
                tokio::task::spawn_blocking(move || jobs.drain(deadline)).await
            }
        });
        let probe = tokio::spawn(upkeep::probe(Arc::clone(&app)));
        let look_over = tokio::spawn(upkeep::look_over(Arc::clone(&app)));
        let rest = tokio::spawn(rest::rest(Arc::clone(&app)));
        let sweep = tokio::spawn(retain::sweep(Arc::clone(&app)));
        let sweep_files = tokio::spawn(exports::sweep(Arc::clone(&app)));
        // who only makes photos has none
        let rooms = rooms.filter(|_| role != Role::Work);
        if let Some(rooms) = &rooms {
            rooms.start(&app.library, &token);
            // set once, as a server runs once
            let _ = app.rooms.set(Arc::clone(rooms));
        }
        let rooms = rooms.map(|rooms| {
            let of = Arc::clone(&app);
            let own = Arc::new(move |headers: &HeaderMap| of.hosts.is_own(headers));
            live::routes::Here { rooms, stop: token.clone(), own }
        });
        let router = match role {
            Role::Work => routes::system_router(Arc::clone(&app)),
            Role::All | Role::Serve => routes::router(Arc::clone(&app), rooms),
        };
        if let Some(tls) = tls.clone() {
            tokio::spawn(tls.follow(token.clone()));
        }
        let admin = admin.map(|(listener, addr, names)| {
            let (router, app, token) = (routes::admin_router(Arc::clone(&app), addr, &names), Arc::clone(&app), token.clone());
            let door = accept::Door { listener, tls: None, proxies: Proxies::default() };
            tokio::spawn(async move { accept::serve(door, router, &app.limits, &app.telemetry, &token).await })
        });
        let door = accept::Door { listener, tls, proxies: app.proxies.clone() };
        accept::serve(door, router, &app.limits, &app.telemetry, &token).await;
        if let Some(admin) = admin
            && let Err(error) = admin.await
        {
            tracing::error!(%error, "the operators' door");
        }
        probe.abort();
        look_over.abort();
        rest.abort();
        sweep.abort();
        sweep_files.abort();
        if let Err(error) = signal.await {
            tracing::error!(%error, "draining jobs");
        }
        app.library.close().await;
        if app.telemetry.traces().is_some() {
            let ended = tokio::task::spawn_blocking(move || app.telemetry.traces().map(Traces::end));
            if let Err(error) = ended.await {
                tracing::error!(%error, "sending the last traces");
            }
        }
        tracing::info!("stopped");
    }
}

/// Listens at an address, and says which it is.
async fn listen(addr: SocketAddr) -> Result<(TcpListener, SocketAddr), ServerError> {
    let listener = TcpListener::bind(addr).await.map_err(|source| ServerError::Listen { addr, source })?;
    let addr = listener.local_addr().map_err(|source| ServerError::Listen { addr, source })?;
    Ok((listener, addr))
}

/// What asks who comes, by the keys of a directory.
fn guard(keys: &Path, secret: Secret) -> Result<Guard, ServerError> {
    Guard::open(keys, secret).map_err(|source| ServerError::Data { dir: keys.to_owned(), source })
}

/// Takes its place among the nodes that share a store; blocks.
fn among(
    sharing: &Sharing,
    data: &Path,
    keys: Option<&Path>,
    maker: Arc<dyn Maker>,
    limits: Arc<Limits>,
    telemetry: Arc<Telemetry>,
) -> Result<(Arc<Jobs>, Option<Guard>), ServerError> {
    let wrong = |source| ServerError::Store { store: sharing.store.clone(), source };
    let cluster = Arc::new(Cluster::open(sharing, &limits).map_err(wrong)?);
    // copies of before may be of makings that are no more
    let copies = data.join("copies");
    match std::fs::remove_dir_all(copies.join("photos")) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => return Err(ServerError::Data { dir: copies, source }),
        _ => {}
    }
    let (store, _) = Store::open(&copies, maker.identity()).map_err(|source| ServerError::Data { dir: copies, source })?;
    child::empty_scratch(data).map_err(|source| ServerError::Data { dir: data.to_owned(), source })?;
    let store = store.keeping(limits.reserve).of_origin(Arc::clone(&cluster) as Arc<dyn store::Origin>, limits.copies);
    // all nodes give a photo the same id, and take each other's links
    let guard = match keys {
        Some(keys) => Some(guard(keys, cluster.secret().map_err(wrong)?)?),
        None => None,
    };
    let jobs = Jobs::start_among(Some(cluster), store, Vec::new(), maker, limits, telemetry).map_err(ServerError::Worker)?;
    Ok((jobs, guard))
}

/// Ready on SIGTERM or SIGINT (elsewhere Ctrl-C).
pub async fn stop_signal() {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        let (Ok(mut term), Ok(mut int)) = (signal(SignalKind::terminate()), signal(SignalKind::interrupt())) else {
            tracing::error!("signals cannot be caught");
            return std::future::pending().await;
        };
        tokio::select! {
            _ = term.recv() => {}
            _ = int.recv() => {}
        }
    }
    #[cfg(not(unix))]
    if let Err(error) = tokio::signal::ctrl_c().await {
        tracing::error!(%error, "signals cannot be caught");
        std::future::pending().await
    }
}
