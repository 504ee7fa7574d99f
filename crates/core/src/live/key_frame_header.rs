//! Reads the headers of key frames: size, cropping and colours of the following pictures. Rejects video that rooms do not support.

use h264_reader::nal::sps::{ChromaFormat, FrameMbsFlags, SeqParameterSet};
use h264_reader::rbsp::{BitReader, decode_nal};

use super::{Colour, Matrix};

/// Type of a NAL unit that is a sequence parameter set (ITU-T H.264, table 7-1).
const PARAMETERS: u8 = 7;

/// Properties that a key frame signals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KeyFrame {
    /// Width of the visible picture, in pixels.
    pub width: u32,
    /// Height of the visible picture, in pixels.
    pub height: u32,
    /// Columns of the coded picture that are cropped at the left.
    pub left: u32,
    /// Rows of the coded picture that are cropped at the top.
    pub top: u32,
    /// Width and height of the coded picture, in pixels.
    pub coded: (u32, u32),
    /// Colours of the picture.
    pub colour: Colour,
}

/// Why a room rejects a key frame.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum KeyFrameError {
    /// The header is damaged.
    #[error("cannot read the header of a key frame: {0}")]
    Broken(String),
    /// The video uses a feature that the server cannot decode.
    #[error("{0}")]
    Unsupported(&'static str),
}

const DEPTH: &str = "the video has more than 8 bits per sample: encode it with ffmpeg -pix_fmt yuv420p";
const CHROMA: &str = "the video does not have 4:2:0 chroma: encode it with ffmpeg -pix_fmt yuv420p";
const INTERLACED: &str = "the video is coded as interlaced: encode it with ffmpeg -vf yadif and without -flags +ildct+ilme";
const PROFILE: &str = "the video uses a VP9 profile other than 0: encode it with ffmpeg -pix_fmt yuv420p";

/// Properties of a frame in H.264 or VP9. `None` if the frame has no header of a key frame, or the codec is another one.
///
/// # Errors
/// [`KeyFrameError`] if the header is damaged, or the video is not progressive 4:2:0 with 8 bits.
pub fn key_frame(codec: &str, data: &[u8]) -> Result<Option<KeyFrame>, KeyFrameError> {
    if codec.starts_with("avc1.") {
        parameters(data).map(h264).last().transpose()
    } else if codec.starts_with("vp09.") {
        vp9(data)
    } else {
        Ok(None)
    }
}

/// Sequence parameter sets of an access unit in Annex B.
fn parameters(unit: &[u8]) -> impl Iterator<Item = &[u8]> {
    let starts = unit.windows(4).enumerate().filter(|(_, w)| w[..3] == [0, 0, 1] && w[3] & 31 == PARAMETERS);
    starts.map(|(at, _)| {
        let rest = &unit[at + 3..];
        let end = rest.windows(3).position(|w| w[..2] == [0, 0] && w[2] <= 1);
        &rest[..end.unwrap_or(rest.len())]
    })
}

fn h264(nal: &[u8]) -> Result<KeyFrame, KeyFrameError> {
    let broken = |why: String| KeyFrameError::Broken(why);
    let bytes = decode_nal(nal).map_err(|e| broken(e.to_string()))?;
    let sps = SeqParameterSet::from_bits(BitReader::new(&*bytes)).map_err(|e| broken(format!("{e:?}")))?;
    if sps.chroma_info.bit_depth_luma_minus8 > 0 || sps.chroma_info.bit_depth_chroma_minus8 > 0 {
        return Err(KeyFrameError::Unsupported(DEPTH));
    }
    if sps.chroma_info.chroma_format != ChromaFormat::YUV420 {
        return Err(KeyFrameError::Unsupported(CHROMA));
    }
    let fields = match sps.frame_mbs_flags {
        FrameMbsFlags::Frames => 1,
        FrameMbsFlags::Fields { mb_adaptive_frame_field_flag: false } => 2,
        FrameMbsFlags::Fields { .. } => return Err(KeyFrameError::Unsupported(INTERLACED)),
    };
    let (width, height) = sps.pixel_dimensions().map_err(|e| broken(format!("{e:?}")))?;
    let blocks = |count: u32| count.checked_mul(16).ok_or_else(|| broken("its size".into()));
    let coded = (blocks(sps.pic_width_in_mbs())?, blocks(sps.pic_height_in_map_units().saturating_mul(fields))?);
    let (left, top) = sps.frame_cropping.as_ref().map_or((0, 0), |cropping| (cropping.left_offset, cropping.top_offset));
    let signal = sps.vui_parameters.as_ref().and_then(|vui| vui.video_signal_type.as_ref());
    let matrix = signal.and_then(|s| s.colour_description.as_ref()).and_then(|c| Matrix::from_code(c.matrix_coefficients));
    let colour = Colour::signalled(matrix, signal.is_some_and(|s| s.video_full_range_flag));
    Ok(KeyFrame { width, height, left: 2 * left, top: 2 * fields * top, coded, colour })
}

/// The uncompressed header of a key frame (VP9 bitstream specification, 6.2).
fn vp9(data: &[u8]) -> Result<Option<KeyFrame>, KeyFrameError> {
    let Some(&[first, a, b, c, colour, d, e, f, g]) = data.first_chunk() else { return Ok(None) };
    // bits of `first`: marker, profile, show-existing-frame flag, not-a-key-frame flag, two more flags; then the sync code
    if first >> 6 != 2 {
        return Ok(None);
    }
    if first & 0b11_0000 != 0 {
        return Err(KeyFrameError::Unsupported(PROFILE));
    }
    if first & 0b1100 != 0 || [a, b, c] != [0x49, 0x83, 0x42] {
        return Ok(None);
    }
    let side = |high: u8, middle: u8, low: u8| (u32::from(high & 15) << 12 | u32::from(middle) << 4 | u32::from(low >> 4)) + 1;
    let (width, height) = (side(colour, d, e), side(e, f, g));
    let matrix = match colour >> 5 {
        1 | 3 => Some(Matrix::Bt601),
        2 => Some(Matrix::Bt709),
        4 => Some(Matrix::Smpte240),
        5 => Some(Matrix::Bt2020),
        _ => None,
    };
    let colour = Colour::signalled(matrix, colour & 16 != 0);
    Ok(Some(KeyFrame { width, height, left: 0, top: 0, coded: (width, height), colour }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_frame_of_8_bits_tells_its_size() {
        // sequence parameters of baseline profile, 8 × 6 macroblocks
        let unit = [0, 0, 0, 1, 0x67, 0x42, 0x00, 0x0a, 0xf8, 0x41, 0xa2];
        let key = key_frame("avc1.42000a", &unit).unwrap().unwrap();
        assert_eq!((key.width, key.height, key.coded, key.left, key.top), (128, 96, (128, 96), 0, 0));
        assert_eq!(key_frame("avc1.42000a", &[0, 0, 0, 1, 0x41, 0x9a]), Ok(None));
    }
}
