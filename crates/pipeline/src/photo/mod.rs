//! Reads photos: detects the format by content, checks the limits, decodes, turns the picture upright, reads the focal length, and drops
//! all metadata.
//!
//! Formats: JPEG (baseline and progressive; grey, `YCbCr`, RGB, CMYK), PNG (all kinds), WebP (lossy, lossless, alpha). Of an animation,
//! the first picture is read, as a browser shows it with animations off. Colours are converted to sRGB by an RGB or grey ICC profile or
//! by PNG's `cICP`; CMYK profiles, and PNG's `gAMA` and `cHRM`, are ignored.

mod check;
mod colour;
mod error;
pub(crate) mod exif;
#[doc(hidden)]
pub mod fuzzing;
mod head;
mod jpeg_frame;
mod jpeg_metadata;
mod jpeg_pixels;
mod limits;
pub(crate) mod png_metadata;
mod pq_hlg;
mod reduction_loss;
mod resample;
mod resample_opencv;
mod resample_pillow;
pub(crate) mod segments;
mod taps;
pub(crate) mod upright_srgb;
mod webp_metadata;

#[cfg(test)]
mod colour_tests;
#[cfg(test)]
mod corpus_tests;
#[cfg(test)]
mod jpeg_tests;
#[cfg(test)]
mod malformed_files;
#[cfg(test)]
mod tests;

use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};

use image::codecs::webp::WebPDecoder;
use image::{ColorType, ImageDecoder};

pub use check::check;
pub use error::PhotoError;
pub use head::{Head, head};
pub use limits::Limits;
pub(crate) use resample::working_size;
pub use resample::{Filter, reduced_size, resample, resample_by, resize};
pub use resample_opencv::resize_opencv;
pub use resample_pillow::resample_bytes;
pub use taps::Taps;
pub(crate) use taps::{around, bilinear};

use self::colour::Profile;
use self::exif::Facts;
use self::jpeg_frame::{Colour, Layout};
pub use self::reduction_loss::Reduction;
use tmpi_core::container::PhotoFormat;
use tmpi_core::{Intrinsics, Photo};

/// A decoded photo and facts about its file.
#[derive(Clone, Debug)]
pub struct Decoded {
    /// Upright pixels; alpha blended over white.
    pub photo: Photo,
    /// Size as uploaded, upright, before any reduction.
    pub original: (u32, u32),
    /// Format as uploaded.
    pub format: PhotoFormat,
    /// Intrinsics of `photo`, from EXIF's 35 mm equivalent focal length if that is 8 to 600 mm, else with a focal length of 0.58 × width.
    ///
    /// A 35 mm frame is 36 mm wide, so the focal length in pixels is `f35 / 36 × longer side`.
    pub intrinsics: Intrinsics,
    /// The uploaded file without metadata, if its pixels are exactly `photo` (no rotation, no reduction, no alpha; JPEG or WebP).
    pub stripped: Option<Vec<u8>>,
    /// Whether the file is damaged or cut short. Most of the picture is intact then; the rest is grey or coarse. Detected for JPEG files
    /// decoded at full size, and for PNG files with a wrong checksum. Other damaged files are refused, or decoded to a reduced size as
    /// far as they go.
    pub damaged: bool,
    /// How the photo was reduced; `None` if it has the file's size.
    pub reduction: Option<Reduction>,
}

/// Most bytes of a colour profile; larger ones are ignored. Printer profiles take 0.5 to 3 MB, camera profiles some kB.
const MAX_PROFILE: usize = 4 << 20;

/// Decodes an uploaded photo. `max_size` bounds the longer side in pixels: a larger photo is reduced.
///
/// # Errors
/// The [`PhotoError`] names the limit or the fault.
pub fn decode(bytes: &[u8], limits: &Limits, max_size: Option<u32>) -> Result<Decoded, PhotoError> {
    limits.check_bytes(bytes.len())?;
    let format = sniff(bytes)?;
    guarded(|| read(bytes, format, limits, max_size, Samples::Colours).map(|raw| finish(raw, format, max_size)))
}

/// Decodes a picture whose samples are values, not colours: profiles and alpha are ignored. The result is upright.
pub(crate) fn decode_values(bytes: &[u8], limits: &Limits) -> Result<Photo, PhotoError> {
    limits.check_bytes(bytes.len())?;
    let format = sniff(bytes)?;
    guarded(|| read(bytes, format, limits, None, Samples::Values).map(|raw| finish(raw, format, None).photo))
}

/// Turns a decoder's panic into an error: its bug must not take the process down.
pub(crate) fn guarded<T>(decode: impl FnOnce() -> Result<T, PhotoError>) -> Result<T, PhotoError> {
    catch_unwind(AssertUnwindSafe(decode)).unwrap_or_else(|_| Err(PhotoError::Broken("the decoder failed on this file".into())))
}

/// What the samples of a picture stand for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Samples {
    Colours,
    Values,
}

/// Detects the format by the first bytes.
fn sniff(bytes: &[u8]) -> Result<PhotoFormat, PhotoError> {
    // brands of ISO base media files that hold pictures
    let heic = bytes.get(4..8) == Some(b"ftyp")
        && bytes
            .get(8..12)
            .is_some_and(|brand| matches!(brand, b"heic" | b"heix" | b"heim" | b"heis" | b"hevc" | b"mif1" | b"msf1" | b"avif"));
    PhotoFormat::sniff(bytes).ok_or(if heic { PhotoError::Heic } else { PhotoError::Unsupported })
}

/// EXIF orientation of a photo, 1 to 8; 1 if it declares none.
pub(crate) fn orientation(photo: &[u8]) -> u8 {
    let facts = match PhotoFormat::sniff(photo) {
        Some(PhotoFormat::Jpeg) => {
            let segments = segments::applications(photo);
            Facts::read(segments.iter().filter(|s| s.number == 1).find_map(|s| s.body.strip_prefix(b"Exif\0\0")))
        }
        Some(PhotoFormat::Png) => png_metadata::scan(photo, &Limits::NONE).map_or(Facts::NONE, |png| png.facts()),
        Some(PhotoFormat::WebP) => webp_metadata::scan(photo).map_or(Facts::NONE, |webp| Facts::read(webp.exif.as_deref())),
        None => Facts::NONE,
    };
    facts.orientation
}

/// Upright width and height of a photo in pixels, by its EXIF orientation, read from its first bytes.
///
/// # Errors
/// [`PhotoError`] if it exceeds a limit, is no photo, or does not state its size before its pixels.
pub fn upright_size(photo: &[u8], limits: &Limits) -> Result<(u32, u32), PhotoError> {
    match head(photo, limits)? {
        Head::Size(width, height) if orientation(photo) > 4 => Ok((height, width)),
        Head::Size(width, height) => Ok((width, height)),
        Head::Needs(_) | Head::Silent => Err(PhotoError::Broken("it does not state its size".into())),
    }
}

/// A picture as its decoder returned it.
struct Raw {
    /// Stored pixels: not upright; smaller than `size` if the decoder reduced.
    photo: Photo,
    /// Stored size.
    size: (u32, u32),
    facts: Facts,
    /// File without metadata, if its pixels are exactly `photo`.
    stripped: Option<Vec<u8>>,
    damaged: bool,
}

fn read(bytes: &[u8], format: PhotoFormat, limits: &Limits, max_size: Option<u32>, samples: Samples) -> Result<Raw, PhotoError> {
    match format {
        PhotoFormat::Jpeg => read_jpeg(bytes, limits, max_size, samples),
        PhotoFormat::Png => read_png(bytes, limits, samples),
        PhotoFormat::WebP => read_webp(bytes, limits, samples),
    }
}

/// Reduces a picture and turns it upright, in the order that touches the fewest pixels.
fn finish(raw: Raw, format: PhotoFormat, max_size: Option<u32>) -> Decoded {
    let Raw { mut photo, size, facts, mut stripped, damaged } = raw;
    let (width, height) = reduced_size(size, max_size);
    let mut reduction = ((width, height) != size).then(|| Reduction { scale: share(width.max(height), size.0.max(size.1)), psnr: None });
    if (photo.width, photo.height) != (width, height) {
        let small = resize(&photo, width, height);
        if let (Some(reduction), true) = (&mut reduction, (photo.width, photo.height) == size) {
            reduction.psnr = Some(reduction_loss::psnr(&small, &photo));
        }
        photo = small;
    }
    if (width, height) != size || facts.orientation != 1 {
        stripped = None;
    }
    let photo = upright_srgb::upright(photo, facts.orientation);
    let original = if facts.orientation >= 5 { (size.1, size.0) } else { size };
    let long = f64::from(photo.width.max(photo.height));
    let focal = facts.focal_35.map_or(Intrinsics::DEFAULT_FOCAL_PER_WIDTH * f64::from(photo.width), |f| f / 36.0 * long);
    let intrinsics = Intrinsics::centred(photo.width, photo.height, focal);
    Decoded { photo, original, format, intrinsics, stripped, damaged, reduction }
}

fn share(part: u32, whole: u32) -> f64 {
    f64::from(part) / f64::from(whole.max(1))
}

fn broken(error: impl std::fmt::Display) -> PhotoError {
    PhotoError::Broken(error.to_string())
}

fn read_jpeg(bytes: &[u8], limits: &Limits, max_size: Option<u32>, samples: Samples) -> Result<Raw, PhotoError> {
    let jpeg = check::jpeg(bytes, limits)?;
    let size = (jpeg.width, jpeg.height);
    let facts = Facts::read(jpeg.exif.as_deref());
    let want = reduced_size(size, max_size);
    let cmyk = matches!(jpeg.colour, Colour::Cmyk | Colour::Ycck);
    // damage is detected only at full size
    let reducible = !cmyk && jpeg.standalone && want.0 <= size.0 / 2 && want.1 <= size.1 / 2;
    let (mut photo, damaged) = match reducible.then(|| jpeg_pixels::reduced(&jpeg, want)).flatten() {
        Some(photo) => (photo, false),
        None => jpeg_pixels::whole(&jpeg)?,
    };
    let profile = jpeg.icc.filter(|icc| !cmyk && icc.len() <= MAX_PROFILE).map(Profile::Icc);
    let conversion = profile.filter(|_| samples == Samples::Colours).and_then(|profile| profile.bytes(jpeg.colour == Colour::Grey));
    if let Some(conversion) = &conversion {
        conversion.run(&mut photo.rgb);
    }
    // decoders disagree on how CMYK becomes RGB, and on rare, damaged and incomplete files
    let alike = !cmyk && jpeg.layout == Layout::Common && jpeg.standalone && !damaged && conversion.is_none();
    Ok(Raw { photo, size, facts, stripped: alike.then_some(jpeg.stripped), damaged })
}

fn read_png(bytes: &[u8], limits: &Limits, samples: Samples) -> Result<Raw, PhotoError> {
    let png = png_metadata::scan(bytes, limits)?;
    let mut decoder = png.decoder()?;
    limits.check_memory(decoder.total_bytes())?;
    let icc = decoder.icc_profile().map_err(broken)?;
    let profile = png.cicp.clone().or(icc.map(Profile::Icc));
    let photo = image_pixels(decoder, profile.as_ref(), samples)?.photo;
    Ok(Raw { photo, size: (png.width, png.height), facts: png.facts(), stripped: None, damaged: png.damaged })
}

fn read_webp(bytes: &[u8], limits: &Limits, samples: Samples) -> Result<Raw, PhotoError> {
    let webp = check::webp(bytes, limits)?;
    let size = (webp.width, webp.height);
    let facts = Facts::read(webp.exif.as_deref());
    let decoder = WebPDecoder::new(Cursor::new(&webp.stripped)).map_err(broken)?;
    if decoder.dimensions() != size {
        return Err(broken("its size differs from that in its header"));
    }
    let pixels = image_pixels(decoder, webp.icc.map(Profile::Icc).as_ref(), samples)?;
    let stripped = (pixels.as_stored && !webp.animated).then_some(webp.stripped);
    Ok(Raw { photo: pixels.photo, size, facts, stripped, damaged: false })
}

/// Decoded pixels of a PNG or WebP.
struct Pixels {
    photo: Photo,
    /// The pixels are the file's own: opaque and not converted.
    as_stored: bool,
}

fn image_pixels(decoder: impl ImageDecoder, profile: Option<&Profile>, samples: Samples) -> Result<Pixels, PhotoError> {
    let ((width, height), colour) = (decoder.dimensions(), decoder.color_type());
    let (pixels, channels) = (width as usize * height as usize, usize::from(colour.channel_count()));
    let (grey, blend) = (!colour.has_color(), samples == Samples::Colours);
    let profile = profile.filter(|_| blend);
    let ((rgb, see_through), converted) = match colour {
        ColorType::Rgb8 => {
            let mut rgb = vec![[0; 3]; pixels];
            decoder.read_image(rgb.as_flattened_mut()).map_err(broken)?;
            let conversion = profile.and_then(|profile| profile.bytes(grey));
            if let Some(conversion) = &conversion {
                conversion.run(&mut rgb);
            }
            ((rgb, false), conversion.is_some())
        }
        ColorType::L8 | ColorType::La8 | ColorType::Rgba8 => {
            let mut samples = vec![0u8; pixels * channels];
            decoder.read_image(&mut samples).map_err(broken)?;
            let conversion = profile.and_then(|profile| profile.bytes(grey));
            (upright_srgb::to_rgb(&samples, channels, conversion.as_ref(), blend), conversion.is_some())
        }
        ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16 => {
            let mut samples = vec![0u16; pixels * channels];
            decoder.read_image(bytemuck::cast_slice_mut(&mut samples)).map_err(broken)?;
            let conversion = profile.and_then(|profile| profile.words(grey));
            (upright_srgb::to_rgb(&samples, channels, conversion.as_ref(), blend), conversion.is_some())
        }
        other => return Err(PhotoError::Broken(format!("pixels of kind {other:?} are not supported"))),
    };
    Ok(Pixels { photo: Photo { width, height, rgb }, as_stored: !see_through && !converted })
}
