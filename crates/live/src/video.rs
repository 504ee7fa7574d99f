//! Decoders for the video that publishers send.

mod vp9;

use tmpi_core::Photo;
use tmpi_core::container::PhotoFormat;
pub use tmpi_core::live::{Colour, I420, to_rgb};
use tmpi_core::live::{KeyFrame, KeyFrameError, key_frame};
use tmpi_pipeline::photo::{self, Limits};

/// Codec string of frames that are JPEG files.
pub const JPEG: &str = "jpeg";

/// Text of [`VideoError::Broken`] if the decoder panicked.
pub const FAILED: &str = "the decoder failed on it";

/// Why a frame cannot be decoded.
#[derive(Debug, thiserror::Error)]
pub enum VideoError {
    /// There is no decoder for the codec.
    #[error("no decoder for the codec {0:?}")]
    Codec(String),
    /// The bytes are damaged, or use an unsupported feature. Decoding continues at the next key frame.
    #[error("video: {0}")]
    Broken(String),
    /// The stream uses an unsupported feature; the text names it and says what to do.
    #[error("{0}")]
    Unsupported(String),
    /// The frame does not have the size that the publisher announced.
    #[error("the frame has {0}×{1} pixels, but the publisher announced {2}×{3}")]
    Size(u32, u32, u32, u32),
}

/// Decodes the frames of a room in order.
pub trait Decoder: Send {
    /// Decodes an access unit; returns `None` if it contains no picture.
    ///
    /// # Errors
    /// [`VideoError::Broken`], [`VideoError::Unsupported`] or [`VideoError::Size`].
    fn decode(&mut self, data: &[u8]) -> Result<Option<Photo>, VideoError>;
}

/// Creates the decoder for a `WebCodecs` codec string and frames of this size.
///
/// # Errors
/// [`VideoError::Codec`] if there is none.
pub fn decoder(codec: &str, size: (u32, u32)) -> Result<Box<dyn Decoder>, VideoError> {
    match codec {
        JPEG => Ok(Box::new(Jpeg { size })),
        _ if codec.starts_with("avc1.") => Ok(Box::new(h264::H264::new(size))),
        _ if codec.starts_with("vp09.00.") => Ok(Box::new(vp9::Vp9::new(size))),
        _ => Err(VideoError::Codec(codec.chars().take(32).collect())),
    }
}

/// Reads the displayed size from a frame's header; returns `None` if it is not a key frame.
///
/// # Errors
/// [`VideoError::Unsupported`] if the frame uses an unsupported feature, [`VideoError::Broken`] if it is damaged.
pub fn size(codec: &str, data: &[u8]) -> Result<Option<(u32, u32)>, VideoError> {
    if codec == JPEG {
        return photo::upright_size(data, &Limits::default()).map(Some).map_err(|e| VideoError::Broken(e.to_string()));
    }
    Ok(key_frame(codec, data)?.map(|key| (key.width, key.height)))
}

impl From<KeyFrameError> for VideoError {
    fn from(error: KeyFrameError) -> Self {
        match error {
            KeyFrameError::Broken(why) => Self::Broken(why),
            KeyFrameError::Unsupported(why) => Self::Unsupported(why.into()),
        }
    }
}

fn expect_size(photo: Photo, (width, height): (u32, u32)) -> Result<Option<Photo>, VideoError> {
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
        if PhotoFormat::sniff(data) != Some(PhotoFormat::Jpeg) {
            return Err(VideoError::Broken("the frame is not a JPEG".into()));
        }
        let (width, height) = self.size;
        let limits = Limits { pixels: u64::from(width) * u64::from(height), side: width.max(height), ..Limits::default() };
        // like a photo, because that reader tolerates frames without code tables or an end marker
        let decoded = photo::decode(data, &limits, None).map_err(|e| VideoError::Broken(e.to_string()))?;
        expect_size(decoded.photo, self.size)
    }
}

mod h264 {
    use std::panic::{AssertUnwindSafe, catch_unwind};

    use rusty_h264_common::YuvFrame;
    use rusty_h264_decoder::DecodeError;

    use super::{Decoder, FAILED, I420, KeyFrame, Photo, VideoError, expect_size, key_frame, to_rgb};
    use crate::access_units::is_bidirectional;

    /// Decoder for H.264 access units in Annex B format.
    pub struct H264 {
        decoder: rusty_h264_decoder::Decoder,
        size: (u32, u32),
        /// Parameters of the last key frame.
        key: Option<KeyFrame>,
    }

    impl Decoder for H264 {
        fn decode(&mut self, data: &[u8]) -> Result<Option<Photo>, VideoError> {
            // damaged slices can make the decoder panic, or unable to read sound ones; a new decoder continues at the next key frame
            let decoded = catch_unwind(AssertUnwindSafe(|| self.picture(data)));
            let decoded = decoded.unwrap_or_else(|_| Err(VideoError::Broken(FAILED.into())));
            decoded.inspect_err(|_| self.decoder = rusty_h264_decoder::Decoder::new())
        }
    }

    impl H264 {
        pub fn new(size: (u32, u32)) -> Self {
            Self { decoder: rusty_h264_decoder::Decoder::new(), size, key: None }
        }

        fn picture(&mut self, data: &[u8]) -> Result<Option<Photo>, VideoError> {
            self.check(data)?;
            let decoded = self.decoder.decode(data).map_err(|error| match error {
                DecodeError::Unsupported(what) => VideoError::Unsupported(format!("the video uses {what}, which is not supported")),
                error => VideoError::Broken(error.to_string()),
            })?;
            let Some(frame) = decoded else { return Ok(None) };
            let key = self.key.ok_or_else(|| VideoError::Broken("a picture precedes its parameters".into()))?;
            let frame = crop(frame, (key.left as usize, key.top as usize));
            let planes = I420 { width: frame.width as u32, height: frame.height as u32, y: &frame.y, u: &frame.u, v: &frame.v };
            let short = || VideoError::Broken("a plane is too short".into());
            expect_size(to_rgb(&planes, key.colour).ok_or_else(short)?, self.size)
        }

        /// Refuses parameters of larger frames before the decoder allocates memory for them. Refuses B slices, which rooms do not use:
        /// damaged data that looks like one can make the decoder panic.
        fn check(&mut self, data: &[u8]) -> Result<(), VideoError> {
            if is_bidirectional(data) {
                return Err(VideoError::Broken("a slice refers to later pictures".into()));
            }
            if let Some(key) = key_frame("avc1.", data)? {
                if (key.width, key.height) != self.size {
                    return Err(VideoError::Size(key.width, key.height, self.size.0, self.size.1));
                }
                self.key = Some(key);
            }
            Ok(())
        }
    }

    /// Crops the left and top; the decoder crops only the right and bottom.
    fn crop(frame: YuvFrame, (left, top): (usize, usize)) -> YuvFrame {
        if (left, top) == (0, 0) {
            return frame;
        }
        let rows = |plane: &[u8], width: usize, by: usize| {
            let rows = plane.chunks_exact(width.max(1)).skip(top / by);
            rows.flat_map(|row| row.get(left / by..).unwrap_or_default()).copied().collect()
        };
        let across = frame.width.div_ceil(2);
        YuvFrame {
            width: frame.width.saturating_sub(left),
            height: frame.height.saturating_sub(top),
            y: rows(&frame.y, frame.width, 1),
            u: rows(&frame.u, across, 2),
            v: rows(&frame.v, across, 2),
        }
    }

    #[cfg(test)]
    mod tests {
        use std::fs;
        use std::path::Path;

        use sha2::{Digest as _, Sha256};

        use super::{Decoder as _, H264, VideoError, is_bidirectional};
        use crate::access_units::Splitter;

        /// Access units of a stream, and hashes of its frames by another decoder (tests/video/README.md).
        fn sample(name: &str, size: (u32, u32)) -> (H264, Vec<Vec<u8>>, Vec<String>) {
            let at = |ending: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/video").join(format!("{name}.{ending}"));
            let mut splitter = Splitter::default();
            let mut units = splitter.push(&fs::read(at("h264")).unwrap()).unwrap();
            units.extend(splitter.finish());
            let table = fs::read_to_string(at("framehash")).unwrap();
            let hashes = table.lines().filter(|l| !l.starts_with('#')).map(|l| l.rsplit(", ").next().unwrap_or_default().to_owned());
            (H264::new(size), units.into_iter().map(|u| u.data).collect(), hashes.collect())
        }

        fn hash(h264: &mut H264, unit: &[u8]) -> String {
            let frame = h264.decoder.decode(unit).unwrap().unwrap();
            let mut sum = Sha256::new();
            for plane in [&frame.y, &frame.u, &frame.v] {
                sum.update(plane);
            }
            sum.finalize().iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().concat()
        }

        /// Whether other frames refer to this one (ITU-T H.264, 7.4.1: `nal_ref_idc`).
        fn is_referred_to(unit: &[u8]) -> bool {
            unit.windows(4).any(|w| w[..3] == [0, 0, 1] && matches!(w[3] & 31, 1 | 5) && w[3] >> 5 != 0)
        }

        #[test]
        fn planes_equal_those_of_another_decoder() {
            for (name, size) in [("testsrc", (174, 142)), ("layers", (320, 240))] {
                let (mut h264, units, hashes) = sample(name, size);
                assert_eq!(units.iter().map(|unit| hash(&mut h264, unit)).collect::<Vec<_>>(), hashes, "{name}");
                assert!(hashes.len() >= 24 && hashes.windows(2).all(|w| w[0] != w[1]) && units.iter().all(|unit| !is_bidirectional(unit)));
            }
        }

        #[test]
        fn b_slices_never_reach_the_decoder() {
            let (mut h264, units, _) = sample("testsrc", (174, 142));
            // first_mb_in_slice 0, slice_type 1
            let slice = [0, 0, 1, 0x41, 0b1010_0000, 7, 7];
            for unit in [slice.to_vec(), [&units[1][..], &slice].concat()] {
                assert!(h264.decode(&units[0]).is_ok_and(|photo| photo.is_some()));
                let refused = h264.decode(&unit);
                assert!(matches!(&refused, Err(VideoError::Broken(why)) if why.contains("later pictures")), "{refused:?}");
            }
        }

        #[test]
        fn the_base_layer_decodes_without_the_upper_one() {
            let (mut h264, units, hashes) = sample("layers", (320, 240));
            let base: Vec<_> = units.iter().zip(hashes).filter(|(unit, _)| is_referred_to(unit)).collect();
            assert_eq!((base.len(), units.len()), (12, 24));
            for (i, (unit, expected)) in base.into_iter().enumerate() {
                assert_eq!(hash(&mut h264, unit), expected, "frame {i}");
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_codecs_and_other_sizes_are_refused() {
        assert!(matches!(decoder("av01.0", (8, 8)), Err(VideoError::Codec(_))));
        let photo = Photo { width: 16, height: 8, rgb: vec![[90; 3]; 128] };
        let jpeg = tmpi_core::container::EncodedPhoto { format: PhotoFormat::Jpeg, bytes: vec![] };
        assert!(jpeg.decode().is_err());
        assert!(expect_size(photo.clone(), (16, 8)).is_ok_and(|p| p.is_some()) && expect_size(photo, (8, 16)).is_err());
        assert!(matches!(decoder(JPEG, (16, 8)).unwrap().decode(b"no JPEG"), Err(VideoError::Broken(_))));
    }

    /// Cameras omit from Motion JPEG frames what is the same in all of them.
    #[test]
    fn jpeg_frames_without_tables_or_end_marker_decode() {
        let rgb = (0..48 * 32).map(|i| [(i % 48 * 5) as u8, (i / 48 * 7) as u8, 90]).collect();
        let frame = tmpi_core::container::EncodedPhoto::from_photo(&Photo { width: 48, height: 32, rgb }, 90).unwrap().bytes;
        let decoded = |frame: &[u8]| decoder(JPEG, (48, 32)).unwrap().decode(frame).unwrap().unwrap();
        let whole = decoded(&frame);
        let mut bare = frame.clone();
        while let Some(at) = bare.windows(2).position(|w| w == [0xFF, 0xC4]) {
            bare.drain(at..at + 2 + usize::from(u16::from_be_bytes([bare[at + 2], bare[at + 3]])));
        }
        assert!(bare.len() + 400 < frame.len());
        for frame in [&frame[..frame.len() - 2], &frame[..frame.len() - 1], &bare, &bare[..bare.len() - 2]] {
            assert_eq!(decoded(frame), whole);
            assert_eq!(size(JPEG, frame).unwrap(), Some((48, 32)));
        }
        assert!(decoder(JPEG, (48, 32)).unwrap().decode(&frame[..frame.len() / 2]).is_err());
        assert!(decoder(JPEG, (40, 32)).unwrap().decode(&frame).is_err() && decoder(JPEG, (96, 32)).unwrap().decode(&frame).is_err());
    }

    /// Without a reset after the first error, the decoder panics on this stream and cannot decode a sound one afterwards.
    #[test]
    fn a_sound_stream_decodes_after_a_damaged_one() {
        let outcomes = |h264: &mut dyn Decoder, stream: &[u8]| {
            let mut splitter = crate::access_units::Splitter::default();
            let mut units = splitter.push(stream).unwrap();
            units.extend(splitter.finish());
            units.iter().map(|u| h264.decode(&u.data).map_err(|e| e.to_string())).collect::<Vec<_>>()
        };
        let [mut used, mut fresh] = [(); 2].map(|()| decoder("avc1.42e01e", (64, 48)).unwrap());
        let failed = outcomes(used.as_mut(), include_bytes!("../../../fuzz/seeds/video/failing.h264"));
        assert!(failed.iter().any(Result::is_err));
        let sound = include_bytes!("../../../fuzz/seeds/video/ten.h264");
        let after = outcomes(used.as_mut(), sound);
        assert!(after.iter().filter(|o| matches!(o, Ok(Some(_)))).count() > 1, "{after:?}");
        assert_eq!(after, outcomes(fresh.as_mut(), sound));
    }
}
