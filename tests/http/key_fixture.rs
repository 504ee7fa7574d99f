//! Adds, lists and removes keys beside a running server, as `tmpi key` does, and signs as its other nodes do.

use std::path::Path;

pub use tmpi_library::Scope;
use tmpi_library::{Config, Grant, Key, Library, LibraryError, Subject};

use crate::fixture::block_on;

fn with<T>(data: &Path, work: impl AsyncFnOnce(&Library) -> Result<T, LibraryError>) -> T {
    block_on(async {
        let library = Box::pin(Library::open(Config::of_folder(data))).await.unwrap();
        let done = work(&library).await.unwrap();
        library.close().await;
        done
    })
}

/// Adds a key; returns it as the value of `Authorization`.
pub fn add(data: &Path, name: &str, scopes: &[Scope]) -> String {
    with(data, async |library| Ok(format!("Bearer {}", library.add_key(name, scopes, None).await?.secret)))
}

/// All keys.
pub fn read(data: &Path) -> Vec<Key> {
    with(data, async |library| library.keys().await)
}

/// Removes keys; returns how many.
pub fn remove(data: &Path, name: &str, id: Option<&str>) -> u64 {
    with(data, async |library| library.remove_keys(name, id).await)
}

/// Credential of another node for a room, valid for so many seconds; as the value of `Authorization`.
pub fn of_node(data: &Path, room: &str, seconds: i64) -> String {
    with(data, async |library| {
        let expires = library.now().await? / 1000 + seconds;
        Ok(format!("Bearer {}", library.secret().sign(Grant::Relay, Subject::Room(room), expires as u64)))
    })
}
