//! Where a library is, for the commands that look into one that a server uses.

use std::path::PathBuf;

use anyhow::Context as _;
use tmpi_library::{Config, Library};

use super::Usage;

/// As options of `tmpi serve`, of its file, and of its variables.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct LibraryArgs {
    /// File of settings that the server is started with; where its library is is read there
    #[arg(long, env = "TMPI_CONFIG", value_name = "FILE")]
    #[allow(dead_code, reason = "read before all else, with what is in it")]
    config: Option<PathBuf>,
    /// Directory that the server keeps its photos in
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
    /// Does `work` with the library, which is made where there is none and `create` says so.
    pub fn with<T>(&self, create: bool, work: impl AsyncFnOnce(&Library) -> anyhow::Result<T>) -> anyhow::Result<T> {
        let Self { data, database, blobs, .. } = self;
        if !create && database.is_none() && !data.join("library.db").exists() {
            let text = format!(
                "{}: no server keeps photos there; --data, --database or --config says where it does, and key add --create makes it",
                data.display()
            );
            return Err(Usage(text).into());
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
