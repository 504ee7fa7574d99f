//! The network Θ: denoised disparity and a confidence per pixel, from photo and disparity (paper, section 3.2).

use std::ops::Range;

use super::local_planes::Degradation;
use crate::networks::{Network, Tensor};
use crate::{StageError, edges};
use tmpi_core::{DisparityMap, Photo};

/// Largest width and height of a block that Θ sees at once, in pixels: multiples of [`MULTIPLE`].
const BLOCK: (usize, usize) = (640, 384);
/// Sides of blocks are multiples of this many pixels.
const MULTIPLE: usize = 16;
/// Margin around a block that Θ sees and that is discarded, in pixels: about as wide as its receptive field.
const MARGIN: usize = 48;

/// Confidence of a pixel for which the network returns no finite one.
const LEAST: f32 = 1e-3;

/// Whether a map has something for Θ to repair: noise, outliers, or edges blurred to ramps. Θ makes any other map a little worse.
pub fn wanted(delta: &DisparityMap) -> bool {
    Degradation::of(delta).found() || edges::ramp_share(delta) > edges::BLURRED
}

/// Runs Θ at the map's own size, in overlapping blocks. Nothing is resampled, because Θ is there to remove what varies from pixel to
/// pixel. A clipped block repeats its last row and column. Returns the denoised map, within 0..=1, and a confidence per pixel, 0.001 to
/// 1.
///
/// # Errors
/// [`StageError::Onnx`] if the network fails, [`StageError::Shape`] if its outputs have other shapes than its card states.
pub fn run(theta: &dyn Network, photo: &Photo, delta: &DisparityMap) -> Result<(DisparityMap, Vec<f32>), StageError> {
    let (w, h) = (photo.width as usize, photo.height as usize);
    let (mut clean, mut certain) = (delta.delta.clone(), vec![0f32; w * h]);
    for rows in parts(h, BLOCK.1) {
        for columns in parts(w, BLOCK.0) {
            let (nw, nh) = (columns.seen.len().next_multiple_of(MULTIPLE), rows.seen.len().next_multiple_of(MULTIPLE));
            let area = nw * nh;
            let mut data = vec![0f32; 4 * area];
            for (y, x, o) in (0..nh).flat_map(|y| (0..nw).map(move |x| (y, x, y * nw + x))) {
                let at = (rows.seen.start + y).min(h - 1) * w + (columns.seen.start + x).min(w - 1);
                (0..3).for_each(|c| data[c * area + o] = f32::from(photo.rgb[at][c]) / 255.0);
                data[3 * area + o] = delta.delta[at];
            }
            let out = theta.run(vec![Tensor { shape: vec![1, 4, nh, nw], data }])?;
            let [denoised, confidence] = out.as_slice() else { return Err(shape(&out, area)) };
            if denoised.data.len() != area || confidence.data.len() != area {
                return Err(shape(&out, area));
            }
            for y in rows.kept.clone() {
                for x in columns.kept.clone() {
                    let (at, o) = (y * w + x, (y - rows.seen.start) * nw + x - columns.seen.start);
                    if denoised.data[o].is_finite() {
                        clean[at] = denoised.data[o].clamp(0.0, 1.0);
                    }
                    certain[at] = if confidence.data[o].is_finite() { confidence.data[o].clamp(LEAST, 1.0) } else { LEAST };
                }
            }
        }
    }
    Ok((DisparityMap { delta: clean, ..*delta }, certain))
}

/// A part of a side: the pixels that are kept of it, and those that are seen for that.
struct Part {
    kept: Range<usize>,
    seen: Range<usize>,
}

/// Splits a side of `n` pixels into parts of which at most `most` pixels are seen at once.
fn parts(n: usize, most: usize) -> impl Iterator<Item = Part> {
    let step = if n <= most { n } else { most - 2 * MARGIN };
    (0..n).step_by(step.max(1)).map(move |start| {
        let kept = start..(start + step).min(n);
        let seen = if step == n { 0..n } else { kept.start.saturating_sub(MARGIN)..(kept.end + MARGIN).min(n) };
        Part { kept, seen }
    })
}

fn shape(out: &[Tensor], want: usize) -> StageError {
    let got = out.iter().map(|t| format!("{:?}", t.shape)).collect::<Vec<_>>().join(" ");
    StageError::Shape { network: "theta", got, want: format!("two maps of {want} values") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn input(w: u32, h: u32) -> (Photo, DisparityMap) {
        let n = (w * h) as usize;
        (
            Photo { width: w, height: h, rgb: vec![[10, 20, 30]; n] },
            DisparityMap { width: w, height: h, delta: (0..n).map(|i| (i % 10) as f32 / 10.0).collect() },
        )
    }

    fn map(t: &Tensor, f: impl Fn(f32) -> f32) -> Tensor {
        let n = t.shape[2] * t.shape[3];
        Tensor { shape: vec![1, 1, t.shape[2], t.shape[3]], data: t.data[3 * n..].iter().map(|d| f(*d)).collect() }
    }

    #[test]
    fn a_network_that_returns_its_input_changes_nothing() {
        for (w, h) in [(64, 48), (100, 37), (1, 1), (1, 700), (2000, 3), (900, 800)] {
            let (photo, delta) = input(w, h);
            let (clean, confidence) = run(&|t: &Tensor| vec![map(t, |d| d), map(t, |_| 0.5)], &photo, &delta).unwrap();
            assert_eq!(clean, delta, "{w}x{h}");
            assert!(confidence.iter().all(|c| (c - 0.5).abs() < 1e-5));
        }
    }

    #[test]
    fn non_finite_outputs_leave_pixels_unchanged_and_untrusted() {
        let (photo, delta) = input(50, 40);
        let nothing: [fn(&Tensor) -> Vec<Tensor>; 3] = [
            |t| vec![map(t, |_| f32::NAN), map(t, |_| f32::NAN)],
            |t| vec![map(t, |_| f32::INFINITY), map(t, |_| f32::INFINITY)],
            |t| vec![map(t, |_| f32::NEG_INFINITY), map(t, |_| f32::NEG_INFINITY)],
        ];
        for network in nothing {
            let (clean, confidence) = run(&network, &photo, &delta).unwrap();
            assert_eq!(clean, delta);
            assert!(confidence.iter().all(|c| (c - LEAST).abs() < f32::EPSILON));
        }
        assert!(matches!(run(&|_: &Tensor| vec![], &photo, &delta), Err(StageError::Shape { .. })));
    }

    #[test]
    fn parts_keep_every_pixel_once_and_see_around_it() {
        for n in [1, 2, 16, 639, 640, 641, 5000] {
            let mut next = 0;
            for p in parts(n, 640) {
                assert_eq!(p.kept.start, next);
                assert!(p.seen.len() <= 640 && p.seen.start <= p.kept.start && p.kept.end <= p.seen.end && p.seen.end <= n);
                assert!(p.seen.end == n || p.seen.end >= p.kept.end + MARGIN);
                next = p.kept.end;
            }
            assert_eq!(next, n);
        }
    }

    #[test]
    fn maps_of_any_size_reach_the_network_unresampled() {
        for (w, h) in [(630, 350), (700, 500)] {
            let (photo, delta) = input(w, h);
            let (clean, _) =
                run(&|t: &Tensor| vec![map(t, |d| if d > 0.45 { 1.0 } else { 0.0 }), map(t, |_| 1.0)], &photo, &delta).unwrap();
            assert!(clean.delta.iter().zip(&delta.delta).all(|(c, d)| (*c > 0.5) == (*d > 0.45)), "{w}x{h}");
        }
    }
}
