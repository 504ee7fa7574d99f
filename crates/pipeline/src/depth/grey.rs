//! Grey pictures: PNG of 8 or 16 bits, JPEG, WebP.

use image::{ColorType, ImageDecoder};
use rayon::prelude::*;

use super::DepthError;
use tmpi_core::container::PhotoFormat;

use crate::photo::{self, Limits, PhotoError, png_metadata};
use tmpi_core::Photo;

/// Levels of 255 by which the channels of a grey picture may differ. Lossy formats store brightness and colour, each rounded and coded by
/// itself, and programs save what they decode as PNG. A map in false colours differs by far more.
pub(super) const ALIKE: u16 = 8;

pub(super) fn not_a_map(error: &PhotoError) -> DepthError {
    DepthError::Map(error.to_string())
}

/// An upright grey picture.
pub(super) struct Grey {
    pub width: u32,
    pub height: u32,
    /// Row by row: 0 to 1, but any float from a portable float map or an OpenEXR file.
    pub values: Vec<f32>,
}

/// Reads a picture that is grey or has nearly equal colour channels: PNG of 8 or 16 bits, JPEG, WebP. Ignores profiles and alpha.
///
/// # Errors
/// [`DepthError::Map`] says what is wrong with the file.
pub(super) fn grey(bytes: &[u8], limits: &Limits) -> Result<Grey, DepthError> {
    photo::check(bytes, limits).map_err(|e| not_a_map(&e))?;
    if PhotoFormat::sniff(bytes) != Some(PhotoFormat::Png) {
        let Photo { width, height, rgb } = photo::decode_values(bytes, limits).map_err(|e| not_a_map(&e))?;
        return Ok(Grey { width, height, values: grey_values(rgb.as_flattened(), 3)? });
    }
    let bad = |e: &dyn std::fmt::Display| DepthError::Map(e.to_string());
    let map = png_metadata::scan(bytes, limits).map_err(|e| not_a_map(&e))?;
    let decoder = map.decoder().map_err(|e| bad(&e))?;
    let (colour, pixels) = (decoder.color_type(), map.width as usize * map.height as usize);
    let channels = usize::from(colour.channel_count());
    let values = match colour {
        ColorType::L8 | ColorType::La8 | ColorType::Rgb8 | ColorType::Rgba8 => {
            let mut samples = vec![0u8; pixels * channels];
            decoder.read_image(&mut samples).map_err(|e| bad(&e))?;
            grey_values(&samples, channels)
        }
        ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16 => {
            let mut samples = vec![0u16; pixels * channels];
            decoder.read_image(bytemuck::cast_slice_mut(&mut samples)).map_err(|e| bad(&e))?;
            grey_values(&samples, channels)
        }
        other => Err(DepthError::Map(format!("pixels of kind {other:?} are not supported"))),
    }?;
    let (values, (width, height)) = photo::upright_srgb::turned(values, (map.width, map.height), photo::orientation(bytes));
    Ok(Grey { width, height, values })
}

/// Values 0 to 1 of pixels with this many channels; the last of two or four is alpha.
fn grey_values<S: Sample>(samples: &[S], channels: usize) -> Result<Vec<f32>, DepthError> {
    let value = |p: &[S]| {
        let colours = if channels < 3 { [p[0]; 3] } else { [p[0], p[1], p[2]] }.map(Into::into);
        let [r, g, b]: [u16; 3] = colours;
        let most = S::MOST / 255 * ALIKE;
        // the middle channel: brightness in lossy formats is mostly green
        (r.abs_diff(g) <= most && b.abs_diff(g) <= most).then(|| f32::from(g) / f32::from(S::MOST))
    };
    samples
        .par_chunks_exact(channels)
        .map(value)
        .collect::<Option<_>>()
        .ok_or_else(|| DepthError::Map("it is in colour: a depth map must be grey or have three nearly equal channels".into()))
}

/// A sample of a map.
trait Sample: Copy + Send + Sync + Into<u16> {
    /// Largest sample.
    const MOST: u16;
}

impl Sample for u8 {
    const MOST: u16 = 255;
}

impl Sample for u16 {
    const MOST: u16 = 65_535;
}
