//! The photo's file as a container carries it.

#[cfg(feature = "write")]
use super::schema::Codec;

/// Container format of an uploaded photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PhotoFormat {
    /// JPEG.
    Jpeg,
    /// PNG.
    Png,
    /// WebP.
    WebP,
}

impl PhotoFormat {
    /// Format of a file, by its first bytes.
    #[must_use]
    pub fn sniff(bytes: &[u8]) -> Option<Self> {
        match bytes {
            [0xFF, 0xD8, 0xFF, ..] => Some(Self::Jpeg),
            [0x89, b'P', b'N', b'G', 0x0D, 0x0A, 0x1A, 0x0A, ..] => Some(Self::Png),
            [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => Some(Self::WebP),
            _ => None,
        }
    }

    /// Media type.
    #[must_use]
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Jpeg => "image/jpeg",
            Self::Png => "image/png",
            Self::WebP => "image/webp",
        }
    }
}

impl PhotoFormat {
    /// How the index names it.
    #[cfg(feature = "write")]
    pub(super) fn codec(self) -> Codec {
        match self {
            Self::Jpeg => Codec::Jpeg,
            Self::Png => Codec::Png,
            Self::WebP => Codec::Webp,
        }
    }
}

/// The photo as it is carried in a container.
#[derive(Clone, Debug)]
pub struct Carried {
    /// Picture file.
    pub bytes: Vec<u8>,
    /// Its format.
    pub format: PhotoFormat,
}
