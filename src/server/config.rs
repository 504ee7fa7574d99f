//! Configuration of a server.

use std::net::SocketAddr;
use std::path::PathBuf;

use super::base_path::BasePath;
use super::fetch_by_url::SourceHost;
use super::limits::Limits;
use super::outbound::AddressPolicy;
use super::presets::Presets;
use super::proxies::Proxies;
use super::traces::Collector;
use super::webhooks::ConfiguredWebhook;

/// Role of a node.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Role {
    /// It serves and makes photos.
    #[default]
    All,
    /// It serves photos that other nodes make.
    Serve,
    /// It makes photos that other nodes serve.
    Work,
}

/// Configuration of a server.
#[derive(Clone, Debug)]
pub struct Config {
    /// Address and port; port 0 takes a free one.
    pub addr: SocketAddr,
    /// Address and port of the admin listener (metrics, shutdown, deletion), which has no authentication. Without it metrics are at
    /// [`Config::addr`], signals shut the server down, and admin keys delete photos.
    pub admin: Option<SocketAddr>,
    /// Data directory; created if missing.
    pub data: PathBuf,
    /// Database that several nodes share, `postgres://…`; by default SQLite in the data directory.
    pub database: Option<String>,
    /// Object store that several nodes share, `s3://…`; by default a folder in the data directory.
    pub blobs: Option<String>,
    /// Directory that replaces the embedded pages.
    pub pages: Option<PathBuf>,
    /// Accepted `Host` names besides loopback and the server's address, without ports: those that proxies forward.
    pub hosts: Vec<String>,
    /// Path at which a proxy serves it.
    pub base_path: BasePath,
    /// Trusted proxies.
    pub proxies: Proxies,
    /// Lists all photos to every caller, not only to this machine's own user.
    pub public_list: bool,
    /// Private access: only owners see their photos.
    pub private: bool,
    /// Role of this node.
    pub role: Role,
    /// Collector of traces; none by default.
    pub traces: Option<Collector>,
    /// Webhooks for all photos and rooms.
    pub webhooks: Vec<ConfiguredWebhook>,
    /// Addresses that webhooks of callers may have.
    pub webhook_addresses: AddressPolicy,
    /// Hosts from which photos are fetched; by default none are.
    pub source_hosts: Vec<SourceHost>,
    /// Addresses that these hosts may have.
    pub source_addresses: AddressPolicy,
    /// Named options of views and photos.
    pub presets: Presets,
    /// Limits.
    pub limits: Limits,
}

impl Config {
    /// Open access and default limits.
    pub fn new(addr: SocketAddr, data: PathBuf) -> Self {
        Self {
            addr,
            admin: None,
            data,
            database: None,
            blobs: None,
            pages: None,
            hosts: Vec::new(),
            base_path: BasePath::default(),
            proxies: Proxies::default(),
            public_list: false,
            private: false,
            role: Role::All,
            traces: None,
            webhooks: Vec::new(),
            webhook_addresses: AddressPolicy::Public,
            source_hosts: Vec::new(),
            source_addresses: AddressPolicy::Public,
            presets: Presets::default(),
            limits: Limits::default(),
        }
    }

    pub(super) fn library(&self) -> tmpi_library::Config {
        let Self { data, database, blobs, limits, .. } = self;
        let reserve = limits.reserve();
        tmpi_library::Config { data: data.clone(), database: database.clone(), blobs: blobs.clone(), limits: limits.library(), reserve }
    }
}
