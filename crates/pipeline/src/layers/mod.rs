//! What layers need beyond the planes of their pixels: background planes where a tile's neighbourhood shows farther surfaces and,
//! optionally, soft alphas and hidden colours that a network refines, or hidden colours that a second picture shows.

mod background;
pub mod refine;
mod seen_colours;

pub use background::{add_backgrounds, add_backgrounds_to};
pub use seen_colours::{Seen, recolour};
