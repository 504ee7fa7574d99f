//! Writes disparity maps as files.

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

use super::DepthError;
use tmpi_core::DisparityMap;

/// Writes a map as a 16-bit grey PNG: `v = round(65535 δ)`. δ is clamped to `[0, 1]`; NaN becomes 0.
///
/// # Errors
/// [`DepthError::Write`] if the encoder fails.
pub fn to_png(map: &DisparityMap) -> Result<Vec<u8>, DepthError> {
    // `as` maps NaN to 0
    let grey: Vec<u16> = map.delta.iter().map(|&d| (d.clamp(0.0, 1.0) * 65_535.0).round() as u16).collect();
    let mut out = Vec::with_capacity(grey.len() + 1024);
    // the encoder takes samples in native byte order
    PngEncoder::new_with_quality(&mut out, CompressionType::Fast, FilterType::Adaptive)
        .write_image(bytemuck::cast_slice(&grey), map.width, map.height, ExtendedColorType::L16)
        .map_err(|e| DepthError::Write(e.to_string()))?;
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth::{DepthKind, from_map};
    use crate::photo::Limits;

    #[test]
    fn values_out_of_range_are_clamped() {
        let map = DisparityMap { width: 4, height: 1, delta: vec![-1.0, 2.0, f32::NAN, f32::INFINITY] };
        let (back, _) = from_map(&to_png(&map).unwrap(), DepthKind::Disparity, &Limits::default(), 4, 1).unwrap();
        assert_eq!(back.delta, [0.0, 1.0, 0.0, 1.0]);
    }
}
