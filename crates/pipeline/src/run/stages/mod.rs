//! The stages of a photo, in order. Each takes the results of earlier stages.

mod depth;
mod encode;
mod layers;
mod photo;
mod planes;
mod strokes;
mod verify;

pub use depth::{Denoise, Depth, SecondPicture, Snap, Source, WeightedDisparity};
pub use encode::{Encode, Encoded};
pub use layers::{Layered, Layers, Refine};
pub use photo::{Prepare, Prepared};
pub use planes::{Placed, Planes};
pub use strokes::Strokes;
pub use verify::Verify;

use super::Stage;

/// Names of all stages, in order.
pub const STAGES: [&str; 10] = [
    Prepare::NAME,
    Depth::NAME,
    Denoise::NAME,
    Strokes::NAME,
    Snap::NAME,
    Planes::NAME,
    Layers::NAME,
    Refine::NAME,
    Encode::NAME,
    Verify::NAME,
];
