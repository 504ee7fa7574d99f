//! The better depth network that a server offers to fetch.

use super::serve::identity;
use crate::server::{InstalledNetwork, NetworkOffer, NetworkUpgrade};
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models::download::{Digest, RemoteFile, fetch};
use tmpi_pipeline::networks::models::registry::{PublishedModel, best_in, folder, recommended_download};

/// A published network that is worth fetching, and the server's model flags.
pub(super) struct BetterNetwork {
    flags: ModelFlags,
    published: &'static PublishedModel,
    url: Option<String>,
    sha256: Digest,
    /// The digest is the publisher's, so the published size holds, too.
    pinned: bool,
}

impl BetterNetwork {
    /// `None` if the user chose the network, or one as good is installed. `url` and `sha256` override the publisher's.
    pub(super) fn of(flags: &ModelFlags, url: Option<String>, sha256: Option<Digest>) -> Option<Self> {
        let published = recommended_download(flags.settings().depth.name).filter(|_| flags.depth_model.auto)?;
        let pinned = sha256.is_none();
        let sha256 = sha256.or_else(|| published.sha256.parse().ok())?;
        Some(Self { flags: flags.clone(), published, url, sha256, pinned })
    }
}

impl NetworkUpgrade for BetterNetwork {
    fn offer(&self) -> NetworkOffer {
        let PublishedModel { name, bytes, licence, .. } = *self.published;
        NetworkOffer { name: name.into(), bytes: self.pinned.then_some(bytes), licence: licence.into() }
    }

    fn fetch(&self, progress: &mut dyn FnMut(u64)) -> Result<InstalledNetwork, String> {
        let url = self.url.as_deref().unwrap_or(self.published.url);
        let wanted = RemoteFile { url, bytes: self.pinned.then_some(self.published.bytes), sha256: self.sha256 };
        fetch(&wanted, &self.published.file(), |have, _| progress(have)).map_err(|e| e.to_string())?;
        // the network that a server started now would use
        let (adapter, file) = best_in(&folder()).ok_or("the fetched network has disappeared")?;
        let settings = self.flags.with_network(adapter, file);
        Ok(InstalledNetwork { network: settings.name().to_owned(), identity: identity(&settings).map_err(|e| format!("{e:#}"))? })
    }
}
