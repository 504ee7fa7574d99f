//! What layers need beyond the planes that pixels lie on: a background plane where a tile's neighbourhood shows one, and, where it is
//! wanted, soft alphas and hidden colours refined by a network.

mod background;
pub mod refine;

pub use background::{add_backgrounds, add_backgrounds_to};
