//! Checks that need no decoded pixels.

use tmpi_core::container::PhotoFormat;

use super::jpeg_metadata::Jpeg;
use super::webp_metadata::WebP;
use super::{Limits, PhotoError, jpeg_metadata, png_metadata, webp_metadata};

/// Reads a photo's format and stored size (width, height in pixels) from its headers alone. A server calls this before it queues a job.
///
/// # Errors
/// The [`PhotoError`] that [`super::decode`] would return, except for damage in the pixel data, which this function does not see.
pub fn check(bytes: &[u8], limits: &Limits) -> Result<(PhotoFormat, (u32, u32)), PhotoError> {
    limits.check_bytes(bytes.len())?;
    let format = super::sniff(bytes)?;
    let size = match format {
        PhotoFormat::Jpeg => jpeg(bytes, limits).map(|j| (j.width, j.height))?,
        PhotoFormat::WebP => webp(bytes, limits).map(|w| (w.width, w.height))?,
        PhotoFormat::Png => png_metadata::scan(bytes, limits).map(|p| (p.width, p.height))?,
    };
    Ok((format, size))
}

/// Scans the segments of a JPEG. Checks the limits, and that there is data for each of its blocks.
pub(super) fn jpeg(bytes: &[u8], limits: &Limits) -> Result<Jpeg, PhotoError> {
    // `head` first, so that a complete file gets the same error as one that is still arriving
    jpeg_metadata::head(bytes, limits)?;
    let jpeg = jpeg_metadata::scan(bytes)?;
    limits.check_size(jpeg.width, jpeg.height)?;
    jpeg.check_data()?;
    limits.check_memory(jpeg.memory)?;
    Ok(jpeg)
}

/// Scans the chunks of a WebP and checks the limits.
pub(super) fn webp(bytes: &[u8], limits: &Limits) -> Result<WebP, PhotoError> {
    webp_metadata::head(bytes, limits)?;
    let webp = webp_metadata::scan(bytes)?;
    limits.check_size(webp.width, webp.height)?;
    limits.check_memory(webp.memory())?;
    Ok(webp)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_render::{PictureFormat, View, encode};

    #[test]
    fn reads_sizes_without_decoding_and_enforces_limits_exactly() {
        let view = View { width: 40, height: 30, rgba: vec![[9, 8, 7, 255]; 1200] };
        for format in PictureFormat::ALL {
            let file = encode(&view, format, 90).unwrap();
            let checked = |pixels, side, bytes| {
                let limits = Limits { bytes, pixels, side, ..Limits::default() };
                let size = check(&file, &limits).map(|(_, size)| size);
                let decoded = super::super::decode(&file, &limits, None).map(|decoded| decoded.original);
                assert_eq!(format!("{size:?}"), format!("{decoded:?}"), "{format:?}");
                size
            };
            assert_eq!(checked(1200, 40, file.len()).unwrap(), (40, 30));
            assert!(matches!(checked(1199, 40, file.len()), Err(PhotoError::TooManyPixels { width: 40, height: 30, limit: 1199 })));
            assert!(matches!(checked(1200, 39, file.len()), Err(PhotoError::SideTooLong { width: 40, height: 30, limit: 39 })));
            assert!(matches!(checked(1200, 40, file.len() - 1), Err(PhotoError::TooManyBytes { .. })));
            assert!(check(&file[..12], &Limits::default()).is_err(), "{format:?} cut short");
        }
        assert!(matches!(check(b"hello", &Limits::default()), Err(PhotoError::Unsupported)));
        for brand in ["heic", "heix", "mif1", "avif"] {
            let file = format!("\0\0\0\u{18}ftyp{brand}\0\0\0\0mif1");
            assert!(matches!(check(file.as_bytes(), &Limits::default()), Err(PhotoError::Heic)), "{brand}");
        }
        assert!(matches!(check(b"\0\0\0\x18ftypisom\0\0\0\0mp42", &Limits::default()), Err(PhotoError::Unsupported)), "a film");
    }
}
