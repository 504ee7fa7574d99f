//! The depth network, and the better one that the server may download while it runs.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::maker::Maker;

/// A better network to download.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
pub struct NetworkOffer {
    /// Its name in reports.
    pub name: String,
    /// Size of its file in bytes, if known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bytes: Option<u64>,
    /// Licence and authors of its weights.
    pub licence: String,
}

/// Network and identity of a maker with the better network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InstalledNetwork {
    /// The network's name in reports.
    pub network: String,
    /// See [`super::Maker::identity`].
    pub identity: String,
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum DownloadState {
    #[default]
    Idle,
    /// Running; so many bytes are downloaded.
    UnderWay(u64),
    /// It failed, as the text says; another try resumes it.
    Failed(String),
}

/// The server's download; one runs at a time.
#[derive(Clone, Debug, Default)]
pub struct Download(Arc<Mutex<DownloadState>>);

impl Download {
    fn lock(&self) -> MutexGuard<'_, DownloadState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn state(&self) -> DownloadState {
        self.lock().clone()
    }

    /// Starts it in its own thread; false if there is nothing to download, or it is running.
    ///
    /// # Errors
    /// If no thread can be started.
    pub fn start(&self, maker: &Arc<dyn Maker>) -> std::io::Result<bool> {
        let mut now = self.lock();
        if matches!(*now, DownloadState::UnderWay(_)) || maker.better().is_none() {
            return Ok(false);
        }
        let (download, maker) = (self.clone(), Arc::clone(maker));
        std::thread::Builder::new().name("tmpi-network".into()).spawn(move || {
            let fetched = maker.download_better(&mut |have| *download.lock() = DownloadState::UnderWay(have));
            *download.lock() = match fetched {
                Ok(()) => {
                    tracing::info!(network = maker.network(), "a better depth network is installed");
                    DownloadState::Idle
                }
                Err(problem) => {
                    tracing::warn!(problem, "cannot download a better depth network");
                    DownloadState::Failed(problem)
                }
            };
        })?;
        *now = DownloadState::UnderWay(0);
        Ok(true)
    }
}
