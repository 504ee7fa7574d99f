//! Flags that several commands share. Ranges are those of [`Options::validate`]; an error names flag and range.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use tmpi_core::ViewBox;
use tmpi_pipeline::depth::{ADAPTERS, Adapter, DepthKind, adapter, detect};
use tmpi_pipeline::networks::models::Settings;
use tmpi_pipeline::networks::models::registry::{PUBLISHED, Published, published, usual};
use tmpi_pipeline::networks::{Config, Provider};
use tmpi_pipeline::strokes::Stroke;
use tmpi_pipeline::{Denoise, Options, PlaneCount, PlaneMethod, Switch, TileSize};

/// How a photo is read and its depth found.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct DepthFlags {
    /// Depth that the photo brings along (Google's depth map metadata, Dynamic Depth, portraits of iPhones sent as JPEG); on: fail without
    #[arg(long, value_enum, default_value_t, value_name = "SWITCH")]
    pub photo_depth: Switch,
    /// Cleaning of the depth map
    #[arg(long, value_enum, default_value_t, value_name = "METHOD")]
    pub denoise: Denoise,
    /// Snapping of blurred depth edges to colour edges
    #[arg(long, value_enum, default_value_t, value_name = "SWITCH")]
    pub snap: Switch,
    /// Longest side in pixels; larger photos are reduced
    #[arg(long, value_parser = max_size, value_name = "PX")]
    pub max_size: Option<u32>,
}

impl DepthFlags {
    /// The options that the flags stand for; all others are the usual ones.
    pub(super) fn options(&self) -> Options {
        let Self { photo_depth, snap, denoise, max_size } = *self;
        Options { photo_depth, snap, denoise, max_size, ..Options::default() }
    }
}

/// How a photo is made.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct MakeFlags {
    #[command(flatten)]
    pub depth: DepthFlags,
    /// How the values of the depth map are meant
    #[arg(long, value_enum, default_value_t, value_name = "KIND")]
    pub depth_kind: DepthKind,
    /// Horizontal field of view of the photo in degrees; without it EXIF, else 81.5
    #[arg(long, value_parser = fov_x, value_name = "DEG")]
    pub fov_x: Option<f64>,
    /// Planes a tile: the fewest that meet --max-error, or a fixed number
    #[arg(long, value_parser = planes, default_value = "auto", value_name = "auto|N")]
    pub planes: PlaneCount,
    /// How planes are placed
    #[arg(long, value_enum, default_value_t, value_name = "METHOD")]
    pub plane_method: PlaneMethod,
    /// Tile size in pixels, or one tile for the whole photo
    #[arg(long, value_parser = tile, default_value = "64", value_name = "H|full")]
    pub tile: TileSize,
    /// Refinement of layers by the network psi.onnx in the folder of networks (`TMPI_MODELS`); auto: none
    #[arg(long, value_enum, default_value_t, value_name = "SWITCH")]
    pub refine: Switch,
    /// Picture quality, 1 to 100
    #[arg(long, value_parser = quality, default_value = "90", value_name = "1-100")]
    pub quality: u8,
    /// Parallax error that planes may leave, in pixels: over a view box that is given, else over one of 0.03
    #[arg(long, value_parser = max_error, default_value = "0.5", value_name = "PX")]
    pub max_error: f64,
    /// Half extents of the box of camera positions, in units of the nearest distance; viewers go half as far as the usual one by
    /// themselves
    #[arg(long, value_parser = view_box, default_value = "0.12,0.12,0.06", value_name = "X,Y,Z")]
    pub view_box: ViewBox,
    /// Milliseconds that making may take: the size and a parallax error of --max-error or more are chosen for it, by the costs
    /// that `tmpi bench` found on this machine (a file named by `TMPI_COSTS`)
    #[arg(long, value_parser = budget_ms, value_name = "MS")]
    pub budget_ms: Option<f64>,
    /// Measure what leaving out texels that are never seen changes at the corners of the view box; takes about as long as making
    #[arg(long)]
    pub verify_prune: bool,
    /// Strokes that put the depth of the photo right, a JSON file as the server's /v1/photos/ID/strokes gives it
    #[arg(long, value_parser = strokes, value_name = "FILE.json")]
    pub strokes: Option<Strokes>,
}

/// Strokes of a file.
#[derive(Clone, Debug, Default)]
pub(super) struct Strokes(Vec<Stroke>);

impl MakeFlags {
    /// The options that the flags stand for.
    pub(super) fn options(&self) -> Options {
        Options {
            depth_kind: self.depth_kind,
            fov_x: self.fov_x,
            planes: self.planes,
            plane_method: self.plane_method,
            tile: self.tile,
            refine: self.refine,
            quality: self.quality,
            max_error: self.max_error,
            view_box: self.view_box,
            budget_ms: self.budget_ms,
            verify_prune: self.verify_prune,
            strokes: self.strokes.clone().unwrap_or_default().0,
            ..self.depth.options()
        }
    }
}

/// Which networks are used, and how.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ModelFlags {
    /// Depth network: auto for the best in the folder of networks (`tmpi models list`), else the embedded one, which is tmpi; or its name,
    /// and its ONNX file unless it is embedded or was fetched by `tmpi models get`; a file alone where its name or its graph tells the network
    #[arg(long, value_parser = depth_model, default_value = "auto", value_name = "auto|NAME[=FILE]|FILE", env = "TMPI_DEPTH_MODEL")]
    pub depth_model: DepthModel,
    /// Pixels at which the depth network sees a photo, if not those that it is best at: its time grows with them
    #[arg(long, value_parser = clap::value_parser!(u32).range(1024..=2_000_000), value_name = "PIXELS")]
    pub depth_pixels: Option<u32>,
    /// How strongly the map of the depth network is smoothed up to the photo's edges, against haloes, 0 to 1000000; 0: not at all
    #[arg(long, value_parser = strength, value_name = "N")]
    pub depth_smoothing: Option<f64>,
    /// How much of a vertical ramp, nearer below, the map of the depth network gains, 0 to 10 times its deviation
    #[arg(long, value_parser = share_of_ramp, value_name = "N")]
    pub depth_ramp: Option<f64>,
    /// Whether depth is the mean with that of the mirrored photo, which takes twice the time, if not as the network is best: the embedded
    /// one has it for photos, no other does
    #[arg(long, num_args = 0..=1, require_equals = true, default_missing_value = "true", value_name = "true|false")]
    pub flip: Option<bool>,
    /// Threads of a network; 0: all cores
    #[arg(long, value_parser = clap::value_parser!(u16).range(0..=1024), default_value_t = 0, value_name = "N")]
    pub threads: u16,
    /// What computes networks, best first, separated by commas; without cpu a missing one is an error
    #[arg(long, value_enum, value_delimiter = ',', default_value = "cpu", value_name = "PROVIDER")]
    pub provider: Vec<Provider>,
}

impl ModelFlags {
    /// The settings that the flags stand for.
    pub(super) fn settings(&self) -> Settings {
        let onnx = Config { threads: self.threads.into(), providers: self.provider.clone(), ..Config::default() };
        let DepthModel { adapter, file, .. } = &self.depth_model;
        let Self { depth_pixels, depth_smoothing, depth_ramp, flip, .. } = *self;
        Settings { depth: adapter, depth_file: file.clone(), depth_pixels, depth_smoothing, depth_ramp, flip, onnx, ..Settings::default() }
    }
}

impl ModelFlags {
    /// The settings of rooms, whose depth network is `live`; none where they are those of photos. What was said of pixels, smoothing, ramp and
    /// the mirrored photo was said of the photos' network: it goes for rooms where they have the same.
    pub(super) fn for_rooms(&self, live: &DepthModel) -> Option<Settings> {
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

    /// The settings that the flags stand for where it is rooms that they are of.
    pub(super) fn settings_of_rooms(&self) -> Settings {
        let settings = self.settings();
        let depth_ramp = Some(settings.depth_ramp.unwrap_or(settings.depth.ramp_of_rooms));
        Settings { depth_ramp, flip: Some(settings.flip.unwrap_or(false)), ..settings }
    }

    /// The settings with another network.
    pub(super) fn with_network(&self, depth: &'static Adapter, file: PathBuf) -> Settings {
        Settings { depth, depth_file: Some(file), ..self.settings() }
    }
}

/// A depth network as chosen on the command line.
#[derive(Clone, Debug)]
pub(super) struct DepthModel {
    /// It was left to the program.
    pub auto: bool,
    adapter: &'static Adapter,
    file: Option<PathBuf>,
}

/// A depth network by its name, its file, or both.
pub(super) fn depth_model(text: &str) -> Result<DepthModel, String> {
    if text == "auto" {
        let (adapter, file) = usual().map_or((&ADAPTERS[0], None), |(adapter, file)| (adapter, Some(file)));
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
        let adapter = detect(path).ok_or_else(|| format!("{text} does not tell its network: write NAME={text} with one of {}", known()))?;
        return Ok(DepthModel { auto: false, adapter, file: Some(path.to_owned()) });
    };
    let file = file.or_else(|| fetched.map(Published::file).filter(|f| f.is_file()));
    if file.is_none() && adapter.name != ADAPTERS[0].name {
        let how = fetched.map_or_else(String::new, |p| format!(", or run tmpi models get {}", p.name));
        return Err(format!("{name} is not embedded: write {name}=FILE with its ONNX file{how}"));
    }
    Ok(DepthModel { auto: false, adapter, file })
}

/// `set` on default options, refused where the value is out of range.
fn checked<T: Copy>(value: T, set: impl FnOnce(&mut Options, T)) -> Result<T, String> {
    let mut options = Options::default();
    set(&mut options, value);
    options.validate().map_err(|e| e.to_string())?;
    Ok(value)
}

/// A share of the ramp.
fn share_of_ramp(text: &str) -> Result<f64, String> {
    let value = number(text)?;
    if (0.0..=10.0).contains(&value) { Ok(value) } else { Err(format!("{text} is not between 0 and 10")) }
}

/// A strength of smoothing.
fn strength(text: &str) -> Result<f64, String> {
    let value = number(text)?;
    if (0.0..=1e6).contains(&value) { Ok(value) } else { Err(format!("{text} is not between 0 and 1000000")) }
}

fn number(text: &str) -> Result<f64, String> {
    text.trim().parse().map_err(|_| format!("{text:?} is not a number"))
}

fn whole(text: &str) -> Result<u32, String> {
    text.trim().parse().map_err(|_| format!("{text:?} is not a whole number"))
}

/// Finite numbers separated by commas.
pub(super) fn numbers(text: &str) -> Result<Vec<f64>, String> {
    let all = text.split(',').map(number).collect::<Result<Vec<_>, _>>()?;
    if all.iter().all(|v| v.is_finite()) { Ok(all) } else { Err("every number must be finite".into()) }
}

pub(super) fn fov_x(text: &str) -> Result<f64, String> {
    checked(number(text)?, |o, v| o.fov_x = Some(v))
}

fn planes(text: &str) -> Result<PlaneCount, String> {
    let count = if text == "auto" { PlaneCount::Auto } else { PlaneCount::Fixed(whole(text)?) };
    checked(count, |o, v| o.planes = v)
}

fn tile(text: &str) -> Result<TileSize, String> {
    let size = if text == "full" { TileSize::Full } else { TileSize::Pixels(whole(text)?) };
    checked(size, |o, v| o.tile = v)
}

fn max_size(text: &str) -> Result<u32, String> {
    checked(whole(text)?, |o, v| o.max_size = Some(v))
}

pub(super) fn quality(text: &str) -> Result<u8, String> {
    let number = whole(text)?;
    let quality = u8::try_from(number).map_err(|_| format!("quality must be 1 to 100, not {number}"))?;
    checked(quality, |o, v| o.quality = v)
}

fn max_error(text: &str) -> Result<f64, String> {
    checked(number(text)?, |o, v| o.max_error = v)
}

fn strokes(file: &str) -> Result<Strokes, String> {
    let bytes = std::fs::read(file).map_err(|e| e.to_string())?;
    tmpi_pipeline::strokes::read(&bytes).map(Strokes).map_err(|e| e.to_string())
}

fn budget_ms(text: &str) -> Result<f64, String> {
    checked(number(text)?, |o, v| o.budget_ms = Some(v))
}

fn view_box(text: &str) -> Result<ViewBox, String> {
    let &[x, y, z] = numbers(text)?.as_slice() else { return Err("three numbers are wanted".into()) };
    checked(ViewBox { x, y, z }, |o, v| o.view_box = v)
}

/// A picture size, `WxH`.
pub(super) fn size(text: &str) -> Result<(u32, u32), String> {
    use tmpi_render::{MAX_PIXELS, MAX_SIDE};
    let (w, h) = text.split_once(['x', 'X', '×']).ok_or("a size is written WIDTHxHEIGHT")?;
    let (w, h) = (whole(w)?, whole(h)?);
    if !(1..=MAX_SIDE).contains(&w) || !(1..=MAX_SIDE).contains(&h) || u64::from(w) * u64::from(h) > MAX_PIXELS {
        return Err(format!("each side must be 1 to {MAX_SIDE} pixels, both together at most {MAX_PIXELS}"));
    }
    Ok((w, h))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_those_of_the_library() {
        #[derive(clap::Parser)]
        struct Just {
            #[command(flatten)]
            flags: MakeFlags,
        }
        let got = <Just as clap::Parser>::parse_from(["x"]).flags.options();
        assert_eq!(got, Options::default());
    }

    #[test]
    fn ranges_hold_at_their_ends_and_nan_is_refused() {
        assert!(planes("1").is_ok() && planes("64").is_ok() && planes("0").is_err() && planes("65").is_err());
        assert!(tile("8").is_ok() && tile("1024").is_ok() && tile("7").is_err() && tile("1025").is_err() && tile("full").is_ok());
        assert!(quality("1").is_ok() && quality("100").is_ok() && quality("0").is_err() && quality("101").is_err());
        for (over, told) in [("101", "not 101"), ("300", "not 300"), ("4294967295", "not 4294967295")] {
            let error = quality(over).unwrap_err();
            assert!(error.contains("1 to 100") && error.contains(told), "{error}");
        }
        assert!(max_size("1").is_ok() && max_size("16384").is_ok() && max_size("0").is_err() && max_size("16385").is_err());
        assert!(fov_x("0.1").is_ok() && fov_x("179").is_ok() && fov_x("0").is_err() && fov_x("180").is_err());
        assert!(budget_ms("1").is_ok() && budget_ms("1e7").is_ok() && budget_ms("0.9").is_err() && budget_ms("1.1e7").is_err());
        for nan in ["nan", "NaN", "inf", "-inf", "1e999"] {
            assert!(
                fov_x(nan).is_err() && budget_ms(nan).is_err() && max_error(nan).is_err() && view_box(&format!("{nan},0,0")).is_err(),
                "{nan}"
            );
        }
        assert!(size("16384x1").is_ok() && size("16385x1").is_err() && size("0x1").is_err() && size("8193x8193").is_err());
        assert!(view_box("0,0,0").is_ok() && view_box("0,0").is_err() && view_box("0,0,-0.1").is_err());
    }

    #[test]
    fn depth_models_by_name() {
        assert!(depth_model("tmpi").is_ok());
        assert!(depth_model("depth-anything-v2").unwrap_err().contains("=FILE"));
        assert_eq!(depth_model("dpt-large=a=b.onnx").unwrap().file.unwrap(), PathBuf::from("a=b.onnx"));
        assert!(depth_model("nosuch").unwrap_err().contains("midas-v2.1"));
        assert!(depth_model("nosuch=dpt-large.onnx").unwrap_err().contains("one of"));
        let alone = depth_model("nets/zoedepth-nyu/model.onnx").unwrap();
        assert_eq!((alone.adapter.name, alone.file.unwrap()), ("zoedepth", PathBuf::from("nets/zoedepth-nyu/model.onnx")));
        assert!(depth_model("nets/model.onnx").unwrap_err().contains("NAME=nets/model.onnx"));
    }

    #[test]
    fn rooms_have_the_network_that_keeps_up_whatever_photos_have() {
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
        // one network is loaded once
        assert!(large.for_rooms(&depth_model("depth-anything-v2=a.onnx").unwrap()).is_none());
        assert!(of(&["--depth-model", "tmpi", "--depth-ramp", "0.1", "--flip"]).for_rooms(&embedded).is_none());
        // rooms have more of a ramp, and one run
        let own = of(&["--depth-model", "tmpi", "--depth-pixels", "9000"]);
        let rooms = own.for_rooms(&embedded).unwrap();
        assert_eq!((rooms.depth.name, rooms.depth_pixels, rooms.depth_ramp), ("tmpi", Some(9000), Some(ADAPTERS[0].ramp_of_rooms)));
        assert_eq!((rooms.flip, own.settings().flip, of(&["--flip=false"]).settings().flip), (Some(false), None, Some(false)));
        assert!(ADAPTERS[0].ramp_of_rooms > ADAPTERS[0].ramp && own.settings().depth_ramp.is_none());
    }
}
