//! Depth networks that others have published, and where they lie once they are here.

use std::path::PathBuf;

use crate::depth::{Adapter, adapter};

/// A published depth network. Size and digest are as several public projects that check them state; `tmpi models get` keeps
/// nothing else.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Published {
    /// Name that users choose it by.
    pub name: &'static str,
    /// What comes before and after it: a name of [`crate::depth::ADAPTERS`].
    pub adapter: &'static str,
    /// Where its ONNX file is.
    pub url: &'static str,
    /// Size of the file in bytes.
    pub bytes: u64,
    /// SHA-256 of the file, in hexadecimal.
    pub sha256: &'static str,
    /// Licence of the weights, and whose they are.
    pub licence: &'static str,
}

/// All networks that `tmpi models get` knows.
pub const PUBLISHED: [Published; 2] = [
    Published {
        name: "midas-v2.1-small",
        adapter: "midas-v2.1-small",
        url: "https://github.com/isl-org/MiDaS/releases/download/v2_1/model-small.onnx",
        bytes: 66_764_249,
        sha256: "2d8c6cb8f415229daf1eb041024208e2608c9f98e17c81cc7c6ecb449c56fd58",
        licence: "MIT, Intel ISL",
    },
    Published {
        name: "depth-anything-v2-small",
        adapter: "depth-anything-v2",
        url: "https://huggingface.co/onnx-community/depth-anything-v2-small/resolve/4472b7362082ad9968fee890ca0f1e5aca36b93d/onnx/model.onnx",
        bytes: 99_060_839,
        sha256: "afb6a5c28f3b6bf1618c6e43f02073ef9dfdc70e937502d51603e57b0a1df10c",
        licence: "Apache-2.0, the Depth Anything V2 authors",
    },
];

impl Published {
    /// Its adapter.
    #[must_use]
    pub fn adapter(&self) -> Option<&'static Adapter> {
        adapter(self.adapter)
    }

    /// File that it is kept in, in [`folder`].
    #[must_use]
    pub fn file(&self) -> PathBuf {
        folder().join(format!("{}.onnx", self.name))
    }
}

/// The published network of that name.
#[must_use]
pub fn published(name: &str) -> Option<&'static Published> {
    PUBLISHED.iter().find(|p| p.name == name)
}

/// Folder of downloaded networks: `TMPI_MODELS`, else the user's data folder, else `models` here.
#[must_use]
pub fn folder() -> PathBuf {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let data = || {
        if cfg!(windows) { set("LOCALAPPDATA") } else { set("XDG_DATA_HOME").or_else(|| set("HOME").map(|home| home.join(".local/share"))) }
    };
    set("TMPI_MODELS").or_else(|| data().map(|d| d.join("tmpi/models"))).unwrap_or_else(|| "models".into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::networks::models::download::Digest;

    #[test]
    fn every_entry_is_whole() {
        for p in &PUBLISHED {
            assert!(p.adapter().is_some(), "{}", p.name);
            assert!(p.sha256.parse::<Digest>().is_ok() && p.bytes > 0 && p.url.starts_with("https://"), "{}", p.name);
            assert_eq!(published(p.name), Some(p));
        }
        assert_eq!(published("no such"), None);
    }
}
