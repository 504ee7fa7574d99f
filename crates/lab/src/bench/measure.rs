//! Runs a setting on all subjects and collects medians of time and means of error.

use std::sync::Arc;

use rayon::prelude::*;

use super::figures::{Figures, median};
use super::subject::Subject;
use crate::LabError;
use crate::metrics::{self, ssim_map};
use crate::oracle_depth::OracleDepth;
use tmpi_core::container;
use tmpi_core::{DisparityMap, Photo, Pose, Scene};
use tmpi_pipeline::Silent;
use tmpi_pipeline::depth::Estimator;
use tmpi_pipeline::networks::{self, Network};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{self, Made, Models, Options};
use tmpi_render::{Cpu, Renderer, View};

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

impl Bench<'_> {
    /// Ψ, if it is available and ONNX Runtime can run it.
    pub fn psi(&self) -> Option<&dyn Network> {
        self.models.psi.as_deref().filter(|_| networks::available().is_ok()).map(|psi| psi as &dyn Network)
    }

    /// Runs a setting on all subjects, and measures the container at `1 / 2^level` of its size.
    pub fn figures(&self, subjects: &[Subject], depth: &Depth, options: &Options, level: u8) -> Result<Figures, LabError> {
        let mut figures = Figures::default();
        for s in subjects {
            self.add_figures(&mut figures, s, (depth, options, level))?;
        }
        Ok(figures)
    }

    /// Processes a subject as often as configured.
    pub fn runs(&self, s: &Subject, depth: &Depth, options: &Options) -> Result<Vec<Made>, LabError> {
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
        let file = map.map(|d| tmpi_pipeline::depth::to_png(&d)).transpose()?;
        let mut runs: Vec<Made> = Vec::with_capacity(self.repeats);
        for _ in 0..self.repeats {
            let made = tmpi_pipeline::make(&models, &Limits::default(), &s.file, file.as_deref(), &options, &Silent);
            runs.push(made.map_err(|source| LabError::Make { subject: s.name.clone(), source })?);
        }
        Ok(runs)
    }

    fn add_figures(&self, f: &mut Figures, s: &Subject, (depth, options, level): (&Depth, &Options, u8)) -> Result<(), LabError> {
        let runs = self.runs(s, depth, options)?;
        let stages = |included: &dyn Fn(&str) -> bool, cpu: bool| {
            let of = |r: &Made| r.report.stages.iter().filter(|s| included(&s.name)).map(|s| if cpu { s.cpu_ms } else { s.ms }).sum();
            median(runs.iter().map(of).collect())
        };
        let Some(made) = runs.last() else { return Ok(()) };
        let (r, e) = (&made.report, &made.report.error);
        let file = container::level(&made.container, level)?;
        f.add("processing, ms", stages(&|n| !APART.contains(&n), false));
        f.add("processing, CPU ms", stages(&|n| !APART.contains(&n), true));
        f.add("planes, CPU ms", stages(&|n| n == "planes", true));
        f.add("depth, ms", stages(&|n| n == "depth", false));
        f.add("verifying, ms", stages(&|n| n == "verify", false));
        f.add("planes per tile", r.planes_per_tile);
        f.add("container, KB", file.len() as f64 / 1000.0);
        f.add("depth MAE, 1e-3", e.depth_mae * 1e3);
        f.add("depth MSE, 1e-3", e.depth_mse * 1e3);
        f.add("depth Q25, 1e-3", e.depth_q25 * 1e3);
        f.add("identity, dB", e.identity_psnr);
        f.add("view box, ±", options.view_box.x);
        f.add("parallax error, px", e.planes.mean_px);
        if e.planes.bound_px.is_some() {
            f.add("tiles over the bound, %", 100.0 * e.planes.missed_tiles as f64 / r.tiles.max(1) as f64);
        }
        if let Some(p) = e.prune {
            f.add("largest difference, levels", p.max_abs.into());
            f.add("wrongly pruned, % of pixels", p.share_off * 100.0);
        }
        let scene = Arc::new(container::decode(&file)?);
        let held = scene.texels.class.iter().filter(|c| **c != 0).count() as f64;
        f.add("texels per pixel", held / (f64::from(r.width) * f64::from(r.height)));
        if let Some(truth) = &s.disparity {
            f.add("disparity error, 1e-3", 1e3 * aligned_error(&made.disparity, truth));
        }
        if !s.views.is_empty() {
            let scores = views(s, &scene)?;
            let mean = |i: usize| scores.iter().map(|v| v[i]).sum::<f64>() / scores.len() as f64;
            f.add("view, dB", mean(0));
            f.add("view SSIM", mean(1));
            f.add("view L1", mean(2));
            let ahead = s.views.iter().position(|(camera, _)| camera.pose == Pose::at(0.0, 0.0, camera.pose.tz));
            if let Some(i) = ahead {
                f.add("view from ahead, dB", scores[i][0]);
            }
        }
        Ok(())
    }
}

/// PSNR, SSIM and L1 of each exact view.
fn views(s: &Subject, scene: &Arc<Scene>) -> Result<Vec<[f64; 3]>, LabError> {
    let cpu = Cpu::default();
    let drawn = s.views.iter().map(|(camera, _)| cpu.render(scene, camera)).collect::<Result<Vec<_>, _>>()?;
    Ok(drawn.par_iter().zip(&s.views).map(|(view, (_, want))| score(view, want)).collect())
}

/// PSNR, SSIM and L1 of a view over black.
pub(super) fn score(view: &View, want: &Photo) -> [f64; 3] {
    compared(&view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect::<Vec<_>>(), want)
}

/// PSNR, SSIM and L1 (of values from 0 to 1), without [`metrics::CROP`] on each side.
pub(crate) fn compared(got: &[[u8; 3]], want: &Photo) -> [f64; 3] {
    let width = want.width as usize;
    let ssim = metrics::cropped(&ssim_map(got, &want.rgb, width), width);
    let (a, b) = (metrics::cropped(got, width), metrics::cropped(&want.rgb, width));
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
