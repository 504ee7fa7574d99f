//! The container: a scene as bytes (DESIGN, section 5; schema in `proto/tmpi.proto`).

mod bands;
mod columns;
mod decode;
mod encode;
pub(crate) mod fuzzing;
mod hidden;
mod labels;
mod level;
mod picture;
mod planes;
mod range;
mod region;
mod select;
mod wire;

pub use decode::{SectionInfo, decode, sections};
pub use encode::{Carries, HiddenAs, encode};
pub use level::{LEVELS, level};
pub use picture::{Carried, encode_jpeg, encode_lossless};
pub use region::{RegionPhoto, Tiles, region};
pub use select::{SECTIONS, select};
#[cfg(feature = "codecs")]
pub(crate) use {
    bands::rows_for,
    decode::{read, read_plain, read_tiles},
    encode::encode_in,
    select::with_section,
    wire::{Codec, Kind},
};

/// First bytes of a container.
pub const MAGIC: [u8; 4] = *b"TMPI";
/// Major version written, and the newest that is read.
pub const MAJOR: u16 = 1;
/// Minor version written.
pub const MINOR: u16 = 3;
/// Media type of a container.
pub const MEDIA_TYPE: &str = "application/vnd.tmpi";

/// Bounds that a reader holds a container to, whatever it says of itself.
mod bounds {
    /// Pixels of the photo.
    pub const PIXELS: u64 = crate::photo::Limits::PIXELS;
    /// Pixels a side.
    pub const SIDE: u32 = crate::photo::Limits::SIDE;
    /// Planes in all.
    pub const PLANES: usize = 4_000_000;
    /// Pixels that deriving the texels may look at: a 50-megapixel photo of four planes a tile looks at about 5e9.
    pub const WORK: u64 = 8_000_000_000;
    /// The same for each pixel of the photo: tiles of 8 pixels, the smallest level's, with 20 planes each look at 17 000.
    pub const WORK_PER_PIXEL: u64 = 20_000;
    /// What even the smallest photo may look at.
    pub const WORK_LEAST: u64 = 50_000_000;
    /// Bytes of the index.
    pub const INDEX: usize = 1 << 20;
    /// Sections.
    pub const SECTIONS: usize = 64;
}

/// Why a container could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum AtlasError {
    /// The bytes are no container, damaged, or exceed a bound; the text names what and where.
    #[error("not a readable TMPI container: {0}")]
    Broken(String),
    /// The container is of a newer major version.
    #[error("the container is of version {found}; this program reads up to version {known}")]
    Newer {
        /// Major version found.
        found: u16,
        /// Major version known.
        known: u16,
    },
    /// A picture codec failed while writing.
    #[error("encoding a picture: {0}")]
    Encode(String),
}

impl AtlasError {
    fn broken(what: impl Into<String>) -> Self {
        Self::Broken(what.into())
    }
}

#[cfg(test)]
mod tests;
