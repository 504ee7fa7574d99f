//! Picture codecs of the container.

use std::io::Write;

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder, ImageFormat};

use super::{ContainerError, EncodedPhoto, MAX_PIXELS, MAX_SIDE, PhotoFormat};
use crate::scene::Photo;

/// Encodes 8-bit RGB as JPEG with a quality from 1 to 100.
///
/// # Errors
/// [`ContainerError::Encode`] if a side is over 65 535 pixels.
pub fn encode_jpeg(width: u32, height: u32, rgb: &[u8], quality: u8) -> Result<Vec<u8>, ContainerError> {
    let mut out = Vec::new();
    write_jpeg(&mut out, (width, height), rgb, quality).map_err(|e| ContainerError::Encode(e.to_string()))?;
    Ok(out)
}

fn write_jpeg(to: impl Write, (width, height): (u32, u32), rgb: &[u8], quality: u8) -> image::ImageResult<()> {
    JpegEncoder::new_with_quality(to, quality.clamp(1, 100)).write_image(rgb, width, height, ExtendedColorType::Rgb8)
}

/// A file that is collected as long as it is shorter than a limit.
struct ShortFile {
    bytes: Vec<u8>,
    limit: usize,
    is_over: bool,
}

impl Write for ShortFile {
    fn write(&mut self, part: &[u8]) -> std::io::Result<usize> {
        self.write_all(part)?;
        Ok(part.len())
    }

    fn write_all(&mut self, part: &[u8]) -> std::io::Result<()> {
        if self.bytes.len() + part.len() >= self.limit {
            self.is_over = true;
            return Err(std::io::ErrorKind::FileTooLarge.into());
        }
        self.bytes.extend_from_slice(part);
        Ok(())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Encodes 8-bit RGB (three bytes per pixel) or RGBA (four) as lossless PNG or WebP.
///
/// # Errors
/// [`ContainerError::Encode`] if the format cannot hold the size.
pub fn encode_lossless(format: ImageFormat, width: u32, height: u32, pixels: &[u8]) -> Result<Vec<u8>, ContainerError> {
    let rgb = pixels.len() == width as usize * height as usize * 3;
    let mut out = std::io::Cursor::new(Vec::new());
    let colour = if rgb { ExtendedColorType::Rgb8 } else { ExtendedColorType::Rgba8 };
    image::write_buffer_with_format(&mut out, pixels, width, height, colour, format).map_err(|e| ContainerError::Encode(e.to_string()))?;
    Ok(out.into_inner())
}

impl EncodedPhoto {
    /// Encodes a photo as JPEG with a quality from 1 to 100.
    ///
    /// # Errors
    /// [`ContainerError::Encode`] if a side is over 65 535 pixels.
    pub fn from_photo(photo: &Photo, quality: u8) -> Result<Self, ContainerError> {
        let bytes = encode_jpeg(photo.width, photo.height, photo.rgb.as_flattened(), quality)?;
        Ok(Self { bytes, format: PhotoFormat::Jpeg })
    }

    /// Like [`EncodedPhoto::from_photo`] if the file is shorter than `limit` bytes, otherwise `None`, without encoding the rest.
    ///
    /// # Errors
    /// As in [`EncodedPhoto::from_photo`].
    pub fn shorter_than(limit: usize, photo: &Photo, quality: u8) -> Result<Option<Self>, ContainerError> {
        let mut file = ShortFile { bytes: Vec::new(), limit, is_over: false };
        match write_jpeg(&mut file, (photo.width, photo.height), photo.rgb.as_flattened(), quality) {
            Ok(()) => Ok(Some(Self { bytes: file.bytes, format: PhotoFormat::Jpeg })),
            Err(_) if file.is_over => Ok(None),
            Err(e) => Err(ContainerError::Encode(e.to_string())),
        }
    }

    /// Encodes a photo as lossless WebP.
    ///
    /// # Errors
    /// [`ContainerError::Encode`] if a side is over 16 383 pixels.
    pub fn lossless(photo: &Photo) -> Result<Self, ContainerError> {
        let bytes = encode_lossless(ImageFormat::WebP, photo.width, photo.height, photo.rgb.as_flattened())?;
        Ok(Self { bytes, format: PhotoFormat::WebP })
    }

    /// Decodes the photo as readers of the container do.
    ///
    /// # Errors
    /// [`ContainerError::Broken`] if the file is damaged or exceeds a limit.
    pub fn decode(&self) -> Result<Photo, ContainerError> {
        decode(self.format, &self.bytes, (MAX_SIDE, MAX_SIDE))
    }
}

/// Maximum memory per pixel for decoding, in bytes: 16-bit RGBA, and the coefficients of a progressive JPEG.
const DECODING: u64 = 16;
/// Memory that even the smallest picture may use, in bytes.
const MIN_DECODING: u64 = 1 << 20;

/// Decodes a picture of at most `most` pixels (width, height).
///
/// # Errors
/// [`ContainerError::Broken`] if it is damaged or larger.
pub fn decode(format: PhotoFormat, bytes: &[u8], most: (u32, u32)) -> Result<Photo, ContainerError> {
    let format = match format {
        PhotoFormat::Jpeg => ImageFormat::Jpeg,
        PhotoFormat::Png => ImageFormat::Png,
        PhotoFormat::WebP => ImageFormat::WebP,
    };
    let broken = |e: image::ImageError| ContainerError::broken(format!("picture: {e}"));
    let mut reader = image::ImageReader::with_format(std::io::Cursor::new(bytes), format);
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(most.0);
    limits.max_image_height = Some(most.1);
    let pixels = (u64::from(most.0) * u64::from(most.1)).min(MAX_PIXELS);
    limits.max_alloc = Some(MIN_DECODING + pixels * DECODING);
    reader.limits(limits);
    let rgb = reader.decode().map_err(broken)?.into_rgb8();
    let (width, height) = rgb.dimensions();
    let rgb: Vec<[u8; 3]> = bytemuck::allocation::try_cast_vec(rgb.into_raw()).unwrap_or_else(|(_, raw)| raw.as_chunks().0.to_vec());
    Ok(Photo { width, height, rgb })
}
