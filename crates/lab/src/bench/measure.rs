//! Runs settings on all subjects, in turns, and collects times of all runs and errors of the first.

use std::borrow::Cow;
use std::sync::Arc;

use rayon::prelude::*;

use super::figures::Figures;
use super::subject::Subject;
use crate::LabError;
use crate::metrics::{self, ssim_map};
use crate::oracle_depth::oracle;
use tmpi_core::{DisparityMap, Photo, Pose, Scene, container};
use tmpi_pipeline::depth::Estimator;
use tmpi_pipeline::networks::{self, Network};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::usage::Clock;
use tmpi_pipeline::{self, Made, Models, Options, Silent};
use tmpi_render::{Cpu, Renderer, View};

/// Stages excluded from the processing time: no option changes them, or they only measure.
const APART: [&str; 3] = ["photo", "depth", "verify"];
/// What takes more milliseconds runs twice at most.
const SLOW_MS: f64 = 1000.0;
/// Figure of how much a photo loses when it is made smaller.
pub(super) const REDUCED: &str = "photo after reduction and enlargement, dB";

/// Networks and repeats for all settings.
#[derive(Clone, Copy)]
pub(super) struct Bench<'a> {
    pub models: &'a Models,
    pub repeats: usize,
}

/// Source of the disparity, options, and the level of the container to measure: `1 / 2^level` of its size.
pub(super) type Setting<'a> = (&'a Depth, &'a Options, u8);

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

    /// Runs each setting on all subjects, in turns, as often as configured.
    pub fn figures(&self, subjects: &[Subject], settings: &[Setting]) -> Result<Vec<Figures>, LabError> {
        let (mut all, count) = (vec![Figures::default(); settings.len()], subjects.len());
        in_turns(settings.len() * count, self.repeats, |i, round| {
            let (f, s, setting) = (&mut all[i / count], &subjects[i % count], &settings[i / count]);
            let clock = Clock::start();
            let made = self.make(s, setting.0, setting.1)?;
            let ms = clock.ms();
            add_times(f, i % count, &made);
            if round == 0 {
                add_errors(f, s, &made, setting)?;
            }
            Ok(ms)
        })?;
        Ok(all)
    }

    /// Processes a subject as often as configured, one run after the other.
    pub fn runs(&self, s: &Subject, depth: &Depth, options: &Options) -> Result<Vec<Made>, LabError> {
        (0..self.repeats).map(|_| self.make(s, depth, options)).collect()
    }

    pub fn make(&self, s: &Subject, depth: &Depth, options: &Options) -> Result<Made, LabError> {
        let options = Options { fov_x: options.fov_x.or(s.fov_x), ..options.clone() };
        let mut models = self.models.clone();
        let map = match (depth, &s.disparity) {
            (Depth::Known, _) => s.map.as_deref().map(Cow::Borrowed),
            (Depth::Given(how), Some(d)) => Some(Cow::Owned(tmpi_pipeline::depth::to_png(&how(d))?)),
            (Depth::By(network), _) => {
                models.depth = Arc::clone(network);
                None
            }
            (Depth::Degraded(how), Some(d)) => {
                models.depth = Arc::new(oracle(how(d)));
                None
            }
            _ => None,
        };
        let made = tmpi_pipeline::make(&models, &Limits::default(), &s.file, map.as_deref(), &options, &Silent);
        made.map_err(|source| LabError::Make { subject: s.name.clone(), source })
    }
}

/// Calls `run` for each of `count` things with its number and that of the run, `repeats` times in turns, so that what slows the machine
/// down for a while slows all of them. `run` returns its milliseconds: a thing whose first run takes more than [`SLOW_MS`] runs twice at
/// most.
pub(super) fn in_turns(count: usize, repeats: usize, mut run: impl FnMut(usize, usize) -> Result<f64, LabError>) -> Result<(), LabError> {
    let mut first = vec![0.0; count];
    for round in 0..repeats {
        for (i, first) in first.iter_mut().enumerate() {
            if round < 2 || *first <= SLOW_MS {
                let ms = run(i, round)?;
                if round == 0 {
                    *first = ms;
                }
            }
        }
    }
    Ok(())
}

fn add_times(f: &mut Figures, subject: usize, made: &Made) {
    let mut add = |name: &str, included: &dyn Fn(&str) -> bool, cpu: bool| {
        let stages = made.report.stages.iter().filter(|s| included(&s.name));
        f.add_run(name, subject, stages.map(|s| if cpu { s.cpu_ms } else { s.ms }).sum());
    };
    add("processing, ms", &|n| !APART.contains(&n), false);
    add("processing, CPU ms", &|n| !APART.contains(&n), true);
    add("planes, CPU ms", &|n| n == "planes", true);
    add("depth, ms", &|n| n == "depth", false);
    add("verifying, ms", &|n| n == "verify", false);
}

fn add_errors(f: &mut Figures, s: &Subject, made: &Made, &(_, options, level): &Setting) -> Result<(), LabError> {
    let (r, e) = (&made.report, &made.report.error);
    let file = container::level(&made.container, level)?;
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
    if let Some(psnr) = e.reduction.and_then(|r| r.psnr) {
        f.add(REDUCED, psnr);
    }
    let scene = Arc::new(container::decode(&file)?);
    let held = scene.texels.class.iter().filter(|c| **c != 0).count() as f64;
    f.add("texels per pixel", held / (f64::from(r.width) * f64::from(r.height)));
    // a reduced map has no pixels to compare
    if let Some(truth) = s.disparity.as_deref().filter(|t| (t.width, t.height) == (r.width, r.height)) {
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
    fn things_run_in_turns_and_slow_ones_twice() {
        let mut runs = Vec::new();
        let done = in_turns(3, 3, |i, round| {
            runs.push((i, round));
            Ok(if i == 1 { 2.0 * SLOW_MS } else { 1.0 })
        });
        assert!(done.is_ok());
        assert_eq!(runs, [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (0, 2), (2, 2)]);
        let failing = in_turns(2, 3, |i, _| if i == 0 { Ok(1.0) } else { Err(LabError::Encode("fails".into())) });
        assert!(failing.is_err());
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
