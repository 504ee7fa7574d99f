//! Measures how much two pictures differ, pixel by pixel.

/// PSNR in dB of two pictures of 8-bit values, over all values; [`MAX_PSNR`] if they are equal or empty.
pub fn psnr(a: &[u8], b: &[u8]) -> f64 {
    // 32-bit sums process twice as many values per step, and hold 65 535 squares of 8-bit values
    let part = |(a, b): (&[u8], &[u8])| a.iter().zip(b).map(|(a, b)| u32::from(a.abs_diff(*b)).pow(2)).sum::<u32>();
    let sum: u64 = a.chunks(1 << 15).zip(b.chunks(1 << 15)).map(|both| u64::from(part(both))).sum();
    psnr_of(sum as f64 / a.len().min(b.len()).max(1) as f64)
}

/// PSNR in dB for a mean squared difference of 8-bit values; [`MAX_PSNR`] for a difference of 0.
pub fn psnr_of(mean_squared: f64) -> f64 {
    if mean_squared > 0.0 { (10.0 * (255.0 * 255.0 / mean_squared).log10()).min(MAX_PSNR) } else { MAX_PSNR }
}

/// PSNR reported for equal pictures, whose PSNR is infinite.
pub const MAX_PSNR: f64 = 99.0;

/// Share of pixels, 0 to 1, in which at least one channel differs by more than `levels`.
pub fn share_off<const N: usize>(a: &[[u8; N]], b: &[[u8; N]], levels: u8) -> f64 {
    if a.is_empty() {
        return 0.0;
    }
    let off = a.iter().zip(b).filter(|(a, b)| a.iter().zip(*b).any(|(a, b)| a.abs_diff(*b) > levels)).count();
    off as f64 / a.len() as f64
}

/// Largest difference of any channel, in levels.
pub fn max_abs<const N: usize>(a: &[[u8; N]], b: &[[u8; N]]) -> u8 {
    a.iter().zip(b).flat_map(|(a, b)| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b))).max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_values() {
        assert!((psnr(&[0, 0], &[255, 255]) - 0.0).abs() < 1e-12);
        assert!((psnr(&[100; 100], &[101; 100]) - 48.130_803_6).abs() < 1e-6);
        assert!((psnr(&[7], &[7]) - MAX_PSNR).abs() < 1e-12);
        assert!((share_off(&[[0, 0], [9, 0]], &[[8, 8], [0, 0]], 8) - 0.5).abs() < 1e-12);
        assert_eq!(max_abs(&[[0, 5]], &[[3, 1]]), 4);
    }
}
