//! The networks of a process: embedded or from files, loaded when they are first needed.
//!
//! The command line and the server both get their [`Models`] from [`load`].

pub mod download;
pub mod registry;

use std::fs::File;
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::Models;
use crate::depth::{ADAPTERS, Adapter, DepthError, Estimate, Estimator, Monocular, SizeRule};
use crate::networks::library::Once;
use crate::networks::{Config, ExternalData, Network, OnnxError, Provider, Session, Tensor, onnx_graph};
use tmpi_core::{DisparityMap, Photo};

#[cfg(embedded = "depth")]
const DEPTH: Option<&[u8]> = Some(include_bytes!("../../../../../models/depth.onnx"));
#[cfg(not(embedded = "depth"))]
const DEPTH: Option<&[u8]> = None;

/// File of Θ in the folder of networks. No default needs Θ or Ψ, so no program embeds them.
pub const THETA: &str = "theta.onnx";
/// File of Ψ, see [`THETA`].
pub const PSI: &str = "psi.onnx";

/// Which networks to use, and how.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Depth network.
    pub depth: &'static Adapter,
    /// Its ONNX file; `None`: the embedded one.
    pub depth_file: Option<PathBuf>,
    /// Pixels to which a photo is resampled for it, instead of its own choice; a file of fixed size overrides it.
    pub depth_pixels: Option<u32>,
    /// Strength with which its map is smoothed up to the photo's edges, instead of its own; 0: none.
    pub depth_smoothing: Option<f64>,
    /// Share of a vertical ramp that is added to its map, instead of its own.
    pub depth_ramp: Option<f64>,
    /// Whether to average depth with that of the mirrored photo, which takes a second run; `None`: as the adapter says.
    pub flip: Option<bool>,
    /// Folder of [`THETA`] and [`PSI`], if their files exist.
    pub folder: PathBuf,
    /// How networks are run.
    pub onnx: Config,
}

impl Settings {
    /// Name of the depth network in reports: that of its file if it says more than the adapter's.
    pub fn name(&self) -> &str {
        let stem = self.depth_file.as_deref().and_then(Path::file_stem).and_then(|s| s.to_str());
        stem.filter(|s| s.starts_with(self.depth.name)).unwrap_or(self.depth.name)
    }
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            depth: &ADAPTERS[0],
            depth_file: None,
            depth_pixels: None,
            depth_smoothing: None,
            depth_ramp: None,
            flip: None,
            folder: registry::folder(),
            onnx: Config::default(),
        }
    }
}

/// A model file cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("model file {file}: {source}")]
pub struct ModelFileError {
    /// The file.
    pub file: PathBuf,
    /// The system's error.
    pub source: std::io::Error,
}

/// The networks that `settings` describe. The depth network's file is read at once, but networks and ONNX Runtime are loaded at their
/// first run: a photo with a depth map needs neither. Θ and Ψ exist only if their files do.
///
/// # Errors
/// [`ModelFileError`] if the depth network's file or one of its files of weights cannot be read.
pub fn load(settings: &Settings) -> Result<Models, ModelFileError> {
    let whole = |file: &Path| Ok((read(file)?, weights(file)?));
    let model = settings.depth_file.as_deref().map(whole).transpose()?;
    let depth = Depth { settings: settings.clone(), model, loaded: Once::new() };
    let lazily = |name: &'static str| {
        let (file, config) = (settings.folder.join(name), settings.onnx.clone());
        file.is_file().then(|| Arc::new(Lazy { name, file, config, loaded: Once::new() }) as Arc<dyn Network>)
    };
    Ok(Models { depth: Arc::new(depth), theta: lazily(THETA), psi: lazily(PSI) })
}

/// The files of weights that a model file names, with the names that it uses. Each lies beside it, under that name or under that of the
/// model file with `_data` appended, as `tmpi models get` stores it. Empty for a file that is not an ONNX file.
///
/// # Errors
/// [`ModelFileError`] if one is missing, or if its name points to another folder.
pub fn external_data_files(file: &Path) -> Result<Vec<(String, PathBuf)>, ModelFileError> {
    let failed = |source| ModelFileError { file: file.to_owned(), source };
    let names = onnx_graph(&mut BufReader::new(File::open(file).map_err(failed)?)).map_or_else(Vec::new, |o| o.external_data);
    let find = |name: String| {
        let own = file.with_extension("onnx_data");
        let plain = Path::new(&name).file_name().is_some_and(|n| n == name.as_str());
        let found = [own, file.with_file_name(&name)].into_iter().find(|f| plain && f.is_file());
        let missing = || {
            failed(io::Error::new(
                io::ErrorKind::NotFound,
                format!("its weights are in a file of their own, {name}, which is not beside it"),
            ))
        };
        let path = found.ok_or_else(missing)?;
        Ok((name, path))
    };
    names.into_iter().map(find).collect()
}

fn weights(file: &Path) -> Result<Vec<ExternalData>, ModelFileError> {
    external_data_files(file)?.into_iter().map(|(name, file)| Ok((name, read(&file)?.into()))).collect()
}

fn read(file: &Path) -> Result<Vec<u8>, ModelFileError> {
    std::fs::read(file).map_err(|source| ModelFileError { file: file.to_owned(), source })
}

/// A network that is loaded at its first run.
struct Lazy {
    name: &'static str,
    file: PathBuf,
    config: Config,
    loaded: Once<Session>,
}

impl Network for Lazy {
    fn run(&self, inputs: Vec<Tensor>) -> Result<Vec<Tensor>, OnnxError> {
        let load = || {
            let model = read(&self.file).map_err(|e| OnnxError::Model { name: self.name.to_owned(), reason: e.to_string() })?;
            Session::load(self.name, &model, &[], &self.config)
        };
        self.loaded.get(load)?.run(inputs)
    }
}

/// A depth network that is loaded at its first run.
struct Depth {
    settings: Settings,
    model: Option<(Vec<u8>, Vec<ExternalData>)>,
    loaded: Once<Monocular>,
}

impl Depth {
    fn get(&self) -> Result<&Monocular, DepthError> {
        let Settings { depth, depth_pixels, depth_smoothing, depth_ramp, flip, onnx, .. } = &self.settings;
        let loaded = self.loaded.get(|| {
            let embedded = DEPTH.filter(|_| *depth == &ADAPTERS[0]);
            let file = self.model.as_ref().map(|(model, external_data)| (model.as_slice(), external_data.as_slice()));
            let (model, external_data) = file.or(embedded.map(|model| (model, [].as_slice()))).ok_or_else(|| OnnxError::Model {
                name: depth.name.to_owned(),
                reason: "it is not embedded in this program: name its ONNX file, or give a depth map".into(),
            })?;
            let size = depth_pixels.map_or(depth.size, SizeRule::Area);
            let (smoothing, ramp) = (depth_smoothing.unwrap_or(depth.smoothing), depth_ramp.unwrap_or(depth.ramp));
            let adapter = Adapter { size, smoothing, ramp, flip: flip.unwrap_or(depth.flip), ..**depth };
            Monocular::load(&adapter, model, external_data, onnx)
        });
        loaded.map_err(|e: OnnxError| e.into())
    }
}

impl Estimator for Depth {
    fn name(&self) -> &str {
        self.settings.name()
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        self.get()?.estimate(photo)
    }

    fn raw(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        self.get()?.raw(photo)
    }

    fn sizes(&self, width: u32, height: u32) -> Vec<(u32, u32)> {
        self.get().map_or_else(|_| Vec::new(), |network| network.sizes(width, height))
    }

    fn may_use_device(&self) -> bool {
        self.settings.onnx.providers.iter().any(|provider| *provider != Provider::Cpu)
    }

    fn estimate_at(&self, photo: &Photo, size: (u32, u32)) -> Result<Estimate, DepthError> {
        self.get()?.estimate_at(photo, size)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_file_is_an_error_at_once_and_a_bad_one_at_the_first_run() {
        let settings = Settings { depth_file: Some("no/such.onnx".into()), ..Settings::default() };
        assert!(load(&settings).err().unwrap().to_string().contains("no/such.onnx"));
        let settings = Settings { depth_file: Some("Cargo.toml".into()), ..Settings::default() };
        let models = load(&settings).unwrap();
        assert_eq!(models.depth.name(), "tmpi");
        let photo = Photo { width: 2, height: 2, rgb: vec![[0; 3]; 4] };
        assert!(matches!(models.depth.estimate(&photo), Err(DepthError::Onnx(_))));
    }

    #[test]
    fn weights_are_found_under_the_models_name_for_them_or_that_of_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let tests = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/onnx"));
        let file = folder.path().join("depth-anything-3-small.onnx");
        std::fs::copy(tests.join("views.onnx"), &file).unwrap();
        let error = load(&Settings { depth_file: Some(file.clone()), ..Settings::default() }).err().unwrap().to_string();
        assert!(error.contains("depth-anything-3-small.onnx") && error.contains("a file of their own, views.onnx_data"), "{error}");
        let found = |name: &str| {
            std::fs::copy(tests.join("views.onnx_data"), folder.path().join(name)).unwrap();
            external_data_files(&file).unwrap()
        };
        assert_eq!(found("views.onnx_data"), [("views.onnx_data".to_owned(), folder.path().join("views.onnx_data"))]);
        assert_eq!(found("depth-anything-3-small.onnx_data")[0].1, folder.path().join("depth-anything-3-small.onnx_data"));
        assert_eq!(external_data_files(&tests.join("mean.onnx")).unwrap(), []);
        let astray = std::fs::read(&file).unwrap().iter().map(|b| if *b == b'v' { b'/' } else { *b }).collect::<Vec<_>>();
        let elsewhere = folder.path().join("elsewhere.onnx");
        std::fs::write(&elsewhere, astray).unwrap();
        std::fs::write(folder.path().join("elsewhere.onnx_data"), b"").unwrap();
        assert!(external_data_files(&elsewhere).is_err(), "a path, not a name");
    }

    #[test]
    fn options_that_need_a_network_need_its_file() {
        use crate::{Denoise, Options, StageError, Switch};
        let folder = tempfile::tempdir().unwrap();
        let settings = Settings { folder: folder.path().to_owned(), ..Settings::default() };
        let wanting = [
            (Options { denoise: Denoise::Theta, ..Options::default() }, "denoise", THETA),
            (Options { refine: Switch::On, ..Options::default() }, "refine", PSI),
        ];
        for (options, option, file) in wanting {
            let models = load(&settings).unwrap();
            let error = models.check(&options).unwrap_err();
            assert!(matches!(error, StageError::Network { field, .. } if field == option), "{error}");
            assert!(error.to_string().contains(file), "{error}");
            assert!(models.check(&Options::default()).is_ok());
            std::fs::write(folder.path().join(file), b"").unwrap();
            assert!(load(&settings).unwrap().check(&options).is_ok());
        }
    }

    #[test]
    fn a_network_that_is_not_embedded_needs_a_file() {
        let settings = Settings { depth: crate::depth::adapter("dpt-large").unwrap(), ..Settings::default() };
        let photo = Photo { width: 2, height: 2, rgb: vec![[0; 3]; 4] };
        let error = load(&settings).unwrap().depth.estimate(&photo).unwrap_err().to_string();
        assert!(error.contains("dpt-large") && error.contains("ONNX file"), "{error}");
    }
}
