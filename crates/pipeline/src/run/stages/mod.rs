//! The stages of a photo, in order. Each takes the results of earlier stages.

mod depth;
mod encode;
mod layers;
mod photo;
mod planes;
mod verify;

pub(super) use depth::apply_strokes;
pub use depth::{SecondPicture, Source, WeightedDisparity, find_disparity, remove_noise, snap_and_widen, snap_to_video};
pub(super) use encode::{Encoded, encode_scene};
pub use layers::{Layered, make_layers, refine_layers};
pub use photo::Prepared;
pub(super) use photo::prepare;
pub use planes::{Placed, WarmStart, place_planes};
pub(super) use verify::verify_container;

/// Names of all stages, in order.
pub const STAGES: [&str; 10] = ["photo", "depth", "denoise", "strokes", "snap", "planes", "layers", "refine", "encode", "verify"];
