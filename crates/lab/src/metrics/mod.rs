//! Picture metrics.

mod filter;
mod flip;
mod ssim;

pub use flip::{PIXELS_PER_DEGREE, flip, flip_map};
pub use ssim::ssim_map;
pub use tmpi_render::difference::{MAX_PSNR, max_abs, psnr, psnr_of, share_off};

/// Share of a view that is cropped on each side before it is compared, as in the paper.
pub const CROP: f64 = 0.15;

/// Number of columns or rows that are cropped on each side of so many.
pub fn margin(side: usize) -> usize {
    (side as f64 * CROP) as usize
}

/// A picture with `width` pixels per row, without [`margin`] on each side.
pub fn cropped<T: Copy>(picture: &[T], width: usize) -> Vec<T> {
    let height = picture.len() / width;
    let (x, y) = (margin(width), margin(height));
    picture.chunks(width).skip(y).take(height - 2 * y).flat_map(|row| &row[x..width - x]).copied().collect()
}
