//! Flags that several commands share. [`Options::validate`] defines the ranges; an error names the flag and its range.

use std::path::Path;

use tmpi_core::ViewBox;
use tmpi_pipeline::depth::{DepthError, DepthKind};
use tmpi_pipeline::strokes::Stroke;
use tmpi_pipeline::{Denoise, Options, PlaneCount, PlaneMethod, Stereo, Switch, TileSize};

/// How to read a photo and estimate its depth.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct DepthFlags {
    /// Use the depth embedded in the photo (Google's depth map metadata, Dynamic Depth, portraits of iPhones sent as JPEG); on: fail
    /// without it
    #[arg(long, value_enum, default_value_t, value_name = "SWITCH")]
    pub photo_depth: Switch,
    /// Where the picture of a second eye is, by which depth is measured; auto: behind the first in the file (MPO), or as the file's name
    /// says (name.left-right.jpg, name.top-bottom.jpg, name.rgbd.png)
    #[arg(long, value_enum, default_value_t, value_name = "WHERE")]
    pub stereo: Stereo,
    /// How to denoise the depth map
    #[arg(long, value_enum, default_value_t, value_name = "METHOD")]
    pub denoise: Denoise,
    /// Snap blurred depth edges to colour edges; auto: where depth is blurred, and things that a depth network draws too small grow; on:
    /// snap always, nothing grows
    #[arg(long, value_enum, default_value_t, value_name = "SWITCH")]
    pub snap: Switch,
    /// Longest side in pixels; larger photos are scaled down
    #[arg(long, value_parser = max_size, value_name = "PX")]
    pub max_size: Option<u32>,
}

impl DepthFlags {
    /// Where the second eye of a photo is: as the flag says, else as the file's name does.
    ///
    /// # Errors
    /// The name tells of a kind of stereo that is not supported.
    pub(super) fn stereo_of(&self, photo: &Path) -> Result<Stereo, DepthError> {
        let name = photo.file_name().unwrap_or_default().to_string_lossy();
        if self.stereo == Stereo::Auto { Stereo::of_name(&name) } else { Ok(self.stereo) }
    }

    /// The pipeline's options; those without a flag here keep their defaults.
    pub(super) fn options(&self) -> Options {
        let Self { photo_depth, stereo, snap, denoise, max_size } = *self;
        Options { photo_depth, stereo, snap, denoise, max_size, ..Options::default() }
    }
}

/// How to make a photo.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct MakeFlags {
    #[command(flatten)]
    pub depth: DepthFlags,
    /// Meaning of the values in the depth map
    #[arg(long, value_enum, default_value_t, value_name = "KIND")]
    pub depth_kind: DepthKind,
    /// Horizontal field of view of the photo in degrees; default: from EXIF, else 81.5
    #[arg(long, value_parser = fov_x, value_name = "DEG")]
    pub fov_x: Option<f64>,
    /// Planes per tile: the fewest that meet --max-error, or a fixed number
    #[arg(long, value_parser = planes, default_value = "auto", value_name = "auto|N")]
    pub planes: PlaneCount,
    /// How to place planes
    #[arg(long, value_enum, default_value_t, value_name = "METHOD")]
    pub plane_method: PlaneMethod,
    /// Tile size in pixels, or one tile for the whole photo
    #[arg(long, value_parser = tile, default_value = "64", value_name = "H|full")]
    pub tile: TileSize,
    /// Refine layers with the network psi.onnx in the folder of networks (`TMPI_MODELS`); auto: off
    #[arg(long, value_enum, default_value_t, value_name = "SWITCH")]
    pub refine: Switch,
    /// Picture quality, 1 to 100
    #[arg(long, value_parser = quality, default_value = "90", value_name = "1-100")]
    pub quality: u8,
    /// Largest parallax error of the planes, in pixels: how far a point may be off in views from the corners of the view box
    #[arg(long, value_parser = max_error, default_value = "1", value_name = "PX")]
    pub max_error: f64,
    /// Half extents of the box of camera positions, in units of the nearest distance; viewers on their own move half as far as the default
    /// box
    #[arg(long, value_parser = view_box, default_value = "0.12,0.12,0.06", value_name = "X,Y,Z")]
    pub view_box: ViewBox,
    /// Time budget in milliseconds: chooses the size, and a parallax error of at least --max-error, by the costs that `tmpi-lab bench`
    /// measured on this machine (the file in `TMPI_COSTS`)
    #[arg(long, value_parser = budget_ms, value_name = "MS")]
    pub budget_ms: Option<f64>,
    /// Measure how pruning invisible texels changes the views from the corners of the view box; takes about half as long as making
    #[arg(long)]
    pub verify_prune: bool,
    /// JSON file of strokes that correct the photo's depth, as returned by the server's /v1/photos/ID/strokes
    #[arg(long, value_parser = strokes, value_name = "FILE.json")]
    pub strokes: Option<Strokes>,
}

#[derive(Clone, Debug, Default)]
pub(super) struct Strokes(Vec<Stroke>);

impl MakeFlags {
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

/// Validates `value` by setting it on default options.
fn checked<T: Copy>(value: T, set: impl FnOnce(&mut Options, T)) -> Result<T, String> {
    let mut options = Options::default();
    set(&mut options, value);
    options.validate().map_err(|e| e.to_string())?;
    Ok(value)
}

fn number(text: &str) -> Result<f64, String> {
    text.trim().parse().map_err(|_| format!("{text:?} is not a number"))
}

fn whole(text: &str) -> Result<u32, String> {
    text.trim().parse().map_err(|_| format!("{text:?} is not a whole number"))
}

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
    let &[x, y, z] = numbers(text)?.as_slice() else { return Err("expected three numbers".into()) };
    checked(ViewBox { x, y, z }, |o, v| o.view_box = v)
}

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
    fn defaults_equal_those_of_the_library() {
        #[derive(clap::Parser)]
        struct Just {
            #[command(flatten)]
            flags: MakeFlags,
        }
        let got = <Just as clap::Parser>::parse_from(["x"]).flags.options();
        assert_eq!(got, Options::default());
    }

    #[test]
    fn ranges_include_their_ends_and_exclude_nan() {
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
}
