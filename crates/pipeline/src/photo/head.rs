//! Reads a photo's size from its first bytes while the rest is still arriving.

use tmpi_core::container::PhotoFormat;

use super::{Limits, PhotoError, jpeg_metadata, png_metadata, webp_metadata};

/// Bytes that suffice to tell any format.
const FORMAT: usize = 12;

/// What the first bytes of a photo say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Head {
    /// Too few bytes: this many are needed, counted from the start, which is more than were given.
    Needs(usize),
    /// Stored width and height in pixels, within the limits.
    Size(u32, u32),
    /// More bytes do not help: only the whole file tells the size.
    Silent,
}

/// Reads a photo's size from its first `bytes`, and checks the limits on its size and on the decoder's memory as its header implies it.
///
/// # Errors
/// The same [`PhotoError`] that [`super::check`] returns for every file within [`Limits::bytes`] that begins with these bytes.
pub fn head(bytes: &[u8], limits: &Limits) -> Result<Head, PhotoError> {
    if bytes.len() < FORMAT {
        return Ok(Head::Needs(FORMAT));
    }
    match super::sniff(bytes)? {
        PhotoFormat::Jpeg => jpeg_metadata::head(bytes, limits),
        PhotoFormat::Png => png_metadata::head(bytes, limits),
        PhotoFormat::WebP => webp_metadata::head(bytes, limits),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tmpi_render::{PictureFormat, View, encode};
    use tmpi_testing::jpeg::{segment, with_segments};

    use super::*;
    use crate::photo::check;

    /// A small picture whose header claims another size.
    fn claiming(format: PictureFormat, width: u16, height: u16) -> Vec<u8> {
        let view = View { width: 40, height: 30, rgba: vec![[9, 8, 7, 255]; 1200] };
        let mut file = encode(&view, format, 90).unwrap();
        match PhotoFormat::sniff(&file).unwrap() {
            PhotoFormat::Jpeg => {
                let frame = file.windows(2).position(|w| w[0] == 0xFF && (0xC0..=0xC2).contains(&w[1])).unwrap();
                file[frame + 5..frame + 9].copy_from_slice(&[height.to_be_bytes(), width.to_be_bytes()].concat());
            }
            PhotoFormat::Png => {
                file[16..24].copy_from_slice(&[u32::from(width).to_be_bytes(), u32::from(height).to_be_bytes()].concat());
            }
            PhotoFormat::WebP => file = canvas(width, height),
        }
        file
    }

    /// The head of a WebP with a canvas of this size, at least one pixel.
    fn canvas(width: u16, height: u16) -> Vec<u8> {
        let side = |s: u16| u32::from(s).saturating_sub(1).to_le_bytes();
        let (w, h) = (side(width), side(height));
        [b"RIFF\x40\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0".as_slice(), &w[..3], &h[..3], &[0; 42]].concat()
    }

    /// A JPEG with `bytes` of metadata before its frame.
    fn with_metadata(bytes: usize) -> Vec<u8> {
        let lengths = std::iter::repeat_n(60_000, bytes / 60_000).chain([bytes % 60_000]);
        let segments: Vec<_> = lengths.map(|length| segment(0xE1, &vec![0xFF; length])).collect();
        with_segments(&claiming(PictureFormat::Jpeg, 40, 30), &segments)
    }

    #[test]
    fn a_size_is_known_as_soon_as_its_bytes_arrive() {
        let limits = Limits::default();
        for format in PictureFormat::ALL {
            let file = claiming(format, 40, 30);
            let mut arrived = 0;
            let seen = loop {
                match head(&file[..arrived], &limits).unwrap() {
                    Head::Needs(more) if more > arrived && more <= file.len() => arrived = more,
                    seen => break seen,
                }
            };
            assert_eq!(seen, Head::Size(40, 30), "{format:?}");
            assert!(matches!(head(&file[..arrived - 1], &limits), Ok(Head::Needs(more)) if more == arrived), "{format:?}");
            assert_eq!(head(&file, &limits).unwrap(), seen);
        }
        let far = with_metadata(300_000);
        assert_eq!(head(&far, &limits).unwrap(), Head::Size(40, 30));
        let Head::Needs(more) = head(&far[..200_000], &limits).unwrap() else { panic!("the frame header has not arrived") };
        assert!((200_001..far.len()).contains(&more));
    }

    #[test]
    fn other_files_are_refused_after_twelve_bytes_and_large_photos_after_their_header() {
        let limits = Limits::default();
        assert_eq!(head(b"Dear madam,", &limits).unwrap(), Head::Needs(12));
        assert!(matches!(head(b"Dear madam, ", &limits), Err(PhotoError::Unsupported)));
        assert!(matches!(head(b"\0\0\0\x18ftypheic", &limits), Err(PhotoError::Heic)));
        for format in PictureFormat::ALL {
            let huge = claiming(format, 60_000, 60_000);
            assert!(matches!(head(&huge, &limits), Err(PhotoError::SideTooLong { .. })), "{format:?}");
            let many = claiming(format, 16_000, 16_000);
            assert!(matches!(head(&many, &limits), Err(PhotoError::TooManyPixels { .. })), "{format:?}");
            let tight = Limits { decoder_memory: 999, ..limits };
            assert!(matches!(head(&claiming(format, 40, 30), &tight), Err(PhotoError::TooMuchMemory { .. })), "{format:?}");
        }
    }

    #[test]
    fn endless_headers_are_left_to_the_check_of_the_whole_file() {
        let limits = Limits::default();
        let fill = [&[0xFF, 0xD8][..], &vec![0xFF; 100_000]].concat();
        assert_eq!(head(&fill, &limits).unwrap(), Head::Silent);
        let comments = [&[0xFF, 0xD8][..], &[0xFF, 0xFE, 0, 2].repeat(50_000)].concat();
        assert_eq!(head(&comments, &limits).unwrap(), Head::Silent);
        assert_eq!(head(b"\xFF\xD8\xFF\xDAscan before", &limits).unwrap(), Head::Silent);
        assert!(matches!(head(b"RIFF\x40\0\0\0WEBPEXIF\x0a\0\0\0\0\0\0\0\0\0\0\0\0\0", &limits), Ok(Head::Silent)));
    }

    proptest! {
        #[test]
        fn head_agrees_with_the_check_of_the_whole_file(
            format in prop::sample::select(PictureFormat::ALL.to_vec()),
            sides in (0..20_000_u16, 0..20_000_u16),
            limits in (1..20_000_u32, 1..400_000_000_u64, 1..900_000_000_u64),
            flips in prop::collection::vec((0..64_usize, any::<u8>()), 0..3),
            cut in 0..200_usize,
            metadata in prop::option::of(0..70_000_usize),
        ) {
            let mut file = match metadata {
                Some(bytes) if format == PictureFormat::Jpeg => with_metadata(bytes),
                _ => claiming(format, sides.0, sides.1),
            };
            for (at, bits) in flips {
                if let Some(byte) = file.get_mut(at) {
                    *byte ^= bits;
                }
            }
            let limits = Limits { side: limits.0, pixels: limits.1, decoder_memory: limits.2, ..Limits::default() };
            let whole = check(&file, &limits);
            for end in [cut.min(file.len()), file.len()] {
                match (head(&file[..end], &limits), &whole) {
                    (Err(early), Err(late)) => prop_assert_eq!(early.to_string(), late.to_string()),
                    (Err(early), Ok(_)) => prop_assert!(false, "refused by head only: {}", early),
                    (Ok(Head::Size(w, h)), Ok((_, size))) => prop_assert_eq!((w, h), *size),
                    (Ok(Head::Needs(more)), _) => prop_assert!(more > end),
                    _ => {}
                }
            }
            // `head` also refuses a file that is refused for its size or format, unless it cannot see the header
            if matches!(whole, Err(PhotoError::SideTooLong { .. } | PhotoError::TooManyPixels { .. } | PhotoError::Unsupported)) {
                prop_assert!(!matches!(head(&file, &limits), Ok(Head::Size(..) | Head::Needs(_))));
            }
        }
    }
}
