//! Data types of a tiled multiplane image: grid, plane, camera, scene (paper, section 3.1).
//!
//! Camera axes: x right, y down, z forward. Pixel centres are at half-integers. Depth is always a disparity `δ = 1/z`: 0 is infinitely far
//! and 1 is the photo's nearest surface, so lengths are in units of the nearest distance.

mod border_colours;
mod camera;
#[cfg(feature = "digest")]
mod digest;
mod grid;
mod multiplane;
pub(crate) mod packed_rgb;
mod plane;

pub use border_colours::{Border, BorderColours};
pub use camera::{Camera, Intrinsics, Mat3, Pose, ViewBox, homography, mat3_mul, mat3_vec};
pub use grid::{Grid, Rect};
pub use multiplane::{Class, DisparityMap, Layer, Photo, Scene, SceneError, Texels};
pub use plane::Plane;
