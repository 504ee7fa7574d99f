//! The driver of a room: frames of a camera in, the planes and labels that changed out.
//!
//! It runs the same stages as the driver of a photo ([`tmpi_pipeline::run::stages`]), with what they carry from frame to frame:
//!
//! 1. [`change`]: which blocks of 8×8 pixels differ from the last frame. Video that was encoded repeats what stands still bit for bit,
//!    sensor noise and all, so this is a test for equality; a tolerance is for frames that were not. What did not change costs nothing:
//!    no depth, no planes, no bytes. A histogram of luma tells a cut, after which nothing is carried on.
//! 2. Depth by the network, or as the camera gives it; snapped to edges as in a photo.
//! 3. [`align`]: a network tells depth up to scale and shift, and each frame others. Both are fitted, robustly, to what is known of the
//!    pixels that did not change; these keep their depth, and what is new meets them where both touch.
//! 4. Planes of changed tiles, starting from the last ones ([`tmpi_pipeline::planes::place_again`]); labels change only where much is won.
//! 5. [`moved()`]: tiles that would show nothing elsewhere than the ones that were sent last, by more than a quarter of a pixel from any camera
//!    of the view box, are not sent, and the room goes on with what was: it has of each tile what its readers have.
//! 6. Chunks ([`tmpi_core::live::chunk`]) of the others.
//!
//! [`Geometry`] drives all that under a [`Budget`] of time, by what the stages took before: where a frame is late the depth network runs at a smaller
//! size, tiles get fewer planes, and what does not fit then waits for the next frame; what changed most goes first, and nothing waits for ever. After a
//! frame of which tiles were sent others rest for a moment ([`Settings::rest`]): what changed in them is sent with the one after.
//! [`video`] and [`depth`] decode what publishers send, [`units`] splits their streams. Nothing here knows of sockets or rooms, and nothing waits.

pub mod align;
mod budget;
pub mod change;
pub mod depth;
mod geometry;
mod moved;
mod queue;
mod settle;
pub mod units;
pub mod video;

pub use budget::{Budget, Share};
pub use change::Tolerance;
pub use geometry::{BUDGET_MS, Frame, Geometry, GeometryError, MAX_ERROR, PARALLAX, REST, Settings, Update};
pub use moved::moved;
pub use settle::{SETTLES, Settling};
