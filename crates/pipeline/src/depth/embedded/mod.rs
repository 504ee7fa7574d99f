//! Depth that a photo brings along: a grey picture within the JPEG file, and how its values are meant.
//!
//! Three ways of writing it are read. [`gdepth`]: Google's depth map metadata of 2014, a picture as text within XMP (Lens Blur). [`dynamic`]:
//! Dynamic Depth 1.0 of 2019, pictures behind the photo that XMP lists (Android). [`multi`]: pictures behind the photo in the Multi-Picture
//! Format of CIPA DC-007, of which one says in its own XMP that it is disparity or depth (portraits of iPhones that were sent as JPEG).

mod dynamic;
mod gdepth;
pub(crate) mod multi;
#[cfg(test)]
mod tests;
pub(crate) mod xmp;

use super::given_map::{Grey, grey};
use super::{DepthError, Read};
use crate::photo::{self, Limits};

/// Depth within a photo's file.
#[derive(Clone, Debug, PartialEq)]
pub struct Carried {
    /// What wrote it: `gdepth`, `dynamic-depth` or `multi-picture`.
    pub format: &'static str,
    /// The grey picture's file.
    picture: Vec<u8>,
    scale: Scale,
    /// EXIF orientation of the photo, 1 to 8.
    orientation: u8,
    /// Pixels that the map may have: those of the photo's file, so that reading it takes no more memory than the photo itself, or [`SMALL`].
    pixels: u64,
}

/// Pixels of maps and second pictures that may be larger than their photo, which programs made smaller: as many as phones write. Reading them takes less memory
/// than the network that they stand in for.
const SMALL: u64 = 2_000_000;

/// What values v of 0 to 1 mean.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Scale {
    /// Distance z where `v = far·(z − near) / (z·(far − near))`: even steps of 1/z, the nearest at 0.
    Inverse { near: f64, far: f64 },
    /// Distance `near + v·(far − near)`.
    Distance { near: f64, far: f64 },
    /// Disparity `low + v·(high − low)`, the nearest at 1.
    Disparity { low: f64, high: f64 },
}

impl Scale {
    /// None where the ends are no range.
    fn checked(self) -> Option<Self> {
        let sound = match self {
            Self::Inverse { near, far } | Self::Distance { near, far } => near > 0.0 && near < far,
            Self::Disparity { low, high } => low < high && high > 0.0 && low.is_finite(),
        };
        // infinity is far enough for even steps of 1/z
        let ends = match self {
            Self::Inverse { .. } => true,
            Self::Distance { far, .. } => far.is_finite(),
            Self::Disparity { high, .. } => high.is_finite(),
        };
        (sound && ends).then_some(self)
    }

    /// δ, 1 at the nearest value that the range holds, at least 0.
    fn delta(self, v: f32) -> f32 {
        let v = f64::from(v);
        let delta = match self {
            Self::Inverse { near, far } => 1.0 - v * (1.0 - near / far),
            Self::Distance { near, far } => near / (near + v * (far - near)),
            Self::Disparity { low, high } => (low + v * (high - low)) / high,
        };
        delta.clamp(0.0, 1.0) as f32
    }
}

/// The depth that a photo brings along; none where it brings none.
///
/// # Errors
/// [`DepthError::Carried`] where there is some that cannot be read.
pub fn carried(photo: &[u8]) -> Result<Option<Carried>, DepthError> {
    let packets = xmp::packets(photo);
    let found = gdepth::find(&packets).or_else(|| dynamic::find(photo, &packets)).or_else(|| multi::find(photo));
    let Some(found) = found else { return Ok(None) };
    let (format, picture, scale) = found.map_err(DepthError::Carried)?;
    // what can be no photo has no map either
    let pixels = photo::check(photo, &Limits::NONE).map_or(0, |(_, (w, h))| (u64::from(w) * u64::from(h)).max(SMALL));
    Ok(Some(Carried { format, picture, scale, orientation: photo::orientation(photo), pixels }))
}

/// What one of the formats gives, or what is wrong with it.
type Found = Result<(&'static str, Vec<u8>, Scale), String>;

/// A number of XMP, where there is a finite or infinite one.
fn number(text: Option<&str>) -> Option<f64> {
    text.and_then(|t| t.trim().parse().ok()).filter(|n: &f64| !n.is_nan())
}

/// What `format` with ends `near` and `far` stands for in Google's metadata.
fn google(format: Option<&str>, near: Option<&str>, far: Option<&str>) -> Result<Scale, String> {
    let (Some(near), Some(far)) = (number(near), number(far)) else { return Err("its nearest and farthest distance are not told".into()) };
    let scale = match format {
        Some("RangeInverse") => Scale::Inverse { near, far },
        Some("RangeLinear") => Scale::Distance { near, far },
        other => return Err(format!("its format is {}, not RangeInverse or RangeLinear", other.unwrap_or("not told"))),
    };
    scale.checked().ok_or_else(|| format!("distances from {near} to {far} are no range"))
}

impl Carried {
    /// The map at the photo's size `width × height`, upright as the photo.
    ///
    /// # Errors
    /// [`DepthError::Carried`] says what is wrong with the picture.
    pub fn read(&self, limits: &Limits, width: u32, height: u32) -> Result<Read, DepthError> {
        let limits = Limits { pixels: limits.pixels.min(self.pixels), ..*limits };
        let Grey { width: w, height: h, mut values } = grey(&self.picture, &limits).map_err(|e| DepthError::Carried(e.to_string()))?;
        for v in &mut values {
            *v = self.scale.delta(*v);
        }
        // one that has an orientation of its own is upright already; so is one that lies or stands as the upright photo does. Where
        // either is a square the shapes tell nothing: phones store both alike
        let alike = (w < h && width < height) || (w > h && width > height);
        let orientation = match self.orientation {
            _ if photo::orientation(&self.picture) != 1 => 1,
            5..=8 if alike => 1,
            other => other,
        };
        let (values, (w, h)) = photo::upright_srgb::turned(values, (w, h), orientation);
        Ok(Read::new(values, (w, h), (width, height)))
    }
}
