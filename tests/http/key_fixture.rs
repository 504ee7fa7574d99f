//! Adds, lists and removes keys beside a running server, as `tmpi key` does.

use std::path::Path;
use std::time::Duration;

pub use tmpi_library::Scope;
use tmpi_library::{Config, Key, Library, LibraryError};

fn with<T>(data: &Path, work: impl AsyncFnOnce(&Library) -> Result<T, LibraryError>) -> Result<T, LibraryError> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let library = Box::pin(Library::open(Config::of_folder(data))).await?;
        let done = work(&library).await;
        library.close().await;
        done
    })
}

/// Adds a key; returns its secret.
pub fn add(data: &Path, name: &str, scopes: &[Scope], days: Option<u32>) -> Result<String, LibraryError> {
    let lasts = days.map(|days| Duration::from_hours(24 * u64::from(days)));
    with(data, async |library| Ok(library.add_key(name, scopes, lasts).await?.secret))
}

/// All keys.
pub fn read(data: &Path) -> Result<Vec<Key>, LibraryError> {
    with(data, async |library| library.keys().await)
}

/// Removes keys; returns how many.
pub fn remove(data: &Path, name: &str, id: Option<&str>) -> Result<u64, LibraryError> {
    with(data, async |library| library.remove_keys(name, id).await)
}
