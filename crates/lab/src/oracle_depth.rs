//! Oracle depth: a known disparity map in place of a network's estimate.

use std::sync::Arc;

use tmpi_core::{DisparityMap, Photo};
use tmpi_pipeline::Models;
use tmpi_pipeline::depth::Estimator;

/// Returns a known map as an estimator, so that the pipeline treats it as estimated.
pub fn oracle(map: DisparityMap) -> impl Estimator + 'static {
    ("oracle", move |_: &Photo| Ok(map.clone()))
}

/// Models whose depth is empty, for measurements that estimate none.
pub fn none() -> Models {
    models(oracle(DisparityMap { width: 0, height: 0, delta: Vec::new() }))
}

/// This source of depth, and no other networks.
pub fn models(depth: impl Estimator + 'static) -> Models {
    Models { depth: Arc::new(depth), theta: None, psi: None }
}
