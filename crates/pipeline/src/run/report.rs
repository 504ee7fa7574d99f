//! The report of a photo: what was done, at what cost, what was left out, and what error that made (DESIGN, section 8).

use serde::{Deserialize, Serialize};
use tmpi_core::container::SectionBytes;

/// The uploaded photo.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Input {
    /// Width in pixels, upright.
    pub width: u32,
    /// Height in pixels, upright.
    pub height: u32,
    /// File size.
    pub bytes: usize,
    /// The file is damaged or cut short, and a part of the picture is grey or coarse.
    #[serde(default)]
    pub damaged: bool,
    /// It was made smaller, as more would have taken more memory than making a photo may.
    #[serde(default)]
    pub fitted: bool,
    /// The depth map that came with it; none where depth was estimated.
    #[serde(default)]
    pub depth: Option<InputDepth>,
    /// Why depth that the photo brings along was not used.
    #[serde(default)]
    pub depth_problem: Option<String>,
    /// Strokes of a touch-up that were applied to the depth.
    #[serde(default)]
    pub strokes: usize,
}

/// A depth map that came with a photo.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct InputDepth {
    /// Where it was: `given` beside the photo, or within its file as `gdepth`, `dynamic-depth` or `multi-picture`.
    pub source: String,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Its shape is not the photo's: it was stretched by more than 3 %, and may not fit.
    pub stretched: bool,
}

/// What one stage took.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct StageTime {
    /// As in [`crate::Progress::stage`].
    pub name: String,
    /// Wall time in milliseconds.
    pub ms: f64,
    /// Processor time of the whole process in milliseconds.
    pub cpu_ms: f64,
}

/// What this scene did not need.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct LeftOut {
    /// Planes fewer than the upper bound of planes a tile.
    pub planes: usize,
    /// Tiles that no refinement ran on.
    pub tiles_not_refined: usize,
    /// Texels of full layers that are not stored.
    pub texels: usize,
    /// Bytes that these would take as raw RGBA8.
    pub bytes: usize,
}

/// Sections of the container in bytes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Bytes {
    /// Everything.
    pub total: usize,
    /// Index and planes.
    pub index: usize,
    /// Photo.
    pub photo: usize,
    /// Classes and alpha.
    pub alpha: usize,
    /// Hidden colours.
    pub hidden: usize,
}

impl From<SectionBytes> for Bytes {
    fn from(b: SectionBytes) -> Self {
        Self { total: b.total, index: b.index, photo: b.photo, alpha: b.alpha, hidden: b.hidden }
    }
}

/// Errors that the approximations made.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ErrorFigures {
    /// Mean absolute error of the planes' disparity against the map they were fitted to.
    pub depth_mae: f64,
    /// Mean squared error of the same.
    pub depth_mse: f64,
    /// Lower quartile of its absolute error.
    pub depth_q25: f64,
    /// Mean parallax error of each tile in pixels over the view box, row by row: how far planes move the picture away from where that
    /// map does.
    #[serde(default)]
    pub tile_px: Vec<f64>,
    /// PSNR in dB of the view from the reference camera against the photo; 99 where they are equal.
    pub identity_psnr: f64,
    /// Largest difference that leaving out made at the corners of the view box, in levels of 255; none where that was
    /// not asked for (`--verify-prune`).
    pub prune_max_abs: Option<f64>,
    /// Share of pixels, 0 to 1, that leaving out changes by more than 8 levels, in the corner where it is largest.
    pub prune_share_off: Option<f64>,
    /// PSNR in dB of the carried photo against the uploaded one; 99 where they are equal.
    pub codec_psnr: f64,
}

/// What a budget of run time made of a photo.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Budget {
    /// Milliseconds that were asked for.
    pub asked_ms: f64,
    /// Milliseconds that were predicted for what was chosen.
    pub predicted_ms: f64,
    /// Milliseconds that it took.
    pub outcome_ms: f64,
    /// What was chosen, as on the command line.
    pub chose: String,
    /// Why.
    pub reason: String,
    /// Share of tiles, 0 to 1, that one plane does not do for at the error that was asked for.
    pub busy: f64,
}

/// The report of a photo.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Report {
    /// The uploaded photo.
    pub input: Input,
    /// Size of the scene in pixels.
    pub width: u32,
    /// Size of the scene in pixels.
    pub height: u32,
    /// Depth network, or `given` (a map beside the photo) or `carried` (one within its file).
    pub depth_model: String,
    /// All stages in order.
    pub stages: Vec<StageTime>,
    /// Wall time of all stages.
    pub total_ms: f64,
    /// Peak resident memory of the process so far.
    pub peak_rss_bytes: u64,
    /// Count of tiles.
    pub tiles: usize,
    /// Count of planes.
    pub planes: usize,
    /// Mean planes a tile.
    pub planes_per_tile: f64,
    /// Count of texels that are not empty, of all layers.
    #[serde(default)]
    pub texels: usize,
    /// What this scene did not need.
    pub left_out: LeftOut,
    /// Sections in bytes.
    pub bytes: Bytes,
    /// Errors made.
    pub error: ErrorFigures,
    /// What the budget of run time made of it; none where none was given.
    #[serde(default)]
    pub budget: Option<Budget>,
}
