//! Sizes of the pictures that a photo is made from, read from their headers.

use super::{MakeError, Options, Switch};
use crate::depth::{self, DepthError};
use crate::photo::{self, Limits};
use crate::stereo::Stereo;

/// Width and height in pixels of the pictures that a photo is made from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sizes {
    /// The picture in the photo's file, upright; with both halves, if it holds two pictures.
    pub file: (u32, u32),
    /// Another picture that is decoded.
    pub extra: Option<ExtraPicture>,
}

/// A picture that is decoded in addition to the photo, with its width and height.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExtraPicture {
    /// A depth map.
    DepthMap((u32, u32)),
    /// A second picture, in a file of its own or embedded in the photo's.
    SecondPicture((u32, u32)),
}

impl ExtraPicture {
    /// Width and height in pixels.
    pub const fn size(self) -> (u32, u32) {
        match self {
            Self::DepthMap(size) | Self::SecondPicture(size) => size,
        }
    }
}

impl Sizes {
    /// Sizes of a photo alone.
    pub const fn of_photo(file: (u32, u32)) -> Self {
        Self { file, extra: None }
    }

    /// Reads the sizes without decoding. `given` is the file of a depth map or second picture. A second picture embedded in the photo's
    /// file that exceeds `limits` is ignored, because it will not be decoded.
    ///
    /// # Errors
    /// [`MakeError::Photo`] if the photo, [`MakeError::Depth`] if `given` cannot be read or exceeds `limits`.
    pub fn of(photo: &[u8], given: Option<&[u8]>, options: &Options, limits: &Limits) -> Result<Self, MakeError> {
        let size = |file: &[u8]| photo::check(file, limits).map(|(_, size)| size);
        let (width, height) = size(photo)?;
        let file = if photo::orientation(photo) > 4 { (height, width) } else { (width, height) };
        let within = options.stereo == Stereo::Auto && options.photo_depth != Switch::Off;
        let extra = match given {
            Some(eye) if options.stereo == Stereo::Beside => {
                Some(ExtraPicture::SecondPicture(size(eye).map_err(|e| DepthError::Second(e.to_string()))?))
            }
            Some(map) => Some(ExtraPicture::DepthMap(depth::check(map, limits)?)),
            None if within => {
                depth::second_picture(photo).and_then(Result::ok).and_then(|eye| size(eye).ok()).map(ExtraPicture::SecondPicture)
            }
            None => None,
        };
        Ok(Self { file, extra })
    }
}
