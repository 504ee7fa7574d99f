//! What can be wrong with a photo.

/// Why a photo was not taken.
#[derive(Debug, thiserror::Error)]
pub enum PhotoError {
    /// The first bytes are of no format that is read.
    #[error("not a JPEG, PNG or WebP picture")]
    Unsupported,
    /// A HEIC or AVIF file, as phones take them.
    #[error(
        "HEIC and AVIF pictures are not read: on an iPhone, Settings > Camera > Formats > Most Compatible takes JPEG from now on, and \
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
    /// More pixels than allowed.
    #[error("{width}×{height} is over the limit of {limit} pixels")]
    TooManyPixels {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Pixels allowed.
        limit: u64,
    },
    /// A side longer than allowed.
    #[error("{width}×{height} is over the limit of {limit} pixels a side")]
    SideTooLong {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Pixels a side allowed.
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
    /// Making it would take more memory than allowed.
    #[error("making this photo takes up to {bytes} bytes of memory, over the limit of {limit} bytes")]
    TooMuchWork {
        /// Bytes that it would take.
        bytes: u64,
        /// Bytes allowed.
        limit: u64,
    },
    /// The file is damaged, or of a kind within its format that is not read.
    #[error("the picture cannot be decoded: {0}")]
    Broken(String),
}
