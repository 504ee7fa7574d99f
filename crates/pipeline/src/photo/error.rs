//! Errors of reading a photo.

/// Why a photo is refused.
#[derive(Debug, thiserror::Error)]
pub enum PhotoError {
    /// The first bytes belong to no supported format.
    #[error("not a JPEG, PNG or WebP picture")]
    Unsupported,
    /// A HEIC or AVIF file, as phones write them.
    #[error(
        "HEIC and AVIF pictures are not supported: on an iPhone, Settings > Camera > Formats > Most Compatible takes JPEG from now on, and \
         Photos > Share > Options > Most Compatible sends this one as JPEG; elsewhere export it as JPEG, where a portrait may lose its depth, which \
         is then estimated"
    )]
    Heic,
    /// The file is larger than allowed.
    #[error("file of {bytes} bytes is over the limit of {limit} bytes")]
    TooManyBytes {
        /// Bytes of the file.
        bytes: usize,
        /// Bytes allowed.
        limit: usize,
    },
    /// The photo has more pixels than allowed.
    #[error("{width}×{height} is over the limit of {limit} pixels")]
    TooManyPixels {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Pixels allowed.
        limit: u64,
    },
    /// A side is longer than allowed.
    #[error("{width}×{height} is over the limit of {limit} pixels a side")]
    SideTooLong {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Longest side allowed, in pixels.
        limit: u32,
    },
    /// Decoding would take more memory than allowed.
    #[error("decoding takes about {bytes} bytes, over the limit of {limit} bytes")]
    TooMuchMemory {
        /// Bytes that the decoder would take.
        bytes: u64,
        /// Bytes allowed.
        limit: u64,
    },
    /// Making the photo would take more memory than allowed.
    #[error("making this photo takes up to {bytes} bytes of memory, over the limit of {limit} bytes")]
    TooMuchWork {
        /// Bytes that making would take.
        bytes: u64,
        /// Bytes allowed.
        limit: u64,
    },
    /// The file is damaged, or a variant of its format that is not supported.
    #[error("the picture cannot be decoded: {0}")]
    Broken(String),
}
