//! The network that estimates depth, and the better one that the server may fetch while it runs.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::maker::Maker;

/// A published network that is worth fetching.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
pub struct Offer {
    /// Its name in reports.
    pub name: String,
    /// Size of its file in bytes, where it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bytes: Option<u64>,
    /// Licence of its weights, and whose they are.
    pub licence: String,
}

/// What a maker is with a better network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Renewed {
    /// The network's name in reports.
    pub network: String,
    /// See [`super::Maker::identity`].
    pub identity: String,
}

/// Fetches a better network.
pub trait Better: Send + Sync + 'static {
    /// What is fetched.
    fn offer(&self) -> Offer;

    /// Fetches it, from where a try before broke off; blocks. `progress` is told the bytes that are here.
    ///
    /// # Errors
    /// Why it is not here, in words.
    fn fetch(&self, progress: &mut dyn FnMut(u64)) -> Result<Renewed, String>;
}

/// How a download fares.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Fetching {
    /// None is under way.
    #[default]
    Idle,
    /// So many bytes are here.
    UnderWay(u64),
    /// It ended before its time, as the text says; another try goes on from there.
    Failed(String),
}

/// The download of a server, one at a time.
#[derive(Clone, Debug, Default)]
pub struct Download(Arc<Mutex<Fetching>>);

impl Download {
    fn lock(&self) -> MutexGuard<'_, Fetching> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How it fares.
    #[must_use]
    pub fn state(&self) -> Fetching {
        self.lock().clone()
    }

    /// Starts it in a thread of its own; false where there is nothing to fetch, or it is under way.
    ///
    /// # Errors
    /// No thread can be started.
    pub fn start(&self, maker: &Arc<dyn Maker>) -> std::io::Result<bool> {
        let mut now = self.lock();
        if matches!(*now, Fetching::UnderWay(_)) || maker.better().is_none() {
            return Ok(false);
        }
        let (download, maker) = (self.clone(), Arc::clone(maker));
        std::thread::Builder::new().name("tmpi-network".into()).spawn(move || {
            let fetched = maker.fetch_better(&mut |have| *download.lock() = Fetching::UnderWay(have));
            *download.lock() = match fetched {
                Ok(()) => {
                    tracing::info!(network = maker.network(), "a better depth network is here");
                    Fetching::Idle
                }
                Err(problem) => {
                    tracing::warn!(problem, "a better depth network could not be fetched");
                    Fetching::Failed(problem)
                }
            };
        })?;
        *now = Fetching::UnderWay(0);
        Ok(true)
    }
}
