//! Limits of an upload, checked before any pixel is decoded (DESIGN, section 8).

/// Bounds on an uploaded photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// File size in bytes.
    pub bytes: usize,
    /// Pixels, width × height.
    pub pixels: u64,
    /// Longest side in pixels.
    pub side: u32,
    /// Memory that a decoder may take, in bytes.
    pub decoder_memory: u64,
}

impl Limits {
    /// 32 MiB.
    pub const BYTES: usize = 32 << 20;
    /// 50 megapixels.
    pub const PIXELS: u64 = 50_000_000;
    /// 16 384 pixels a side.
    pub const SIDE: u32 = 16_384;
    /// 256 MiB.
    pub const DECODER_MEMORY: u64 = 256 << 20;
}

impl Default for Limits {
    fn default() -> Self {
        Self { bytes: Self::BYTES, pixels: Self::PIXELS, side: Self::SIDE, decoder_memory: Self::DECODER_MEMORY }
    }
}
