//! A depth network whose disparity is brought to the scale of the truth: what its scale alone costs is told by the difference.

use std::sync::{Arc, Mutex, PoisonError};

use tmpi_core::{DisparityMap, Photo};
use tmpi_live::align;
use tmpi_pipeline::Models;
use tmpi_pipeline::depth::{DepthError, Estimate, Estimator};

/// The truth of the frame under way.
#[derive(Clone, Default)]
pub struct Truth(Arc<Mutex<Option<DisparityMap>>>);

impl Truth {
    /// Of the frame that comes next.
    pub fn is(&self, delta: &DisparityMap) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(delta.clone());
    }

    /// A map brought to it, where it is of one size with it.
    fn brought(&self, mut map: DisparityMap) -> DisparityMap {
        let truth = self.0.lock().unwrap_or_else(PoisonError::into_inner).clone();
        if let Some(truth) = truth.filter(|t| (t.width, t.height) == (map.width, map.height)) {
            align::fit(&map, &truth, &vec![true; map.delta.len()]).apply(&mut map.delta);
        }
        map
    }

    /// The same networks, of which that for depth gives its disparity on the truth's scale: the best one factor and shift for a frame.
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
        self.network.estimate(photo).map(|map| self.truth.brought(map))
    }

    fn sizes(&self, width: u32, height: u32) -> Vec<(u32, u32)> {
        self.network.sizes(width, height)
    }

    fn estimate_at(&self, photo: &Photo, size: (u32, u32)) -> Result<Estimate, DepthError> {
        self.network.estimate_at(photo, size).map(|e| Estimate { map: self.truth.brought(e.map), ..e })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "test")]

    use super::*;

    /// Half of what it should be, from a quarter on.
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
    fn a_scale_that_is_off_is_brought_to_the_truth() {
        let photo = Photo { width: 40, height: 30, rgb: (0..1200).map(|i| [(i % 200) as u8; 3]).collect() };
        let truth = DisparityMap { width: 40, height: 30, delta: photo.rgb.iter().map(|p| f32::from(p[0]) / 255.0).collect() };
        let given = Truth::default();
        let models = given.scaled(&Models { depth: Arc::new(Half), theta: None, psi: None });
        assert_eq!(models.depth.estimate(&photo).unwrap(), Half.estimate(&photo).unwrap(), "without a truth nothing is changed");
        given.is(&truth);
        let found = models.depth.estimate(&photo).unwrap();
        let most = found.delta.iter().zip(&truth.delta).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(most < 1e-3, "{most}");
    }
}
