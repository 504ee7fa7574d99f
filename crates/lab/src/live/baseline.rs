//! Baselines for a room's bytes: a JPEG of each frame with the same PSNR as the video, and sound.

use tmpi_core::Photo;
use tmpi_core::live::schema::Sound;
use tmpi_core::live::schema::message::Kind;
use tmpi_live::video;
use tmpi_render::difference::psnr;

use super::LiveBenchError;
use super::encode::{Encoder as _, Jpeg};

/// Opus bits per second and packets per second, as the publishing page sends them (`static/live/microphone.js`).
const SOUND: (usize, usize) = (32_000, 50);

/// Bytes of sound per frame at 30 frames a second, including messages.
#[must_use]
pub fn sound_bytes() -> f64 {
    let data = vec![0; SOUND.0 / 8 / SOUND.1].into();
    // about two weeks in microseconds, like a clock that counts since boot
    let message = tmpi_core::live::write(Kind::Sound(Sound { time: 1 << 40, data }));
    (message.len() * SOUND.1) as f64 / 30.0
}

/// A frame encoded as JPEG, interpolated between two qualities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AsJpeg {
    /// Quality, 1 to 100.
    pub quality: f64,
    /// PSNR in dB.
    pub psnr: f64,
    /// Size in bytes.
    pub bytes: f64,
}

/// The JPEG of `noisy` with PSNR `target` against `clean`: interpolates between the lowest quality that reaches it and the one below. If
/// none reaches it, returns the best.
///
/// # Errors
/// [`LiveBenchError`] if a frame cannot be encoded or decoded.
pub fn as_jpeg(noisy: &Photo, clean: &Photo, target: f64) -> Result<AsJpeg, LiveBenchError> {
    let at = |quality: u8| -> Result<AsJpeg, LiveBenchError> {
        let (data, _) = Jpeg { quality }.encode(noisy)?;
        let decoded = video::decoder(video::JPEG, (noisy.width, noisy.height))?.decode(&data)?;
        let decoded = decoded.ok_or_else(|| LiveBenchError::Encode("a JPEG file without a picture".into()))?;
        let psnr = psnr(decoded.rgb.as_flattened(), clean.rgb.as_flattened());
        Ok(AsJpeg { quality: quality.into(), psnr, bytes: data.len() as f64 })
    };
    // binary search: no quality below `low` reaches the target; `high` does, or is the last
    let (mut low, mut high) = (1u8, 100u8);
    while low < high {
        let middle = low.midpoint(high);
        if at(middle)?.psnr >= target { high = middle } else { low = middle + 1 }
    }
    let reaches = at(high)?;
    if high == 1 || reaches.psnr <= target {
        return Ok(reaches);
    }
    let below = at(high - 1)?;
    let share = ((target - below.psnr) / (reaches.psnr - below.psnr)).clamp(0.0, 1.0);
    let between = |a: f64, b: f64| a + (b - a) * share;
    Ok(AsJpeg {
        quality: between(below.quality, reaches.quality),
        psnr: between(below.psnr, reaches.psnr),
        bytes: between(below.bytes, reaches.bytes),
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "test")]

    use super::super::sequence::{Kind, Sequence};
    use super::*;

    #[test]
    fn jpegs_meet_their_target_and_grow_with_it() {
        let shot = Sequence::new(Kind::Still, 900_101, (160, 120), 2, 0.03).shot(0);
        let found: Vec<AsJpeg> = [30.0, 34.0, 38.0].map(|db| as_jpeg(&shot.noisy, &shot.clean, db).unwrap()).to_vec();
        for (f, db) in found.iter().zip([30.0, 34.0, 38.0]) {
            assert!((f.psnr - db).abs() < 1e-6, "{f:?}");
            // the size is between those of the adjacent qualities
            let bytes = |quality: f64| Jpeg { quality: quality as u8 }.encode(&shot.noisy).unwrap().0.len() as f64;
            assert!((bytes(f.quality.floor())..=bytes(f.quality.ceil())).contains(&f.bytes), "{f:?}");
        }
        assert!(found.is_sorted_by(|a, b| a.bytes < b.bytes && a.quality < b.quality), "{found:?}");
        // the noise limits the PSNR: returns the best
        assert!(as_jpeg(&shot.noisy, &shot.clean, 70.0).unwrap().quality > 99.0);
    }

    #[test]
    fn sound_includes_message_overhead() {
        let kbit_s = sound_bytes() * 30.0 * 8.0 / 1e3;
        assert!((32.0..40.0).contains(&kbit_s), "{kbit_s} kbit/s");
    }
}
