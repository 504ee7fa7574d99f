//! Depth that a photo carries: a grey picture inside the JPEG file, and what its values mean.
//!
//! Three formats are read. [`gdepth`]: Google's depth map metadata of 2014, a picture as text within XMP (Lens Blur). [`dynamic`]:
//! Dynamic Depth 1.0 of 2019, pictures after the photo that XMP lists (Android). [`multi`]: pictures after the photo in the Multi-Picture
//! Format of CIPA DC-007, one of which declares itself disparity or depth in its own XMP (portraits of iPhones that were sent as JPEG).

mod dynamic;
mod gdepth;
pub(crate) mod multi;
#[cfg(test)]
mod tests;
pub(crate) mod xmp;

use super::grey::{Grey, grey};
use super::{DepthError, Read};
use crate::photo::{self, Limits};

/// Depth in a photo's file.
#[derive(Clone, Debug, PartialEq)]
pub struct EmbeddedDepth {
    /// Its format: `gdepth`, `dynamic-depth` or `multi-picture`.
    pub format: &'static str,
    /// File of the grey picture.
    picture: Vec<u8>,
    scale: Scale,
    /// EXIF orientation of the photo, 1 to 8.
    orientation: u8,
    /// Most pixels of the map: as many as the photo's file has, so that reading it takes no more memory than the photo itself, or
    /// [`SMALL`].
    pixels: u64,
}

/// Pixels up to which a map or second picture may be larger than its photo, which programs may have reduced: as many as phones write.
/// Reading them takes less memory than the network that they replace.
const SMALL: u64 = 2_000_000;

/// What values v of 0 to 1 mean.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Scale {
    /// Distance z with `v = far·(z − near) / (z·(far − near))`: even steps of 1/z, the nearest at 0.
    Inverse { near: f64, far: f64 },
    /// Distance `near + v·(far − near)`.
    Distance { near: f64, far: f64 },
    /// Disparity `low + v·(high − low)`, the nearest at 1.
    Disparity { low: f64, high: f64 },
}

impl Scale {
    /// `None` if the ends do not form a range.
    fn checked(self) -> Option<Self> {
        let sound = match self {
            Self::Inverse { near, far } | Self::Distance { near, far } => near > 0.0 && near < far,
            Self::Disparity { low, high } => low < high && high > 0.0 && low.is_finite(),
        };
        // infinity is a valid end for even steps of 1/z
        let ends = match self {
            Self::Inverse { .. } => true,
            Self::Distance { far, .. } => far.is_finite(),
            Self::Disparity { high, .. } => high.is_finite(),
        };
        (sound && ends).then_some(self)
    }

    /// Disparity δ, 0 to 1; 1 is the nearest value that the range can hold.
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

/// Finds the depth that a photo carries; `None` if it carries none.
///
/// # Errors
/// [`DepthError::Embedded`] if it carries depth that cannot be read.
pub fn embedded_depth(photo: &[u8]) -> Result<Option<EmbeddedDepth>, DepthError> {
    let packets = xmp::packets(photo);
    let found = gdepth::find(&packets).or_else(|| dynamic::find(photo, &packets)).or_else(|| multi::find(photo));
    let Some(found) = found else { return Ok(None) };
    let (format, picture, scale) = found.map_err(DepthError::Embedded)?;
    // a file that cannot be a photo has no map either
    let pixels = photo::check(photo, &Limits::NONE).map_or(0, |(_, (w, h))| (u64::from(w) * u64::from(h)).max(SMALL));
    Ok(Some(EmbeddedDepth { format, picture, scale, orientation: photo::orientation(photo), pixels }))
}

/// Format name, picture and scale of one of the formats, or what is wrong with it.
type DepthPicture = Result<(&'static str, Vec<u8>, Scale), String>;

/// A finite or infinite number in XMP.
fn number(text: Option<&str>) -> Option<f64> {
    text.and_then(|t| t.trim().parse().ok()).filter(|n: &f64| !n.is_nan())
}

/// The scale that `format`, `near` and `far` describe in Google's metadata.
fn google(format: Option<&str>, near: Option<&str>, far: Option<&str>) -> Result<Scale, String> {
    let (Some(near), Some(far)) = (number(near), number(far)) else { return Err("its nearest or farthest distance is missing".into()) };
    let scale = match format {
        Some("RangeInverse") => Scale::Inverse { near, far },
        Some("RangeLinear") => Scale::Distance { near, far },
        other => return Err(format!("its format is {}, not RangeInverse or RangeLinear", other.unwrap_or("missing"))),
    };
    scale.checked().ok_or_else(|| format!("distances from {near} to {far} do not form a range"))
}

impl EmbeddedDepth {
    /// Reads the map at the photo's size `width × height`, upright like the photo.
    ///
    /// # Errors
    /// [`DepthError::Embedded`] names the fault of the picture.
    pub fn read(&self, limits: &Limits, width: u32, height: u32) -> Result<Read, DepthError> {
        let limits = Limits { pixels: limits.pixels.min(self.pixels), ..*limits };
        let Grey { width: w, height: h, mut values } = grey(&self.picture, &limits).map_err(|e| DepthError::Embedded(e.to_string()))?;
        for v in &mut values {
            *v = self.scale.delta(*v);
        }
        // a map with an orientation of its own is upright already, and so is one with the same long side as the upright photo. If either
        // is a square, shapes decide nothing: phones store both in the same orientation
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
