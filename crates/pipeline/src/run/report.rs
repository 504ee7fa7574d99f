//! The report of a photo: what was done, at what cost, what was left out, and what error that made (DESIGN, section 8).

use serde::{Deserialize, Serialize};
use tmpi_core::container::SectionBytes;

use crate::photo::Reduction;
use crate::stereo::StereoError;

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
    /// Why depth that the photo brings along, or a second view, was not used.
    #[serde(default)]
    pub depth_problem: Option<String>,
    /// Strokes of a touch-up that were applied to the depth.
    #[serde(default)]
    pub strokes: usize,
}

/// A depth map that came with a photo.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct InputDepth {
    /// Where it was: `given` beside the photo, or within its file as `gdepth`, `dynamic-depth` or `multi-picture`; or `stereo`, measured
    /// against a second view.
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
    /// Texels that are not stored, of the layers that there are, were each as large as its tile.
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

/// How far a step moved the disparity map that it was given: pixels between where a point is shown before and after it, by the camera of
/// the view box that shows them the farthest apart.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Moved {
    /// Mean over the pixels.
    pub mean_px: f64,
    /// Largest.
    pub most_px: f64,
    /// Some pixels alone were looked at.
    pub sampled: bool,
}

/// What planes made of the disparity map that they were fitted to, in pixels over the view box.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct PlaneError {
    /// Mean over all pixels of all tiles.
    pub mean_px: f64,
    /// What 99 % of a tile's pixels were to stay below: `max-error`, or what a budget of run time made of it; none where the count of planes
    /// was fixed.
    pub bound_px: Option<f64>,
    /// Planes that a tile could have at most, without its background.
    pub most_planes: u32,
    /// Count of tiles that need more planes than that to stay below the bound.
    pub missed_tiles: usize,
    /// By how much these are above it, in the mean.
    pub missed_mean_px: f64,
    /// And at most.
    pub missed_most_px: f64,
    /// Part of the mean that smoothing of labels adds: error beyond that of each pixel's nearest plane.
    pub smoothing_px: f64,
    /// Most that rounding a plane to the container's grid moves any of its points.
    pub rounding_px: f64,
}

/// What leaving out texels that are never seen changes in views from the view box.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct PruneError {
    /// Largest difference of any channel, in levels of 255.
    pub max_abs: u8,
    /// Share of pixels, 0 to 1, that differ by more than 8 levels, in the view where it is largest.
    pub share_off: f64,
    /// Count of tiles in the views that were drawn with and without: all with `verify-prune`, else some of those with the most planes, each as if there were
    /// nothing around it and its neighbours.
    pub tiles: usize,
}

/// Errors that the approximations made, each against what the step was given. What was not applied is none.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default)]
pub struct ErrorFigures {
    /// The photo was made smaller.
    pub reduction: Option<Reduction>,
    /// Share of the depth map's pixels, 0 to 1, that were unknown and took the depth of a neighbour; of a map with depth in metres.
    pub depth_filled: Option<f64>,
    /// Share of pixels, 0 to 1, that were nearer than the nearest distance, and were put there; of a map with depth in metres.
    pub depth_clipped: Option<f64>,
    /// Depth was measured against a second view.
    pub stereo: Option<StereoError>,
    /// The disparity map was brought to the photo's size.
    pub resampling: Option<Moved>,
    /// It was cleaned of noise.
    pub denoise: Option<Moved>,
    /// Its ramps were drawn to the photo's edges.
    pub snap: Option<Moved>,
    /// Mean absolute error of the planes' disparity against the map that they were fitted to.
    pub depth_mae: f64,
    /// Mean squared error of the same.
    pub depth_mse: f64,
    /// Lower quartile of its absolute error.
    pub depth_q25: f64,
    /// Mean parallax error of each tile, row by row: pixels between where its planes show a point and where that map does, by the camera of
    /// the container's view box that shows them the farthest apart.
    pub tile_px: Vec<f64>,
    /// The same of all tiles, and what became of the bound on it.
    pub planes: PlaneError,
    /// What leaving out texels changes; none where a photo has too few tiles for a sample to be quick, and `verify-prune` was not asked for.
    pub prune: Option<PruneError>,
    /// PSNR in dB of the carried photo against the one that the scene was made of; 99 where they are equal.
    pub codec_psnr: f64,
    /// PSNR in dB of the hidden colours that the container carries against those that a network gave; none where they follow from the rest.
    pub hidden_psnr: Option<f64>,
    /// PSNR in dB of the view from the photo's own place against the photo, drawn from what a reader gets; 99 where they are equal.
    pub identity_psnr: f64,
    /// Count of tiles of that view; where it is not all, the rows between were not drawn.
    pub identity_tiles: usize,
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
    /// What was chosen, as on the command line; `error.planes` and `error.reduction` tell what error that made.
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
    /// Depth network, or `given` (a map beside the photo) or `carried` (one within its file), or `stereo` (measured against a second view).
    pub depth_model: String,
    /// All stages in order.
    pub stages: Vec<StageTime>,
    /// Wall time of all stages.
    pub total_ms: f64,
    /// Peak resident memory of the process so far.
    pub peak_rss_bytes: u64,
    /// What making was to take at most, by the formula that photos are admitted by, with the planes that were placed.
    #[serde(default)]
    pub memory_bound_bytes: u64,
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
