//! Photo in: sniff by content, check limits before decoding, decode, orient, read the focal length, drop all metadata.
//!
//! What is read: JPEG (baseline and progressive; grey, `YCbCr`, RGB, CMYK), PNG (all kinds), WebP (lossy, lossless, alpha).
//! Of an animation the first picture is taken, as a browser shows it with animations off. An embedded RGB ICC profile is
//! converted to sRGB; grey and CMYK profiles, and PNG's `gAMA` and `cHRM`, are passed over.

mod check;
mod colour;
mod error;
pub(crate) mod exif;
#[doc(hidden)]
pub mod fuzzing;
mod head;
mod jpeg;
mod limits;
pub(crate) mod pixels;
pub(crate) mod png;
mod resample;
mod resample_bytes;
mod resample_opencv;
pub(crate) mod segments;
mod taps;
mod webp;

#[cfg(test)]
mod hostile;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod wild;

use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};

use image::codecs::webp::WebPDecoder;
use image::{ColorType, ImageDecoder};
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

pub use check::check;
pub use error::PhotoError;
pub use head::{Head, head};
pub use limits::Limits;
pub use resample::{Filter, reduced_size, resample, resample_by, resize};
pub use resample_bytes::resample_bytes;
pub use resample_opencv::{Interpolation, resize_opencv};
pub use taps::Taps;

use self::exif::Facts;
use tmpi_core::container::PhotoFormat;
use tmpi_core::{Intrinsics, Photo};

/// A decoded photo with what was learnt on the way.
#[derive(Clone, Debug)]
pub struct Decoded {
    /// Upright pixels; alpha blended over white.
    pub photo: Photo,
    /// Size as uploaded, upright, before any reduction.
    pub original: (u32, u32),
    /// Format as uploaded.
    pub format: PhotoFormat,
    /// Intrinsics for `photo`: EXIF focal length (35 mm equivalent) where it is sane, else 0.58 × width.
    ///
    /// A 35 mm frame is 36 mm wide, so the focal length in pixels is `f35 / 36 × longer side`; values outside
    /// 8 to 600 mm are taken as missing.
    pub intrinsics: Intrinsics,
    /// True where the focal length comes from EXIF.
    pub focal_from_exif: bool,
    /// The uploaded file without metadata, where its pixels are exactly `photo` (no rotation, no reduction, no alpha; JPEG or WebP).
    pub carried: Option<Vec<u8>>,
    /// True where the file is damaged or cut short, yet most of the picture is there; what is missing is grey or coarse. Told of
    /// JPEG files that are decoded at their own size; others are refused, or decoded to a reduced size as far as they go.
    pub damaged: bool,
}

/// Bytes of a colour profile, at most; larger ones are passed over. Those of printers take 0.5 to 3 MB, those of cameras some kB.
const MAX_PROFILE: usize = 4 << 20;

/// Decodes an uploaded photo; `max_size` bounds the longer side in pixels (a larger photo is reduced).
///
/// # Errors
/// [`PhotoError`] names the limit or the fault.
pub fn decode(bytes: &[u8], limits: &Limits, max_size: Option<u32>) -> Result<Decoded, PhotoError> {
    limits.check_bytes(bytes.len())?;
    let format = sniff(bytes)?;
    // The last resort: a decoder's own bug must not take the process down
    catch_unwind(AssertUnwindSafe(|| read(bytes, format, limits, max_size).map(|raw| finish(raw, format, max_size))))
        .unwrap_or_else(|_| Err(PhotoError::Broken("the decoder failed on this file".into())))
}

/// Format by the first bytes.
fn sniff(bytes: &[u8]) -> Result<PhotoFormat, PhotoError> {
    // brands of ISO base media files that hold pictures
    let heic = bytes.get(4..8) == Some(b"ftyp")
        && bytes
            .get(8..12)
            .is_some_and(|brand| matches!(brand, b"heic" | b"heix" | b"heim" | b"heis" | b"hevc" | b"mif1" | b"msf1" | b"avif"));
    PhotoFormat::sniff(bytes).ok_or(if heic { PhotoError::Heic } else { PhotoError::Unsupported })
}

/// EXIF orientation of a JPEG, 1 to 8; 1 where it says none.
pub(crate) fn orientation(jpeg: &[u8]) -> u8 {
    let segments = segments::applications(jpeg);
    let tiff = segments.iter().find(|s| s.number == 1).and_then(|s| s.body.strip_prefix(b"Exif\0\0"));
    Facts::read(tiff).orientation
}

/// A picture as its decoder gave it.
struct Raw {
    /// Pixels as stored: not upright, in the file's own colour space; smaller than `size` where decoding could reduce.
    photo: Photo,
    /// Size as stored.
    size: (u32, u32),
    facts: Facts,
    icc: Option<Vec<u8>>,
    /// File without metadata, where its pixels are exactly `photo`.
    carried: Option<Vec<u8>>,
    damaged: bool,
}

fn read(bytes: &[u8], format: PhotoFormat, limits: &Limits, max_size: Option<u32>) -> Result<Raw, PhotoError> {
    match format {
        PhotoFormat::Jpeg => read_jpeg(bytes, limits, max_size),
        PhotoFormat::Png => read_png(bytes, limits),
        PhotoFormat::WebP => read_webp(bytes, limits),
    }
}

/// Colours, size and orientation, in the order that touches the fewest pixels.
fn finish(raw: Raw, format: PhotoFormat, max_size: Option<u32>) -> Decoded {
    let Raw { mut photo, size, facts, icc, mut carried, damaged } = raw;
    if icc.is_some_and(|icc| colour::to_srgb(&mut photo.rgb, &icc)) {
        carried = None;
    }
    let (width, height) = reduced_size(size, max_size);
    if (photo.width, photo.height) != (width, height) {
        photo = resize(&photo, width, height);
    }
    if (width, height) != size || facts.orientation != 1 {
        carried = None;
    }
    let photo = pixels::upright(photo, facts.orientation);
    let original = if facts.orientation >= 5 { (size.1, size.0) } else { size };
    let long = f64::from(photo.width.max(photo.height));
    let focal = facts.focal_35.map_or(Intrinsics::DEFAULT_FOCAL_PER_WIDTH * f64::from(photo.width), |f| f / 36.0 * long);
    let intrinsics = Intrinsics::centred(photo.width, photo.height, focal);
    Decoded { photo, original, format, intrinsics, focal_from_exif: facts.focal_35.is_some(), carried, damaged }
}

fn broken(error: impl std::fmt::Display) -> PhotoError {
    PhotoError::Broken(error.to_string())
}

fn read_jpeg(bytes: &[u8], limits: &Limits, max_size: Option<u32>) -> Result<Raw, PhotoError> {
    let jpeg = check::jpeg(bytes, limits)?;
    let size = (jpeg.width, jpeg.height);
    let facts = Facts::read(jpeg.exif.as_deref());
    let want = reduced_size(size, max_size);
    let reducible = jpeg.components < 4 && want.0 <= size.0 / 2 && want.1 <= size.1 / 2;
    let (photo, damaged) = match reducible.then(|| scaled_jpeg(&jpeg.stripped, want)).flatten() {
        Some(photo) => (photo, false),
        None => whole_jpeg(&jpeg)?,
    };
    let icc = jpeg.icc.filter(|icc| jpeg.components == 3 && icc.len() <= MAX_PROFILE);
    // Decoders do not agree on how CMYK becomes RGB, nor on what is shown of damaged files
    let carried = (jpeg.components < 4 && !damaged).then_some(jpeg.stripped);
    Ok(Raw { photo, size, facts, icc, carried, damaged })
}

/// A JPEG at its own size, and whether it is damaged; one of which less than most is whole is refused.
fn whole_jpeg(jpeg: &jpeg::Jpeg) -> Result<(Photo, bool), PhotoError> {
    if jpeg.progressive && !jpeg.complete {
        if jpeg.scans < 2 {
            return Err(broken("it was cut within its first scan"));
        }
        return Ok((jpeg_pixels(&jpeg.stripped, false)?, true));
    }
    match jpeg_pixels(&jpeg.open(), true) {
        Ok(photo) => Ok((photo, false)),
        Err(fault) => {
            jpeg_pixels(&jpeg.most(), true).map_err(|_| fault)?;
            Ok((jpeg_pixels(&jpeg.stripped, false)?, true))
        }
    }
}

/// Decodes a JPEG of one, three or four components. Strictly, any fault in its data is an error; else what can be had is given.
fn jpeg_pixels(file: &[u8], strict: bool) -> Result<Photo, PhotoError> {
    let options = DecoderOptions::default().set_strict_mode(strict).set_max_width(usize::MAX).set_max_height(usize::MAX);
    let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(file), options);
    decoder.decode_headers().map_err(broken)?;
    let (Some((width, height)), Some(stored)) = (decoder.dimensions(), decoder.input_colorspace()) else {
        return Err(broken("no frame header"));
    };
    let grey = stored == ColorSpace::Luma;
    decoder.set_options(options.jpeg_set_out_colorspace(if grey { ColorSpace::Luma } else { ColorSpace::RGB }));
    let mut rgb = vec![[0; 3]; width * height];
    if grey {
        let mut samples = vec![0; width * height];
        decoder.decode_into(&mut samples).map_err(broken)?;
        rgb.iter_mut().zip(samples).for_each(|(p, v)| *p = [v; 3]);
    } else {
        decoder.decode_into(rgb.as_flattened_mut()).map_err(broken)?;
    }
    Ok(Photo { width: width as u32, height: height as u32, rgb })
}

/// A JPEG decoded at 1/2, 1/4 or 1/8 inside the DCT, at least `want` large; none where that is not possible.
fn scaled_jpeg(file: &[u8], want: (u32, u32)) -> Option<Photo> {
    let mut decoder = jpeg_decoder::Decoder::new(file);
    let (w, h) = decoder.scale(u16::try_from(want.0).ok()?, u16::try_from(want.1).ok()?).ok()?;
    let (width, height) = (u32::from(w), u32::from(h));
    if width < want.0 || height < want.1 {
        return None;
    }
    let samples = decoder.decode().ok()?;
    let colour = match decoder.info()?.pixel_format {
        jpeg_decoder::PixelFormat::L8 => ColorType::L8,
        jpeg_decoder::PixelFormat::RGB24 => ColorType::Rgb8,
        _ => return None,
    };
    let (rgb, _) = pixels::to_rgb(&samples, colour).ok()?;
    (rgb.len() == width as usize * height as usize).then_some(Photo { width, height, rgb })
}

fn read_png(bytes: &[u8], limits: &Limits) -> Result<Raw, PhotoError> {
    let png = png::scan(bytes, limits)?;
    let mut decoder = png.decoder()?;
    limits.check_memory(decoder.total_bytes())?;
    let icc = decoder.icc_profile().map_err(broken)?;
    let photo = image_pixels(decoder)?.0;
    Ok(Raw { photo, size: (png.width, png.height), facts: Facts::read(png.exif), icc, carried: None, damaged: false })
}

fn read_webp(bytes: &[u8], limits: &Limits) -> Result<Raw, PhotoError> {
    let webp = check::webp(bytes, limits)?;
    let size = (webp.width, webp.height);
    let facts = Facts::read(webp.exif.as_deref());
    let decoder = WebPDecoder::new(Cursor::new(&webp.stripped)).map_err(broken)?;
    if decoder.dimensions() != size {
        return Err(broken("the picture has another size than its header says"));
    }
    let (photo, see_through) = image_pixels(decoder)?;
    let carried = (!see_through && !webp.animated).then_some(webp.stripped);
    Ok(Raw { photo, size, facts, icc: webp.icc, carried, damaged: false })
}

/// Decodes, and tells whether any pixel was not opaque.
fn image_pixels(decoder: impl ImageDecoder) -> Result<(Photo, bool), PhotoError> {
    let ((width, height), colour) = (decoder.dimensions(), decoder.color_type());
    if colour == ColorType::Rgb8 {
        let mut rgb = vec![[0; 3]; width as usize * height as usize];
        decoder.read_image(rgb.as_flattened_mut()).map_err(broken)?;
        return Ok((Photo { width, height, rgb }, false));
    }
    let mut samples = vec![0; decoder.total_bytes() as usize];
    decoder.read_image(&mut samples).map_err(broken)?;
    let (rgb, see_through) = pixels::to_rgb(&samples, colour)?;
    Ok((Photo { width, height, rgb }, see_through))
}
