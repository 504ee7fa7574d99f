//! Command-line flags that choose depth networks, for every program that runs them.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::models::Settings;
use super::models::registry::{PUBLISHED, PublishedModel, default_model, published};
use super::{Config, Provider};
use crate::depth::{ADAPTERS, Adapter, adapter, detect};

/// Which networks to use, and how.
#[derive(Clone, Debug, clap::Args)]
pub struct ModelFlags {
    /// Depth network: auto uses the best in the folder of networks (`tmpi models list`), else the embedded one, tmpi. Or its name, with
    /// its ONNX file unless it is embedded or was fetched by `tmpi models get`. Or a file alone, if its name or graph identifies the
    /// network
    #[arg(long, value_parser = depth_model, default_value = "auto", value_name = "auto|NAME[=FILE]|FILE", env = "TMPI_DEPTH_MODEL")]
    pub depth_model: DepthModel,
    /// Pixels at which the depth network sees a photo, if not its own best number; its time grows with them
    #[arg(long, value_parser = clap::value_parser!(u32).range(1024..=2_000_000), value_name = "PIXELS")]
    pub depth_pixels: Option<u32>,
    /// How strongly to smooth the depth network's map up to the photo's edges, against haloes, 0 to 1000000; 0: not at all
    #[arg(long, value_parser = |text: &str| up_to(text, 1e6), value_name = "N")]
    pub depth_smoothing: Option<f64>,
    /// How much of a vertical ramp, nearer at the bottom, to add to the depth network's map, 0 to 10 times its deviation
    #[arg(long, value_parser = |text: &str| up_to(text, 10.0), value_name = "N")]
    pub depth_ramp: Option<f64>,
    /// Whether to average depth with that of the mirrored photo, which takes twice the time. By default the embedded network does so for
    /// photos, and no other does
    #[arg(long, num_args = 0..=1, require_equals = true, default_missing_value = "true", value_name = "true|false")]
    pub flip: Option<bool>,
    /// Threads of a network; 0: all cores
    #[arg(long, value_parser = clap::value_parser!(u16).range(0..=1024), default_value_t = 0, value_name = "N")]
    pub threads: u16,
    /// What computes networks, best first, separated by commas; without cpu, a missing provider is an error
    #[arg(long, value_enum, value_delimiter = ',', default_value = "cpu", value_name = "PROVIDER")]
    pub provider: Vec<Provider>,
}

impl ModelFlags {
    /// The settings that the flags describe.
    pub fn settings(&self) -> Settings {
        let onnx = Config { threads: self.threads.into(), providers: self.provider.clone() };
        let DepthModel { adapter, file, .. } = &self.depth_model;
        let Self { depth_pixels, depth_smoothing, depth_ramp, flip, .. } = *self;
        Settings { depth: adapter, depth_file: file.clone(), depth_pixels, depth_smoothing, depth_ramp, flip, onnx, ..Settings::default() }
    }

    /// The settings of rooms, whose depth network is `live`; `None` if they are those of photos. Flags for pixels, smoothing, ramp and
    /// the mirrored photo describe the photos' network, and apply to rooms only if they use the same one.
    pub fn for_rooms(&self, live: &DepthModel) -> Option<Settings> {
        let photos = self.settings();
        let (depth, depth_file) = (live.adapter, live.file.clone());
        if photos.depth != depth || photos.depth_file != depth_file {
            let depth_ramp = Some(depth.ramp_of_rooms);
            return Some(Settings {
                depth,
                depth_file,
                depth_pixels: None,
                depth_smoothing: None,
                depth_ramp,
                flip: Some(false),
                ..photos
            });
        }
        let rooms = self.settings_of_rooms();
        let way = |settings: &Settings| (settings.depth_ramp.unwrap_or(depth.ramp).to_bits(), settings.flip.unwrap_or(depth.flip));
        (way(&rooms) != way(&photos)).then_some(rooms)
    }

    /// The settings that the flags describe for rooms.
    pub fn settings_of_rooms(&self) -> Settings {
        let settings = self.settings();
        let depth_ramp = Some(settings.depth_ramp.unwrap_or(settings.depth.ramp_of_rooms));
        Settings { depth_ramp, flip: Some(settings.flip.unwrap_or(false)), ..settings }
    }

    /// These settings with another network.
    pub fn with_network(&self, depth: &'static Adapter, file: PathBuf) -> Settings {
        Settings { depth, depth_file: Some(file), ..self.settings() }
    }
}

/// A depth network as chosen on the command line.
#[derive(Clone, Debug)]
pub struct DepthModel {
    /// Whether the choice is left to the program.
    pub auto: bool,
    adapter: &'static Adapter,
    file: Option<PathBuf>,
}

/// Parses a depth network: its name, its file, or both.
///
/// # Errors
/// A text for the user if there is no such network, or if its file is unknown.
pub fn depth_model(text: &str) -> Result<DepthModel, String> {
    if text == "auto" {
        let (adapter, file) = default_model().map_or((&ADAPTERS[0], None), |(adapter, file)| (adapter, Some(file)));
        return Ok(DepthModel { auto: true, adapter, file });
    }
    let (name, file) = text.split_once('=').map_or((text, None), |(n, f)| (n, Some(PathBuf::from(f))));
    let fetched = published(name);
    let known = || {
        let names =
            ["auto"].into_iter().chain(ADAPTERS.iter().map(|a| a.name)).chain(PUBLISHED.iter().map(|p| p.name)).collect::<BTreeSet<_>>();
        names.into_iter().collect::<Vec<_>>().join(", ")
    };
    let Some(adapter) = adapter(name).or_else(|| fetched?.adapter()) else {
        let path = Path::new(text);
        if !path.extension().is_some_and(|e| e.eq_ignore_ascii_case("onnx")) || name != text && !path.is_file() {
            return Err(format!("the name must be one of {}", known()));
        }
        let adapter =
            detect(path).ok_or_else(|| format!("{text} does not identify its network: write NAME={text} with one of {}", known()))?;
        return Ok(DepthModel { auto: false, adapter, file: Some(path.to_owned()) });
    };
    let file = file.or_else(|| fetched.map(PublishedModel::file).filter(|f| f.is_file()));
    if file.is_none() && adapter.name != ADAPTERS[0].name {
        let how = fetched.map_or_else(String::new, |p| format!(", or run tmpi models get {}", p.name));
        return Err(format!("{name} is not embedded: write {name}=FILE with its ONNX file{how}"));
    }
    Ok(DepthModel { auto: false, adapter, file })
}

/// Parses a number from 0 to `most`.
fn up_to(text: &str, most: f64) -> Result<f64, String> {
    let value: f64 = text.trim().parse().map_err(|_| format!("{text:?} is not a number"))?;
    if (0.0..=most).contains(&value) { Ok(value) } else { Err(format!("{text} is not between 0 and {most}")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_within_their_range() {
        assert_eq!((up_to("0", 10.0), up_to(" 10", 10.0)), (Ok(0.0), Ok(10.0)));
        assert!(["-0.1", "10.1", "nan", "inf", "ten"].iter().all(|text| up_to(text, 10.0).is_err()));
    }

    #[test]
    fn depth_models_are_parsed_by_name() {
        assert!(depth_model("tmpi").is_ok());
        assert!(depth_model("depth-anything-v2").unwrap_err().contains("=FILE"));
        assert_eq!(depth_model("dpt-large=a=b.onnx").unwrap().file.unwrap(), PathBuf::from("a=b.onnx"));
        assert!(depth_model("nosuch").unwrap_err().contains("midas-v2.1"));
        assert!(depth_model("nosuch=dpt-large.onnx").unwrap_err().contains("one of"));
        let alone = depth_model("nets/dpt-large/model.onnx").unwrap();
        assert_eq!((alone.adapter.name, alone.file.unwrap()), ("dpt-large", PathBuf::from("nets/dpt-large/model.onnx")));
        assert!(depth_model("nets/model.onnx").unwrap_err().contains("NAME=nets/model.onnx"));
    }

    #[test]
    fn rooms_have_their_own_network_unless_photos_use_the_same() {
        #[derive(clap::Parser)]
        struct Args {
            #[command(flatten)]
            models: ModelFlags,
        }
        let of = |args: &[&str]| <Args as clap::Parser>::try_parse_from([&["tmpi"], args].concat()).unwrap().models;
        let embedded = depth_model("tmpi").unwrap();
        let large = of(&["--depth-model", "depth-anything-v2=a.onnx", "--depth-pixels", "300000", "--flip"]);
        let rooms = large.for_rooms(&embedded).unwrap();
        assert_eq!((rooms.depth.name, rooms.depth_file, rooms.depth_pixels, rooms.flip), ("tmpi", None, None, Some(false)));
        let other = large.for_rooms(&depth_model("midas-v2.1-small=b.onnx").unwrap()).unwrap();
        assert_eq!((other.depth.name, other.depth_file), ("midas-v2.1-small", Some(PathBuf::from("b.onnx"))));
        // a network that both use is loaded once
        assert!(large.for_rooms(&depth_model("depth-anything-v2=a.onnx").unwrap()).is_none());
        assert!(of(&["--depth-model", "tmpi", "--depth-ramp", "0.1", "--flip"]).for_rooms(&embedded).is_none());
        // rooms have more of a ramp, and a single run
        let own = of(&["--depth-model", "tmpi", "--depth-pixels", "9000"]);
        let rooms = own.for_rooms(&embedded).unwrap();
        assert_eq!((rooms.depth.name, rooms.depth_pixels, rooms.depth_ramp), ("tmpi", Some(9000), Some(ADAPTERS[0].ramp_of_rooms)));
        assert_eq!((rooms.flip, own.settings().flip, of(&["--flip=false"]).settings().flip), (Some(false), None, Some(false)));
        assert!(ADAPTERS[0].ramp_of_rooms > ADAPTERS[0].ramp && own.settings().depth_ramp.is_none());
    }
}
