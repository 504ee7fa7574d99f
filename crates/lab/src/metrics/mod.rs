//! Measures of pictures.

mod flip;
mod ssim;
#[cfg(feature = "codecs")]
mod ssimulacra;

pub use flip::{PIXELS_PER_DEGREE, flip, flip_map};
pub use ssim::ssim_map;
#[cfg(feature = "codecs")]
pub use ssimulacra::Ssimulacra2;
pub use tmpi_render::difference::{EQUAL, max_abs, psnr, share_off};
