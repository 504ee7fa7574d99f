//! Published depth networks, and where their files are stored.

use std::path::{Path, PathBuf};

use super::external_data_files;
use crate::depth::{Adapter, adapter, detect};

/// A published depth network. Size and digest are those that several public projects state and check; `tmpi models get` keeps no other
/// file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PublishedModel {
    /// Name by which users choose it.
    pub name: &'static str,
    /// Name of its adapter in [`crate::depth::ADAPTERS`].
    pub adapter: &'static str,
    /// Address of its ONNX file.
    pub url: &'static str,
    /// Size of the file in bytes.
    pub bytes: u64,
    /// SHA-256 of the file, in hexadecimal.
    pub sha256: &'static str,
    /// The file of weights beside it, if it has one.
    pub weights: Option<Weights>,
    /// Licence and owner of the weights.
    pub licence: &'static str,
}

/// A published file of weights that an ONNX file names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Weights {
    /// Address.
    pub url: &'static str,
    /// Size of the file in bytes.
    pub bytes: u64,
    /// SHA-256 of the file, in hexadecimal.
    pub sha256: &'static str,
}

/// The published network to fetch if there is none: of the kinds whose maps were inspected here, the smallest download of the best.
pub const BETTER: &str = "depth-anything-v2-small-fp16";

/// Adapters from best to worst: papers report smaller errors on unseen data for each than for those after it. MoGe-2 comes first because it
/// reports sharper edges, along which planes are cut. Depth Anything 3 reports smaller errors on distances than 2, at fewer pixels.
const RANKS: [&str; 11] = [
    "moge-2",
    "depth-anything-3",
    "depth-anything-v2",
    "depth-anything-v2-metric",
    "dpt-large",
    "dpt-hybrid",
    "midas-v2.1",
    "midas-v2.1-hub",
    "midas-v2.1-small",
    "midas-v2.1-small-hub",
    "tmpi",
];

/// Adapters of networks that are available only as files, and the licences of their weights.
pub const BY_FILE: [(&str, &str); 6] = [
    ("midas-v2.1", "MIT, Intel ISL"),
    ("midas-v2.1-hub", "MIT, Intel ISL"),
    ("midas-v2.1-small-hub", "MIT, Intel ISL"),
    ("dpt-large", "MIT, Intel ISL"),
    ("dpt-hybrid", "MIT, Intel ISL"),
    ("depth-anything-v2-metric", "small: Apache-2.0, larger ones: CC BY-NC 4.0, the Depth Anything V2 authors"),
];

/// All networks that `tmpi models get` can fetch.
pub const PUBLISHED: [PublishedModel; 5] = [
    PublishedModel {
        name: BETTER,
        adapter: "depth-anything-v2",
        url: "https://huggingface.co/onnx-community/depth-anything-v2-small/resolve/4472b7362082ad9968fee890ca0f1e5aca36b93d/onnx/model_fp16.onnx",
        bytes: 49_642_442,
        sha256: "2df6223f206b5164e21f664ace61dabeb9bb6a49b8b5a3e00510b4807d0f5b04",
        weights: None,
        licence: "Apache-2.0, the Depth Anything V2 authors",
    },
    PublishedModel {
        name: "midas-v2.1-small",
        adapter: "midas-v2.1-small",
        url: "https://github.com/isl-org/MiDaS/releases/download/v2_1/model-small.onnx",
        bytes: 66_764_249,
        sha256: "2d8c6cb8f415229daf1eb041024208e2608c9f98e17c81cc7c6ecb449c56fd58",
        weights: None,
        licence: "MIT, Intel ISL",
    },
    PublishedModel {
        name: "depth-anything-v2-small",
        adapter: "depth-anything-v2",
        url: "https://huggingface.co/onnx-community/depth-anything-v2-small/resolve/4472b7362082ad9968fee890ca0f1e5aca36b93d/onnx/model.onnx",
        bytes: 99_060_839,
        sha256: "afb6a5c28f3b6bf1618c6e43f02073ef9dfdc70e937502d51603e57b0a1df10c",
        weights: None,
        licence: "Apache-2.0, the Depth Anything V2 authors",
    },
    PublishedModel {
        name: "depth-anything-3-small",
        adapter: "depth-anything-3",
        url: "https://huggingface.co/onnx-community/depth-anything-v3-small/resolve/0b6a7f3bf5595f9950b91389e0da3a0de130324c/onnx/model.onnx",
        bytes: 640_691,
        sha256: "396008798244a074297fd88e450433b1357fc687f534939375c804ded86e7b2a",
        weights: Some(Weights {
            url: "https://huggingface.co/onnx-community/depth-anything-v3-small/resolve/0b6a7f3bf5595f9950b91389e0da3a0de130324c/onnx/model.onnx_data",
            bytes: 104_702_464,
            sha256: "802bb24741e67f5bb2b369fc64d40afe11439cc895d676d658d65cfb75c9860f",
        }),
        licence: "Apache-2.0, ByteDance",
    },
    PublishedModel {
        name: "moge-2-small",
        adapter: "moge-2",
        url: "https://huggingface.co/Ruicheng/moge-2-vits-normal-onnx/resolve/e50ffda41565591092adea54c6ac83d6212e1e23/model.onnx",
        bytes: 140_852_051,
        sha256: "24eacb5dc7a2c54c7bc98f7de085ffbed79ad006ea5b664c2c2cdc02ff3a52f0",
        weights: None,
        licence: "MIT, Microsoft; its encoder DINOv2 Apache-2.0, Meta AI",
    },
];

impl PublishedModel {
    /// Its adapter.
    pub fn adapter(&self) -> Option<&'static Adapter> {
        adapter(self.adapter)
    }

    /// Its file in [`folder`].
    pub fn file(&self) -> PathBuf {
        folder().join(format!("{}.onnx", self.name))
    }

    /// Size of all its files in bytes.
    pub fn total(&self) -> u64 {
        self.bytes + self.weights.map_or(0, |w| w.bytes)
    }
}

/// Index in [`RANKS`] of a network by its name in reports; `None` if it has no rank.
fn rank(network: &str) -> Option<usize> {
    let known = RANKS.iter().enumerate().filter(|(_, kind)| network.starts_with(**kind));
    // the names of some kinds begin with those of others
    known.max_by_key(|(_, kind)| kind.len()).map(|(at, _)| at)
}

/// Kinds that are worse than a network, given by its name in reports, from best to worst. A network's name begins with its kind, and no
/// better kind's name begins with that of a worse one. Empty if the network has no rank.
pub fn better_than(network: &str) -> &'static [&'static str] {
    rank(network).map_or(&[], |at| &RANKS[at + 1..])
}

/// The published network worth fetching for users of `network`, a name in reports; `None` if that is as good or unknown.
pub fn recommended_download(network: &str) -> Option<&'static PublishedModel> {
    let better = published(BETTER)?;
    (rank(network)? > rank(better.adapter)?).then_some(better)
}

/// Finds a published network by name.
pub fn published(name: &str) -> Option<&'static PublishedModel> {
    PUBLISHED.iter().find(|p| p.name == name)
}

/// Folder of downloaded networks: `TMPI_MODELS`, else the user's data folder, else `models` in the current directory.
pub fn folder() -> PathBuf {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let data = || {
        if cfg!(windows) { set("LOCALAPPDATA") } else { set("XDG_DATA_HOME").or_else(|| set("HOME").map(|home| home.join(".local/share"))) }
    };
    set("TMPI_MODELS").or_else(|| data().map(|d| d.join("tmpi/models"))).unwrap_or_else(|| "models".into())
}

/// Folder that ships with the program: `models` beside the executable.
fn shipped() -> Option<PathBuf> {
    Some(std::env::current_exe().ok()?.parent()?.join("models"))
}

/// The best network in [`folder`], else among those that ship with the program.
pub fn default_model() -> Option<(&'static Adapter, PathBuf)> {
    best_in(&folder()).or_else(|| best_in(&shipped()?))
}

/// The best network among the ONNX files of `folder`: by kind, then the larger file, then by name. Skips files that do not identify their
/// network, or whose file of weights is missing. `None` if no file is left.
pub fn best_in(folder: &Path) -> Option<(&'static Adapter, PathBuf)> {
    let files = std::fs::read_dir(folder).ok()?.filter_map(|entry| {
        let (file, bytes) = entry.ok().and_then(|e| Some((e.path(), e.metadata().ok()?.len())))?;
        let onnx = file.extension().is_some_and(|e| e.eq_ignore_ascii_case("onnx")) && file.is_file();
        let network = detect(&file).filter(|_| onnx && external_data_files(&file).is_ok())?;
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
    fn every_entry_is_complete() {
        for p in &PUBLISHED {
            assert!(p.adapter().is_some(), "{}", p.name);
            assert!(p.sha256.parse::<Digest>().is_ok() && p.bytes > 0 && p.url.starts_with("https://"), "{}", p.name);
            assert!(
                p.weights.is_none_or(|w| w.sha256.parse::<Digest>().is_ok() && w.bytes > 0 && w.url.starts_with("https://")),
                "{}",
                p.name
            );
            assert_eq!(detect(&p.file()).map(|a| a.name), Some(p.adapter), "its name identifies its adapter");
            assert_eq!(published(p.name), Some(p));
        }
        assert_eq!(published("no such"), None);
        assert!(published(BETTER).is_some());
    }

    #[test]
    fn every_adapter_has_a_rank() {
        for a in &crate::depth::ADAPTERS {
            assert_eq!(RANKS.iter().filter(|r| **r == a.name).count(), 1, "{}", a.name);
        }
    }

    #[test]
    fn every_ranked_network_has_a_licence() {
        for name in RANKS.iter().filter(|name| **name != "tmpi") {
            let fetched = PUBLISHED.iter().any(|p| p.adapter == *name);
            assert_eq!(BY_FILE.iter().filter(|(adapter, _)| adapter == name).count(), usize::from(!fetched), "{name}");
        }
    }

    #[test]
    fn no_name_of_a_better_kind_begins_with_a_worse_one() {
        for (at, kind) in RANKS.iter().enumerate() {
            assert_eq!(rank(kind), Some(at));
            assert!(!better_than(kind).iter().any(|worse| kind.starts_with(worse)), "{kind}");
            assert_eq!(better_than(kind).len(), RANKS.len() - 1 - at, "{kind}");
        }
        assert!(better_than("depth-anything-v2-small-fp16").contains(&"depth-anything-v2-metric"));
        assert!(!better_than("depth-anything-v2-metric-indoor").contains(&"depth-anything-v2"));
        assert_eq!((better_than("tmpi"), better_than("of-my-own")), (&[][..], &[][..]));
    }

    #[test]
    fn the_better_network_is_worth_fetching_unless_there_is_one_as_good() {
        for worse in ["tmpi", "midas-v2.1-small", "dpt-large", "depth-anything-v2-metric-small"] {
            assert_eq!(recommended_download(worse).map(|p| p.name), Some(BETTER), "{worse}");
        }
        for as_good in [BETTER, "depth-anything-v2-large", "depth-anything-3-small", "moge-2-small", "of-my-own"] {
            assert_eq!(recommended_download(as_good), None, "{as_good}");
        }
    }

    #[test]
    fn the_best_network_of_a_folder_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let put = |name: &str, bytes: usize| std::fs::write(folder.path().join(name), vec![0; bytes]).unwrap();
        let found = || best_in(folder.path()).map(|(a, file)| (a.name, file.file_name().unwrap().to_str().unwrap().to_owned()));
        assert_eq!(best_in(Path::new("no/such/folder")), None);
        assert_eq!(found(), None);
        put("notes.txt", 9);
        put("model.onnx", 9);
        put("depth-anything-v2-small.onnx.part", 9);
        std::fs::create_dir(folder.path().join("dpt-large.onnx")).unwrap();
        assert_eq!(found(), None, "no file identifies its network");
        put("midas-v2.1-small.onnx", 50);
        assert_eq!(found().unwrap().0, "midas-v2.1-small");
        put("depth-anything-v2-small-fp16.onnx", 5);
        assert_eq!(found(), Some(("depth-anything-v2", "depth-anything-v2-small-fp16.onnx".into())));
        put("depth_anything_v2_vitb.ONNX", 7);
        assert_eq!(found().unwrap().1, "depth_anything_v2_vitb.ONNX", "the larger one of a kind");
        put("moge-2-small.onnx", 9);
        assert_eq!(found().unwrap().0, "moge-2");
        std::fs::remove_file(folder.path().join("moge-2-small.onnx")).unwrap();
        std::fs::write(folder.path().join("depth-anything-3-small.onnx"), include_bytes!("../../../../../tests/onnx/views.onnx")).unwrap();
        assert_eq!(found().unwrap().0, "depth-anything-v2", "without its weights it does not count");
        put("depth-anything-3-small.onnx_data", 8);
        assert_eq!(found().unwrap().0, "depth-anything-3");
    }
}
