//! Disparity of a photo: from a monocular depth network, or from a map that the photo carries or the user gives.

mod adapter;
mod detect;
mod embedded;

mod given_map;
mod grey;
mod monocular;
mod onnx_io;
mod openexr;
mod pfm;
mod png_writer;
pub mod points;
mod resample;
mod smooth;
mod upsample;

pub use adapter::{ADAPTERS, Adapter, Kind, Outputs, Sampling, SizeRule, Sky, adapter};
pub use detect::detect;
pub(crate) use embedded::multi::second_picture;
pub(crate) use embedded::xmp;
pub use embedded::{EmbeddedDepth, embedded_depth};
pub(crate) use given_map::fits;
pub use given_map::{check, from_half, from_map, from_map_beside, head};
pub use monocular::Monocular;
pub use png_writer::to_png;
pub use resample::resized;
pub use upsample::{halved, upsample};

use tmpi_core::{DisparityMap, Photo};

/// What the values of a user's own depth map mean.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum DepthKind {
    /// `δ = v / 65535`, used unchanged.
    #[default]
    Disparity,
    /// `δ = 1 − v / 65535`: white is far.
    Inverted,
    /// Depth; `δ = z_min / z`, 0 marks unknown.
    Metric,
}

/// Why there is no disparity map.
#[derive(Clone, Debug, thiserror::Error)]
pub enum DepthError {
    /// The depth map is not a grey picture that can be read.
    #[error("the depth map cannot be read: {0}")]
    Map(String),
    /// The depth that the photo carries cannot be read.
    #[error("the depth map within the photo cannot be read: {0}")]
    Embedded(String),
    /// The photo carries no depth, and the options allow no other.
    #[error("the photo carries no depth map, but photo-depth is on")]
    NotEmbedded,
    /// The picture of the second eye cannot be read.
    #[error("the picture of the second eye cannot be read: {0}")]
    Second(String),
    /// The picture of the second eye is missing.
    #[error("stereo is beside, but there is no picture of the second eye beside the photo")]
    NoSecond,
    /// The picture shows all directions.
    #[error("this is a 360° picture, which no flat photo can show; stereo none reads it as one flat photo")]
    Sphere,
    /// The map cannot be written as a file.
    #[error("the depth map cannot be written: {0}")]
    Write(String),
    /// The network failed.
    #[error(transparent)]
    Onnx(#[from] crate::networks::OnnxError),
}

/// A monocular depth estimator: the network and everything before and after it.
pub trait Estimator: Send + Sync {
    /// Name in the report.
    fn name(&self) -> &str;

    /// Disparity at the photo's size, normalised to `[0, 1]` by robust percentiles; larger is nearer. Every value is finite.
    ///
    /// # Errors
    /// [`DepthError::Onnx`] if the network cannot run.
    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError>;

    /// Disparity as the network returns it, at its own size and scale; larger is nearer. An estimator without a network returns what
    /// [`Estimator::estimate`] does.
    ///
    /// # Errors
    /// [`DepthError::Onnx`] if the network cannot run.
    fn raw(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        self.estimate(photo)
    }

    /// Sizes at which the network can run for a photo of `width × height` pixels: first that of [`Estimator::estimate`], then ever
    /// smaller ones. Empty if there is no choice.
    fn sizes(&self, _width: u32, _height: u32) -> Vec<(u32, u32)> {
        Vec::new()
    }

    /// Whether it may wait for a graphics device, so that processor time does not tell what it costs.
    fn may_use_device(&self) -> bool {
        false
    }

    /// Like [`Estimator::estimate`], with the network at one of [`Estimator::sizes`]. Nothing else depends on this size.
    ///
    /// # Errors
    /// [`DepthError::Onnx`] if the network cannot run.
    fn estimate_at(&self, photo: &Photo, _size: (u32, u32)) -> Result<Estimate, DepthError> {
        Ok(self.estimate(photo)?.into())
    }
}

/// A function of the photo, and its name.
impl<F> Estimator for (&'static str, F)
where
    F: Fn(&Photo) -> Result<DisparityMap, DepthError> + Send + Sync,
{
    fn name(&self) -> &str {
        self.0
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        (self.1)(photo)
    }
}

/// Result of an [`Estimator`].
#[derive(Clone, Debug)]
pub struct Estimate {
    /// Disparity at the photo's size.
    pub map: DisparityMap,
    /// The same at the network's own size, if it was enlarged.
    pub small: Option<DisparityMap>,
    /// Milliseconds that the network alone took; 0 if unknown.
    pub network_ms: f64,
}

impl From<DisparityMap> for Estimate {
    fn from(map: DisparityMap) -> Self {
        Self { map, small: None, network_ms: 0.0 }
    }
}

/// A depth map that was read.
#[derive(Clone, Debug)]
pub struct Read {
    /// Disparity at the photo's size.
    pub map: DisparityMap,
    /// Upright width and height of the file's own map.
    pub size: (u32, u32),
    /// Disparity at that size, if it is not the photo's.
    pub own: Option<DisparityMap>,
    /// Share of its pixels, 0 to 1, that were unknown and took the depth of a neighbour; `None` for a map without unknown pixels.
    pub filled: Option<f64>,
    /// Share of its pixels, 0 to 1, that were nearer than the nearest distance and were moved there; `None` for a map that states its
    /// own.
    pub clipped: Option<f64>,
}

impl Read {
    /// Resamples the values of a map of size `(w, h)` to the size of the photo.
    fn new(delta: Vec<f32>, (w, h): (u32, u32), (width, height): (u32, u32)) -> Self {
        let own = DisparityMap { width: w, height: h, delta };
        let (map, own) = if (w, h) == (width, height) { (own, None) } else { (resample::resized(&own, width, height), Some(own)) };
        Self { map, size: (w, h), own, filled: None, clipped: None }
    }
}
