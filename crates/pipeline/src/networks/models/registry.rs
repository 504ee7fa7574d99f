//! Depth networks that others have published, and where they lie once they are here.

use std::path::{Path, PathBuf};

use crate::depth::{Adapter, adapter, detect};

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

/// The published network that is worth fetching where there is none: the smallest download of the best kind.
pub const BETTER: &str = "depth-anything-v2-small-fp16";

/// Adapters from the best to the worst: each line of papers reports smaller errors on unseen data than those after it. An adapter that stands
/// for no published network has no rank.
const RANKS: [&str; 10] = [
    "depth-anything-v2",
    "depth-anything-v2-metric",
    "zoedepth",
    "dpt-large",
    "dpt-hybrid",
    "midas-v2.1",
    "midas-v2.1-hub",
    "midas-v2.1-small",
    "midas-v2.1-small-hub",
    "tmpi",
];

/// All networks that `tmpi models get` knows.
pub const PUBLISHED: [Published; 3] = [
    Published {
        name: BETTER,
        adapter: "depth-anything-v2",
        url: "https://huggingface.co/onnx-community/depth-anything-v2-small/resolve/4472b7362082ad9968fee890ca0f1e5aca36b93d/onnx/model_fp16.onnx",
        bytes: 49_642_442,
        sha256: "2df6223f206b5164e21f664ace61dabeb9bb6a49b8b5a3e00510b4807d0f5b04",
        licence: "Apache-2.0, the Depth Anything V2 authors",
    },
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

/// Folder that comes with the program: `models` beside it.
fn shipped() -> Option<PathBuf> {
    Some(std::env::current_exe().ok()?.parent()?.join("models"))
}

/// The best network in [`folder`], else of those that came with the program.
#[must_use]
pub fn usual() -> Option<(&'static Adapter, PathBuf)> {
    best(&folder()).or_else(|| best(&shipped()?))
}

/// The best network among the ONNX files of `folder`: by kind, then the larger file, then by name. Files that do not tell their network are passed
/// over; none where nothing is left.
#[must_use]
pub fn best(folder: &Path) -> Option<(&'static Adapter, PathBuf)> {
    let files = std::fs::read_dir(folder).ok()?.filter_map(|entry| {
        let (file, bytes) = entry.ok().and_then(|e| Some((e.path(), e.metadata().ok()?.len())))?;
        let onnx = file.extension().is_some_and(|e| e.eq_ignore_ascii_case("onnx")) && file.is_file();
        let network = detect(&file).filter(|_| onnx)?;
        let rank = RANKS.iter().position(|r| *r == network.name)?;
        Some((rank, std::cmp::Reverse(bytes), file, network))
    });
    files.min_by(|a, b| (a.0, a.1, &a.2).cmp(&(b.0, b.1, &b.2))).map(|(_, _, file, network)| (network, file))
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
        assert!(published(BETTER).is_some());
    }

    #[test]
    fn every_adapter_has_a_rank() {
        for a in &crate::depth::ADAPTERS {
            assert_eq!(RANKS.iter().filter(|r| **r == a.name).count(), usize::from(a.name != "log-depth"), "{}", a.name);
        }
    }

    #[test]
    fn the_best_network_of_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        let put = |name: &str, bytes: usize| std::fs::write(folder.path().join(name), vec![0; bytes]).unwrap();
        let found = || best(folder.path()).map(|(a, file)| (a.name, file.file_name().unwrap().to_str().unwrap().to_owned()));
        assert_eq!(best(Path::new("no/such/folder")), None);
        assert_eq!(found(), None);
        put("notes.txt", 9);
        put("model.onnx", 9);
        put("depth-anything-v2-small.onnx.part", 9);
        std::fs::create_dir(folder.path().join("dpt-large.onnx")).unwrap();
        assert_eq!(found(), None, "none that tells what it is");
        put("midas-v2.1-small.onnx", 50);
        assert_eq!(found().unwrap().0, "midas-v2.1-small");
        put("depth-anything-v2-small-fp16.onnx", 5);
        assert_eq!(found(), Some(("depth-anything-v2", "depth-anything-v2-small-fp16.onnx".into())));
        put("depth_anything_v2_vitb.ONNX", 7);
        assert_eq!(found().unwrap().1, "depth_anything_v2_vitb.ONNX", "the larger one of a kind");
    }
}
