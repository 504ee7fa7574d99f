//! `tmpi depth`.

use std::path::PathBuf;

use anyhow::Context;
use serde_json::json;

use super::flags::DepthFlags;
use super::progress::{Bars, DepthAlone};
use super::{Usage, files, result_as};
use tmpi_core::DisparityMap;
use tmpi_pipeline::depth::to_png;
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;
use tmpi_pipeline::photo::{self, Limits};
use tmpi_pipeline::{self, Options, PlaneCount, PlaneMethod, Switch};

/// Write the disparity of a photo
#[derive(Clone, Debug, clap::Args)]
pub(super) struct DepthArgs {
    /// JPEG, PNG or WebP file
    #[arg(value_name = "PHOTO")]
    photo: PathBuf,
    /// 16-bit grey PNG (value / 65535, 1 is nearest) or PFM (32-bit floats)
    #[arg(short, long, value_name = "OUT.{png,pfm}")]
    output: PathBuf,
    /// The network's output at its own size; a PNG is stretched to the full range
    #[arg(long)]
    raw: bool,
    /// JSON on standard output
    #[arg(long)]
    json: bool,
    /// No progress
    #[arg(short, long)]
    quiet: bool,
    #[command(flatten)]
    flags: DepthFlags,
    #[command(flatten)]
    models: ModelFlags,
}

pub(super) fn run(args: &DepthArgs) -> anyhow::Result<()> {
    let encode = match files::extension(&args.output).as_str() {
        "png" => png,
        "pfm" => pfm,
        _ => return Err(Usage(format!("--output {} must end in .png or .pfm", args.output.display())).into()),
    };
    let bytes = files::read(&args.photo)?;
    let models = models::load(&args.models.settings())?;
    let limits = Limits::default();
    let name = args.photo.display().to_string();
    let map = if args.raw {
        let photo = photo::decode(&bytes, &limits, args.flags.max_size).with_context(|| name.clone())?.photo;
        models.depth.raw(&photo).with_context(|| name.clone())?
    } else {
        let bar = DepthAlone(Bars::new(args.quiet).bar(&name));
        // Planes do not affect the disparity: use the cheapest options
        let options = Options {
            planes: PlaneCount::Fixed(1),
            plane_method: PlaneMethod::Linear,
            refine: Switch::Off,
            quality: 1,
            stereo: args.flags.stereo_of(&args.photo).with_context(|| name.clone())?,
            ..args.flags.options()
        };
        tmpi_pipeline::make(&models, &limits, &bytes, None, &options, &bar).with_context(|| name.clone())?.disparity
    };
    files::write(&args.output, &encode(&map, args.raw)?)?;
    let (low, high) = range(&map);
    let about = json!({
        "photo": args.photo, "output": args.output, "width": map.width, "height": map.height,
        "model": models.depth.name(), "raw": args.raw, "least": low, "greatest": high,
    });
    let text = format!("{}: {}×{}, disparity {low:.4} to {high:.4}", args.output.display(), map.width, map.height);
    result_as(args.json, &about, &text)
}

fn range(map: &DisparityMap) -> (f32, f32) {
    map.delta.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |m, &v| (m.0.min(v), m.1.max(v)))
}

/// 16-bit grey; `stretch` maps the least value to 0 and the greatest to 65 535.
fn png(map: &DisparityMap, stretch: bool) -> anyhow::Result<Vec<u8>> {
    if !stretch {
        return Ok(to_png(map)?);
    }
    let (low, high) = range(map);
    let span = if high > low { high - low } else { 1.0 };
    Ok(to_png(&DisparityMap { delta: map.delta.iter().map(|v| (v - low) / span).collect(), ..*map })?)
}

/// Portable float map: rows from the lowest up, little-endian.
#[expect(clippy::unnecessary_wraps, reason = "the same shape as png, which can fail")]
fn pfm(map: &DisparityMap, _: bool) -> anyhow::Result<Vec<u8>> {
    let mut out = format!("Pf\n{} {}\n-1.0\n", map.width, map.height).into_bytes();
    for row in map.delta.chunks_exact(map.width as usize).rev() {
        out.extend(row.iter().flat_map(|v| v.to_le_bytes()));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_pipeline::depth::{DepthKind, from_map};

    #[test]
    fn a_png_reads_back_as_written() {
        let map = DisparityMap { width: 3, height: 2, delta: vec![0.0, 0.25, 1.0, 0.5, 0.125, 0.75] };
        let (back, _) = from_map(&png(&map, false).unwrap(), DepthKind::Disparity, &Limits::default(), 3, 2).unwrap();
        assert!(back.delta.iter().zip(&map.delta).all(|(a, b)| (a - b).abs() < 1e-5));
        let wide = DisparityMap { width: 2, height: 1, delta: vec![-40.0, 60.0] };
        let (back, _) = from_map(&png(&wide, true).unwrap(), DepthKind::Disparity, &Limits::default(), 2, 1).unwrap();
        assert!(back.delta[0] < 1e-5 && back.delta[1] > 0.9999);
        let flat = DisparityMap { width: 1, height: 1, delta: vec![7.0] };
        assert!(png(&flat, true).is_ok());
    }

    #[test]
    fn a_pfm_has_its_last_row_first() {
        let map = DisparityMap { width: 1, height: 2, delta: vec![1.0, 2.0] };
        let bytes = pfm(&map, true).unwrap();
        assert_eq!(bytes, [b"Pf\n1 2\n-1.0\n".as_slice(), &2f32.to_le_bytes(), &1f32.to_le_bytes()].concat());
    }
}
