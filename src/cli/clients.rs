//! What `tmpi serve` lets its clients do: rates, quotas, and what goes by itself.

use std::time::Duration;

use crate::server::{ClientAddress, Limits, Network, Proxies};

/// Bounds on clients.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ClientArgs {
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
    /// Requests a minute for each key, and for each address without one; 0 for any number, which it is on loopback and behind a proxy that is not trusted (--host without --tls-cert), else 6000
    #[arg(long, value_name = "N")]
    rate_requests: Option<u32>,
    /// Uploads a minute, the same way; else 60
    #[arg(long, value_name = "N")]
    rate_uploads: Option<u32>,
    /// Views, films and files to download a minute, the same way; else 600
    #[arg(long, value_name = "N")]
    rate_views: Option<u32>,
    /// Photos of one owner, where the server asks who comes; any number without this
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    quota_photos: Option<u32>,
    /// Room of one owner's photos, uploaded and made, in MiB, where the server asks who comes
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..), value_name = "MIB")]
    quota_mib: Option<u32>,
    /// Days after which a photo goes by itself; never without this
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=36_500), value_name = "DAYS")]
    retain_days: Option<u32>,
    /// Room of all photos, in MiB, beyond which those go by themselves that were looked at least recently
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..), conflicts_with = "store", value_name = "MIB")]
    retain_mib: Option<u32>,
}

impl ClientArgs {
    /// The proxies that are trusted.
    pub fn proxies(&self) -> Proxies {
        Proxies::new(&self.trusted_proxies, self.client_address)
    }

    /// Writes them into `limits`. Rates that are not given hold where strangers come `by_themselves`, or by a proxy that tells them apart.
    pub fn put(&self, limits: &mut Limits, by_themselves: bool) {
        let by_themselves = by_themselves || !self.trusted_proxies.is_empty();
        let rate = |given: Option<u32>, usual| given.unwrap_or(if by_themselves { usual } else { 0 });
        let mib = |n: Option<u32>| n.map(|n| u64::from(n) << 20);
        limits.rate_requests = rate(self.rate_requests, Limits::RATE_REQUESTS);
        limits.rate_uploads = rate(self.rate_uploads, Limits::RATE_UPLOADS);
        limits.rate_views = rate(self.rate_views, Limits::RATE_VIEWS);
        limits.quota_photos = self.quota_photos.map(|n| n as usize);
        limits.quota_bytes = mib(self.quota_mib);
        limits.retain = self.retain_days.map(|days| Duration::from_hours(24 * u64::from(days)));
        limits.retain_bytes = mib(self.retain_mib);
    }

    /// Whether an owner may have only so much.
    pub const fn has_quota(&self) -> bool {
        self.quota_photos.is_some() || self.quota_mib.is_some()
    }
}
