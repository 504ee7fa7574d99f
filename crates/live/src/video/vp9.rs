//! VP9 of profile 0, one frame per message.

use std::panic::{AssertUnwindSafe, catch_unwind};

use rusty_vp9::{BitReader, DecodedFrame, Error, Vp9Decoder, parse_uncompressed_header};

use super::{Colour, Decoder, FAILED, I420, Photo, VideoError, expect_size, key_frame, to_rgb};

/// Marker in the last byte of a superframe, which contains several frames (VP9 bitstream specification, annex B).
const SUPERFRAME: u8 = 0xC0;

/// The decoder.
pub struct Vp9 {
    decoder: Vp9Decoder,
    size: (u32, u32),
    /// Colour of the last key frame.
    colour: Colour,
}

impl Vp9 {
    /// A decoder for frames of this size.
    pub fn new(size: (u32, u32)) -> Self {
        Self { decoder: Vp9Decoder::new(), size, colour: Colour::default() }
    }

    fn frame(&mut self, data: &[u8]) -> Result<Option<DecodedFrame>, VideoError> {
        let broken = |error: Error| VideoError::Broken(error.to_string());
        self.check(data)?;
        self.decoder.push(data, None).map_err(broken)?;
        match self.decoder.next_frame() {
            Ok(frame) => Ok(Some(frame)),
            // the frame is hidden
            Err(Error::Again) => Ok(None),
            Err(error) => Err(broken(error)),
        }
    }

    /// Refuses frames of another size before the decoder allocates memory for them. All reference frames have `self.size`.
    fn check(&mut self, data: &[u8]) -> Result<(), VideoError> {
        if data.last().is_none_or(|last| last & 0xE0 == SUPERFRAME) {
            return Err(VideoError::Broken("the message is empty or contains several frames".into()));
        }
        if let Some(key) = key_frame("vp09.", data)? {
            self.colour = key.colour;
        }
        let header = parse_uncompressed_header(&mut BitReader::new(data), &[self.size; 8]);
        let header = header.map_err(|e| VideoError::Broken(e.to_string()))?;
        if !header.show_existing_frame && (header.width, header.height) != self.size {
            return Err(VideoError::Size(header.width, header.height, self.size.0, self.size.1));
        }
        Ok(())
    }
}

impl Decoder for Vp9 {
    fn decode(&mut self, data: &[u8]) -> Result<Option<Photo>, VideoError> {
        let decoded = catch_unwind(AssertUnwindSafe(|| self.frame(data)));
        let decoded = decoded.unwrap_or_else(|_| Err(VideoError::Broken(FAILED.into())));
        // as with H.264, a new decoder continues at the next key frame
        let Some(frame) = decoded.inspect_err(|_| self.decoder = Vp9Decoder::new())? else { return Ok(None) };
        let [y, u, v] = frame.planes.as_slice() else { return Err(VideoError::Broken("the frame does not have three planes".into())) };
        let planes = I420 { width: frame.width, height: frame.height, y, u, v };
        expect_size(to_rgb(&planes, self.colour).ok_or_else(|| VideoError::Broken("a plane is too short".into()))?, self.size)
    }
}

#[cfg(test)]
mod tests {
    use sha2::{Digest as _, Sha256};
    use tmpi_testing::pictures::ivf_frames as frames;

    use super::*;

    const FILM: &[u8] = include_bytes!("../../tests/video/testsrc.ivf");
    const SIZE: (u32, u32) = (174, 142);

    #[test]
    fn planes_equal_those_of_another_decoder() {
        let table = include_str!("../../tests/video/testsrc-vp9.framehash");
        let hashes: Vec<_> = table.lines().filter(|l| !l.starts_with('#')).filter_map(|l| l.rsplit(", ").next()).collect();
        let mut vp9 = Vp9::new(SIZE);
        let hash = |data: &&[u8]| {
            let frame = vp9.frame(data).unwrap().unwrap();
            let mut sum = Sha256::new();
            for plane in &frame.planes {
                sum.update(plane);
            }
            sum.finalize().iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().concat()
        };
        assert_eq!(frames(FILM).iter().map(hash).collect::<Vec<_>>(), hashes);
        assert_eq!(hashes.len(), 40);
    }

    #[test]
    fn a_key_frame_decodes_after_a_refused_frame() {
        let frames = frames(FILM);
        let mut vp9 = Vp9::new(SIZE);
        assert!(vp9.decode(frames[0]).unwrap().is_some_and(|photo| (photo.width, photo.height) == SIZE));
        assert!(matches!(Vp9::new((64, 64)).decode(frames[0]), Err(VideoError::Size(174, 142, 64, 64))));
        for broken in [&[][..], &[0xFF; 9], &frames[1][..1], &[frames[1], &[0xC1, 9, 0xC1]].concat()] {
            assert!(vp9.decode(broken).is_err());
        }
        // refers to frames that the new decoder does not have
        assert!(vp9.decode(frames[1]).is_err());
        assert!(vp9.decode(frames[20]).unwrap().is_some());
    }
}
