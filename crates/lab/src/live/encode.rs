//! What publishers send: video and sound.

use tmpi_core::Photo;
use tmpi_core::live::schema::Sound;
use tmpi_core::live::schema::message::Kind;

use crate::LabError;

/// Opus bits per second and packets per second, as the publishing page sends them (`static/live/microphone.js`).
const SOUND: (usize, usize) = (32_000, 50);

/// Bytes of sound per frame at 30 frames a second, including messages.
pub fn sound_bytes() -> f64 {
    let data = vec![0; SOUND.0 / 8 / SOUND.1].into();
    // about two weeks in microseconds, like a clock that counts since boot
    let message = tmpi_core::live::write(Kind::Sound(Sound { time: 1 << 40, data }));
    (message.len() * SOUND.1) as f64 / 30.0
}

/// Encodes H.264 Constrained Baseline without delay.
pub struct H264 {
    encoder: rusty_h264_encoder::Encoder,
    frames: u32,
}

impl H264 {
    /// Frames between key frames.
    pub const GOP: u32 = 60;
    /// Codec string, as sent by publishers.
    pub const CODEC: &'static str = "avc1.42e01e";

    /// Bits per second of the publishing page (`static/live/encoders.js`), 5 for each pixel: 384 kbit/s at 320×240.
    pub const fn usual_bitrate((width, height): (u32, u32)) -> u32 {
        5 * width * height
    }

    /// Creates an encoder for frames of this size at 30 frames and `bitrate` bits per second.
    ///
    /// # Errors
    /// [`LabError::Encode`] if a side is odd or the encoder does not support the size.
    pub fn new((width, height): (u32, u32), bitrate: u32) -> Result<Self, LabError> {
        let mut config = rusty_h264_encoder::EncoderConfig::baseline(width as usize, height as usize);
        config.preset = rusty_h264_encoder::Preset::Balanced;
        (config.gop_size, config.min_keyint, config.framerate, config.bitrate) = (Self::GOP, Self::GOP, 30.0, bitrate);
        let encoder = rusty_h264_encoder::Encoder::new(config).map_err(|e| LabError::Encode(e.to_string()))?;
        Ok(Self { encoder, frames: 0 })
    }

    /// Encodes a frame; returns its bytes, and whether it is a key frame.
    pub fn encode(&mut self, photo: &Photo) -> Result<(Vec<u8>, bool), LabError> {
        let key = self.frames.is_multiple_of(Self::GOP);
        self.frames += 1;
        let [y, u, v] = to_i420(photo);
        let frame = rusty_h264_common::YuvFrame { width: photo.width as usize, height: photo.height as usize, y, u, v };
        Ok((self.encoder.try_encode(&frame).map_err(|e| LabError::Encode(e.to_string()))?, key))
    }
}

/// Converts to BT.709, limited range. Chroma is the mean of four pixels.
fn to_i420(photo: &Photo) -> [Vec<u8>; 3] {
    let (w, h) = (photo.width, photo.height);
    let (kr, kb) = (0.2126, 0.0722);
    let luma = |[r, g, b]: [f64; 3]| kr * r + (1.0 - kr - kb) * g + kb * b;
    let level = |v: f64| v.round().clamp(0.0, 255.0) as u8;
    let y = photo.rgb.iter().map(|p| level(16.0 + 219.0 / 255.0 * luma(p.map(f64::from)))).collect();
    let (mut u, mut v) = (Vec::new(), Vec::new());
    for row in (0..h).step_by(2) {
        for column in (0..w).step_by(2) {
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| photo.at((column + dx).min(w - 1), (row + dy).min(h - 1)));
            let mean: [f64; 3] = std::array::from_fn(|c| four.iter().map(|p| f64::from(p[c])).sum::<f64>() / 4.0);
            let grey = luma(mean);
            u.push(level(128.0 + 224.0 / 255.0 * (mean[2] - grey) / (2.0 * (1.0 - kb))));
            v.push(level(128.0 + 224.0 / 255.0 * (mean[0] - grey) / (2.0 * (1.0 - kr))));
        }
    }
    [y, u, v]
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_live::video::{Colour, I420, to_rgb};

    #[test]
    fn readers_invert_the_colour_conversion() {
        // one colour per four pixels, like chroma
        let pixel = |x: u32, y: u32| [(x / 2 * 8) as u8, (y / 2 * 8) as u8, ((x / 2 + y / 2) * 4) as u8];
        let photo = Photo::from_fn(64, 64, pixel);
        let [y, u, v] = to_i420(&photo);
        let back = to_rgb(&I420 { width: 64, height: 64, y: &y, u: &u, v: &v }, Colour::default()).unwrap();
        let off = photo.rgb.as_flattened().iter().zip(back.rgb.as_flattened()).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(off <= Some(3), "{off:?}");
    }

    #[test]
    fn sound_includes_message_overhead() {
        let kbit_s = sound_bytes() * 30.0 * 8.0 / 1e3;
        assert!((32.0..40.0).contains(&kbit_s), "{kbit_s} kbit/s");
    }
}
