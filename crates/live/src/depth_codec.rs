//! Codec for measured depth, sent as a message with each frame: 16 bits per pixel, differences along rows, compressed with zstd.

use tmpi_core::DisparityMap;

/// Compression level: packing a frame must take only milliseconds.
const LEVEL: i32 = 1;
/// Coded value of δ = 1.
const NEAREST: f32 = 65_535.0;

/// The bytes are not a valid depth map of the expected size.
#[derive(Debug, thiserror::Error)]
#[error("measured depth: {0}")]
pub struct InvalidDepth(String);

/// Packs a map; clamps values to 0 to 1.
///
/// # Errors
/// [`InvalidDepth`] if the compressor fails.
pub fn pack(map: &DisparityMap) -> Result<Vec<u8>, InvalidDepth> {
    let value = |i: usize| (map.delta[i] * NEAREST).round() as u16;
    let width = map.width as usize;
    let raw: Vec<u8> = (0..map.delta.len()).flat_map(|i| value(i).wrapping_sub(before(i, width).map_or(0, value)).to_le_bytes()).collect();
    zstd::bulk::compress(&raw, LEVEL).map_err(|e| InvalidDepth(e.to_string()))
}

/// Unpacks a map of `width × height` pixels. Allocates no more memory than a map of that size needs.
///
/// # Errors
/// [`InvalidDepth`] if the bytes are damaged or the map has another size.
pub fn unpack(packed: &[u8], width: u32, height: u32) -> Result<DisparityMap, InvalidDepth> {
    let count = width as usize * height as usize;
    let raw = zstd::bulk::decompress(packed, 2 * count).map_err(|e| InvalidDepth(e.to_string()))?;
    if raw.len() != 2 * count {
        return Err(InvalidDepth(format!("{} bytes for {width}×{height} pixels", raw.len())));
    }
    let mut values: Vec<u16> = raw.as_chunks().0.iter().map(|b| u16::from_le_bytes(*b)).collect();
    for i in 1..count {
        values[i] = values[i].wrapping_add(before(i, width as usize).map_or(0, |b| values[b]));
    }
    Ok(DisparityMap { width, height, delta: values.into_iter().map(|v| f32::from(v) / NEAREST).collect() })
}

/// The pixel that predicts pixel `i`: its left neighbour, or the one above in the first column.
fn before(i: usize, width: usize) -> Option<usize> {
    if i.is_multiple_of(width) { i.checked_sub(width) } else { Some(i - 1) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn maps_survive_a_round_trip(w in 1u32..40, h in 1u32..40, seed in any::<u32>()) {
            let delta = (0..w * h).map(|i| (i.wrapping_mul(seed | 1) >> 8) as f32 / (1u32 << 24) as f32).collect();
            let map = DisparityMap { width: w, height: h, delta };
            let packed = pack(&map).unwrap();
            let back = unpack(&packed, w, h).unwrap();
            prop_assert!(back.delta.iter().zip(&map.delta).all(|(a, b)| (a - b).abs() <= 0.51 / NEAREST));
            prop_assert!(unpack(&packed, w, h + 1).is_err() && unpack(&packed, w + 1, h).is_err());
            prop_assert!(unpack(&packed[..packed.len() - 1], w, h).is_err());
        }
    }

    #[test]
    fn ramps_compress_well_and_bombs_are_refused() {
        let map = DisparityMap::from_fn(320, 240, |_, y| y as f32 / 240.0);
        assert!(pack(&map).unwrap().len() < 2_000);
        let bomb = zstd::bulk::compress(&vec![0; 64 << 20], LEVEL).unwrap();
        assert!(bomb.len() < 10_000 && unpack(&bomb, 320, 240).is_err());
        assert!(unpack(b"none", 320, 240).is_err());
        let wild = DisparityMap { width: 3, height: 1, delta: vec![f32::NAN, -3.0, 9.0] };
        assert_eq!(unpack(&pack(&wild).unwrap(), 3, 1).unwrap().delta, [0.0, 0.0, 1.0]);
    }
}
