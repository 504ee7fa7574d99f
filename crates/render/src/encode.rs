//! Encodes views as picture files.

use image::codecs::{jpeg::JpegEncoder, png, webp::WebPEncoder};
use image::{ExtendedColorType, ImageEncoder};

use super::{View, mpo};
use tmpi_core::Photo;

/// Picture formats for views.
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
    /// A side-by-side pair as two JPEGs in one file, as 3D cameras write them.
    Mpo,
}

impl PictureFormat {
    /// All formats of single pictures; the default comes first.
    pub const ALL: [Self; 3] = [Self::Png, Self::Jpeg, Self::WebP];

    /// Media type.
    pub const fn media_type(self) -> &'static str {
        match self {
            Self::Png => "image/png",
            Self::Jpeg => "image/jpeg",
            Self::WebP => "image/webp",
            Self::Mpo => "image/mpo",
        }
    }

    /// Returns the format of a file name extension: `png`, `jpg`, `jpeg`, `webp` or `mpo`, in any case.
    pub fn from_extension(extension: &str) -> Option<Self> {
        <Self as clap::ValueEnum>::from_str(extension, true).ok()
    }
}

/// Why a view could not be encoded.
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
        /// The codec's message.
        reason: String,
    },
}

/// Default JPEG quality.
pub const DEFAULT_QUALITY: u8 = 90;

/// Encodes a view: PNG and WebP with straight alpha, JPEG over black at `quality` (clamped to 1..=100), MPO as the JPEGs of its left and
/// its right half.
///
/// # Errors
/// [`EncodeError::Codec`]: WebP holds at most 16 384 pixels per side, JPEG 65 535.
pub fn encode(view: &View, format: PictureFormat, quality: u8) -> Result<Vec<u8>, EncodeError> {
    let (width, height) = (view.width, view.height);
    if format == PictureFormat::Mpo {
        let [left, right] = [0, width / 2].map(|from| encode(&part(view, from, width / 2), PictureFormat::Jpeg, quality));
        return Ok(mpo::join(&left?, &right?));
    }
    let mut out = Vec::with_capacity(view.rgba.len() / 2 + 1024);
    let written = match format {
        PictureFormat::Png => png::PngEncoder::new_with_quality(&mut out, png::CompressionType::Fast, png::FilterType::Up).write_image(
            straight(view).as_flattened(),
            width,
            height,
            ExtendedColorType::Rgba8,
        ),
        PictureFormat::Jpeg | PictureFormat::Mpo => {
            // premultiplied colour equals the colour over black
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

/// The columns `from..from + width` of a view.
fn part(view: &View, from: u32, width: u32) -> View {
    let row = |row: &[[u8; 4]]| row[from as usize..][..width as usize].to_vec();
    let rgba = view.rgba.chunks_exact(view.width.max(1) as usize).flat_map(row).collect();
    View { width, height: view.height, rgba }
}

/// Texels with straight alpha; fully transparent ones are 0.
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
    fn an_mpo_holds_both_halves() {
        let rgba = (0..40 * 16).map(|i| if i % 40 < 20 { [200, 30, 30, 255] } else { [30, 30, 200, 255] }).collect();
        let file = encode(&View { width: 40, height: 16, rgba }, PictureFormat::Mpo, 95).unwrap();
        let second = file.windows(4).rposition(|w| w == b"\xff\xd8\xff\xe2").unwrap();
        let open = |bytes: &[u8]| image::load_from_memory_with_format(bytes, image::ImageFormat::Jpeg).unwrap().to_rgb8();
        let (left, right) = (open(&file), open(&file[second..]));
        assert_eq!((left.dimensions(), right.dimensions()), ((20, 16), (20, 16)));
        assert!(left.pixels().all(|p| p.0[0] > 180 && p.0[2] < 60) && right.pixels().all(|p| p.0[2] > 180 && p.0[0] < 60));
        assert!(encode(&view(1, 5), PictureFormat::Mpo, 90).is_err(), "there are no halves of one column");
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
