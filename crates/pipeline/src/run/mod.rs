//! Runs a photo through its [`stages`]: photo → depth → denoise → strokes → snap → planes → layers → refine → encode → verify.
//!
//! The command line, the server's workers, `tmpi-lab` and the tests all call [`make`].

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
pub use crate::planes::Method as PlaneMethod;

pub use input_sizes::{ExtraPicture, Sizes};
pub use make::make;
pub use options::{Denoise, Options, PlaneCount, Switch, TileSize};
pub use parallax_error::{Parallax, TileError};
pub use progress::{Progress, Silent, Sink};
pub use report::{Budget, Bytes, ErrorFigures, Input, InputDepth, LeftOut, ParallaxShift, PlaneError, PruneError, Report, StageTime};
pub use stage::{Begun, Context};
pub use stages::STAGES;

/// Networks of the pipeline, loaded once per process and shared by all photos.
#[derive(Clone)]
pub struct Models {
    /// Monocular depth.
    pub depth: Arc<dyn Estimator>,
    /// Θ: confidence and denoised disparity; `None` if its file is missing.
    pub theta: Option<Arc<dyn Network>>,
    /// Ψ: soft alpha and hidden colours; `None` if its file is missing.
    pub psi: Option<Arc<dyn Network>>,
}

impl Models {
    /// Rejects options that need a missing network.
    ///
    /// # Errors
    /// [`StageError::Network`] names the option and the file.
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

/// Result of making a photo.
#[derive(Clone, Debug)]
pub struct Made {
    /// The container, ready to be stored or sent.
    pub container: Vec<u8>,
    /// What the stages did and left out, with errors and costs.
    pub report: Report,
    /// The disparity map that planes were fitted to, at the scene's size.
    pub disparity: DisparityMap,
    /// The disparity map before strokes, reduced by [`crate::strokes::to_keep`]; `None` without strokes.
    pub before_strokes: Option<DisparityMap>,
}

/// Why a photo could not be made.
#[derive(Debug, thiserror::Error)]
pub enum MakeError {
    /// The photo is invalid or exceeds a limit.
    #[error(transparent)]
    Photo(#[from] PhotoError),
    /// The depth map or second picture is invalid, or the depth network failed.
    #[error(transparent)]
    Depth(#[from] DepthError),
    /// An option is out of range, or a stage failed.
    #[error(transparent)]
    Generate(#[from] StageError),
    /// The container could not be written.
    #[error(transparent)]
    Atlas(#[from] tmpi_core::container::ContainerError),
    /// A view of the scene could not be drawn.
    #[error(transparent)]
    Render(#[from] tmpi_render::RenderError),
    /// The caller cancelled.
    #[error("cancelled")]
    Cancelled,
    /// The caller's deadline passed before this stage.
    #[error("no time left for the stage {stage}")]
    Late {
        /// Name of the stage.
        stage: &'static str,
    },
}
