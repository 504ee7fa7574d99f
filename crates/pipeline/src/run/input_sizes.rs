//! How large the pictures are that a photo is made of, by their headers alone.

use super::{MakeError, Options, Switch};
use crate::depth::{self, DepthError};
use crate::photo::{self, Limits};
use crate::stereo::Stereo;

/// Width and height in pixels of the pictures that a photo is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sizes {
    /// The photo's file, upright; of one that shows two eyes, both.
    pub file: (u32, u32),
    /// What is decoded besides.
    pub other: Option<Other>,
}

/// A picture that is decoded besides the photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Other {
    /// A depth map.
    Map((u32, u32)),
    /// What a second eye sees, in a file of its own or within the photo's.
    Eye((u32, u32)),
}

impl Other {
    /// Width and height in pixels.
    #[must_use]
    pub const fn size(self) -> (u32, u32) {
        match self {
            Self::Map(size) | Self::Eye(size) => size,
        }
    }
}

impl Sizes {
    /// Of a photo by itself.
    #[must_use]
    pub const fn of_photo(file: (u32, u32)) -> Self {
        Self { file, other: None }
    }

    /// Reads them, and refuses what exceeds `limits` before anything is decoded. A picture of a second eye within the photo's file that does is
    /// passed over, as it is not decoded.
    ///
    /// # Errors
    /// [`MakeError::Photo`], and [`MakeError::Depth`] of what is `given` beside the photo.
    pub fn of(photo: &[u8], given: Option<&[u8]>, options: &Options, limits: &Limits) -> Result<Self, MakeError> {
        let size = |file: &[u8]| photo::check(file, limits).map(|(_, size)| size);
        let (width, height) = size(photo)?;
        let file = if photo::orientation(photo) > 4 { (height, width) } else { (width, height) };
        let within = options.stereo == Stereo::Auto && options.photo_depth != Switch::Off;
        let other = match given {
            Some(eye) if options.stereo == Stereo::Beside => Some(Other::Eye(size(eye).map_err(|e| DepthError::Second(e.to_string()))?)),
            Some(map) => Some(Other::Map(depth::check(map, limits)?)),
            None if within => depth::second_eye(photo).and_then(Result::ok).and_then(|eye| size(eye).ok()).map(Other::Eye),
            None => None,
        };
        Ok(Self { file, other })
    }
}
