//! Opens a server's library, for commands that work on it.

use std::path::PathBuf;

use anyhow::Context as _;
use tmpi_library::{Config, Library};

use super::Usage;

/// The location of the library. The options, the settings file and the variables are those of `tmpi serve`.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct LibraryArgs {
    /// Settings file of the server, which names its library
    #[arg(long, env = "TMPI_CONFIG", value_name = "FILE")]
    #[allow(dead_code, reason = "`config::complete` reads it")]
    config: Option<PathBuf>,
    /// Directory in which the server keeps its photos
    #[arg(long, default_value = "tmpi-data", value_name = "DIR")]
    data: PathBuf,
    /// Database that several nodes share
    #[arg(long, value_name = "URL")]
    database: Option<String>,
    /// Object store that several nodes share
    #[arg(long, value_name = "URL")]
    blobs: Option<String>,
}

impl LibraryArgs {
    /// Opens the library, or creates it if `create` is set, and runs `work` on it.
    pub fn with<T>(&self, create: bool, work: impl AsyncFnOnce(&Library) -> anyhow::Result<T>) -> anyhow::Result<T> {
        let Self { data, database, blobs, .. } = self;
        if !create && database.is_none() && !data.join("library.db").exists() {
            let text =
                format!("{}: no library there; give --data, --database or --config, or create one with key add --create", data.display());
            return Err(Usage(text).into());
        }
        if database.is_some() != blobs.is_some() {
            return Err(Usage("--database and --blobs go together: give those of the server".into()).into());
        }
        let config = Config { database: database.clone(), blobs: blobs.clone(), ..Config::of_folder(data) };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        runtime.block_on(async {
            let library = Box::pin(Library::open(config)).await.context("library")?;
            let done = work(&library).await;
            library.close().await;
            done
        })
    }
}
