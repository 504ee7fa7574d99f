//! Scores views and disparity maps against the truth.

use serde::Serialize;

use crate::metrics;
use tmpi_core::DisparityMap;
use tmpi_pipeline::networks::{Network, OnnxError, Tensor};

/// Maximum disparity that counts as infinitely far; ratios of such disparities mean nothing.
const FAR: f64 = 0.02;

/// How close a view is to the truth; means over pixels, or over views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Score {
    /// PSNR in dB.
    pub psnr: f64,
    /// SSIM with an 11×11 Gaussian window, σ 1.5; mean over the channels.
    pub ssim: f64,
    /// Mean absolute difference of values in 0 to 1.
    pub l1: f64,
    pub flip: f64,
    /// LPIPS of the cropped view; `None` without a network for it.
    pub lpips: Option<f64>,
    /// PSNR in dB within [`BESIDE`] pixels of depth borders; without a depth border, of all pixels.
    pub borders: f64,
    /// PSNR in dB where the photo shows nothing; without such pixels, of all pixels.
    pub uncovered: f64,
}

/// Maximum distance from a depth border, in pixels, at which a pixel is beside it.
const BESIDE: usize = 3;
/// Neighbouring pixels that differ by more than this in δ have a depth border between them.
const BORDER: f64 = 0.03;

impl Score {
    pub(super) fn mean(all: &[Self]) -> Self {
        let n = all.len().max(1) as f64;
        let of = |f: fn(&Self) -> f64| all.iter().map(f).sum::<f64>() / n;
        let lpips = all.iter().map(|s| s.lpips).sum::<Option<f64>>().map(|s| s / n);
        let (borders, uncovered) = (of(|s| s.borders), of(|s| s.uncovered));
        Self { psnr: of(|s| s.psnr), ssim: of(|s| s.ssim), l1: of(|s| s.l1), flip: of(|s| s.flip), lpips, borders, uncovered }
    }
}

/// The part of a view that is scored.
pub(super) struct Mask {
    pub width: usize,
    pub inside: Vec<bool>,
    /// Scored pixels beside a depth border, and scored pixels that the photo does not show.
    beside: Vec<bool>,
    uncovered: Vec<bool>,
}

impl Mask {
    /// Masks the centre of a view, without gaps that reach the view's border: there, the photo at its true depth covers nothing. `depth` is
    /// the δ of the surface that covers each pixel, negative infinity where there is none.
    pub fn new(width: usize, depth: &[f64]) -> Self {
        let covered: Vec<bool> = depth.iter().map(|d| *d > f64::NEG_INFINITY).collect();
        let height = covered.len() / width.max(1);
        let mut outside = vec![false; covered.len()];
        let border = (0..covered.len()).filter(|i| i % width == 0 || i % width == width - 1 || i / width == 0 || i / width == height - 1);
        let mut open: Vec<usize> = border.filter(|&i| !covered[i]).collect();
        for &i in &open {
            outside[i] = true;
        }
        while let Some(i) = open.pop() {
            let (x, y) = (i % width, i / width);
            let around = [
                (x > 0).then(|| i - 1),
                (x + 1 < width).then_some(i + 1),
                (y > 0).then(|| i - width),
                (y + 1 < height).then_some(i + width),
            ];
            for j in around.into_iter().flatten().filter(|&j| !covered[j]) {
                if !std::mem::replace(&mut outside[j], true) {
                    open.push(j);
                }
            }
        }
        let (cx, cy) = (metrics::margin(width), metrics::margin(height));
        let middle = |i: usize| (cx..width - cx).contains(&(i % width)) && (cy..height - cy).contains(&(i / width));
        let inside: Vec<bool> = (0..covered.len()).map(|i| middle(i) && !outside[i]).collect();
        let near = beside(width, depth);
        let among = |of: &dyn Fn(usize) -> bool| (0..covered.len()).map(|i| inside[i] && of(i)).collect();
        Self { width, beside: among(&|i| near[i]), uncovered: among(&|i| !covered[i]), inside }
    }

    /// Share of the scored pixels for which `blank` is true.
    pub fn share(&self, blank: impl Fn(usize) -> bool) -> f64 {
        let all = self.inside.iter().filter(|b| **b).count();
        (0..self.inside.len()).filter(|&i| self.inside[i] && blank(i)).count() as f64 / all.max(1) as f64
    }

    fn mean(&self, map: impl Iterator<Item = f64>) -> f64 {
        mean(map, &self.inside).unwrap_or(0.0)
    }

    pub fn score(&self, view: &[[u8; 3]], truth: &[[u8; 3]]) -> Score {
        let difference = |power: i32, of: &[bool]| {
            let pixels = view.iter().zip(truth);
            let off =
                |(a, b): (&[u8; 3], &[u8; 3])| a.iter().zip(b).map(|(a, b)| (f64::from(a.abs_diff(*b)) / 255.0).powi(power)).sum::<f64>();
            mean(pixels.map(|both| off(both) / 3.0), of)
        };
        let decibels = |mse: f64| metrics::psnr_of(255.0 * 255.0 * mse);
        let psnr = decibels(difference(2, &self.inside).unwrap_or(0.0));
        let of = |mask: &[bool]| difference(2, mask).map_or(psnr, decibels);
        let (borders, uncovered, l1) = (of(&self.beside), of(&self.uncovered), difference(1, &self.inside).unwrap_or(0.0));
        let ssim = self.mean(metrics::ssim_map(view, truth, self.width).iter().map(|v| f64::from(*v)));
        let flip = self.mean(metrics::flip_map(truth, view, self.width).into_iter());
        Score { psnr, ssim, l1, flip, lpips: None, borders, uncovered }
    }

    /// The centre of a view and of the truth; pixels that are not scored come from the truth in both.
    fn middle(&self, view: &[[u8; 3]], truth: &[[u8; 3]]) -> [Vec<[u8; 3]>; 2] {
        let mixed: Vec<[u8; 3]> = view.iter().zip(truth).zip(&self.inside).map(|((v, t), inside)| if *inside { *v } else { *t }).collect();
        [&mixed, truth].map(|p| metrics::cropped(p, self.width))
    }

    /// Runs an LPIPS `network` on a view and the truth. Its two inputs are `[1, 3, height, width]` in −1 to 1; the result is the mean of
    /// its output.
    ///
    /// # Errors
    /// [`OnnxError`] if the network does not have this form.
    pub fn lpips(&self, network: &dyn Network, view: &[[u8; 3]], truth: &[[u8; 3]]) -> Result<f64, OnnxError> {
        let width = self.width - 2 * metrics::margin(self.width);
        let both = self.middle(view, truth).map(|rgb| {
            let plane = |c: usize| rgb.iter().map(move |p| f32::from(p[c]) / 127.5 - 1.0);
            Tensor { shape: vec![1, 3, rgb.len() / width, width], data: (0..3).flat_map(plane).collect() }
        });
        let out = network.run(both.into())?;
        let fail = || OnnxError::Run { name: "lpips".into(), reason: "it gave no number".into() };
        let values = &out.first().filter(|o| !o.data.is_empty()).ok_or_else(fail)?.data;
        Ok(values.iter().map(|v| f64::from(*v)).sum::<f64>() / values.len() as f64)
    }
}

/// Mean over the pixels of a mask; `None` if the mask is empty.
fn mean(map: impl Iterator<Item = f64>, mask: &[bool]) -> Option<f64> {
    let (mut sum, mut n) = (0.0, 0usize);
    for (v, _) in map.zip(mask).filter(|(_, wanted)| **wanted) {
        sum += v;
        n += 1;
    }
    (n > 0).then(|| sum / n as f64)
}

/// Which pixels are beside depth borders.
fn beside(width: usize, depth: &[f64]) -> Vec<bool> {
    // the edge of the covered area counts as a depth border, too
    let apart = |a: f64, b: f64| (a.max(-1.0) - b.max(-1.0)).abs() > BORDER;
    let mut out = vec![false; depth.len()];
    for (i, &d) in depth.iter().enumerate() {
        let (x, y) = (i % width, i / width);
        let right = x + 1 < width && apart(d, depth[i + 1]);
        if right || depth.get(i + width).is_some_and(|&below| apart(d, below)) {
            for v in y.saturating_sub(BESIDE - 1)..(y + BESIDE + 1).min(depth.len() / width) {
                out[v * width..][x.saturating_sub(BESIDE - 1)..(x + BESIDE + 1).min(width)].fill(true);
            }
        }
    }
    out
}

/// How close a disparity map is to the truth, once scale and shift fit it best.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct DepthScore {
    /// Mean of |distance − truth| / truth.
    pub abs_rel: f64,
    /// Root mean square error of the disparity, divided by the truth's standard deviation.
    pub rmse: f64,
    /// Share of pixels whose ratio to the truth is below 1.25, either way.
    pub within_125: f64,
    /// Spearman's rank correlation of disparities, before the fit.
    pub spearman: f64,
}

impl DepthScore {
    /// Scores `map` against `truth` of the same size, where the truth is above [`FAR`].
    pub(super) fn new(map: &DisparityMap, truth: &DisparityMap) -> Self {
        let both = known(map, truth);
        let (n, fit) = (both.len().max(1) as f64, Fit::of(&both));
        let variance = {
            let mean = both.iter().map(|b| b.1).sum::<f64>() / n;
            both.iter().map(|b| (b.1 - mean).powi(2)).sum::<f64>()
        };
        let fitted = both.iter().map(|(m, t)| (fit.scale * m + fit.shift, *t));
        let (mut square, mut relative, mut near) = (0.0, 0.0, 0.0);
        for (f, t) in fitted {
            square += (f - t) * (f - t);
            let f = f.max(FAR);
            relative += (t / f - 1.0).abs();
            near += f64::from(u8::from((f / t).max(t / f) < 1.25));
        }
        let rmse = if variance > 0.0 { (square / variance).sqrt() } else { 0.0 };
        let ranks = [ranks(both.iter().map(|b| b.0)), ranks(both.iter().map(|b| b.1))];
        Self { abs_rel: relative / n, rmse, within_125: near / n, spearman: correlation(&ranks[0], &ranks[1]) }
    }

    pub(super) fn mean(all: &[Self]) -> Option<Self> {
        let of = |f: fn(&Self) -> f64| all.iter().map(f).sum::<f64>() / all.len() as f64;
        let mean =
            || Self { abs_rel: of(|s| s.abs_rel), rmse: of(|s| s.rmse), within_125: of(|s| s.within_125), spearman: of(|s| s.spearman) };
        (!all.is_empty()).then(mean)
    }
}

/// Disparities of a map and of the truth, where the truth is above [`FAR`].
fn known(map: &DisparityMap, truth: &DisparityMap) -> Vec<(f64, f64)> {
    let both = map.delta.iter().zip(&truth.delta).map(|(m, t)| (f64::from(*m), f64::from(*t)));
    both.filter(|(_, t)| *t > FAR).collect()
}

/// Least-squares fit of an estimate to the truth: `scale · δ + shift`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Fit {
    pub scale: f64,
    pub shift: f64,
}

impl Fit {
    /// Fits `map` to `truth` of the same size.
    pub fn new(map: &DisparityMap, truth: &DisparityMap) -> Self {
        Self::of(&known(map, truth))
    }

    fn of(both: &[(f64, f64)]) -> Self {
        let n = both.len().max(1) as f64;
        let (mm, mt) = (both.iter().map(|b| b.0).sum::<f64>() / n, both.iter().map(|b| b.1).sum::<f64>() / n);
        let (mut xx, mut xy) = (0.0, 0.0);
        for (m, t) in both {
            xx += (m - mm) * (m - mm);
            xy += (m - mm) * (t - mt);
        }
        let scale = if xx > 0.0 { xy / xx } else { 0.0 };
        Self { scale, shift: mt - scale * mm }
    }
}

/// Rank of each value; equal values share the mean of their ranks.
fn ranks(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let values: Vec<f64> = values.collect();
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|&a, &b| values[a].total_cmp(&values[b]));
    let mut ranks = vec![0.0; values.len()];
    let mut first = 0;
    for run in order.chunk_by(|&a, &b| values[a].total_cmp(&values[b]).is_eq()) {
        for &i in run {
            ranks[i] = first as f64 + (run.len() - 1) as f64 / 2.0;
        }
        first += run.len();
    }
    ranks
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len().max(1) as f64;
    let (ma, mb) = (a.iter().sum::<f64>() / n, b.iter().sum::<f64>() / n);
    let (mut aa, mut ab, mut bb) = (0.0, 0.0, 0.0);
    for (a, b) in a.iter().zip(b) {
        aa += (a - ma) * (a - ma);
        ab += (a - ma) * (b - mb);
        bb += (b - mb) * (b - mb);
    }
    if aa > 0.0 && bb > 0.0 { ab / (aa * bb).sqrt() } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(delta: Vec<f32>) -> DisparityMap {
        DisparityMap { width: delta.len() as u32, height: 1, delta }
    }

    #[test]
    fn scale_and_shift_do_not_count() {
        let truth = map((1..=50).map(|i| i as f32 / 50.0).collect());
        let s = DepthScore::new(&map(truth.delta.iter().map(|d| 0.3 + 0.4 * d).collect()), &truth);
        assert!(s.rmse < 1e-6 && s.abs_rel < 1e-5 && (s.within_125 - 1.0).abs() < 1e-12 && (s.spearman - 1.0).abs() < 1e-12, "{s:?}");
        // a map that says nothing is the mean
        let s = DepthScore::new(&map(vec![0.5; 50]), &truth);
        assert!((s.rmse - 1.0).abs() < 1e-9 && s.spearman == 0.0, "{s:?}");
        let s = DepthScore::new(&map(truth.delta.iter().map(|d| 1.0 - d).collect()), &truth);
        assert!((s.spearman + 1.0).abs() < 1e-12, "near for far is told: {s:?}");
    }

    #[test]
    fn equal_values_share_a_rank() {
        assert_eq!(ranks([3.0, 1.0, 3.0, 0.0].into_iter()), [2.5, 1.0, 2.5, 0.0]);
    }

    #[test]
    fn what_the_photo_does_not_show_and_the_rim_are_not_scored() {
        let (w, h) = (20, 20);
        // nothing is known right of column 12 of the lower half, and in a hole in the middle of the upper half
        let covered: Vec<bool> = (0..w * h).map(|i| !(i % w > 12 && i / w >= 10 || i % w == 8 && i / w == 6)).collect();
        let depth: Vec<f64> = covered.iter().map(|c| if *c { 0.5 } else { f64::NEG_INFINITY }).collect();
        let mask = Mask::new(w, &depth);
        let inside = |x: usize, y: usize| mask.inside[y * w + x];
        assert!(inside(3, 3) && inside(16, 3) && inside(12, 15) && inside(8, 6), "a hole is to be filled");
        assert!(!inside(2, 5) && !inside(17, 5) && !inside(5, 17) && !inside(13, 15));
        let truth = vec![[100u8; 3]; w * h];
        let mut view = truth.clone();
        view[15 * w + 15] = [0; 3];
        view[0] = [0; 3];
        let same = mask.score(&view, &truth);
        assert!((same.psnr - metrics::MAX_PSNR).abs() < 1e-12 && same.l1 == 0.0);
        view[5 * w + 5] = [151; 3];
        let n = mask.inside.iter().filter(|b| **b).count() as f64;
        let other = mask.score(&view, &truth);
        assert!((other.l1 - 0.2 / n).abs() < 1e-12 && (other.psnr + 10.0 * (0.04 / n).log10()).abs() < 1e-9, "{other:?}");
        assert!((mask.share(|i| i == 5 * w + 5 || i == 0) - 1.0 / n).abs() < 1e-12);
    }
}
