//! What layers need beyond the planes of their pixels: background planes where a tile's neighbourhood shows farther surfaces and,
//! optionally, soft alphas and hidden colours that a network refines.

mod background;
pub mod refine;

pub use background::{BackgroundSamples, add_backgrounds, add_backgrounds_by, add_backgrounds_to};
