//! `tmpi-lab compare`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use serde_json::json;

use super::{read, result};
use tmpi_lab::metrics::{flip, max_abs, psnr, share_off, ssim_map};

/// Levels of 255 from which a pixel counts as different.
const LEVELS: u8 = 8;

/// Compare two pictures of one size: PSNR, SSIM, FLIP, and the share of pixels that differ
#[derive(Clone, Debug, clap::Args)]
pub(super) struct CompareArgs {
    /// The picture that the other one is held against
    #[arg(value_name = "REFERENCE")]
    reference: PathBuf,
    /// PNG, JPEG or WebP; what is transparent lies over black
    #[arg(value_name = "TEST")]
    test: PathBuf,
    /// The figures as JSON
    #[arg(long)]
    json: bool,
}

/// Colours over black, and pixels a row.
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
    anyhow::ensure!(
        width == other && a.len() == b.len(),
        "pictures of one size are wanted, not {} and {}",
        size(&a, width),
        size(&b, other)
    );
    let ssim = ssim_map(&a, &b, width);
    let ssim = ssim.iter().map(|v| f64::from(*v)).sum::<f64>() / ssim.len().max(1) as f64;
    let (psnr, flip, share, most) =
        (psnr(a.as_flattened(), b.as_flattened()), flip(&a, &b, width), share_off(&a, &b, LEVELS), max_abs(&a, &b));
    if args.json {
        return result(&json!({ "psnr": psnr, "ssim": ssim, "flip": flip, "share_off": share, "max_abs": most }).to_string());
    }
    result(&format!(
        "PSNR {psnr:.2} dB, SSIM {ssim:.4}, FLIP {flip:.4}, {:.3} % of the pixels off by more than {LEVELS} levels, at most {most}",
        100.0 * share
    ))
}
