//! ꟻLIP: the difference that a viewer perceives when flipping between two pictures.
//!
//! Implements Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström and Fairchild, *ꟻLIP: A Difference Evaluator for Alternating
//! Images* (HPG 2020), in `f64`, with the paper's constants. Colours are filtered by the eye's contrast sensitivity and compared by the
//! `HyAB` distance in CIELAB; differences of edges and points amplify the result.

use std::f64::consts::PI;

use super::filter::{along, down};

/// Pixels per degree of a screen 0.7 m and 3840 pixels wide, seen from 0.7 m, as in the paper.
pub const PIXELS_PER_DEGREE: f64 = 67.020_643_276_582_26;

/// Exponent of the colour difference.
const QC: f64 = 0.7;
/// End of the linear range, as a fraction of the largest colour difference.
const PC: f64 = 0.4;
/// Output at the end of the linear range.
const PT: f64 = 0.95;
/// Exponent of the feature difference.
const QF: f64 = 0.5;
/// Width of the feature detectors in degrees.
const FEATURE_DEGREES: f64 = 0.082;
/// Contrast sensitivity, `(a, b)` of each Gaussian `a √(π/b) e^{−π² x²/b}` with `x` in degrees: light–dark, red–green, blue–yellow.
const SENSITIVITY: [&[(f64, f64)]; 3] = [&[(1.0, 0.0047)], &[(1.0, 0.0053)], &[(34.1, 0.04), (13.5, 0.025)]];
/// Widest Gaussian, which determines the size of all filters.
const WIDEST: f64 = 0.04;
/// D65 white: the row sums of [`XYZ`].
const WHITE: [f64; 3] = [0.950_428_545_377_181, 1.0, 1.088_900_370_798_128];
/// Linear sRGB to XYZ (IEC 61966-2-1).
const XYZ: [[f64; 3]; 3] = [
    [10_135_552.0 / 24_577_794.0, 8_788_810.0 / 24_577_794.0, 4_435_075.0 / 24_577_794.0],
    [2_613_072.0 / 12_288_897.0, 8_788_810.0 / 12_288_897.0, 887_015.0 / 12_288_897.0],
    [1_425_312.0 / 73_733_382.0, 8_788_810.0 / 73_733_382.0, 70_074_185.0 / 73_733_382.0],
];

/// Channels of a picture, in row-major order.
type Channels = [Vec<f64>; 3];

/// ꟻLIP of two sRGB pictures with `width` pixels per row, for each pixel, 0 (equal) to 1, at [`PIXELS_PER_DEGREE`].
///
/// # Panics
/// Panics if the pictures differ in size, or `width` does not divide their length.
pub fn flip_map(reference: &[[u8; 3]], test: &[[u8; 3]], width: usize) -> Vec<f64> {
    assert!(reference.len() == test.len(), "the pictures must have the same size");
    assert!(width > 0 && reference.len().is_multiple_of(width), "the width must divide the number of pixels");
    let seen = [reference, test].map(|picture| Perceived::new(picture, width));
    let most = hyab(hunt(&[0.0, 1.0, 0.0]), hunt(&[0.0, 0.0, 1.0])).powf(QC);
    (0..reference.len())
        .map(|i| {
            let colour = redistributed(hyab(seen[0].lab[i], seen[1].lab[i]).powf(QC), most);
            let apart = |kind: usize| (seen[0].features[kind][i] - seen[1].features[kind][i]).abs();
            let feature = (apart(0).max(apart(1)) / std::f64::consts::SQRT_2).powf(QF);
            // for equal features the exponent is 1
            colour.powf(1.0 - feature)
        })
        .collect()
}

/// Mean of [`flip_map`]; 0 for empty pictures.
///
/// # Panics
/// As [`flip_map`].
pub fn flip(reference: &[[u8; 3]], test: &[[u8; 3]], width: usize) -> f64 {
    let map = flip_map(reference, test, width);
    map.iter().sum::<f64>() / map.len().max(1) as f64
}

/// Maps the linear range to 0..[`PT`], and larger errors to the rest.
fn redistributed(error: f64, most: f64) -> f64 {
    let knee = PC * most;
    if error < knee { PT / knee * error } else { PT + (error - knee) / (most - knee) * (1.0 - PT) }
}

struct Perceived {
    /// CIELAB after the eye's filters, adjusted by Hunt's effect.
    lab: Vec<[f64; 3]>,
    /// Strength of edges and of points.
    features: [Vec<f64>; 2],
}

impl Perceived {
    fn new(picture: &[[u8; 3]], width: usize) -> Self {
        let opponent: Vec<[f64; 3]> = picture.iter().map(|rgb| opponent(&rgb.map(linear))).collect();
        let channels: Channels = std::array::from_fn(|c| opponent.iter().map(|p| p[c]).collect());
        let filtered: Channels = std::array::from_fn(|c| filter_channel(&channels[c], width, SENSITIVITY[c]));
        let lab = (0..picture.len())
            .map(|i| {
                let linear = of_opponent(&[filtered[0][i], filtered[1][i], filtered[2][i]]);
                hunt(&linear.map(|v| v.clamp(0.0, 1.0)))
            })
            .collect();
        let light: Vec<f64> = channels[0].iter().map(|y| (y + 16.0) / 116.0).collect();
        Self { lab, features: features(&light, width) }
    }
}

/// Applies the eye's filter to a channel: a sum of separable Gaussians.
fn filter_channel(channel: &[f64], width: usize, gaussians: &[(f64, f64)]) -> Vec<f64> {
    let sigma = (WIDEST / (2.0 * PI * PI)).sqrt();
    let radius = (3.0 * sigma * PIXELS_PER_DEGREE).ceil() as i32;
    let kernels: Vec<Vec<f64>> = (gaussians.iter())
        .map(|&(_, b)| (-radius..=radius).map(|i| (-(PI * f64::from(i) / PIXELS_PER_DEGREE).powi(2) / b).exp()).collect())
        .collect();
    // integral of each Gaussian over the plane
    let weight = |i: usize| gaussians[i].0 * (PI / gaussians[i].1).sqrt() * kernels[i].iter().sum::<f64>().powi(2);
    let total: f64 = (0..gaussians.len()).map(weight).sum();
    let mut out = vec![0.0; channel.len()];
    for (i, kernel) in kernels.iter().enumerate() {
        let kernel = scaled(kernel, 1.0 / kernel.iter().sum::<f64>());
        let share = weight(i) / total;
        let blurred = down(&along(channel, width, &kernel, repeated), width, &kernel, repeated);
        out.iter_mut().zip(blurred).for_each(|(sum, v)| *sum += share * v);
    }
    out
}

/// Magnitudes of the responses to edges and to points.
fn features(light: &[f64], width: usize) -> [Vec<f64>; 2] {
    let sigma = 0.5 * FEATURE_DEGREES * PIXELS_PER_DEGREE;
    let radius = (3.0 * sigma).ceil() as i32;
    let places: Vec<f64> = (-radius..=radius).map(f64::from).collect();
    let bell: Vec<f64> = places.iter().map(|x| (-x * x / (2.0 * sigma * sigma)).exp()).collect();
    let blur = scaled(&bell, 1.0 / bell.iter().sum::<f64>());
    let edge = balanced(places.iter().zip(&bell).map(|(x, g)| -x * g).collect());
    let point = balanced(places.iter().zip(&bell).map(|(x, g)| (x * x / (sigma * sigma) - 1.0) * g).collect());
    // perpendicular to the detector's direction, blur with the Gaussian
    let (blurred_along, blurred_down) = (along(light, width, &blur, repeated), down(light, width, &blur, repeated));
    [edge, point].map(|kernel| {
        let (x, y) = (along(&blurred_down, width, &kernel, repeated), down(&blurred_along, width, &kernel, repeated));
        x.iter().zip(&y).map(|(x, y)| x.hypot(*y)).collect()
    })
}

fn scaled(kernel: &[f64], by: f64) -> Vec<f64> {
    kernel.iter().map(|v| v * by).collect()
}

/// Scales the positive weights to a sum of 1 and the negative ones to −1.
fn balanced(mut kernel: Vec<f64>) -> Vec<f64> {
    let sum = |sign: f64| kernel.iter().map(|v| (v * sign).max(0.0)).sum::<f64>();
    let (positive, negative) = (sum(1.0), sum(-1.0));
    for v in &mut kernel {
        *v /= if *v > 0.0 { positive } else { negative };
    }
    kernel
}

/// Beyond a border, its own values are repeated.
fn repeated(at: isize, n: usize) -> usize {
    at.max(0).unsigned_abs().min(n.saturating_sub(1))
}

/// Linear value of an sRGB level.
fn linear(level: u8) -> f64 {
    let v = f64::from(level) / 255.0;
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// XYZ of a linear colour, relative to white.
fn relative(rgb: &[f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| (0..3).map(|c| XYZ[i][c] * rgb[c]).sum::<f64>() / WHITE[i])
}

/// `YCxCz`: lightness and two opponent colours, linear in light.
fn opponent(rgb: &[f64; 3]) -> [f64; 3] {
    let [x, y, z] = relative(rgb);
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

/// Linear colour of `YCxCz`.
fn of_opponent(v: &[f64; 3]) -> [f64; 3] {
    let y = (v[0] + 16.0) / 116.0;
    let xyz = [(y + v[1] / 500.0) * WHITE[0], y * WHITE[1], (y - v[2] / 200.0) * WHITE[2]];
    // by Cramer's rule
    let det = |m: [[f64; 3]; 3]| {
        (0..3).map(|i| m[0][i] * (m[1][(i + 1) % 3] * m[2][(i + 2) % 3] - m[1][(i + 2) % 3] * m[2][(i + 1) % 3])).sum::<f64>()
    };
    let whole = det(XYZ);
    std::array::from_fn(|c| {
        let mut m = XYZ;
        (0..3).for_each(|i| m[i][c] = xyz[i]);
        det(m) / whole
    })
}

/// CIELAB of a linear colour, with less saturation in dark colours (Hunt effect).
fn hunt(rgb: &[f64; 3]) -> [f64; 3] {
    const KNEE: f64 = 6.0 / 29.0;
    let f = |t: f64| if t > KNEE.powi(3) { t.cbrt() } else { t / (3.0 * KNEE * KNEE) + 4.0 / 29.0 };
    let [x, y, z] = relative(rgb).map(f);
    let l = 116.0 * y - 16.0;
    [l, 0.01 * l * 500.0 * (x - y), 0.01 * l * 200.0 * (y - z)]
}

/// Difference in lightness plus distance in chromaticity, which is also valid for large differences.
fn hyab(p: [f64; 3], q: [f64; 3]) -> f64 {
    (p[0] - q[0]).abs() + (p[1] - q[1]).hypot(p[2] - q[2])
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn plain(colour: [u8; 3]) -> Vec<[u8; 3]> {
        vec![colour; 30 * 20]
    }

    #[test]
    fn white_matches_the_matrix() {
        for i in 0..3 {
            assert!((XYZ[i].iter().sum::<f64>() - WHITE[i]).abs() < 1e-12);
        }
        let lab = hunt(&[1.0; 3]);
        assert!((lab[0] - 100.0).abs() < 1e-9 && lab[1].abs() < 1e-9 && lab[2].abs() < 1e-9, "{lab:?}");
    }

    #[test]
    fn green_and_blue_have_the_maximum_difference() {
        let map = flip_map(&plain([0, 255, 0]), &plain([0, 0, 255]), 30);
        assert!(map.iter().all(|v| (v - 1.0).abs() < 1e-9), "{}", map[0]);
    }

    #[test]
    fn plain_pictures_differ_by_their_colours() {
        // black and white have a HyAB distance of 100, beyond the linear range
        let most = hyab(hunt(&[0.0, 1.0, 0.0]), hunt(&[0.0, 0.0, 1.0])).powf(QC);
        let want = redistributed(100f64.powf(QC), most);
        let map = flip_map(&plain([0; 3]), &plain([255; 3]), 30);
        assert!(want > PT && map.iter().all(|v| (v - want).abs() < 1e-9), "{} {want}", map[0]);
        // a single grey level is invisible
        assert!(flip(&plain([128; 3]), &plain([129; 3]), 30) < 0.03);
        assert!((redistributed(PC * most, most) - PT).abs() < 1e-12 && (redistributed(most, most) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn moved_edges_count_and_fine_patterns_blur() {
        let (w, h) = (64, 64);
        let edge = |at: usize| (0..w * h).map(|i| if i % w < at { [30; 3] } else { [220; 3] }).collect::<Vec<[u8; 3]>>();
        let map = flip_map(&edge(32), &edge(34), w);
        let [near, far] = [map[32 * w + 33], map[32 * w + 4]];
        assert!(near > 0.5 && far < 1e-6, "{near} {far}");
        // a fine pattern blurs to its mean and is less visible than a plain difference
        let checks = (0..w * h).map(|i| if (i % w + i / w) % 2 == 0 { [118; 3] } else { [138; 3] }).collect::<Vec<_>>();
        let fine = flip(&vec![[128; 3]; w * h], &checks, w);
        let plain = flip(&vec![[128; 3]; w * h], &vec![[138; 3]; w * h], w);
        assert!(fine < plain, "{fine} {plain}");
    }

    #[test]
    fn opponent_colours_can_be_inverted() {
        for rgb in [[0.0, 0.0, 0.0], [1.0, 0.2, 0.7], [0.01, 1.0, 0.5]] {
            let back = of_opponent(&opponent(&rgb));
            assert!((0..3).all(|c| (back[c] - rgb[c]).abs() < 1e-12), "{back:?}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        #[test]
        fn flip_is_symmetric_bounded_and_zero_for_equals(
            (w, h) in (1usize..24, 1usize..24), seed in any::<u32>(), step in 1u32..2000,
        ) {
            let mut state = seed;
            let mut byte = || { state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223 + step); (state >> 24) as u8 };
            let mut picture = || (0..w * h).map(|_| [byte(), byte(), byte()]).collect::<Vec<_>>();
            let (a, b) = (picture(), picture());
            let (ab, ba) = (flip_map(&a, &b, w), flip_map(&b, &a, w));
            prop_assert!(ab.iter().all(|v| (0.0..=1.0 + 1e-9).contains(v)));
            prop_assert!(ab.iter().zip(&ba).all(|(x, y)| (x - y).abs() < 1e-12));
            prop_assert!(flip(&a, &a, w) < 1e-300);
        }
    }
}
