//! Picture metrics.

mod flip;
mod ssim;

pub use flip::{PIXELS_PER_DEGREE, flip, flip_map};
pub use ssim::ssim_map;
pub use tmpi_render::difference::{MAX_PSNR, max_abs, psnr, share_off};
