//! Depth that a camera measures, as a message beside its frame: 16 bits a pixel, differences along the rows, packed by zstd.

use tmpi_core::DisparityMap;

/// Effort of the packer: a frame's depth has to be packed within milliseconds.
const LEVEL: i32 = 1;
/// δ = 1.
const NEAREST: f32 = 65_535.0;

/// The bytes are none of a depth map of that size.
#[derive(Debug, thiserror::Error)]
#[error("measured depth: {0}")]
pub struct DepthBytes(String);

/// Packs a map; values beyond 0 to 1 become the nearest of these.
///
/// # Errors
/// [`DepthBytes`] where the packer fails.
pub fn pack(map: &DisparityMap) -> Result<Vec<u8>, DepthBytes> {
    let value = |i: usize| (map.delta[i] * NEAREST).round() as u16;
    let width = map.width as usize;
    let raw: Vec<u8> = (0..map.delta.len()).flat_map(|i| value(i).wrapping_sub(before(i, width).map_or(0, value)).to_le_bytes()).collect();
    zstd::bulk::compress(&raw, LEVEL).map_err(|e| DepthBytes(e.to_string()))
}

/// The map of a frame of `width × height` pixels.
///
/// # Errors
/// [`DepthBytes`] where the bytes are damaged, or of another size; no more memory is taken than that size needs.
pub fn unpack(packed: &[u8], width: u32, height: u32) -> Result<DisparityMap, DepthBytes> {
    let count = width as usize * height as usize;
    let raw = zstd::bulk::decompress(packed, 2 * count).map_err(|e| DepthBytes(e.to_string()))?;
    if raw.len() != 2 * count {
        return Err(DepthBytes(format!("{} bytes for {width}×{height} pixels", raw.len())));
    }
    let mut values: Vec<u16> = raw.as_chunks().0.iter().map(|b| u16::from_le_bytes(*b)).collect();
    for i in 1..count {
        values[i] = values[i].wrapping_add(before(i, width as usize).map_or(0, |b| values[b]));
    }
    Ok(DisparityMap { width, height, delta: values.into_iter().map(|v| f32::from(v) / NEAREST).collect() })
}

/// The pixel that one differs from: the one to the left, in the first column the one above.
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
        fn maps_come_back_to_a_step(w in 1u32..40, h in 1u32..40, seed in any::<u32>()) {
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
    fn a_ramp_takes_next_to_nothing_and_a_bomb_is_refused() {
        let delta = (0..320 * 240).map(|i| (i / 320) as f32 / 240.0).collect();
        let map = DisparityMap { width: 320, height: 240, delta };
        assert!(pack(&map).unwrap().len() < 2_000);
        let bomb = zstd::bulk::compress(&vec![0; 64 << 20], LEVEL).unwrap();
        assert!(bomb.len() < 10_000 && unpack(&bomb, 320, 240).is_err());
        assert!(unpack(b"none", 320, 240).is_err());
        let wild = DisparityMap { width: 3, height: 1, delta: vec![f32::NAN, -3.0, 9.0] };
        assert_eq!(unpack(&pack(&wild).unwrap(), 3, 1).unwrap().delta, [0.0, 0.0, 1.0]);
    }
}
