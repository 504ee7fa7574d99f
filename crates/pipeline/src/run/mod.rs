//! Drives a photo through all stages: photo → depth → denoise → snap → planes → layers → refine → encode → verify.
//!
//! The command line, the server's workers, the instruments and the tests all call [`make`].

pub mod budget;
mod make;
mod progress;
mod prune;
mod report;
mod tile_error;

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::StageError;
use crate::depth::{DepthError, DepthKind, Estimator};
use crate::networks::Network;
use crate::photo::PhotoError;
pub use make::{STAGES, make};
pub use progress::{Progress, Silent, Sink};
pub use report::{Budget, Bytes, ErrorFigures, Input, LeftOut, Report, Stage};
use tmpi_core::{DisparityMap, ViewBox};

/// How planes are placed in a tile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum PlaneMethod {
    /// Evenly in disparity between the tile's extremes.
    Linear,
    /// Confidence-weighted k-means (the paper's).
    Lloyd,
    /// Exact one-dimensional k-means by dynamic programming.
    Optimal,
    /// Confidence-weighted k-planes with slanted planes.
    #[default]
    Slanted,
}

/// How many planes a tile gets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PlaneCount {
    /// The fewest that meet the error target.
    #[default]
    Auto,
    /// Always this many (fewer where a tile has fewer distinct disparities).
    Fixed(u32),
}

/// Tile size.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TileSize {
    /// Square tiles of that many pixels.
    Pixels(u32),
    /// One tile: a regular MPI.
    Full,
}

/// A step that runs where it helps, or not at all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Switch {
    /// Where it helps by measure.
    #[default]
    Auto,
    /// Always.
    On,
    /// Never.
    Off,
}

/// How the disparity map is cleaned before planes are placed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Denoise {
    /// Planes fitted around each pixel where noise is measured; a map without noise or outliers stays as it is.
    #[default]
    Auto,
    /// The network Θ, whatever the map is like.
    Theta,
    /// 5-pixel median and guided filter.
    Classic,
    /// Not at all.
    Off,
}

/// Everything a caller can choose; the defaults are those of the command line and of the server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Options {
    /// How the user's own depth map is meant.
    pub depth_kind: DepthKind,
    /// Horizontal field of view in degrees; none: EXIF, else 0.58 × width.
    pub fov_x: Option<f64>,
    /// Planes a tile.
    pub planes: PlaneCount,
    /// Their placement.
    pub plane_method: PlaneMethod,
    /// Tile size.
    pub tile: TileSize,
    /// Snapping of depth ramps to colour edges.
    pub snap: Switch,
    /// Refinement by Ψ.
    pub refine: Switch,
    /// Cleaning of the disparity map.
    pub denoise: Denoise,
    /// Longest side in pixels; larger photos are reduced.
    pub max_size: Option<u32>,
    /// Picture quality, 1 to 100.
    pub quality: u8,
    /// Parallax error that planes may leave over the view box, in pixels.
    pub max_error: f64,
    /// Camera positions to make the scene for.
    pub view_box: ViewBox,
    /// Wall time that making may take, in milliseconds: size and parallax error are chosen for it.
    pub budget_ms: Option<f64>,
    /// Whether to measure what leaving out unseen texels changes; it takes about as long as making the scene.
    pub verify_prune: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            depth_kind: DepthKind::default(),
            fov_x: None,
            planes: PlaneCount::default(),
            plane_method: PlaneMethod::default(),
            tile: TileSize::Pixels(64),
            snap: Switch::default(),
            refine: Switch::default(),
            denoise: Denoise::default(),
            max_size: None,
            quality: 90,
            max_error: 0.5,
            view_box: ViewBox::default(),
            budget_ms: None,
            verify_prune: false,
        }
    }
}

/// The networks of the pipeline, loaded once per process and shared by all photos.
#[derive(Clone)]
pub struct Models {
    /// Monocular depth.
    pub depth: Arc<dyn Estimator>,
    /// Θ: confidence and denoised disparity; none: no confidence.
    pub theta: Option<Arc<dyn Network>>,
    /// Ψ: soft alpha and hidden colour; none: no refinement.
    pub psi: Option<Arc<dyn Network>>,
}

/// A made photo.
#[derive(Clone, Debug)]
pub struct Made {
    /// The container, ready to be stored or sent.
    pub container: Vec<u8>,
    /// What was done, left out, and at what error and cost.
    pub report: Report,
    /// Disparity as used: the map that planes were fitted to, at the scene's size.
    pub disparity: DisparityMap,
}

/// Why a photo could not be made.
#[derive(Debug, thiserror::Error)]
pub enum MakeError {
    /// The photo is at fault.
    #[error(transparent)]
    Photo(#[from] PhotoError),
    /// The depth map or the depth network is at fault.
    #[error(transparent)]
    Depth(#[from] DepthError),
    /// An option is out of range, or a step failed.
    #[error(transparent)]
    Generate(#[from] StageError),
    /// The container could not be written.
    #[error(transparent)]
    Atlas(#[from] tmpi_core::container::ContainerError),
    /// The identity view could not be drawn.
    #[error(transparent)]
    Render(#[from] tmpi_render::RenderError),
    /// The caller no longer wants the result.
    #[error("cancelled")]
    Cancelled,
}
