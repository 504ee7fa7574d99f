//! The container format: a scene as bytes (DESIGN, section 5; schema in `proto/tmpi.proto`).

pub(crate) mod bounds;
pub(crate) mod columns;
pub(crate) mod crc;
mod decode;
mod decode_rows;
#[cfg(feature = "write")]
mod encode;
#[cfg(all(feature = "write", any(test, feature = "fixtures")))]
#[doc(hidden)]
pub mod fixtures;
#[doc(hidden)]
pub mod fuzzing;
mod hidden;
mod label_bands;
pub(crate) mod labels;
mod photo;
#[cfg(feature = "pictures")]
mod picture_codec;
pub(crate) mod planes;
pub(crate) mod range_coder;
#[cfg(feature = "write")]
mod region;
#[doc(hidden)]
pub mod schema;
mod select_sections;
#[cfg(feature = "write")]
mod smaller_level;
mod texture_strip;
#[cfg(feature = "unpack")]
mod unpack;

pub use bounds::{most_planes, readable};
pub use decode::{PictureDecoder, SectionInfo, decode_with, read_geometry, sections};
#[cfg(feature = "pictures")]
pub use decode::{decode, read};
pub use decode_rows::{PhotoRows, TileLayers, decode_rows, pixel_rows};
#[cfg(feature = "write")]
pub use encode::{HiddenCodec, OptionalSections, SectionBytes, encode, encode_in};
pub use label_bands::band_rows;
pub use photo::{EncodedPhoto, PhotoFormat};
#[cfg(feature = "pictures")]
pub use picture_codec::decode as decode_picture;
#[cfg(feature = "write")]
pub use picture_codec::{encode_jpeg, encode_lossless};
#[cfg(feature = "write")]
pub use region::{RegionPhoto, TileRect, region};
pub use select_sections::{SECTIONS, select};
#[cfg(feature = "write")]
pub use smaller_level::{LEVELS, level};
pub(crate) use texture_strip::texels;
pub use texture_strip::{Piece, strip};
#[cfg(feature = "unpack")]
pub use unpack::unpacked;

/// First bytes of a container.
pub const MAGIC: [u8; 4] = *b"TMPI";
/// Major version that is written, and the newest that can be read.
pub const MAJOR: u16 = 1;
/// Minor version that is written.
pub const MINOR: u16 = 0;
/// Media type of a container.
pub const MEDIA_TYPE: &str = "application/vnd.tmpi";

/// Maximum number of pixels in a container's photo: 50 megapixels.
pub const MAX_PIXELS: u64 = 50_000_000;
/// Maximum width and height of a container's photo, in pixels.
pub const MAX_SIDE: u32 = 16_384;

/// Why a container cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum ContainerError {
    /// The bytes are not a container, or are damaged, or exceed a limit; the text says what and where.
    #[error("not a readable TMPI container: {0}")]
    Broken(String),
    /// The container is of a newer major version.
    #[error("the container is of version {found}; this program reads up to version {known}")]
    Newer {
        /// Its major version.
        found: u16,
        /// The newest known major version.
        known: u16,
    },
    /// The container exceeds a limit of readers; the text names it.
    #[error("unsupported container: {0}")]
    Bound(String),
    /// A picture cannot be encoded, or the container cannot hold what was requested.
    #[error("encoding a picture: {0}")]
    Encode(String),
}

impl ContainerError {
    fn broken(what: impl Into<String>) -> Self {
        Self::Broken(what.into())
    }
}

#[cfg(all(test, feature = "write"))]
mod tests;
