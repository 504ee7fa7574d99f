//! Limits of an upload, checked before any pixel is decoded.

use super::PhotoError;

/// Bounds on an uploaded photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// File size in bytes.
    pub bytes: usize,
    /// Pixels, width × height.
    pub pixels: u64,
    /// Longest side in pixels.
    pub side: u32,
    /// Memory that a decoder may take, in bytes: coefficients, planes, and the output in the file's own sample format.
    pub decoder_memory: u64,
    /// Memory that making the photo may take in total, in bytes (`Options::memory` estimates it).
    pub memory: u64,
}

impl Limits {
    /// 32 MiB.
    pub const BYTES: usize = 32 << 20;
    /// 50 megapixels.
    pub const PIXELS: u64 = tmpi_core::container::MAX_PIXELS;
    /// 16 384 pixels a side.
    pub const SIDE: u32 = tmpi_core::container::MAX_SIDE;
    /// 512 MiB: 50 megapixels of a progressive JPEG without subsampling take 450 MB, of a PNG of 16 bits with alpha 400 MB.
    pub const DECODER_MEMORY: u64 = 512 << 20;
    /// No limits, for data that was checked before.
    pub(crate) const NONE: Self = Self { bytes: usize::MAX, pixels: u64::MAX, side: u32::MAX, decoder_memory: u64::MAX, memory: u64::MAX };

    /// Checks the size of a file.
    pub(crate) fn check_bytes(&self, bytes: usize) -> Result<(), PhotoError> {
        if bytes > self.bytes { Err(PhotoError::TooManyBytes { bytes, limit: self.bytes }) } else { Ok(()) }
    }

    /// Checks the size of a picture.
    pub(crate) fn check_size(&self, width: u32, height: u32) -> Result<(), PhotoError> {
        if width == 0 || height == 0 {
            return Err(PhotoError::Broken(format!("a picture of {width}×{height} pixels")));
        }
        if width.max(height) > self.side {
            return Err(PhotoError::SideTooLong { width, height, limit: self.side });
        }
        if u64::from(width) * u64::from(height) > self.pixels {
            return Err(PhotoError::TooManyPixels { width, height, limit: self.pixels });
        }
        Ok(())
    }

    /// Checks the memory that a decoder would take.
    pub(crate) fn check_memory(&self, bytes: u64) -> Result<(), PhotoError> {
        if bytes > self.decoder_memory { Err(PhotoError::TooMuchMemory { bytes, limit: self.decoder_memory }) } else { Ok(()) }
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self { bytes: Self::BYTES, pixels: Self::PIXELS, side: Self::SIDE, decoder_memory: Self::DECODER_MEMORY, memory: u64::MAX }
    }
}
