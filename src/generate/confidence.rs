//! Θ: denoised disparity and a confidence per pixel, from photo and disparity (paper, section 3.2).

use super::GenerateError;
use crate::onnx::{Network, Tensor};
use crate::tmpi::{DisparityMap, Photo};

/// Most pixels that Θ sees at once; it was trained at about this size, and more only costs time.
const PIXELS: usize = 384 * 640;
/// Sides are multiples of this.
const MULTIPLE: usize = 16;

/// Runs Θ. The denoised map is the given one plus the network's change, so that detail above the network's size stays.
///
/// # Errors
/// [`GenerateError::Onnx`] where the network fails, [`GenerateError::Shape`] where its outputs are not as its card says.
pub fn run(theta: &dyn Network, photo: &Photo, delta: &DisparityMap) -> Result<(DisparityMap, Vec<f32>), GenerateError> {
    let (w, h) = (photo.width as usize, photo.height as usize);
    let (nw, nh) = size(w, h);
    let mut data = Vec::with_capacity(4 * nw * nh);
    for channel in 0..3 {
        data.extend(resample(&|i| f32::from(photo.rgb[i][channel]) / 255.0, (w, h), (nw, nh)));
    }
    let small = resample(&|i| delta.delta[i], (w, h), (nw, nh));
    data.extend(&small);
    let out = theta.run(vec![Tensor { shape: vec![1, 4, nh, nw], data }])?;
    let want = nw * nh;
    let [denoised, confidence] = out.as_slice() else { return Err(shape(&out, want)) };
    if denoised.data.len() != want || confidence.data.len() != want {
        return Err(shape(&out, want));
    }
    let change: Vec<f32> = denoised.data.iter().zip(&small).map(|(d, s)| if d.is_finite() { d - s } else { 0.0 }).collect();
    let up = resample(&|i| change[i], (nw, nh), (w, h));
    let clean = delta.delta.iter().zip(up).map(|(d, c)| (d + c).clamp(0.0, 1.0)).collect();
    let confidence =
        resample(&|i| if confidence.data[i].is_finite() { confidence.data[i].clamp(1e-3, 1.0) } else { 1e-3 }, (nw, nh), (w, h));
    Ok((DisparityMap { width: delta.width, height: delta.height, delta: clean }, confidence))
}

fn shape(out: &[Tensor], want: usize) -> GenerateError {
    let got = out.iter().map(|t| format!("{:?}", t.shape)).collect::<Vec<_>>().join(" ");
    GenerateError::Shape { network: "theta", got, want: format!("two maps of {want} values") }
}

/// Size that Θ runs at: the photo's where it is small enough, rounded up to the multiple; else reduced to [`PIXELS`].
fn size(w: usize, h: usize) -> (usize, usize) {
    let scale = (PIXELS as f64 / (w * h) as f64).sqrt().min(1.0);
    let fit = |n: usize| {
        // a very long photo must not become wider than it is for the sake of its other side
        let n = (n as f64 * scale).clamp(1.0, PIXELS as f64 / MULTIPLE as f64) as usize;
        n.div_ceil(MULTIPLE) * MULTIPLE
    };
    (fit(w), fit(h))
}

/// Resamples a map: mean over the source area where it shrinks, bilinear where it grows; per axis.
fn resample(at: &dyn Fn(usize) -> f32, (w, h): (usize, usize), (nw, nh): (usize, usize)) -> Vec<f32> {
    let columns = taps(w, nw);
    let rows = taps(h, nh);
    let mut out = Vec::with_capacity(nw * nh);
    let mut cache: Vec<(usize, Vec<f32>)> = Vec::new();
    for (start, weights) in &rows {
        cache.retain(|(y, _)| *y >= *start);
        for y in *start..start + weights.len() {
            if !cache.iter().any(|(c, _)| *c == y) {
                let line = columns.iter().map(|(x, k)| k.iter().enumerate().map(|(i, k)| k * at(y * w + x + i)).sum()).collect();
                cache.push((y, line));
            }
        }
        let lines: Vec<(&Vec<f32>, f32)> =
            weights.iter().enumerate().filter_map(|(i, k)| cache.iter().find(|(y, _)| *y == start + i).map(|(_, l)| (l, *k))).collect();
        out.extend((0..nw).map(|x| lines.iter().map(|(l, k)| l[x] * k).sum::<f32>()));
    }
    out
}

/// First source sample and weights for every target sample of an axis.
fn taps(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let step = from as f64 / to as f64;
    (0..to)
        .map(|i| {
            if step > 1.0 {
                let (a, b) = (i as f64 * step, ((i + 1) as f64 * step).min(from as f64));
                let (first, last) = (a.floor() as usize, (b.ceil() as usize).min(from));
                let k = (first..last).map(|s| (((s + 1) as f64).min(b) - (s as f64).max(a)).max(0.0) / (b - a)).map(|k| k as f32).collect();
                (first, k)
            } else {
                let x = ((i as f64 + 0.5) * step - 0.5).clamp(0.0, (from - 1) as f64);
                let first = (x.floor() as usize).min(from.saturating_sub(2));
                let t = (x - first as f64) as f32;
                (first, if from == 1 { vec![1.0] } else { vec![1.0 - t, t] })
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::onnx::OnnxError;

    struct Fake(fn(&Tensor) -> Vec<Tensor>);

    impl Network for Fake {
        fn run(&self, inputs: Vec<Tensor>) -> Result<Vec<Tensor>, OnnxError> {
            Ok((self.0)(&inputs[0]))
        }
    }

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
    fn a_network_that_changes_nothing_changes_nothing() {
        for (w, h) in [(64, 48), (100, 37), (1, 1), (1, 700), (2000, 3)] {
            let (photo, delta) = input(w, h);
            let (clean, confidence) = run(&Fake(|t| vec![map(t, |d| d), map(t, |_| 0.5)]), &photo, &delta).unwrap();
            assert_eq!(clean, delta, "{w}x{h}");
            assert!(confidence.iter().all(|c| (c - 0.5).abs() < 1e-5));
        }
    }

    #[test]
    fn a_broken_network_gives_no_nan() {
        let (photo, delta) = input(50, 40);
        let (clean, confidence) = run(&Fake(|t| vec![map(t, |_| f32::NAN), map(t, |_| f32::NAN)]), &photo, &delta).unwrap();
        assert!(clean.delta.iter().chain(&confidence).all(|v| v.is_finite()));
        assert!(matches!(run(&Fake(|_| vec![]), &photo, &delta), Err(GenerateError::Shape { .. })));
    }

    #[test]
    fn resampling_keeps_a_constant_and_the_mean() {
        for (a, b) in [(7, 3), (3, 7), (100, 16), (1, 16), (16, 1)] {
            for (first, k) in taps(a, b) {
                assert!(first + k.len() <= a && (k.iter().sum::<f32>() - 1.0).abs() < 1e-5, "{a} to {b}");
            }
        }
    }
}
