//! Where the picture of a second eye is.

use tmpi_core::Photo;

use crate::depth::{DepthError, xmp};
use crate::photo::{self, Limits, PhotoError};

const PANO: &str = "http://ns.google.com/photos/1.0/panorama/";
/// Largest share of all directions, from left to right, that a wide photo may show: 120°.
const PANORAMA: f64 = 1.0 / 3.0;
/// Words in file names for two eyes beside one another. Each stands between characters other than letters and digits.
const BESIDE: [&str; 4] = ["left-right", "side-by-side", "sbs", "lr"];
/// Words for two eyes above one another.
const ABOVE: [&str; 5] = ["top-bottom", "over-under", "ou", "tb", "tab"];
/// The word for a photo and its depth map beside one another.
const RGBD: &str = "rgbd";
/// Words for pictures of all directions.
const SPHERE: [&str; 3] = ["360", "vr360", "vr180"];

/// Where the picture of a second eye is, or the depth map in its place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Stereo {
    /// After the first in the file, as 3D cameras write it (MPO), or as the file's name says.
    #[default]
    Auto,
    /// In the photo's right half.
    LeftRight,
    /// In the photo's lower half.
    TopBottom,
    /// The photo's right half is its depth map (RGB-D).
    Rgbd,
    /// In a file of its own, given instead of a depth map.
    Beside,
    /// Nowhere: the photo is read as a single picture.
    None,
}

/// Two pictures in the halves of one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Halves {
    /// Left and right.
    LeftRight,
    /// Top and bottom.
    TopBottom,
}

impl Stereo {
    /// The layout that the name of a photo's file states, as `name.left-right.jpg` does; [`Stereo::Auto`] if it states none.
    ///
    /// # Errors
    /// [`DepthError::Sphere`] if it also states that the picture shows all directions.
    pub fn of_name(name: &str) -> Result<Self, DepthError> {
        let name = name.to_lowercase();
        let says = |word: &&str| {
            name.match_indices(*word).any(|(at, _)| {
                let apart = |c: Option<char>| c.is_none_or(|c| !c.is_alphanumeric());
                apart(name[..at].chars().next_back()) && apart(name[at + word.len()..].chars().next())
            })
        };
        let layout = match (BESIDE.iter().any(says), ABOVE.iter().any(says), says(&RGBD)) {
            (true, false, false) => Self::LeftRight,
            (false, true, false) => Self::TopBottom,
            (_, false, true) => Self::Rgbd,
            _ => return Ok(Self::Auto),
        };
        if SPHERE.iter().any(says) { Err(DepthError::Sphere) } else { Ok(layout) }
    }

    /// How to cut a picture that holds two; `None` if it does not.
    pub fn halves(self) -> Option<Halves> {
        match self {
            Self::LeftRight | Self::Rgbd => Some(Halves::LeftRight),
            Self::TopBottom => Some(Halves::TopBottom),
            Self::Auto | Self::Beside | Self::None => None,
        }
    }

    /// Refuses a 360° picture, which no flat photo can show, and a missing second picture.
    ///
    /// # Errors
    /// [`DepthError::Sphere`], [`DepthError::NoSecond`].
    pub fn check(self, photo: &[u8], given: bool) -> Result<(), DepthError> {
        if self == Self::Beside && !given {
            return Err(DepthError::NoSecond);
        }
        if self != Self::None && is_panorama(photo) { Err(DepthError::Sphere) } else { Ok(()) }
    }
}

/// Whether a file's metadata declares an equirectangular picture of more than [`PANORAMA`] of all directions
/// (<https://developers.google.com/streetview/spherical-metadata>).
fn is_panorama(photo: &[u8]) -> bool {
    let packets = xmp::packets(photo);
    let Some(document) = packets.first().and_then(|p| xmp::document(p)) else { return false };
    let property = |name| xmp::anywhere(&document, PANO, name).map(str::trim);
    let width = |name| property(name).and_then(|v| v.parse::<f64>().ok());
    let share = width("CroppedAreaImageWidthPixels").zip(width("FullPanoWidthPixels")).map_or(1.0, |(own, full)| own / full);
    property("ProjectionType") == Some("equirectangular") && share > PANORAMA
}

impl Halves {
    /// Size of one eye's picture within a picture of both.
    pub(crate) fn of(self, (width, height): (u32, u32)) -> (u32, u32) {
        match self {
            Self::LeftRight => (width / 2, height),
            Self::TopBottom => (width, height / 2),
        }
    }

    /// Longest side, in pixels, of a file's picture at which the longest side of one eye's picture is `side`.
    pub(crate) fn of_both(self, file: &[u8], limits: &Limits, side: u32) -> Result<u32, PhotoError> {
        let both = photo::upright_size(file, limits)?;
        let eye = self.of(both);
        let (both, eye) = (u64::from(both.0.max(both.1)), u64::from(eye.0.max(eye.1)).max(1));
        Ok(u32::try_from((u64::from(side) * both).div_ceil(eye)).unwrap_or(u32::MAX))
    }

    /// Splits a picture into the first eye's and the second's, of equal size; drops the middle one of an odd number of columns or rows.
    /// `None` if a half would be empty.
    pub fn split(self, photo: &Photo) -> Option<(Photo, Photo)> {
        let (width, height) = self.of((photo.width, photo.height));
        if width == 0 || height == 0 {
            return None;
        }
        let (right, down) = (photo.width - width, photo.height - height);
        let cut = |x: u32, y: u32| {
            let row = |y: u32| &photo.rgb[(y * photo.width + x) as usize..][..width as usize];
            Photo { width, height, rgb: (y..y + height).flat_map(row).copied().collect() }
        };
        Some((cut(0, 0), cut(right, down)))
    }
}
