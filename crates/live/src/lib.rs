//! The geometry of a room: takes camera frames, and returns the planes and labels that changed.
//!
//! It runs the same stages as for a photo ([`tmpi_pipeline::run::stages`]), but keeps state between frames:
//!
//! 1. [`change`] finds the blocks of 8×8 pixels that differ from the last frame. Encoded video repeats still areas bit for bit, including
//!    sensor noise, so this is a test for equality; a tolerance handles frames that were not encoded. Unchanged blocks cost nothing: no
//!    depth, no planes, no bytes. A luma histogram detects cuts, after which no state is kept.
//! 2. Depth comes from the network or from the camera, and is snapped to edges as in a photo.
//! 3. [`align`] fits scale and shift: a network estimates depth only up to these, and they differ in each frame. The fit is robust and uses
//!    the pixels that did not change; these keep their depth, and new depth joins them without a step.
//! 4. Changed tiles get new planes, starting from the last ones ([`tmpi_pipeline::planes::place_again`]). Labels change only if that gains
//!    much.
//! 5. [`tile_displacement()`] compares each new tile with the one sent last. If no point moves by more than a quarter of a pixel, for any
//!    camera in the view box, the tile is not sent and the room keeps the old one, so that it always has the tiles that its readers have.
//! 6. The other tiles are encoded as chunks ([`tmpi_core::live::chunk`]).
//!
//! [`FramePipeline`] aims at a time [`Budget`], based on earlier measurements: if frames are late, the depth network runs at a smaller size
//! or less often, and tiles get fewer planes. The changed tiles of a frame always go together. After a frame whose tiles were sent, there is
//! a short cooldown ([`Settings::cooldown`]); changes during it are sent after it.
//!
//! [`video`] and [`depth_codec`] decode what publishers send, and [`access_units`] splits their streams. This crate does no I/O and never
//! blocks.

pub mod access_units;
pub mod align;
pub mod change;
pub mod depth_codec;
mod depth_recheck;
mod frame_budget;
mod frame_pipeline;
mod tile_displacement;
mod tile_queue;
pub mod video;

pub use frame_budget::{Budget, DepthTime, TileBudget};
pub use frame_pipeline::{BUDGET_MS, COOLDOWN, Frame, FramePipeline, GeometryError, MAX_ERROR, PARALLAX, Settings, Update};
pub use tile_displacement::tile_displacement;
