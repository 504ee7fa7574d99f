//! Recovers distances from points that a network returns up to a shift along the view axis, as `MoGe` does (Wang et al., *`MoGe`*, CVPR
//! 2025, section 3.1): the camera is a pinhole behind the middle of the picture, and each point has to project to its own pixel.

/// Samples per side from which the shift is computed.
const SIDE: usize = 64;
/// Largest factor by which the shift may change the distance of the nearest point.
const REACH: f64 = 1e6;

/// A point and the position of its pixel, in units of half the picture's diagonal from its middle.
#[derive(Clone, Copy)]
struct Sample {
    point: [f64; 3],
    pixel: [f64; 2],
}

/// Returns what to add to each z of `points`: rows of `width × height` pixels with x, y, z each. Only pixels with `valid` count, and of
/// these the ones nearest to a grid of 64 × 64. Returns 0 if fewer than two of these are finite.
///
/// `points` has `3 · width · height` values, `valid` a third of them.
pub fn shift(points: &[f32], valid: &[bool], width: usize, height: usize) -> f64 {
    let samples = sample(points, valid, width, height);
    let nearest = samples.iter().map(|s| s.point[2]).fold(f64::INFINITY, f64::min);
    if samples.len() < 2 || !nearest.is_finite() {
        return 0.0;
    }
    // each point projects to its pixel, to the precision of its numbers
    let pixels: f64 = samples.iter().map(|s| s.pixel[0].powi(2) + s.pixel[1].powi(2)).sum();
    if error(&samples, 0.0) <= 1e-12 * pixels {
        return 0.0;
    }
    // search over the logarithm of what is left of the nearest distance, so that every point stays in front of the camera
    let shift = nearest * valley(|t| error(&samples, nearest * t.exp() - nearest), REACH.ln()).exp() - nearest;
    if shift.is_finite() { shift } else { 0.0 }
}

fn sample(points: &[f32], valid: &[bool], width: usize, height: usize) -> Vec<Sample> {
    if valid.is_empty() {
        return Vec::new();
    }
    let diagonal = (width as f64).hypot(height as f64);
    // in single precision, as in MoGe's code
    let place = |k: usize, size: usize| ((k as f32 * (size as f32 / SIDE as f32)) as usize).min(size - 1);
    let middle = |k: usize, size: usize| (2.0 * k as f64 + 1.0 - size as f64) / diagonal;
    let grid = (0..SIDE * SIDE).map(|k| (place(k % SIDE, width), place(k / SIDE, height)));
    grid.filter(|&(x, y)| valid[y * width + x])
        .map(|(x, y)| {
            let at = 3 * (y * width + x);
            Sample { point: std::array::from_fn(|c| f64::from(points[at + c])), pixel: [middle(x, width), middle(y, height)] }
        })
        // no point should lie behind the camera; one that does has no pixel
        .filter(|s| s.point[2] > 0.0 && s.point.iter().all(|v| v.is_finite()))
        .collect()
}

/// Sum of the squared distances between the pixels and the projected points, for the focal length that fits best.
fn error(samples: &[Sample], shift: f64) -> f64 {
    let (mut across, mut square, mut pixels) = (0.0, 0.0, 0.0);
    for Sample { point: [x, y, z], pixel: [u, v] } in samples {
        let [x, y] = [x / (z + shift), y / (z + shift)];
        across += x * u + y * v;
        square += x * x + y * y;
        pixels += u * u + v * v;
    }
    pixels - if square > 0.0 { across * across / square } else { 0.0 }
}

/// Lowest point of the valley that contains 0, at most `reach` away: steps that double bracket it, golden-section search finds it.
fn valley(f: impl Fn(f64) -> f64, reach: f64) -> f64 {
    const STEP: f64 = 1e-2;
    let here = f(0.0);
    let Some(sign) = [1.0, -1.0].into_iter().find(|sign| f(sign * STEP) < here) else { return golden_section(f, -STEP, STEP) };
    let (mut before, mut at, mut value, mut step) = (0.0, sign * STEP, f(sign * STEP), 2.0 * STEP);
    loop {
        let next = (at + sign * step).clamp(-reach, reach);
        let ahead = f(next);
        if ahead.is_nan() || ahead >= value || next.abs() >= reach {
            return golden_section(f, before, next);
        }
        (before, at, value, step) = (at, next, ahead, 2.0 * step);
    }
}

/// The only minimum between `a` and `b`, to 1e-9.
fn golden_section(f: impl Fn(f64) -> f64, a: f64, b: f64) -> f64 {
    const RATIO: f64 = 0.618_033_988_749_894_9;
    let (mut a, mut b) = (a.min(b), a.max(b));
    let (mut c, mut d) = (b - RATIO * (b - a), a + RATIO * (b - a));
    let (mut at_c, mut at_d) = (f(c), f(d));
    while b - a > 1e-9 {
        if at_c <= at_d {
            (b, d, at_d) = (d, c, at_c);
            c = b - RATIO * (b - a);
            at_c = f(c);
        } else {
            (a, c, at_c) = (c, d, at_d);
            d = a + RATIO * (b - a);
            at_d = f(d);
        }
    }
    f64::midpoint(a, b)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Points of a scene of `distance(x, y)` before a camera with a focal length of `focal` half diagonals, moved by −`moved` along the
    /// view axis.
    fn scene(w: usize, h: usize, focal: f64, moved: f64, distance: impl Fn(usize, usize) -> f64) -> Vec<f32> {
        let diagonal = (w as f64).hypot(h as f64);
        let point = |k: usize| {
            let (x, y) = (k % w, k / w);
            let [u, v] = [(2 * x + 1) as f64 - w as f64, (2 * y + 1) as f64 - h as f64].map(|p| p / diagonal);
            let z = distance(x, y);
            [u * z / focal, v * z / focal, z - moved].map(|v| v as f32)
        };
        (0..w * h).flat_map(point).collect()
    }

    proptest! {
        #[test]
        fn the_shift_of_a_pinhole_camera_is_found(
            w in 2usize..150, h in 2usize..150, focal in 0.4f64..4.0, moved in -5.0f64..0.9, waves in 0.5f64..4.0,
        ) {
            // a relief whose distances are at least 1
            let scene = scene(w, h, focal, moved, |x, y| 2.0 + (x as f64 * waves / w as f64).sin() * (1.0 - y as f64 / h as f64));
            let got = shift(&scene, &vec![true; w * h], w, h);
            // a flat scene fits any shift
            let range = scene.iter().skip(2).step_by(3).fold((f32::INFINITY, f32::NEG_INFINITY), |r, &z| (r.0.min(z), r.1.max(z)));
            if range.1 - range.0 > 0.1 {
                prop_assert!((got - moved).abs() < 2e-3 * (1.0 + moved.abs()), "{got} for {moved}");
            }
        }

        #[test]
        fn no_nearby_shift_is_better(seed in 0u32..10_000, w in 8usize..40, h in 8usize..40) {
            let mut scene = scene(w, h, 1.0, 0.5, |x, _| 1.5 + x as f64 / w as f64);
            for (i, v) in (0..).zip(&mut scene) {
                *v *= 0.95 + 0.1 * tmpi_testing::pictures::noise(i, seed);
            }
            let valid = vec![true; w * h];
            let got = shift(&scene, &valid, w, h);
            let samples = sample(&scene, &valid, w, h);
            for beside in [-0.01, -1e-4, 1e-4, 0.01] {
                prop_assert!(error(&samples, got + beside) >= error(&samples, got) - 1e-12);
            }
        }
    }

    #[test]
    fn masked_and_non_finite_points_are_ignored() {
        let (w, h) = (60, 40);
        let mut scene = scene(w, h, 1.2, 0.7, |x, y| 1.0 + (x + y) as f64 / 50.0);
        let mut valid = vec![true; w * h];
        for (k, v) in valid.iter_mut().enumerate().filter(|(k, _)| k % 7 == 0) {
            *v = false;
            scene[3 * k + 2] = [f32::NAN, -1e30, 1e30][k % 3];
        }
        for k in (0..w * h).filter(|k| k % 11 == 0) {
            scene[3 * k + k % 3] = f32::INFINITY;
        }
        assert!((shift(&scene, &valid, w, h) - 0.7).abs() < 1e-3);
    }

    #[test]
    fn degenerate_points_give_finite_shifts() {
        let all = |w: usize, h: usize, p: [f32; 3]| shift(&(0..w * h).flat_map(|_| p).collect::<Vec<_>>(), &vec![true; w * h], w, h);
        for p in [[0.0; 3], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1e30, -1e30, 1e-30], [1.0, 0.0, -2.0], [f32::NAN; 3], [f32::INFINITY; 3]] {
            for (w, h) in [(1, 1), (1, 200), (200, 1), (64, 64)] {
                assert!(all(w, h, p).is_finite(), "{w}×{h} of {p:?}");
            }
        }
        assert!(shift(&[1.0, 2.0, 3.0, 1.0, 2.0, 3.0], &[false, false], 2, 1).abs() < f64::EPSILON, "none valid");
        assert!(shift(&[], &[], 0, 0).abs() < f64::EPSILON);
    }
}
