//! Runs a setting on all subjects and collects medians of time and means of error.

use std::sync::Arc;

use rayon::prelude::*;

use super::subject::Subject;
use super::{BenchError, Point};
use crate::metrics::{self, ssim_map};
use crate::oracle_depth::OracleDepth;
use tmpi_core::container;
use tmpi_core::{DisparityMap, Photo, Scene};
use tmpi_pipeline::Silent;
use tmpi_pipeline::depth::Estimator;
use tmpi_pipeline::networks::{self, Network};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{self, Made, Models, Options};
use tmpi_render::{Cpu, Renderer, View};

/// Fraction of a view that is cropped on each side, as in the paper.
const CROP: f64 = 0.15;
/// Stages excluded from the processing time: no option changes them, or they only measure.
const APART: [&str; 3] = ["photo", "depth", "verify"];

/// Networks and repeats for all settings.
pub(super) struct Bench<'a> {
    pub models: &'a Models,
    pub repeats: usize,
}

/// Source of a setting's disparity.
#[derive(Clone)]
pub(super) enum Depth {
    /// The known disparity, otherwise the network's.
    Known,
    /// Always the network's estimate.
    Estimated,
    /// Always this network's estimate.
    By(Arc<dyn Estimator>),
    /// The known disparity, degraded, treated as an estimate.
    Degraded(fn(&DisparityMap) -> DisparityMap),
    /// The known disparity, degraded, provided as a file.
    Given(fn(&DisparityMap) -> DisparityMap),
}

/// Median; 0 if there are no values.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    match n {
        0 => 0.0,
        _ if n % 2 == 1 => values[n / 2],
        _ => f64::midpoint(values[n / 2 - 1], values[n / 2]),
    }
}

/// Values of all subjects by figure name.
#[derive(Default)]
pub(super) struct Figures(Vec<(&'static str, Vec<f64>)>);

impl Figures {
    pub fn add(&mut self, name: &'static str, value: f64) {
        match self.0.iter_mut().find(|(n, _)| *n == name) {
            Some((_, all)) => all.push(value),
            None => self.0.push((name, vec![value])),
        }
    }

    /// Mean and standard deviation; NaN for an unknown figure.
    fn of(&self, name: &str) -> [f64; 2] {
        let Some((_, all)) = self.0.iter().find(|f| f.0 == name) else { return [f64::NAN; 2] };
        let n = all.len() as f64;
        let mean = all.iter().sum::<f64>() / n;
        [mean, (all.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt()]
    }

    /// The means, with two of them as the place of a point, and the spread of the second.
    pub fn point(&self, setting: String, axes: (&str, &str)) -> Point {
        let ([x, _], [y, spread]) = (self.of(axes.0), self.of(axes.1));
        let figures = self.0.iter().map(|(name, _)| (*name, self.of(name)[0])).collect();
        Point { setting, x, y, spread, figures, ..Point::default() }
    }
}

impl Bench<'_> {
    /// Ψ, if it is available and ONNX Runtime can run it.
    pub fn psi(&self) -> Option<&dyn Network> {
        self.models.psi.as_deref().filter(|_| networks::available().is_ok()).map(|psi| psi as &dyn Network)
    }

    /// Runs a setting on all subjects. `axes` names the figures for x and y.
    pub fn point(
        &self,
        subjects: &[Subject],
        depth: &Depth,
        options: &Options,
        setting: String,
        axes: (&str, &str),
    ) -> Result<Point, BenchError> {
        self.point_of_level(subjects, depth, options, 0, setting, axes)
    }

    /// The same for the container at `1 / 2^level` of its size.
    pub fn point_of_level(
        &self,
        subjects: &[Subject],
        depth: &Depth,
        options: &Options,
        level: u8,
        setting: String,
        axes: (&str, &str),
    ) -> Result<Point, BenchError> {
        let mut figures = Figures::default();
        for s in subjects {
            for (name, value) in self.figures(s, depth, options, level)? {
                figures.add(name, value);
            }
        }
        Ok(figures.point(setting, axes))
    }

    /// Processes a subject as often as configured.
    pub fn runs(&self, s: &Subject, depth: &Depth, options: &Options) -> Result<Vec<Made>, BenchError> {
        let options = Options { fov_x: options.fov_x.or(s.fov_x), ..options.clone() };
        let mut models = self.models.clone();
        let map = match (depth, &s.disparity) {
            (Depth::Known, Some(d)) => Some(d.clone()),
            (Depth::Given(how), Some(d)) => Some(Arc::new(how(d))),
            (Depth::By(network), _) => {
                models.depth = Arc::clone(network);
                None
            }
            (Depth::Degraded(how), Some(d)) => {
                models.depth = Arc::new(OracleDepth(how(d)));
                None
            }
            _ => None,
        };
        let file = map.map(|d| tmpi_pipeline::depth::to_png(&d)).transpose().map_err(|e| BenchError::Picture(e.to_string()))?;
        let mut runs: Vec<Made> = Vec::with_capacity(self.repeats);
        for _ in 0..self.repeats {
            let made = tmpi_pipeline::make(&models, &Limits::default(), &s.file, file.as_deref(), &options, &Silent);
            runs.push(made.map_err(|source| BenchError::Make { subject: s.name.clone(), source })?);
        }
        Ok(runs)
    }

    fn figures(&self, s: &Subject, depth: &Depth, options: &Options, level: u8) -> Result<Vec<(&'static str, f64)>, BenchError> {
        let runs = self.runs(s, depth, options)?;
        let over = |f: &dyn Fn(&tmpi_pipeline::Report) -> f64| median(runs.iter().map(|m| f(&m.report)).collect());
        let stages = |included: &dyn Fn(&str) -> bool, cpu: bool| {
            over(&|r| r.stages.iter().filter(|s| included(&s.name)).map(|s| if cpu { s.cpu_ms } else { s.ms }).sum())
        };
        let Some(made) = runs.last() else { return Ok(Vec::new()) };
        let r = &made.report;
        let file = container::level(&made.container, level)?;
        let mut all = vec![
            ("processing, ms", stages(&|n| !APART.contains(&n), false)),
            ("processing, CPU ms", stages(&|n| !APART.contains(&n), true)),
            ("planes, CPU ms", stages(&|n| n == "planes", true)),
            ("depth, ms", stages(&|n| n == "depth", false)),
            ("planes per tile", r.planes_per_tile),
            ("container, KB", file.len() as f64 / 1000.0),
            ("depth MAE, 1e-3", r.error.depth_mae * 1e3),
            ("depth MSE, 1e-3", r.error.depth_mse * 1e3),
            ("depth Q25, 1e-3", r.error.depth_q25 * 1e3),
            ("identity, dB", r.error.identity_psnr),
        ];
        all.push(("view box, ±", options.view_box.x));
        all.extend(
            r.error
                .planes
                .bound_px
                .map(|_| ("tiles over the bound, %", 100.0 * r.error.planes.missed_tiles as f64 / r.tiles.max(1) as f64)),
        );
        if let Some(p) = r.error.prune {
            all.push(("largest difference, levels", p.max_abs.into()));
            all.push(("wrongly pruned, % of pixels", p.share_off * 100.0));
        }
        all.push(("verifying, ms", stages(&|n| n == "verify", false)));
        let scene = Arc::new(container::decode(&file)?);
        let held = scene.texels.class.iter().filter(|c| **c != 0).count() as f64;
        all.push(("texels per pixel", held / (f64::from(r.width) * f64::from(r.height))));
        all.push(("parallax error, px", r.error.planes.mean_px));
        if let Some(truth) = &s.disparity {
            all.push(("disparity error, 1e-3", 1e3 * aligned_error(&made.disparity, truth)));
        }
        if !s.views.is_empty() {
            let [psnr, ssim, l1] = views(s, &scene)?;
            all.extend([("view, dB", psnr), ("view SSIM", ssim), ("view L1", l1)]);
        }
        Ok(all)
    }
}

/// Mean PSNR, SSIM and L1 of all exact views.
fn views(s: &Subject, scene: &Arc<Scene>) -> Result<[f64; 3], BenchError> {
    let cpu = Cpu::default();
    let drawn = s.views.iter().map(|(camera, _)| cpu.render(scene, camera)).collect::<Result<Vec<_>, _>>()?;
    let scores: Vec<[f64; 3]> = drawn.par_iter().zip(&s.views).map(|(view, (_, want))| score(view, want)).collect();
    Ok(std::array::from_fn(|i| scores.iter().map(|v| v[i]).sum::<f64>() / scores.len().max(1) as f64))
}

/// PSNR, SSIM and L1 of a view over black.
fn score(view: &View, want: &Photo) -> [f64; 3] {
    compared(&view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect::<Vec<_>>(), want)
}

/// PSNR, SSIM and L1 (of values from 0 to 1), without [`CROP`] on each side.
pub(super) fn compared(got: &[[u8; 3]], want: &Photo) -> [f64; 3] {
    let (w, h) = (want.width as usize, want.height as usize);
    let (x, y) = ((w as f64 * CROP) as usize, (h as f64 * CROP) as usize);
    let cut = |p: &[[u8; 3]]| -> Vec<[u8; 3]> { p.chunks(w).skip(y).take(h - 2 * y).flat_map(|row| row[x..w - x].to_vec()).collect() };
    let map = ssim_map(got, &want.rgb, w);
    let ssim: Vec<f32> = map.chunks(w).skip(y).take(h - 2 * y).flat_map(|row| row[x..w - x].to_vec()).collect();
    let (a, b) = (cut(got), cut(&want.rgb));
    let l1 = a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / (a.len() * 3).max(1) as f64;
    [
        metrics::psnr(a.as_flattened(), b.as_flattened()),
        ssim.iter().map(|&v| f64::from(v)).sum::<f64>() / ssim.len().max(1) as f64,
        l1 / 255.0,
    ]
}

/// Mean absolute difference after alignment of scale and shift, which monocular disparity lacks.
fn aligned_error(got: &DisparityMap, want: &DisparityMap) -> f64 {
    let n = got.delta.len().min(want.delta.len()).max(1) as f64;
    let mean = |f: &dyn Fn(f64, f64) -> f64| got.delta.iter().zip(&want.delta).map(|(g, w)| f((*g).into(), (*w).into())).sum::<f64>() / n;
    let (mg, mw) = (mean(&|g, _| g), mean(&|_, w| w));
    let (var, cov) = (mean(&|g, _| (g - mg).powi(2)), mean(&|g, w| (g - mg) * (w - mw)));
    let scale = if var > 0.0 { cov / var } else { 0.0 };
    mean(&|g, w| (mw + scale * (g - mg) - w).abs())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_of_odd_even_and_empty_lists() {
        assert!((median(vec![3.0, 1.0, 9.0]) - 3.0).abs() < 1e-12);
        assert!((median(vec![4.0, 1.0, 9.0, 2.0]) - 3.0).abs() < 1e-12);
        assert!(median(Vec::new()).abs() < 1e-12);
    }

    #[test]
    fn scale_and_shift_of_disparity_do_not_count() {
        let map = |f: &dyn Fn(f32) -> f32| DisparityMap { width: 10, height: 1, delta: (0..10).map(|i| f(i as f32)).collect() };
        assert!(aligned_error(&map(&|i| i * 0.01 + 0.3), &map(&|i| i * 0.1)) < 1e-6);
        assert!(aligned_error(&map(&|_| 0.5), &map(&|i| i * 0.1)) > 0.2);
    }

    #[test]
    fn equal_views_score_best() {
        let photo = Photo { width: 20, height: 20, rgb: (0..400).map(|i: u32| [(i % 256) as u8, (i / 3) as u8, 90]).collect() };
        let [psnr, ssim, l1] = score(&View::from(&photo), &photo);
        assert!((psnr - metrics::MAX_PSNR).abs() < 1e-9 && (ssim - 1.0).abs() < 1e-5 && l1.abs() < 1e-12);
    }
}
