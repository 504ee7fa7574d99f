//! `tmpi export`.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context;
use serde_json::json;

use super::{Usage, files, result_as};
use crate::export::{ExportFormat, ExportOptions, ModelOptions, ModelShape, ModelTextures, export};
use tmpi_core::Rect;
use tmpi_core::container::{self, LEVELS, RegionPhoto, TileRect};

/// Export a container, or a part of it, as a web page, a glTF model, layers for image editors, photo and depth side by side, an archive of its parts or a container
#[derive(Clone, Debug, clap::Args)]
#[allow(clippy::struct_excessive_bools, reason = "flags of a command")]
pub(super) struct ExportArgs {
    /// The container
    #[arg(value_name = "IN.tmpi")]
    input: PathBuf,
    /// File to write: a page that opens from disk, a binary glTF model, layers for image editors (.ora: 3 to 8 of the photo's size, and the
    /// depth map), a picture of the photo and its depth map side by side (RGB-D), an archive of photo, tiles and planes, or a container
    #[arg(short, long, value_name = "OUT.{html,glb,ora,png,zip,tmpi}")]
    output: PathBuf,
    /// Export only the tiles over this rectangle, in pixels of the photo; re-encodes that part of the photo
    #[arg(long, value_name = "X,Y,W,H")]
    region: Option<Rect>,
    /// Reduce to half (1), a quarter (2) or an eighth (3) of the size
    #[arg(long, default_value_t = 0, value_name = "0-3", value_parser = clap::value_parser!(u8).range(..=i64::from(LEVELS)))]
    level: u8,
    /// Encode the region's photo without loss
    #[arg(long, requires = "region")]
    lossless: bool,
    /// Write the glTF model in the photo's own space, at real distances, instead of a relief that fits into a viewer's frame
    #[arg(long)]
    metric: bool,
    /// Write the glTF model's layers as WebP: far smaller, for programs that support the glTF extension for WebP (three.js, model-viewer,
    /// Blender 4)
    #[arg(long)]
    webp: bool,
    /// Title of the page; default: the container's name
    #[arg(long, value_name = "TEXT")]
    title: Option<String>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// The region and level of the container that the flags select.
fn part_of(whole: &[u8], args: &ExportArgs) -> anyhow::Result<Vec<u8>> {
    let context = || args.input.display().to_string();
    let Some(region) = args.region else { return container::level(whole, args.level).with_context(context) };
    let tiles = TileRect::over_region(whole, region).with_context(context)?;
    let tiles = tiles.ok_or_else(|| Usage("--region must contain a pixel and lie within the photo".into()))?;
    let photo = if args.lossless { RegionPhoto::Lossless } else { RegionPhoto::Jpeg };
    container::region(whole, &tiles, args.level, photo).with_context(context)
}

pub(super) fn run(args: &ExportArgs) -> anyhow::Result<()> {
    let extension = files::extension(&args.output);
    let format = ExportFormat::from_extension(&extension);
    if format.is_none() && extension != "tmpi" {
        return Err(Usage(format!("--output {} must end in .html, .glb, .ora, .png, .zip or .tmpi", args.output.display())).into());
    }
    let (html, glb) = (ExportFormat::Html, ExportFormat::Glb);
    for (flag, is_given, only) in [("--title", args.title.is_some(), html), ("--metric", args.metric, glb), ("--webp", args.webp, glb)] {
        if is_given && format != Some(only) {
            return Err(Usage(format!("{flag} is only for .{}", only.ending())).into());
        }
    }
    let start = Instant::now();
    let whole = files::read(&args.input)?;
    let container = if args.region.is_some() || args.level > 0 { part_of(&whole, args)? } else { whole.clone() };
    let context = || args.input.display().to_string();
    // do not make a broken page from a broken container
    let scene = container::decode(&container).with_context(context)?;
    let stem = args.input.file_stem().unwrap_or_default().to_string_lossy();
    let shape = if args.metric { ModelShape::Metric } else { ModelShape::Relief };
    let textures = if args.webp { ModelTextures::WebP } else { ModelTextures::Plain };
    let options = ExportOptions { title: args.title.as_deref().unwrap_or(&stem), model: ModelOptions { shape, textures } };
    let written = format.map(|f| export(f, &container, &scene, &options, &|| false)).transpose();
    let bytes = written.with_context(context)?.unwrap_or_else(|| container.clone());
    let ms = start.elapsed().as_secs_f64() * 1e3;
    files::write(&args.output, &bytes)?;
    let format = format.map_or("tmpi", ExportFormat::name);
    let about = json!({ "output": args.output, "format": format, "bytes": bytes.len(), "container_bytes": whole.len(), "ms": ms });
    let times = bytes.len() as f64 / whole.len() as f64;
    let text = format!("{}: {} bytes, {times:.2} × the container, in {ms:.1} ms", args.output.display(), bytes.len());
    result_as(args.json, &about, &text)
}
