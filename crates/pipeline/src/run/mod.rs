//! Drives a photo through its [`stages`]: photo → depth → denoise → snap → planes → layers → refine → encode → verify.
//!
//! The command line, the server's workers, the instruments and the tests all call [`make`].

mod input_sizes;
mod make;
pub mod memory;
mod options;
mod parallax_error;
mod progress;
mod prune_error;
mod report;
mod stage;
pub mod stages;
#[cfg(test)]
mod tests;
pub mod time_budget;

use std::sync::Arc;

use tmpi_core::DisparityMap;

use crate::StageError;
use crate::depth::{DepthError, Estimator};
use crate::networks::Network;
use crate::networks::models::{PSI, THETA};
use crate::photo::PhotoError;
pub use crate::photo::Reduction;

pub use input_sizes::{Other, Sizes};
pub use make::make;
pub use options::{Denoise, Options, PlaneCount, PlaneMethod, Switch, TileSize};
pub use parallax_error::{Movement, TileError};
pub use progress::{Progress, Silent, Sink};
pub use report::{Budget, Bytes, ErrorFigures, Input, InputDepth, LeftOut, Moved, PlaneError, PruneError, Report, StageTime};
pub use stage::{Context, Stage};
pub use stages::STAGES;

/// The networks of the pipeline, loaded once per process and shared by all photos.
#[derive(Clone)]
pub struct Models {
    /// Monocular depth.
    pub depth: Arc<dyn Estimator>,
    /// Θ: confidence and denoised disparity, where its file is there.
    pub theta: Option<Arc<dyn Network>>,
    /// Ψ: soft alpha and hidden colour, where its file is there.
    pub psi: Option<Arc<dyn Network>>,
}

impl Models {
    /// Refuses options that want a network that is not there.
    ///
    /// # Errors
    /// [`StageError::Network`].
    pub fn check(&self, options: &Options) -> Result<(), StageError> {
        if options.denoise == Denoise::Theta && self.theta.is_none() {
            return Err(StageError::Network { field: "denoise", value: "theta", file: THETA });
        }
        if options.refine == Switch::On && self.psi.is_none() {
            return Err(StageError::Network { field: "refine", value: "on", file: PSI });
        }
        Ok(())
    }
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
    /// What strokes went over, as [`crate::strokes::to_keep`] keeps it; none where there were none.
    pub before_strokes: Option<DisparityMap>,
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
    /// The time that the caller gave was over before this stage.
    #[error("there was no time left for the stage {stage}")]
    Late {
        /// Name of the stage.
        stage: &'static str,
    },
}
