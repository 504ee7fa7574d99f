//! The report of a photo: what was done, what was left out, and the errors and costs (`docs/explanation/error-budget.md`).

use serde::{Deserialize, Serialize};
use tmpi_core::container::SectionBytes;

use crate::photo::Reduction;
use crate::stereo::StereoFigures;

/// The uploaded photo.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Input {
    /// Width in pixels, upright.
    pub width: u32,
    /// Height in pixels, upright.
    pub height: u32,
    /// File size in bytes.
    pub bytes: usize,
    /// The file is damaged or truncated, and part of the picture is grey or coarse.
    pub damaged: bool,
    /// The photo was scaled down to fit into the memory limit for making.
    pub fitted: bool,
    /// The depth map that came with the photo; null if depth was estimated.
    pub depth: Option<InputDepth>,
    /// Why the depth embedded in the photo, or a second picture, was not used.
    pub depth_problem: Option<String>,
    /// Number of touch-up strokes applied to the depth.
    pub strokes: usize,
}

/// A depth map that came with a photo.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct InputDepth {
    /// Origin of the map: `given` in a file of its own; `rgbd` in the picture's right half; `gdepth`, `dynamic-depth` or `multi-picture`
    /// embedded in the photo's file; `stereo` measured against a second picture.
    pub source: String,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// The aspect ratio differs from the photo's: the map was stretched by more than 3 %, and may not fit.
    pub stretched: bool,
}

/// Time of one stage.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct StageTime {
    /// Name of the stage: `photo`, `depth`, `denoise`, `strokes`, `snap`, `planes`, `layers`, `refine`, `encode` or `verify`.
    pub name: String,
    /// Wall time in milliseconds.
    pub ms: f64,
    /// CPU time of the whole process in milliseconds.
    pub cpu_ms: f64,
}

/// What this scene did not need.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct LeftOut {
    /// Number of planes below the upper bound, which is the most planes per tile times the number of tiles.
    pub planes: usize,
    /// Number of tiles that were not refined by a network.
    pub tiles_not_refined: usize,
    /// Number of texels left out, compared with layers as large as their tiles.
    pub texels: usize,
    /// Bytes that the texels left out would take as raw RGBA8.
    pub bytes: usize,
}

/// Sizes of the container's sections in bytes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Bytes {
    /// The whole container.
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

/// How far a step shifted the disparity map: distance in pixels between a point before and after the step, in the camera of the view box
/// where it is largest.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ParallaxShift {
    /// Mean over all compared pixels.
    pub mean_px: f64,
    /// Largest over all compared pixels.
    pub most_px: f64,
    /// Only a sample of the pixels was compared.
    pub sampled: bool,
}

/// Parallax error of the planes against the disparity map that they were fitted to, in pixels over the view box.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct PlaneError {
    /// Mean over all pixels of all tiles.
    pub mean_px: f64,
    /// Bound that 99 % of a tile's pixels were to stay below: `max-error`, or what a time budget made of it; null if the number of planes
    /// was fixed.
    pub bound_px: Option<f64>,
    /// Most planes that a tile could have, without its background plane.
    pub most_planes: u32,
    /// Number of tiles above the bound, which need more than `most_planes` planes.
    pub missed_tiles: usize,
    /// Mean excess over the bound, among the tiles above it.
    pub missed_mean_px: f64,
    /// Largest excess over the bound.
    pub missed_most_px: f64,
    /// Part of `mean_px` that label smoothing adds, beyond the error of each pixel's nearest plane.
    pub smoothing_px: f64,
    /// Largest shift of a pixel by rounding planes to the container's grid of coefficients, among 8 × 8 pixels of each tile.
    pub rounding_px: f64,
}

/// What pruning leaves out of views from the view box.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct PruneError {
    /// Largest part of a pixel that texels left out would take, in levels, 0 to 255: no channel differs by more.
    pub max_abs: u8,
    /// Share of pixels, 0 to 1, of which they would take more than 8 levels, in the view where this share is largest.
    pub share_off: f64,
    /// Number of tiles in the compared parts: all with `verify-prune`, else those around some of the tiles with the largest steps in depth.
    pub tiles: usize,
}

/// Errors of the approximations, each against the input of its step; null if the step was not applied.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ErrorFigures {
    /// Error of scaling the photo down.
    pub reduction: Option<Reduction>,
    /// Share of the pixels of a depth map in metres, 0 to 1, whose depth is unknown; they take the depth of a neighbour.
    pub depth_filled: Option<f64>,
    /// Share of the pixels of a depth map in metres, 0 to 1, that are nearer than the nearest distance; they are clipped to it.
    pub depth_clipped: Option<f64>,
    /// Result of measuring depth against a second picture.
    pub stereo: Option<StereoFigures>,
    /// Shift by resampling the disparity map to the photo's size.
    pub resampling: Option<ParallaxShift>,
    /// Shift by denoising the disparity map.
    pub denoise: Option<ParallaxShift>,
    /// Shift by snapping the ramps of the disparity map to the photo's edges, and by widening what a depth network draws too small.
    pub snap: Option<ParallaxShift>,
    /// Mean absolute disparity error of the planes against the map that they were fitted to.
    pub depth_mae: f64,
    /// Mean squared disparity error of the planes against that map.
    pub depth_mse: f64,
    /// Lower quartile of the absolute disparity error of the planes against that map.
    pub depth_q25: f64,
    /// Mean parallax error of each tile, row by row, to 0.001: distance in pixels between a point on the tile's planes and on the map that
    /// they were fitted to, in the camera of the view box where it is largest.
    pub tile_px: Vec<f64>,
    /// Parallax error over all tiles, against its bound.
    pub planes: PlaneError,
    /// Effect of pruning; null if the photo has too few tiles for a quick sample and `verify-prune` is off.
    pub prune: Option<PruneError>,
    /// Number of tiles whose hidden texels a camera of the view box may see past an edge more than 1664 pixels away, which pruning does not
    /// search; views may show gaps there.
    pub unsearched_tiles: usize,
    /// PSNR in dB of the container's photo against the one that the scene was made from; 99 if they are equal.
    pub codec_psnr: f64,
    /// PSNR in dB of the container's hidden colours against those that a network computed; null if readers derive hidden colours.
    pub hidden_psnr: Option<f64>,
    /// PSNR in dB of the reference view, drawn from what a reader gets, against the photo; 99 if they are equal.
    pub identity_psnr: f64,
    /// Number of tiles that `identity_psnr` covers; if not all, the rows of tiles in between were not drawn.
    pub identity_tiles: usize,
}

/// Effect of a time budget.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Budget {
    /// Time budget in milliseconds.
    pub asked_ms: f64,
    /// Predicted time in milliseconds for the chosen settings.
    pub predicted_ms: f64,
    /// Actual time in milliseconds.
    pub outcome_ms: f64,
    /// Chosen settings, as on the command line; `error.planes` and `error.reduction` hold their errors.
    pub chose: String,
    /// Reason for the choice.
    pub reason: String,
    /// Share of tiles, 0 to 1, whose parallax error with one plane exceeds the requested one.
    pub busy: f64,
}

/// The report of a photo.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Report {
    /// The uploaded photo.
    pub input: Input,
    /// Width of the scene in pixels.
    pub width: u32,
    /// Height of the scene in pixels.
    pub height: u32,
    /// Name of the depth network, or `given` (a map in a file of its own), `embedded` (a map embedded in the photo's file) or `stereo`
    /// (measured against a second picture).
    pub depth_model: String,
    /// Times of all stages, in order.
    pub stages: Vec<StageTime>,
    /// Wall time of making in milliseconds.
    pub total_ms: f64,
    /// Peak resident memory of the process so far, in bytes.
    pub peak_rss_bytes: u64,
    /// Upper bound of the memory for making, in bytes: the formula by which photos are admitted, with the number of planes that were
    /// placed.
    pub memory_bound_bytes: u64,
    /// Number of tiles.
    pub tiles: usize,
    /// Number of planes, background planes included.
    pub planes: usize,
    /// Mean number of planes per tile.
    pub planes_per_tile: f64,
    /// Number of texels of all layers that are not empty.
    pub texels: usize,
    /// What this scene did not need.
    pub left_out: LeftOut,
    /// Sizes of the container's sections in bytes.
    pub bytes: Bytes,
    /// Errors of the approximations.
    pub error: ErrorFigures,
    /// Effect of the time budget; null if none was given.
    pub budget: Option<Budget>,
}
