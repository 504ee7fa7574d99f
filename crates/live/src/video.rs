//! Decoders of what publishers send, and the conversion to RGB that every reader of a room does alike.

use tmpi_core::Photo;
use tmpi_core::container::{PhotoFormat, decode_picture};

/// Codec string of frames that are JPEG files.
pub const JPEG: &str = "jpeg";

/// Why a frame cannot be decoded.
#[derive(Debug, thiserror::Error)]
pub enum VideoError {
    /// There is no decoder for the codec.
    #[error("no decoder for the codec {0:?}")]
    Codec(String),
    /// The bytes are damaged, or use what the decoder does not know; it goes on with the next key frame.
    #[error("video: {0}")]
    Broken(String),
    /// The frame is not of the size that the publisher said.
    #[error("a frame of {0}×{1}, where the publisher said {2}×{3}")]
    Size(u32, u32, u32, u32),
}

/// Decodes the frames of a room one after the other.
pub trait Decoder: Send {
    /// Decodes an access unit; none where it holds no picture.
    ///
    /// # Errors
    /// [`VideoError::Broken`], [`VideoError::Size`].
    fn decode(&mut self, data: &[u8]) -> Result<Option<Photo>, VideoError>;
}

/// The decoder for a codec string of `WebCodecs`, of frames of that size.
///
/// # Errors
/// [`VideoError::Codec`].
pub fn decoder(codec: &str, size: (u32, u32)) -> Result<Box<dyn Decoder>, VideoError> {
    match codec {
        JPEG => Ok(Box::new(Jpeg { size })),
        #[cfg(feature = "h264")]
        _ if codec.starts_with("avc1.") => Ok(Box::new(h264::H264::new(size))),
        _ => Err(VideoError::Codec(codec.chars().take(32).collect())),
    }
}

/// Size of a picture by its first access unit.
///
/// # Errors
/// [`VideoError`] where it cannot be decoded by itself.
pub fn size(codec: &str, data: &[u8]) -> Result<(u32, u32), VideoError> {
    let most = (1 << 14, 1 << 14);
    let decoded = decoder(codec, most).and_then(|mut d| d.decode(data));
    match decoded {
        Ok(Some(photo)) => Ok((photo.width, photo.height)),
        Err(VideoError::Size(width, height, ..)) => Ok((width, height)),
        Ok(None) => Err(VideoError::Broken("there is no picture in it".into())),
        Err(error) => Err(error),
    }
}

fn sized(photo: Photo, (width, height): (u32, u32)) -> Result<Option<Photo>, VideoError> {
    if (photo.width, photo.height) == (width, height) {
        Ok(Some(photo))
    } else {
        Err(VideoError::Size(photo.width, photo.height, width, height))
    }
}

/// Frames that are JPEG files.
struct Jpeg {
    size: (u32, u32),
}

impl Decoder for Jpeg {
    fn decode(&mut self, data: &[u8]) -> Result<Option<Photo>, VideoError> {
        let photo = decode_picture(PhotoFormat::Jpeg, data, self.size).map_err(|e| VideoError::Broken(e.to_string()))?;
        sized(photo, self.size)
    }
}

/// Planes of a picture whose chroma has half the width and half the height, rounded up; 8 bits, rows without gaps.
#[derive(Clone, Copy, Debug)]
pub struct I420<'a> {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Luma.
    pub y: &'a [u8],
    /// Blue less luma.
    pub u: &'a [u8],
    /// Red less luma.
    pub v: &'a [u8],
}

/// Fraction bits of the conversion.
const BITS: u32 = 14;

/// BT.709, limited range, in whole numbers, each chroma value for its four pixels: the shader of the viewer computes the same, so that
/// hidden colours that a reader derives agree with what the server saw. None where a plane is too short.
#[must_use]
pub fn to_rgb(i: &I420) -> Option<Photo> {
    let (w, h) = (i.width as usize, i.height as usize);
    let across = w.div_ceil(2);
    let chroma = across * h.div_ceil(2);
    let (luma, u, v) = (i.y.get(..w * h)?, i.u.get(..chroma)?, i.v.get(..chroma)?);
    let mut rgb = Vec::with_capacity(w * h);
    for (y, row) in luma.chunks(w.max(1)).enumerate() {
        let (u, v) = (&u[y / 2 * across..][..across], &v[y / 2 * across..][..across]);
        for ((pair, u), v) in row.chunks(2).zip(u).zip(v) {
            let (u, v) = (i32::from(*u) - 128, i32::from(*v) - 128);
            let (red, green, blue) = (29_372 * v, -3_494 * u - 8_731 * v, 34_610 * u);
            rgb.extend(pair.iter().map(|y| {
                let luma = 19_077 * (i32::from(*y) - 16) + (1 << (BITS - 1));
                [red, green, blue].map(|c| ((luma + c) >> BITS).clamp(0, 255) as u8)
            }));
        }
    }
    Some(Photo { width: i.width, height: i.height, rgb })
}

#[cfg(feature = "h264")]
mod h264 {
    use rusty_h264_common::nal::{emulation_unprevent, split_annex_b};
    use rusty_h264_decoder::Sps;

    use super::{Decoder, I420, Photo, VideoError, sized, to_rgb};

    /// H.264, access units in Annex B.
    pub struct H264 {
        decoder: rusty_h264_decoder::Decoder,
        size: (u32, u32),
    }

    impl H264 {
        pub fn new(size: (u32, u32)) -> Self {
            Self { decoder: rusty_h264_decoder::Decoder::new(), size }
        }
    }

    /// Type of a NAL unit that is a sequence parameter set.
    const SPS: u8 = 7;

    impl Decoder for H264 {
        fn decode(&mut self, data: &[u8]) -> Result<Option<Photo>, VideoError> {
            self.check(data)?;
            let Some(frame) = self.decoder.decode(data).map_err(|e| VideoError::Broken(e.to_string()))? else { return Ok(None) };
            let planes = I420 { width: frame.width as u32, height: frame.height as u32, y: &frame.y, u: &frame.u, v: &frame.v };
            let short = || VideoError::Broken("a plane that is too short".into());
            sized(to_rgb(&planes).ok_or_else(short)?, self.size)
        }
    }

    impl H264 {
        /// Refuses parameters of larger frames before the decoder takes memory for them.
        fn check(&self, data: &[u8]) -> Result<(), VideoError> {
            let (width, height) = self.size;
            let fits = |coded: usize, side: u32| coded <= side.next_multiple_of(16) as usize;
            for nal in split_annex_b(data).into_iter().filter(|n| n.first().is_some_and(|head| head & 31 == SPS)) {
                let sps = Sps::parse(&emulation_unprevent(&nal[1..])).map_err(|e| VideoError::Broken(e.to_string()))?;
                if !fits(sps.coded_width(), width) || !fits(sps.coded_height(), height) {
                    return Err(VideoError::Size(sps.coded_width() as u32, sps.coded_height() as u32, width, height));
                }
            }
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// BT.709 of a grey ramp and of full-range corners, against the definition in `f64`.
    #[test]
    fn the_conversion_is_that_of_the_standard_to_a_level() {
        for (y, u, v) in (16..=235).step_by(3).flat_map(|y| [(y, 128, 128), (y, 100, 150), (y, 160, 90), (y, 16, 240)]) {
            let rgb = to_rgb(&I420 { width: 1, height: 1, y: &[y], u: &[u], v: &[v] }).unwrap().rgb[0];
            let (y, u, v) = ((f64::from(y) - 16.0) / 219.0, (f64::from(u) - 128.0) / 224.0, (f64::from(v) - 128.0) / 224.0);
            let (kr, kb) = (0.2126, 0.0722);
            let (r, b) = (y + 2.0 * (1.0 - kr) * v, y + 2.0 * (1.0 - kb) * u);
            let g = (y - kr * r - kb * b) / (1.0 - kr - kb);
            for (is, should) in rgb.into_iter().zip([r, g, b]) {
                assert!((f64::from(is) - (should * 255.0).clamp(0.0, 255.0)).abs() <= 1.0, "{rgb:?}: {should}");
            }
        }
    }

    #[test]
    fn planes_that_are_too_short_are_no_picture() {
        let y = [0; 15];
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y, u: &[0; 6], v: &[0; 6] }).is_some());
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y, u: &[0; 6], v: &[0; 5] }).is_none());
        assert!(to_rgb(&I420 { width: 5, height: 3, y: &y[1..], u: &[0; 6], v: &[0; 6] }).is_none());
    }

    #[test]
    fn a_codec_that_nobody_knows_is_refused_and_so_is_another_size() {
        assert!(matches!(decoder("av01.0", (8, 8)), Err(VideoError::Codec(_))));
        let photo = Photo { width: 16, height: 8, rgb: vec![[90; 3]; 128] };
        let jpeg = tmpi_core::container::Carried { format: PhotoFormat::Jpeg, bytes: vec![] };
        assert!(jpeg.decode().is_err());
        assert!(sized(photo.clone(), (16, 8)).is_ok_and(|p| p.is_some()) && sized(photo, (8, 16)).is_err());
        assert!(matches!(decoder(JPEG, (16, 8)).unwrap().decode(b"no JPEG"), Err(VideoError::Broken(_))));
    }
}
