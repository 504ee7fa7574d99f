//! Measures error against run time for each approximation, on rendered scenes with exact second views and on photos.
//!
//! For rendered scenes, the error is that of whole views (PSNR, SSIM, L1 over the view without 15 % on each side). Photos have no second
//! view; their error is that of the planes against the disparity that they were fitted to, in pixels of parallax over the view box. A point
//! is the mean over all subjects, with the standard deviation.

mod ablation;
mod costs;
mod depth_settings;
mod discretisation;
mod experiments;
mod figures;
mod log;
mod machine;
mod measure;
mod page;
mod photo_size;
mod plot;
mod report_cost;
mod snapping;
mod subject;
mod tile_sizes;

use std::borrow::Cow;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub(crate) use figures::Figures;
use log::Log;
pub use machine::Machine;
pub(crate) use measure::compared;
pub use page::html;
use tmpi_pipeline::run::time_budget::Costs;
use tmpi_pipeline::{MakeError, Models};

/// Settings of a benchmark.
#[derive(Clone)]
pub struct Settings {
    /// Uses fewer scenes, fewer repeats and smaller pictures; takes minutes.
    pub quick: bool,
    /// Folders of photos to measure in addition to rendered scenes.
    pub photos: Vec<PathBuf>,
    /// Experiments to run, from [`EXPERIMENTS`]; empty: all.
    pub only: Vec<String>,
    /// Folder for `index.html`, `results.json` and `costs.json`.
    pub output: PathBuf,
    /// Keeps the experiments of the folder's `results.json`, and runs only the others.
    pub resume: bool,
    /// The networks.
    pub models: Models,
    /// Settings that the networks were loaded with; an experiment varies those of the depth network.
    pub networks: tmpi_pipeline::networks::models::Settings,
}

/// Short names of the experiments.
pub const EXPERIMENTS: [&str; 22] = [
    "scaling",
    "efficiency",
    "max-error",
    "planes",
    "tiles",
    "quality",
    "prune",
    "view-box",
    "size",
    "levels",
    "denoise",
    "depth",
    "depth-smoothing",
    "depth-ramp",
    "depth-mirror",
    "ramps",
    "without",
    "labels",
    "photos",
    "discretisation",
    "budget",
    "measuring",
];

/// A measured setting: means over all subjects.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Point {
    /// The setting, as on the command line.
    pub setting: String,
    /// Position on the horizontal axis.
    pub x: f64,
    /// Position on the vertical axis.
    pub y: f64,
    /// Standard deviation of `y` over the subjects; 0 for a single subject.
    pub spread: f64,
    /// Whether this is the default setting.
    pub default: bool,
    /// Whether no other point of the experiment is better on both axes.
    pub pareto: bool,
    /// All measured values, by name.
    pub figures: Vec<(String, f64)>,
}

/// Settings that differ in one number.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Curve {
    /// Name in the legend.
    pub name: String,
    /// Points in the order of that number.
    pub points: Vec<Point>,
}

/// Axis of a plot.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Axis {
    /// Name and unit.
    pub label: Cow<'static, str>,
    /// Whether the axis is logarithmic.
    pub log: bool,
    /// Whether more is better; `None` if neither direction is.
    pub up: Option<bool>,
}

impl Axis {
    pub(crate) const fn new(label: &'static str, log: bool, up: Option<bool>) -> Self {
        Self { label: Cow::Borrowed(label), log, up }
    }
}

/// Figures with names of their own.
fn figures<const N: usize>(all: [(&str, f64); N]) -> Vec<(String, f64)> {
    all.map(|(name, value)| (name.to_owned(), value)).into()
}

/// Curves on common axes.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Experiment {
    /// Short name.
    pub id: String,
    /// Heading.
    pub title: String,
    /// Description.
    pub about: String,
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// Curves.
    pub curves: Vec<Curve>,
}

/// Results of a benchmark.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Results {
    /// Version of the program.
    pub version: String,
    /// The machine.
    pub machine: Machine,
    /// Names of the measured scenes and photos.
    pub subjects: Vec<String>,
    /// Number of runs; times are medians.
    pub repeats: usize,
    /// The experiments.
    pub experiments: Vec<Experiment>,
    /// Costs of this machine for `--budget-ms`, if they were measured.
    pub costs: Option<Costs>,
    /// Skipped experiments, each with the reason.
    pub skipped: Vec<String>,
    /// Total time in seconds.
    pub seconds: f64,
}

/// Why a benchmark failed.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// A photo could not be processed.
    #[error("cannot process {subject}")]
    Make {
        /// Scene or photo.
        subject: String,
        /// The error.
        source: MakeError,
    },
    /// A view could not be rendered.
    #[error(transparent)]
    Render(#[from] tmpi_render::RenderError),
    /// A container could not be decoded.
    #[error(transparent)]
    Atlas(#[from] tmpi_core::container::ContainerError),
    /// A scene could not be encoded as a picture.
    #[error("cannot write a scene: {0}")]
    Picture(String),
    /// A folder or a file cannot be used.
    #[error("{path}: {reason}")]
    File {
        /// The path.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
}

/// Runs the experiments, and writes the results to the folder after each; calls `progress` with the name of each.
///
/// # Errors
/// [`BenchError`].
pub fn run(settings: &Settings, progress: &dyn Fn(&str)) -> Result<Results, BenchError> {
    let mut log = Log::new(settings, progress)?;
    let (quick, repeats) = (settings.quick, log.results.repeats);
    if log.starts("scaling") {
        match photo_size::run(quick) {
            Ok(both) => both.into_iter().try_for_each(|e| log.add(e))?,
            Err(reason) => log.skip(format!("scaling: {reason}")),
        }
    }
    if log.starts("efficiency") {
        match tile_sizes::table(repeats) {
            Ok(experiment) => log.add(experiment)?,
            Err(reason) => log.skip(format!("efficiency: {reason}")),
        }
    }
    progress("rendering scenes");
    let scenes = subject::rendered(quick)?;
    let photos = subject::photos(&settings.photos, quick)?;
    log.results.subjects = scenes.iter().chain(&photos).map(|s| s.name.clone()).collect();
    let bench = measure::Bench { models: &settings.models, repeats };
    let known = photos.iter().any(|p| p.disparity.is_some());
    let measured = if known { &photos } else { &scenes };
    experiments::on_scenes(&bench, &scenes, &mut log)?;
    depth_settings::run(&bench, measured, &mut log)?;
    if log.starts("ramps") {
        log.add(snapping::run(&bench, &scenes)?)?;
    }
    if log.starts("without") {
        log.add(ablation::steps(&bench, &scenes)?)?;
    }
    if log.starts("labels") {
        log.add(ablation::labels(&scenes, quick)?)?;
    }
    if !photos.is_empty() {
        experiments::on_photos(&bench, &photos, &mut log)?;
    }
    if log.starts("discretisation") {
        log.add(discretisation::run(&bench, measured)?)?;
    }
    if log.starts("budget") {
        log.results.costs = Some(costs::fitted(&bench, &scenes)?);
        log.add(costs::kept(&bench, &scenes)?)?;
    }
    if log.starts("measuring") {
        log.add(report_cost::run(&bench, &scenes, quick)?)?;
    }
    log.write()?;
    Ok(log.results)
}

impl Experiment {
    /// Marks the Pareto-optimal points, among those that can be compared.
    pub(crate) fn mark(&mut self) {
        let (Some(x_up), Some(y_up)) = (self.x.up, self.y.up) else { return };
        let score = |p: &Point| (if x_up { p.x } else { -p.x }, if y_up { p.y } else { -p.y });
        // curves that each have a default are of different things, whose points cannot be compared
        let apart = self.curves.iter().filter(|c| c.points.iter().any(|p| p.default)).count() > 1;
        let all: Vec<(f64, f64)> = self.curves.iter().flat_map(|c| &c.points).map(score).collect();
        for c in &mut self.curves {
            let own: Vec<(f64, f64)> = c.points.iter().map(score).collect();
            let others = if apart { &own } else { &all };
            for p in &mut c.points {
                let (x, y) = score(p);
                p.pareto = !others.iter().any(|&(a, b)| a >= x && b >= y && (a > x || b > y));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn experiment(points: &[(f64, f64)]) -> Experiment {
        let points = points.iter().map(|&(x, y)| Point { x, y, setting: format!("{x}"), ..Point::default() }).collect();
        Experiment {
            id: "e".into(),
            title: "E".into(),
            about: "about <it>".into(),
            x: Axis::new("ms", true, Some(false)),
            y: Axis::new("dB", false, Some(true)),
            curves: vec![Curve { name: "c, \"d\"".into(), points }],
        }
    }

    #[test]
    fn pareto_points_are_marked() {
        let mut e = experiment(&[(1.0, 10.0), (2.0, 20.0), (3.0, 15.0), (2.0, 19.0), (1.0, 10.0)]);
        e.mark();
        assert_eq!(e.curves[0].points.iter().map(|p| p.pareto).collect::<Vec<_>>(), [true, true, false, false, true]);
        // points of curves of different things are not compared
        let [mut worse, mut better] = [&[(9.0, 1.0)], &[(1.0, 9.0)]].map(|points| experiment(points).curves.remove(0));
        (worse.points[0].default, better.points[0].default) = (true, true);
        let mut e = Experiment { curves: vec![worse, better], ..e };
        e.mark();
        assert!(e.curves.iter().all(|c| c.points[0].pareto));
    }
}
