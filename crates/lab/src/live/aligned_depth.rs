//! A depth network whose disparity is aligned with the truth, to measure the effect of its scale errors.

use std::sync::{Arc, Mutex, PoisonError};

use tmpi_core::{DisparityMap, Photo};
use tmpi_live::align;
use tmpi_pipeline::Models;
use tmpi_pipeline::depth::{DepthError, Estimate, Estimator};

/// True disparity of the current frame.
#[derive(Clone, Default)]
pub struct Truth(Arc<Mutex<Option<DisparityMap>>>);

impl Truth {
    /// Sets the truth for the next frame.
    pub fn set(&self, delta: &DisparityMap) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(delta.clone());
    }

    /// Aligns a map with the truth, if both have the same size.
    fn align(&self, mut map: DisparityMap) -> DisparityMap {
        let truth = self.0.lock().unwrap_or_else(PoisonError::into_inner).clone();
        if let Some(truth) = truth.filter(|t| (t.width, t.height) == (map.width, map.height)) {
            align::fit(&map, &truth, &vec![true; map.delta.len()]).apply(&mut map.delta);
        }
        map
    }

    /// The same networks, with a depth network whose disparity is aligned by the best scale and shift for each frame.
    pub fn scaled(&self, models: &Models) -> Models {
        Models { depth: Arc::new(Scaled { network: Arc::clone(&models.depth), truth: self.clone() }), ..models.clone() }
    }
}

struct Scaled {
    network: Arc<dyn Estimator>,
    truth: Truth,
}

impl Estimator for Scaled {
    fn name(&self) -> &str {
        self.network.name()
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        self.network.estimate(photo).map(|map| self.truth.align(map))
    }

    fn sizes(&self, width: u32, height: u32) -> Vec<(u32, u32)> {
        self.network.sizes(width, height)
    }

    fn estimate_at(&self, photo: &Photo, size: (u32, u32)) -> Result<Estimate, DepthError> {
        self.network.estimate_at(photo, size).map(|e| Estimate { map: self.truth.align(e.map), ..e })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "test")]

    use super::*;

    /// Half of the true disparity, plus a quarter.
    struct Half;

    impl Estimator for Half {
        fn name(&self) -> &'static str {
            "half"
        }

        fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
            let delta = photo.rgb.iter().map(|p| f32::from(p[0]) / 510.0 + 0.25).collect();
            Ok(DisparityMap { width: photo.width, height: photo.height, delta })
        }
    }

    #[test]
    fn wrong_scale_and_shift_are_corrected() {
        let photo = Photo { width: 40, height: 30, rgb: (0..1200).map(|i| [(i % 200) as u8; 3]).collect() };
        let truth = DisparityMap { width: 40, height: 30, delta: photo.rgb.iter().map(|p| f32::from(p[0]) / 255.0).collect() };
        let given = Truth::default();
        let models = given.scaled(&Models { depth: Arc::new(Half), theta: None, psi: None });
        assert_eq!(models.depth.estimate(&photo).unwrap(), Half.estimate(&photo).unwrap(), "unchanged without a truth");
        given.set(&truth);
        let found = models.depth.estimate(&photo).unwrap();
        let most = found.delta.iter().zip(&truth.delta).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(most < 1e-3, "{most}");
    }
}
