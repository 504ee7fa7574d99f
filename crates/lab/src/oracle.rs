//! Oracle depth: a disparity map that is known, in the place of a network's.

use tmpi_core::{DisparityMap, Photo};
use tmpi_pipeline::depth::{DepthError, Estimator};

/// Hands out a map as if a network had estimated it, so that the pipeline treats it as estimated.
pub struct OracleDepth(pub DisparityMap);

impl Estimator for OracleDepth {
    fn name(&self) -> &'static str {
        "oracle"
    }

    fn estimate(&self, _: &Photo) -> Result<DisparityMap, DepthError> {
        Ok(self.0.clone())
    }
}
