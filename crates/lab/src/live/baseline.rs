//! What the bytes of a room are compared with, and what goes beside them: JPEG of each frame at the PSNR that the video has, and sound.

use tmpi_core::Photo;
use tmpi_core::live::wire::Sound;
use tmpi_core::live::wire::message::Kind;
use tmpi_live::video;
use tmpi_render::difference::psnr;

use super::LiveBenchError;
use super::encode::{Encoder as _, Jpeg};

/// Bits a second of Opus and packets a second, as the publishing page sends them (`static/live/microphone.js`).
const SOUND: (usize, usize) = (32_000, 50);

/// Bytes of sound that go with a frame, 30 a second, messages and all.
#[must_use]
pub fn sound_bytes() -> f64 {
    let data = vec![0; SOUND.0 / 8 / SOUND.1].into();
    // a time of two weeks in microseconds, as a clock that began at the start of a machine has
    let message = tmpi_core::live::write(Kind::Sound(Sound { time: 1 << 40, data }));
    (message.len() * SOUND.1) as f64 / 30.0
}

/// A frame as JPEG.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AsJpeg {
    /// Quality, 1 to 100, between two where the PSNR lies between theirs.
    pub quality: f64,
    /// PSNR in dB.
    pub psnr: f64,
    /// Bytes, of the two in proportion.
    pub bytes: f64,
}

/// The JPEG file of `noisy` whose PSNR against `clean` is `wanted`: the one of the least quality that reaches it, and the one before, in
/// the proportion in which it lies between them. The best there is where none reaches it.
///
/// # Errors
/// [`LiveBenchError`] where a frame cannot be encoded or decoded.
pub fn as_jpeg(noisy: &Photo, clean: &Photo, wanted: f64) -> Result<AsJpeg, LiveBenchError> {
    let at = |quality: u8| -> Result<AsJpeg, LiveBenchError> {
        let (data, _) = Jpeg { quality }.encode(noisy)?;
        let decoded = video::decoder(video::JPEG, (noisy.width, noisy.height))?.decode(&data)?;
        let decoded = decoded.ok_or_else(|| LiveBenchError::Encode("a JPEG file without a picture".into()))?;
        let psnr = psnr(decoded.rgb.as_flattened(), clean.rgb.as_flattened());
        Ok(AsJpeg { quality: quality.into(), psnr, bytes: data.len() as f64 })
    };
    // of all below `low` none reaches it, `high` does or is the last
    let (mut low, mut high) = (1u8, 100u8);
    while low < high {
        let middle = low.midpoint(high);
        if at(middle)?.psnr >= wanted { high = middle } else { low = middle + 1 }
    }
    let reaches = at(high)?;
    if high == 1 || reaches.psnr <= wanted {
        return Ok(reaches);
    }
    let below = at(high - 1)?;
    let share = ((wanted - below.psnr) / (reaches.psnr - below.psnr)).clamp(0.0, 1.0);
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
    fn the_jpeg_has_the_psnr_that_is_wanted_and_more_costs_more() {
        let shot = Sequence::new(Kind::Still, 900_101, (160, 120), 2, 0.03).shot(0);
        let found: Vec<AsJpeg> = [30.0, 34.0, 38.0].map(|db| as_jpeg(&shot.noisy, &shot.clean, db).unwrap()).to_vec();
        for (f, db) in found.iter().zip([30.0, 34.0, 38.0]) {
            assert!((f.psnr - db).abs() < 1e-6, "{f:?}");
            // by one that was encoded: between the qualities beside it
            let bytes = |quality: f64| Jpeg { quality: quality as u8 }.encode(&shot.noisy).unwrap().0.len() as f64;
            assert!((bytes(f.quality.floor())..=bytes(f.quality.ceil())).contains(&f.bytes), "{f:?}");
        }
        assert!(found.is_sorted_by(|a, b| a.bytes < b.bytes && a.quality < b.quality), "{found:?}");
        // noise cannot be coded away: the best there is
        assert!(as_jpeg(&shot.noisy, &shot.clean, 70.0).unwrap().quality > 99.0);
    }

    #[test]
    fn sound_has_its_rate_and_heads() {
        let kbit_s = sound_bytes() * 30.0 * 8.0 / 1e3;
        assert!((32.0..40.0).contains(&kbit_s), "{kbit_s} kbit/s");
    }
}
