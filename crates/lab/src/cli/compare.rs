//! `tmpi-lab compare`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use serde_json::json;

use super::result;
use crate::files::read;
use crate::metrics::{flip, max_abs, psnr, share_off, ssim_map};

/// A pixel counts as different above this many of 255 levels.
const LEVELS: u8 = 8;

/// Compare two pictures of the same size: PSNR, SSIM, FLIP, and the fraction of pixels that differ
#[derive(Clone, Debug, clap::Args)]
pub(super) struct CompareArgs {
    /// Reference picture
    #[arg(value_name = "REFERENCE")]
    reference: PathBuf,
    /// Picture to compare: PNG, JPEG or WebP; transparency shows black
    #[arg(value_name = "TEST")]
    test: PathBuf,
    /// Print the results as JSON
    #[arg(long)]
    json: bool,
}

/// Reads a picture over black; returns its pixels and width.
fn picture(path: &Path) -> anyhow::Result<(Vec<[u8; 3]>, usize)> {
    let decoded = image::load_from_memory(&read(path)?).with_context(|| path.display().to_string())?;
    let rgba = decoded.into_rgba8();
    let width = rgba.width() as usize;
    let over = |v: u8, a: u8| ((u16::from(v) * u16::from(a) + 127) / 255) as u8;
    Ok((rgba.pixels().map(|p| [over(p[0], p[3]), over(p[1], p[3]), over(p[2], p[3])]).collect(), width))
}

pub(super) fn run(args: &CompareArgs) -> anyhow::Result<()> {
    let ((a, width), (b, other)) = (picture(&args.reference)?, picture(&args.test)?);
    let size = |p: &[[u8; 3]], w: usize| format!("{w}×{}", p.len() / w.max(1));
    anyhow::ensure!(width == other && a.len() == b.len(), "the pictures differ in size: {} and {}", size(&a, width), size(&b, other));
    let ssim = ssim_map(&a, &b, width);
    let ssim = ssim.iter().map(|v| f64::from(*v)).sum::<f64>() / ssim.len().max(1) as f64;
    let (psnr, flip, share, most) =
        (psnr(a.as_flattened(), b.as_flattened()), flip(&a, &b, width), share_off(&a, &b, LEVELS), max_abs(&a, &b));
    if args.json {
        return result(&json!({ "psnr": psnr, "ssim": ssim, "flip": flip, "share_off": share, "max_abs": most }).to_string());
    }
    result(&format!(
        "PSNR {psnr:.2} dB, SSIM {ssim:.4}, FLIP {flip:.4}, {:.3} % of pixels off by more than {LEVELS} levels, largest difference {most}",
        100.0 * share
    ))
}
