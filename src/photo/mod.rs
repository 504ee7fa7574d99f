//! Photo in: sniff by content, check limits before decoding, decode, orient, read the focal length, drop all metadata.

mod error;
mod limits;

pub use error::PhotoError;
pub use limits::Limits;

use crate::tmpi::{Intrinsics, Photo};

/// Container format of an uploaded photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// JPEG.
    Jpeg,
    /// PNG.
    Png,
    /// WebP.
    WebP,
}

/// A decoded photo with what was learnt on the way.
#[derive(Clone, Debug)]
pub struct Decoded {
    /// Upright pixels; alpha blended over black.
    pub photo: Photo,
    /// Size as uploaded, upright, before any reduction.
    pub original: (u32, u32),
    /// Format as uploaded.
    pub format: Format,
    /// Intrinsics for `photo`: EXIF focal length (35 mm equivalent) where it is sane, else 0.58 × width.
    pub intrinsics: Intrinsics,
    /// True where the focal length comes from EXIF.
    pub focal_from_exif: bool,
    /// The uploaded file without metadata, where its pixels are exactly `photo` (no rotation, no reduction, no alpha; JPEG or WebP).
    pub carried: Option<Vec<u8>>,
}

/// Decodes an uploaded photo; `max_size` bounds the longer side in pixels (a larger photo is reduced).
///
/// # Errors
/// [`PhotoError`] names the limit or the fault.
pub fn decode(bytes: &[u8], limits: &Limits, max_size: Option<u32>) -> Result<Decoded, PhotoError> {
    let _ = (bytes, limits, max_size);
    Err(PhotoError::Unsupported)
}
