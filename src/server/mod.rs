//! The HTTP server: takes uploads, serves containers, views and progress.
//!
//! It does no image processing itself: it calls [`tmpi_pipeline::make`], [`tmpi_core::container::decode`] and a [`tmpi_render::Renderer`].
//! Requests and workers ([`Limits::workers`]) run on tokio; a bounded pool renders views. A photo that was answered 202 is in the library:
//! it survives a crash, and the next start resumes it.

mod accept_loop;
mod access;
mod answer_memory;
mod app_state;
mod base_path;
mod better_network;
mod blocking_pool;
mod body_source;
mod cache;
mod cache_entries;
mod child;
mod client_slots;
mod compress;
mod conditional;
mod config;
mod content_disposition;
mod cross_site;
mod depth_network_download;
mod exports;
mod fetch_by_url;
mod finished_photo;
#[doc(hidden)]
pub mod fuzzing;
mod hosts;
mod http2_streams;
mod idle_trim;
mod limits;
mod link_preview;
mod maintenance;
mod maker;
mod memory_budget;
mod metrics;
mod middleware;
mod minimum_rate;
mod multipart_header_limit;
mod outbound;
mod pages;
mod photo_options;
mod presets;
mod problem;
mod program_digest;
mod proxies;
mod rate_limit;
mod request_body;
mod routes;
mod time_limit;
mod timestamps;
mod tls;
mod traces;
mod units;
mod upload;
mod upload_by_address;
mod upload_fields;
mod upload_file;
mod upload_head;
mod viewer_settings;
mod webhooks;
mod workers;

use std::fs::File;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use axum::http::HeaderMap;
use tokio::net::TcpListener;

pub use accept_loop::ConnectionGuard;
pub(crate) use answer_memory::ANSWERS;
pub use base_path::BasePath;
pub(crate) use better_network::{BetterNetwork, identity};
pub use child::{ProcessMaker, VARIABLE, disable_process_inspection, serve as run_child};
pub(crate) use conditional::{ContentCoding, Entity, respond};
pub use config::{Config, Role};
pub(crate) use cross_site::check_origin;
pub use depth_network_download::NetworkOffer;
pub use fetch_by_url::SourceHost;
pub use idle_trim::use_one_malloc_arena;
pub use limits::{Caches, Exports, Limits, Quotas, Rates, Retention};
pub use maker::{Fault, HeadOf, Maker, PipelineMaker, Product};
pub use outbound::AddressPolicy;
pub use presets::{Preset, Presets};
pub use problem::Problem;
pub use proxies::{Network, Proxies};
pub use routes::{Access, Route, openapi, openapi_of, routes};
pub(crate) use routes::{EmptyBody, Pairs};
pub use tls::{Tls, TlsError};
pub use traces::{Collector, CollectorError, check_collector};
pub use webhooks::ConfiguredWebhook;

use app_state::{App, AppState};
pub(crate) use metrics::Metric;
use metrics::Telemetry;
pub(crate) use timestamps::{rfc3339, since_1970};
use traces::Traces;
use webhooks::Clients;
use workers::Workers;

use tmpi_library::{Library, NewWebhook};
pub use tmpi_library::{PhotoId, Reserve, hex};
use tmpi_render::Renderer;

use crate::live::{self, Rooms};

/// A hint for an error of listening.
fn hint(error: &std::io::Error) -> &'static str {
    match error.kind() {
        std::io::ErrorKind::AddrInUse => ", as another program does already: choose another port with --addr, or 0 for a free one",
        std::io::ErrorKind::PermissionDenied => ": ports below 1024 often need more rights, choose another one with --addr",
        _ => "",
    }
}

/// Why the server cannot start or run.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// It cannot listen at the address.
    #[error("cannot listen on {addr}{}", hint(source))]
    Listen {
        /// The address.
        addr: SocketAddr,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The data directory cannot be used.
    #[error("data directory {dir}")]
    Data {
        /// The directory.
        dir: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The library cannot be opened.
    #[error("library")]
    Library(#[from] tmpi_library::LibraryError),
    /// The collector of traces is not usable.
    #[error(transparent)]
    Traces(#[from] CollectorError),
    /// The `OpenAPI` document cannot be written.
    #[error("OpenAPI document")]
    OpenApi(#[from] serde_json::Error),
}

/// A server that listens and waits for [`Server::run`].
pub struct Server {
    listener: TcpListener,
    addr: SocketAddr,
    app: App,
    rooms: Option<Arc<Rooms>>,
    role: Role,
    has_objects: bool,
    tls: Option<Tls>,
    webhooks: Arc<Clients>,
    /// The admin listener, with its address and accepted names.
    admin: Option<(TcpListener, SocketAddr, Vec<String>)>,
    /// Lock of the data directory, until the server is dropped.
    lock: File,
}

impl Server {
    /// Listens, and opens the library.
    ///
    /// # Errors
    /// [`ServerError`].
    pub async fn bind(config: Config, maker: Arc<dyn Maker>, renderer: Arc<dyn Renderer>) -> Result<Self, ServerError> {
        let data = config.data.clone();
        let openapi = openapi_of(&config.limits, config.admin.is_some(), &config.base_path)?;
        let (listener, addr) = listen(config.addr).await?;
        let admin = match config.admin {
            Some(addr) => Some(listen(addr).await?).map(|(listener, addr)| (listener, addr, config.hosts.clone())),
            None => None,
        };
        let telemetry = Arc::new(Telemetry::of(config.traces.as_ref())?);
        let library = Box::pin(Library::open(config.library())).await?;
        let lock = claim(&data, library.incoming()).map_err(|source| ServerError::Data { dir: data, source })?;
        if config.database.is_none() {
            // the process that held them has ended
            library.reclaim().await?;
        }
        let webhooks: Vec<NewWebhook> = config.webhooks.iter().map(|webhook| webhook.0.clone()).collect();
        library.configure_webhooks(&webhooks).await?;
        let webhooks = Arc::new(Clients::new(config.webhook_addresses));
        let (role, has_objects) = (config.role, config.blobs.is_some());
        let app = Arc::new(AppState::new(config, addr, library, maker, renderer, telemetry, openapi));
        Ok(Self { listener, addr, app, rooms: None, role, has_objects, tls: None, webhooks, admin, lock })
    }

    /// Adds rooms.
    pub fn with_rooms(mut self, rooms: Rooms) -> Self {
        self.rooms = Some(Arc::new(rooms));
        self
    }

    /// Adds TLS, with HTTP/2 for clients that support it.
    pub fn with_tls(mut self, tls: Tls) -> Self {
        self.tls = Some(tls);
        self
    }

    /// `http` or `https`.
    pub const fn scheme(&self) -> &'static str {
        if self.tls.is_some() { "https" } else { "http" }
    }

    /// Address that the server listens on.
    pub const fn addr(&self) -> SocketAddr {
        self.addr
    }

    /// Address of the admin listener, if any.
    pub fn admin_addr(&self) -> Option<SocketAddr> {
        self.admin.as_ref().map(|(_, addr, _)| *addr)
    }

    /// Serves until `stop` is ready or an operator requests a shutdown, and for [`Limits::lame_duck`] more. Then it accepts no more
    /// connections and gives running requests and jobs [`Limits::drain`] to end. The next start resumes the other jobs.
    pub async fn run(self, stop: impl Future<Output = ()> + Send + 'static) {
        let Self { listener, addr, app, rooms, role, has_objects, tls, webhooks: clients, admin, lock } = self;
        let token = app.stop.clone();
        let workers = (role != Role::Serve).then(|| Workers::start(&app));
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
                token.cancel();
                if let Some(workers) = workers {
                    workers.drain(deadline).await;
                }
            }
        });
        let mut background = tokio::task::JoinSet::new();
        background.spawn(maintenance::probe(Arc::clone(&app), has_objects));
        background.spawn(maintenance::sweep(Arc::clone(&app)));
        background.spawn(maintenance::evict_deleted(Arc::clone(&app)));
        if tls.is_some() {
            app.set_origin(addr.port());
        }
        background.spawn(webhooks::deliver(Arc::clone(&app), clients));
        background.spawn(idle_trim::trim_when_idle(Arc::clone(&app)));
        if !has_objects {
            // an object store checks its own contents
            background.spawn(maintenance::verify_photos(Arc::clone(&app)));
        }
        // nodes that only make photos have no rooms
        let rooms = rooms.filter(|_| role != Role::Work);
        if let Some(rooms) = &rooms {
            rooms.start(&app.library, &token);
            // a server runs once
            let _ = app.rooms.set(Arc::clone(rooms));
        }
        let rooms = rooms.map(|rooms| {
            let of = Arc::clone(&app);
            let own = Arc::new(move |headers: &HeaderMap| of.hosts.is_own(headers));
            live::RoomsContext { rooms, stop: token.clone(), own }
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
            let endpoint = accept_loop::Endpoint { listener, tls: None, proxies: Proxies::default(), base: BasePath::default() };
            tokio::spawn(async move { accept_loop::serve(endpoint, router, &app.limits, &app.telemetry, &token).await })
        });
        let endpoint = accept_loop::Endpoint { listener, tls, proxies: app.proxies.clone(), base: app.base.clone() };
        accept_loop::serve(endpoint, router, &app.limits, &app.telemetry, &token).await;
        if let Some(admin) = admin
            && let Err(error) = admin.await
        {
            tracing::error!(%error, "the admin listener failed");
        }
        if let Err(error) = signal.await {
            tracing::error!(%error, "draining jobs");
        }
        background.shutdown().await;
        if let Err(error) = app.library.save_views().await {
            tracing::warn!(%error, "cannot record when photos were viewed");
        }
        app.library.close().await;
        if app.telemetry.traces().is_some() {
            let ended = tokio::task::spawn_blocking(move || app.telemetry.traces().map(Traces::end));
            if let Err(error) = ended.await {
                tracing::error!(%error, "sending the last traces");
            }
        }
        drop(lock);
        tracing::info!("stopped");
    }
}

/// Listens at an address; returns the actual one.
async fn listen(addr: SocketAddr) -> Result<(TcpListener, SocketAddr), ServerError> {
    let listener = TcpListener::bind(addr).await.map_err(|source| ServerError::Listen { addr, source })?;
    let addr = listener.local_addr().map_err(|source| ServerError::Listen { addr, source })?;
    Ok((listener, addr))
}

/// Locks a data directory for this process, and removes partial uploads and leftovers of a crash.
fn claim(data: &Path, incoming: &Path) -> std::io::Result<File> {
    let lock = File::options().create(true).truncate(false).write(true).open(data.join("lock"))?;
    lock.try_lock().map_err(|_| std::io::Error::other("another process serves from there"))?;
    child::remove_leftovers(data)?;
    for entry in std::fs::read_dir(incoming)? {
        std::fs::remove_file(entry?.path())?;
    }
    Ok(lock)
}

/// Ready on SIGTERM or SIGINT (elsewhere Ctrl-C).
pub async fn stop_signal() {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        let (Ok(mut term), Ok(mut int)) = (signal(SignalKind::terminate()), signal(SignalKind::interrupt())) else {
            tracing::error!("cannot catch signals");
            return std::future::pending().await;
        };
        tokio::select! {
            _ = term.recv() => {}
            _ = int.recv() => {}
        }
    }
    #[cfg(not(unix))]
    if let Err(error) = tokio::signal::ctrl_c().await {
        tracing::error!(%error, "cannot catch signals");
        std::future::pending().await
    }
}
