//! Oracle depth: a known disparity map in place of a network's estimate.

use tmpi_core::{DisparityMap, Photo};
use tmpi_pipeline::depth::{DepthError, Estimator};

/// Returns a known map as an estimator, so that the pipeline treats it as estimated.
pub struct OracleDepth(pub DisparityMap);

impl Estimator for OracleDepth {
    fn name(&self) -> &'static str {
        "oracle"
    }

    fn estimate(&self, _: &Photo) -> Result<DisparityMap, DepthError> {
        Ok(self.0.clone())
    }
}
