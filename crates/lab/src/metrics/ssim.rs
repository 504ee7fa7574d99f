//! Structural similarity of two pictures.

use super::filter::{along, down};

/// Radius of the window of 11×11 pixels.
const RADIUS: usize = 5;
const SIGMA: f64 = 1.5;
/// Stabilising constants for values from 0 to 1: 0.01² and 0.03².
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// SSIM of each pixel (11×11 Gaussian window, σ 1.5), averaged over the three channels. Borders are mirrored. Both pictures have `width`
/// pixels per row; the map of an empty picture is empty.
///
/// Source: Wang et al., Image Quality Assessment: From Error Visibility to Structural Similarity, 2004.
pub fn ssim_map(a: &[[u8; 3]], b: &[[u8; 3]], width: usize) -> Vec<f32> {
    let pixels = a.len().min(b.len());
    if width == 0 || pixels == 0 {
        return Vec::new();
    }
    let height = pixels / width;
    let bell: [f64; 2 * RADIUS + 1] = std::array::from_fn(|i| (-(i as f64 - RADIUS as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp());
    let all: f64 = bell.iter().sum();
    let kernel = bell.map(|k| k / all);
    let mut sum = vec![0f32; width * height];
    for channel in 0..3 {
        let plane = |p: &[[u8; 3]]| -> Vec<f64> { p[..width * height].iter().map(|p| f64::from(p[channel]) / 255.0).collect() };
        let (x, y) = (plane(a), plane(b));
        let product = |p: &[f64], q: &[f64]| -> Vec<f64> { p.iter().zip(q).map(|(p, q)| p * q).collect() };
        let blurred = |p: &[f64]| down(&along(p, width, &kernel, mirrored), width, &kernel, mirrored);
        let (mx, my) = (blurred(&x), blurred(&y));
        let (xx, yy, xy) = (blurred(&product(&x, &x)), blurred(&product(&y, &y)), blurred(&product(&x, &y)));
        for (i, s) in sum.iter_mut().enumerate() {
            let (m, n) = (mx[i], my[i]);
            let (vx, vy, cov) = (xx[i] - m * m, yy[i] - n * n, xy[i] - m * n);
            let value = ((2.0 * m * n + C1) * (2.0 * cov + C2)) / ((m * m + n * n + C1) * (vx + vy + C2));
            *s += (value / 3.0) as f32;
        }
    }
    sum
}

/// Rows and columns are mirrored about the centre of their last pixel.
fn mirrored(at: isize, n: usize) -> usize {
    let (last, period) = (n as isize - 1, (2 * n as isize - 2).max(1));
    let m = at.rem_euclid(period);
    (if m > last { period - m } else { m }) as usize
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Reference: each pixel by the sums over its window of 11 × 11 pixels, mirrored about the outermost ones as often as needed.
    fn by_definition(a: &[[u8; 3]], b: &[[u8; 3]], width: usize) -> Vec<f64> {
        let height = a.len() / width;
        let mirrored = |mut i: i64, n: usize| {
            let last = n as i64 - 1;
            while last > 0 && !(0..=last).contains(&i) {
                i = if i < 0 { -i } else { 2 * last - i };
            }
            if last == 0 { 0 } else { i as usize }
        };
        let pixel = |at: usize, channel: usize| {
            let mut sums = [0.0; 6];
            for (dx, dy) in (-5..=5).flat_map(|dy| (-5..=5).map(move |dx: i64| (dx, dy))) {
                let i = mirrored((at / width) as i64 + dy, height) * width + mirrored((at % width) as i64 + dx, width);
                let (x, y) = (f64::from(a[i][channel]) / 255.0, f64::from(b[i][channel]) / 255.0);
                let weight = (-((dx * dx + dy * dy) as f64) / 4.5).exp();
                sums.iter_mut().zip([1.0, x, y, x * x, y * y, x * y]).for_each(|(sum, v)| *sum += weight * v);
            }
            let [x, y, xx, yy, xy] = [1, 2, 3, 4, 5].map(|k| sums[k] / sums[0]);
            let (vx, vy, cov) = (xx - x * x, yy - y * y, xy - x * y);
            (2.0 * x * y + 1e-4) * (2.0 * cov + 9e-4) / ((x * x + y * y + 1e-4) * (vx + vy + 9e-4))
        };
        (0..a.len()).map(|at| (0..3).map(|channel| pixel(at, channel)).sum::<f64>() / 3.0).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        #[test]
        fn maps_agree_with_their_definition(
            width in 1usize..16, height in 1usize..9, values in prop::collection::vec(any::<([u8; 3], [u8; 3])>(), 16 * 9),
        ) {
            let (a, b): (Vec<_>, Vec<_>) = values[..width * height].iter().copied().unzip();
            let (got, want) = (ssim_map(&a, &b, width), by_definition(&a, &b, width));
            prop_assert!(got.iter().zip(want).all(|(g, w)| (f64::from(*g) - w).abs() < 1e-5), "{got:?}");
        }
    }

    /// Flat pictures have variance 0, so SSIM has a closed form.
    #[test]
    fn flat_pictures_match_the_closed_form() {
        let (a, b) = (vec![[51u8; 3]; 300], vec![[102u8; 3]; 300]);
        let want = (2.0 * 0.2 * 0.4 + C1) / (0.04 + 0.16 + C1);
        assert!(ssim_map(&a, &b, 20).iter().all(|s| (f64::from(*s) - want).abs() < 1e-6));
    }

    #[test]
    fn equal_pictures_have_ssim_1_and_noise_lowers_it() {
        let a: Vec<[u8; 3]> = (0..40 * 30).map(|i: u32| [(i % 40 * 6) as u8, (i / 40 * 8) as u8, 90]).collect();
        assert!(ssim_map(&a, &a, 40).iter().all(|s| (s - 1.0).abs() < 1e-6));
        let noisy: Vec<[u8; 3]> = a.iter().enumerate().map(|(i, p)| p.map(|v| v.wrapping_add((i * 37 % 23) as u8))).collect();
        let mean = ssim_map(&a, &noisy, 40).iter().sum::<f32>() / 1200.0;
        assert!((0.0..0.95).contains(&mean), "{mean}");
        assert!(ssim_map(&[], &[], 0).is_empty());
    }
}
