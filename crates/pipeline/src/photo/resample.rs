//! Separable resampling in bands, so that memory grows with the result's width but not with the source's height.

use rayon::prelude::*;

use super::taps::Taps;
use tmpi_core::Photo;

/// Resampling kernel. When reducing, it is stretched by the ratio to prevent aliasing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Filter {
    /// Windowed sinc with three lobes: sharp, but overshoots at edges.
    Lanczos3,
    /// Linear: never leaves the range of its input.
    Triangle,
    /// Cubic with slope −½ at 1 (Keys 1981), which Pillow uses to reduce pictures.
    Cubic,
}

impl Filter {
    /// Radius beyond which the kernel is 0, in pixels.
    pub(super) fn support(self) -> f64 {
        match self {
            Self::Lanczos3 => 3.0,
            Self::Triangle => 1.0,
            Self::Cubic => 2.0,
        }
    }

    /// The unstretched kernel at a distance in pixels.
    pub(super) fn at(self, x: f64) -> f64 {
        let x = x.abs();
        match self {
            Self::Triangle => (1.0 - x).max(0.0),
            Self::Cubic if x < 1.0 => (1.5 * x - 2.5) * x * x + 1.0,
            Self::Cubic if x < 2.0 => ((2.5 - 0.5 * x) * x - 4.0) * x + 2.0,
            Self::Cubic => 0.0,
            Self::Lanczos3 if x < 1e-9 => 1.0,
            Self::Lanczos3 if x >= 3.0 => 0.0,
            Self::Lanczos3 => {
                let a = std::f64::consts::PI * x;
                3.0 * a.sin() * (a / 3.0).sin() / (a * a)
            }
        }
    }
}

/// Resamples a row-major picture from size `from` to size `to` (width, height); `load` and `store` convert a pixel to and from channels.
///
/// Both sizes are at least 1×1 and `source` has `from.0 · from.1` pixels.
pub fn resample<const C: usize, S: Copy + Sync, D: Copy + Default + Send>(
    source: &[S],
    from: (u32, u32),
    to: (u32, u32),
    filter: Filter,
    load: impl Fn(S) -> [f32; C] + Sync,
    store: impl Fn([f32; C]) -> D + Sync,
) -> Vec<D> {
    let across = Taps::stretched(from.0 as usize, to.0 as usize, filter);
    let down = Taps::stretched(from.1 as usize, to.1 as usize, filter);
    resample_by(source, from.0 as usize, &across, &down, load, store)
}

/// Like [`resample`], but with your own taps. `source` has rows of `from_w` pixels, and the taps lie inside it.
pub fn resample_by<const C: usize, S: Copy + Sync, D: Copy + Default + Send>(
    source: &[S],
    from_w: usize,
    across: &Taps,
    down: &Taps,
    load: impl Fn(S) -> [f32; C] + Sync,
    store: impl Fn([f32; C]) -> D + Sync,
) -> Vec<D> {
    const BAND: usize = 32;
    let (to_w, to_h) = (across.0.len(), down.0.len());
    let mut out = vec![D::default(); to_w * to_h];
    out.par_chunks_mut(BAND * to_w).enumerate().for_each(|(band, out)| {
        let taps = &down.0[band * BAND..band * BAND + out.len() / to_w];
        let (first, end) = (taps.iter().map(|t| t.0).min().unwrap_or(0), taps.iter().map(|t| t.0 + t.1.len()).max().unwrap_or(0));
        let mut sums = vec![[0f32; C]; out.len()];
        let (mut line, mut row) = (vec![[0f32; C]; from_w], vec![[0f32; C]; to_w]);
        for y in first..end {
            // taps that are not stretched skip rows
            if !taps.iter().any(|(at, weights)| (*at..at + weights.len()).contains(&y)) {
                continue;
            }
            for (l, &s) in line.iter_mut().zip(&source[y * from_w..]) {
                *l = load(s);
            }
            for (r, (at, weights)) in row.iter_mut().zip(&across.0) {
                let mut sum = [0f32; C];
                for (w, p) in weights.iter().zip(&line[*at..]) {
                    for c in 0..C {
                        sum[c] += w * p[c];
                    }
                }
                *r = sum;
            }
            for (sums, (at, weights)) in sums.chunks_exact_mut(to_w).zip(taps) {
                let Some(w) = y.checked_sub(*at).and_then(|i| weights.get(i)) else { continue };
                for (s, r) in sums.iter_mut().zip(&row) {
                    for c in 0..C {
                        s[c] += w * r[c];
                    }
                }
            }
        }
        for (o, s) in out.iter_mut().zip(sums) {
            *o = store(s);
        }
    });
    out
}

/// Resamples a photo to another size, at least 1×1, with [`Filter::Lanczos3`].
pub fn resize(photo: &Photo, width: u32, height: u32) -> Photo {
    let rgb = resample(
        &photo.rgb,
        (photo.width, photo.height),
        (width, height),
        Filter::Lanczos3,
        |p| p.map(f32::from),
        // `as` saturates
        |p| p.map(|v| v.round() as u8),
    );
    Photo { width, height, rgb }
}

/// Size (width, height) with the longer side at most `max_size` and the same aspect; at least 1×1.
pub fn reduced_size((width, height): (u32, u32), max_size: Option<u32>) -> (u32, u32) {
    let Some(max) = max_size.map(|m| m.max(1)).filter(|&m| m < width.max(height)) else { return (width, height) };
    let ratio = f64::from(max) / f64::from(width.max(height));
    let side = |s: u32| ((f64::from(s) * ratio).round() as u32).clamp(1, max);
    (side(width), side(height))
}

/// A picture's size, reduced to at most `most` pixels.
pub fn working_size((width, height): (u32, u32), most: f64) -> (u32, u32) {
    let scale = (most / (f64::from(width) * f64::from(height))).sqrt().min(1.0);
    let side = |s: u32| ((f64::from(s) * scale).round() as u32).clamp(1, s);
    (side(width), side(height))
}
