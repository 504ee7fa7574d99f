//! Everything that can be refused without decoding a pixel.

use tmpi_core::container::PhotoFormat;

use super::{Limits, PhotoError, broken, jpeg, webp};

/// Format and stored size of a photo, from its headers alone; a server refuses by it before it queues any work.
///
/// # Errors
/// [`PhotoError`], as [`super::decode`] would; damage within the pixels is not seen here.
pub fn check(bytes: &[u8], limits: &Limits) -> Result<(PhotoFormat, (u32, u32)), PhotoError> {
    limits.check_bytes(bytes.len())?;
    let format = PhotoFormat::sniff(bytes).ok_or(PhotoError::Unsupported)?;
    let size = match format {
        PhotoFormat::Jpeg => jpeg::scan(bytes).map(|j| (j.width, j.height))?,
        PhotoFormat::WebP => webp::scan(bytes).map(|w| (w.width, w.height))?,
        PhotoFormat::Png => png_size(bytes)?,
    };
    limits.check_size(size.0, size.1)?;
    Ok((format, size))
}

/// Size of a PNG: its header chunk comes first and has a fixed length.
pub(super) fn png_size(bytes: &[u8]) -> Result<(u32, u32), PhotoError> {
    let Some(head) = bytes.get(8..24).filter(|h| &h[4..8] == b"IHDR") else { return Err(broken("no PNG header")) };
    let side = |at: usize| u32::from_be_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
    Ok((side(8), side(12)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_render::{PictureFormat, View, encode};

    #[test]
    fn sizes_without_decoding_and_limits_at_and_one_over() {
        let view = View { width: 40, height: 30, rgba: vec![[9, 8, 7, 255]; 1200] };
        for format in PictureFormat::ALL {
            let file = encode(&view, format, 90).unwrap();
            let limits = |pixels, side, bytes| Limits { bytes, pixels, side, ..Limits::default() };
            let (_, size) = check(&file, &limits(1200, 40, file.len())).unwrap();
            assert_eq!(size, (40, 30));
            assert!(matches!(check(&file, &limits(1199, 40, file.len())), Err(PhotoError::TooManyPixels { .. })));
            assert!(matches!(check(&file, &limits(1200, 39, file.len())), Err(PhotoError::SideTooLong { .. })));
            assert!(matches!(check(&file, &limits(1200, 40, file.len() - 1)), Err(PhotoError::TooManyBytes { .. })));
            assert!(check(&file[..12], &Limits::default()).is_err(), "{format:?} cut short");
        }
        assert!(matches!(check(b"hello", &Limits::default()), Err(PhotoError::Unsupported)));
    }
}
