//! The better depth network that a server offers to fetch.

use anyhow::Context as _;
use sha2::{Digest as _, Sha256};

use super::depth_network_download::{InstalledNetwork, NetworkOffer};
use tmpi_library::hex;
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;
use tmpi_pipeline::networks::models::download::{Digest, RemoteFile, fetch};
use tmpi_pipeline::networks::models::registry::{PublishedModel, best_in, folder, recommended_download};

/// A published network that is worth fetching, and the server's model flags.
pub struct BetterNetwork {
    flags: ModelFlags,
    published: &'static PublishedModel,
    url: Option<String>,
    sha256: Digest,
    /// The digest is the publisher's, so the published size holds, too.
    pinned: bool,
}

impl BetterNetwork {
    /// `None` if the user chose the network, or one as good is installed. `url` and `sha256` override the publisher's.
    pub fn of(flags: &ModelFlags, url: Option<String>, sha256: Option<Digest>) -> Option<Self> {
        let published = recommended_download(flags.settings().depth.name).filter(|_| flags.depth_model.auto)?;
        let pinned = sha256.is_none();
        let sha256 = sha256.or_else(|| published.sha256.parse().ok())?;
        Some(Self { flags: flags.clone(), published, url, sha256, pinned })
    }

    pub fn offer(&self) -> NetworkOffer {
        let PublishedModel { name, bytes, licence, .. } = *self.published;
        NetworkOffer { name: name.into(), bytes: self.pinned.then_some(bytes), licence: licence.into() }
    }

    /// Downloads it, resuming an earlier try; blocks. Calls `progress` with the bytes downloaded so far.
    ///
    /// # Errors
    /// Why it failed, as text.
    pub fn fetch(&self, progress: &mut dyn FnMut(u64)) -> Result<InstalledNetwork, String> {
        let url = self.url.as_deref().unwrap_or(self.published.url);
        let wanted = RemoteFile { url, bytes: self.pinned.then_some(self.published.bytes), sha256: self.sha256 };
        fetch(&wanted, &self.published.file(), |have, _| progress(have)).map_err(|e| e.to_string())?;
        // the network that a server started now would use
        let (adapter, file) = best_in(&folder()).ok_or("the fetched network has disappeared")?;
        let settings = self.flags.with_network(adapter, file);
        Ok(InstalledNetwork { network: settings.name().to_owned(), identity: identity(&settings).map_err(|e| format!("{e:#}"))? })
    }
}

/// Identifies the networks on which photos depend: a photo is made again with another network.
pub fn identity(settings: &models::Settings) -> anyhow::Result<String> {
    // an embedded network is a part of the program
    let mut digest: Option<String> = None;
    if let Some(file) = &settings.depth_file {
        let weights = models::external_data_files(file)?.into_iter().map(|(_, file)| file);
        for file in std::iter::once(file.clone()).chain(weights) {
            let bytes = std::fs::read(&file).with_context(|| file.display().to_string())?;
            // for one file its digest, for several their digests concatenated
            digest = Some(digest.unwrap_or_default() + &hex(&Sha256::digest(bytes)));
        }
    }
    let models::Settings { depth, depth_pixels, depth_smoothing, depth_ramp, flip, folder, .. } = settings;
    let mut text = format!("{} {digest:?} {depth_pixels:?} {depth_smoothing:?} {flip:?}", depth.name);
    if let Some(ramp) = depth_ramp {
        text = format!("{text} {ramp:?}");
    }
    // optional networks
    for name in [models::THETA, models::PSI] {
        match std::fs::read(folder.join(name)) {
            Ok(bytes) => text = format!("{text} {name} {}", hex(&Sha256::digest(bytes))),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
            Err(e) => return Err(e).with_context(|| folder.join(name).display().to_string()),
        }
    }
    Ok(text)
}
