//! The photo's file in a container.

#[cfg(feature = "write")]
use super::schema::Codec;

/// File format of a photo.
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
    /// The format of a file, from its first bytes; `None` if it is another format.
    pub fn sniff(bytes: &[u8]) -> Option<Self> {
        match bytes {
            [0xFF, 0xD8, 0xFF, ..] => Some(Self::Jpeg),
            [0x89, b'P', b'N', b'G', 0x0D, 0x0A, 0x1A, 0x0A, ..] => Some(Self::Png),
            [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => Some(Self::WebP),
            _ => None,
        }
    }

    /// Media type.
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Jpeg => "image/jpeg",
            Self::Png => "image/png",
            Self::WebP => "image/webp",
        }
    }

    /// The codec's name in the index.
    #[cfg(feature = "write")]
    pub(super) fn codec(self) -> Codec {
        match self {
            Self::Jpeg => Codec::Jpeg,
            Self::Png => Codec::Png,
            Self::WebP => Codec::Webp,
        }
    }
}

/// The photo's file, as a container carries it.
#[derive(Clone, Debug)]
pub struct EncodedPhoto {
    /// Contents of the picture file.
    pub bytes: Vec<u8>,
    /// Format of the file.
    pub format: PhotoFormat,
}
