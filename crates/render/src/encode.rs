//! A drawn view as a picture file.

use image::codecs::{jpeg::JpegEncoder, png, webp::WebPEncoder};
use image::{ExtendedColorType, ImageEncoder};

use super::View;
use tmpi_core::Photo;

/// Picture formats that views are written in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum PictureFormat {
    /// Lossless, with alpha.
    #[default]
    Png,
    /// Lossy, over black.
    #[value(alias = "jpg")]
    Jpeg,
    /// Lossless, with alpha.
    #[value(name = "webp")]
    WebP,
}

impl PictureFormat {
    /// All formats, the default first.
    pub const ALL: [Self; 3] = [Self::Png, Self::Jpeg, Self::WebP];

    /// Media type.
    #[must_use]
    pub const fn media_type(self) -> &'static str {
        match self {
            Self::Png => "image/png",
            Self::Jpeg => "image/jpeg",
            Self::WebP => "image/webp",
        }
    }

    /// The format that a file name ending stands for: `png`, `jpg`, `jpeg` or `webp`, in any case.
    #[must_use]
    pub fn from_extension(extension: &str) -> Option<Self> {
        match extension.to_ascii_lowercase().as_str() {
            "png" => Some(Self::Png),
            "jpg" | "jpeg" => Some(Self::Jpeg),
            "webp" => Some(Self::WebP),
            _ => None,
        }
    }
}

/// Why a view could not be written as a picture.
#[derive(Debug, thiserror::Error)]
pub enum EncodeError {
    /// The format cannot hold the picture, or the codec failed.
    #[error("a view of {width}×{height} cannot be written as {format:?}: {reason}")]
    Codec {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// The format.
        format: PictureFormat,
        /// What the codec says.
        reason: String,
    },
}

/// JPEG quality where the caller has no wish.
pub const DEFAULT_QUALITY: u8 = 90;

/// Writes a view as a picture file: PNG and WebP with straight alpha, JPEG over black at `quality` (clamped to 1..=100).
///
/// # Errors
/// [`EncodeError::Codec`]: WebP holds at most 16 384 pixels a side, JPEG 65 535.
pub fn encode(view: &View, format: PictureFormat, quality: u8) -> Result<Vec<u8>, EncodeError> {
    let (width, height) = (view.width, view.height);
    let mut out = Vec::with_capacity(view.rgba.len() / 2 + 1024);
    let written = match format {
        PictureFormat::Png => png::PngEncoder::new_with_quality(&mut out, png::CompressionType::Fast, png::FilterType::Up).write_image(
            straight(view).as_flattened(),
            width,
            height,
            ExtendedColorType::Rgba8,
        ),
        PictureFormat::Jpeg => {
            // premultiplied colour is the colour over black
            let rgb: Vec<[u8; 3]> = view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect();
            JpegEncoder::new_with_quality(&mut out, quality.clamp(1, 100)).write_image(
                rgb.as_flattened(),
                width,
                height,
                ExtendedColorType::Rgb8,
            )
        }
        PictureFormat::WebP => {
            WebPEncoder::new_lossless(&mut out).write_image(straight(view).as_flattened(), width, height, ExtendedColorType::Rgba8)
        }
    };
    written.map(|()| out).map_err(|e| EncodeError::Codec { width, height, format, reason: e.to_string() })
}

/// Straight-alpha texels; fully transparent ones are 0.
fn straight(view: &View) -> Vec<[u8; 4]> {
    view.rgba.iter().map(|&p| unpremultiply(p)).collect()
}

impl From<&Photo> for View {
    /// The photo itself, opaque.
    fn from(photo: &Photo) -> Self {
        Self { width: photo.width, height: photo.height, rgba: photo.rgb.iter().map(|&[r, g, b]| [r, g, b, 255]).collect() }
    }
}

fn unpremultiply(p: [u8; 4]) -> [u8; 4] {
    let a = u32::from(p[3]);
    if a == 255 {
        return p;
    }
    let c = |v: u8| (u32::from(v) * 255 + a / 2).checked_div(a).unwrap_or(0).min(255) as u8;
    [c(p[0]), c(p[1]), c(p[2]), p[3]]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(width: u32, height: u32) -> View {
        let rgba = (0..width * height).map(|i| [(i % 251) as u8, (i % 13) as u8, 7, 255]).collect();
        View { width, height, rgba }
    }

    #[test]
    fn lossless_formats_give_the_same_pixels_back() {
        let v = view(37, 5);
        for format in [PictureFormat::Png, PictureFormat::WebP] {
            let bytes = encode(&v, format, 1).unwrap();
            let back = image::load_from_memory(&bytes).unwrap().to_rgba8();
            assert_eq!((back.width(), back.height()), (37, 5));
            assert_eq!(back.as_raw().as_slice(), v.rgba.as_flattened(), "{format:?}");
        }
    }

    #[test]
    fn alpha_is_straight_in_files() {
        let v = View { width: 3, height: 1, rgba: vec![[64, 32, 0, 128], [0, 0, 0, 0], [255, 0, 0, 255]] };
        let back = image::load_from_memory(&encode(&v, PictureFormat::Png, 90).unwrap()).unwrap().to_rgba8();
        assert_eq!(back.as_raw(), &[128, 64, 0, 128, 0, 0, 0, 0, 255, 0, 0, 255]);
    }

    #[test]
    fn jpeg_is_near_and_any_quality_is_taken() {
        let v = View { width: 16, height: 16, rgba: vec![[200, 100, 50, 255]; 256] };
        for quality in [0, 90, 255] {
            let back = image::load_from_memory(&encode(&v, PictureFormat::Jpeg, quality).unwrap()).unwrap().to_rgb8();
            assert_eq!((back.width(), back.height()), (16, 16));
            let p = back.get_pixel(8, 8).0;
            let tolerance = if quality == 0 { 60 } else { 4 };
            assert!(p.iter().zip([200u8, 100, 50]).all(|(a, b)| a.abs_diff(b) <= tolerance), "{p:?} at {quality}");
        }
    }

    #[test]
    fn a_side_too_long_for_the_format_is_an_error() {
        let v = View { width: 16_385, height: 1, rgba: vec![[1, 2, 3, 255]; 16_385] };
        assert!(encode(&v, PictureFormat::Png, 90).is_ok());
        match encode(&v, PictureFormat::WebP, 90) {
            Err(EncodeError::Codec { width: 16_385, .. }) => {}
            other => panic!("WebP ends at 16 384 pixels: {:?}", other.map(|b| b.len())),
        }
    }
}
