//! Measures error against run time for each approximation, on rendered scenes with exact second views and on photos.
//!
//! For rendered scenes, the error is that of whole views (PSNR, SSIM, L1 over the view without 15 % on each side). Photos have no second
//! view; their error is that of the planes against the disparity that they were fitted to, in pixels of parallax over the view box. A point
//! is the mean over all subjects, with the standard deviation.

mod ablation;
mod costs;
mod depth_settings;
mod discretisation;
mod drawing;
mod experiments;
mod machine;
mod measure;
mod mesh;
mod page;
mod photo_size;
mod plot;
mod report_cost;
mod scene_families;
pub mod serve;
mod snapping;
mod subject;
mod tile_sizes;
mod verdicts;

use std::fmt::Write;
use std::path::PathBuf;

use serde::Serialize;

pub use machine::Machine;
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
    /// The networks.
    pub models: Models,
    /// Settings that the networks were loaded with; an experiment varies those of the depth network.
    pub networks: tmpi_pipeline::networks::models::Settings,
}

/// Short names of the experiments. `live-budget` is [`crate::live::budget`]'s.
pub const EXPERIMENTS: [&str; 30] = [
    "scaling",
    "efficiency",
    "clustering",
    "max-error",
    "planes",
    "tiles",
    "steps",
    "ramps",
    "quality",
    "prune",
    "view-box",
    "size",
    "levels",
    "denoise",
    "depth",
    "depth-pixels",
    "depth-smoothing",
    "depth-ramp",
    "depth-mirror",
    "without",
    "labels",
    "moves",
    "photos",
    "mesh",
    "discretisation",
    "families",
    "drawing",
    "budget",
    "measuring",
    "live-budget",
];

impl Settings {
    /// Whether an experiment is asked for.
    #[must_use]
    pub fn wants(&self, experiment: &str) -> bool {
        self.only.is_empty() || self.only.iter().any(|o| o == experiment)
    }
}

/// A measured setting: means over all subjects.
#[derive(Clone, Debug, Default, Serialize)]
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
    pub figures: Vec<(&'static str, f64)>,
}

/// Settings that differ in one number.
#[derive(Clone, Debug, Serialize)]
pub struct Curve {
    /// Name in the legend.
    pub name: String,
    /// Points in the order of that number.
    pub points: Vec<Point>,
}

/// Axis of a plot.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Axis {
    /// Name and unit.
    pub label: &'static str,
    /// Whether the axis is logarithmic.
    pub log: bool,
    /// Whether more is better; `None` if neither direction is.
    pub up: Option<bool>,
}

/// Curves on common axes.
#[derive(Clone, Debug, Serialize)]
pub struct Experiment {
    /// Short name.
    pub id: &'static str,
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
#[derive(Clone, Debug, Serialize)]
pub struct Results {
    /// Version of the program.
    pub version: &'static str,
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

/// Path of the program `tmpi`: the variable `TMPI`, otherwise the program beside this one.
fn program() -> std::io::Result<PathBuf> {
    if let Some(named) = std::env::var_os("TMPI").filter(|v| !v.is_empty()) {
        return Ok(named.into());
    }
    let path = std::env::current_exe()?.with_file_name(format!("tmpi{}", std::env::consts::EXE_SUFFIX));
    if path.is_file() {
        return Ok(path);
    }
    let reason = format!("{} does not exist: run `cargo build --release`, or set TMPI to the program", path.display());
    Err(std::io::Error::new(std::io::ErrorKind::NotFound, reason))
}

/// Runs the experiments; calls `progress` with the name of each.
///
/// # Errors
/// [`BenchError`].
pub fn run(settings: &Settings, progress: &dyn Fn(&str)) -> Result<Results, BenchError> {
    let start = std::time::Instant::now();
    let mut skipped = Vec::new();
    let wants = |id: &str| settings.wants(id);
    let scaling = if wants("scaling") { photo_size::run(settings.quick, &mut skipped, progress) } else { Vec::new() };
    let repeats = if settings.quick { 3 } else { 5 };
    let mut first = Vec::new();
    if wants("efficiency") {
        first.extend(tile_sizes::table(repeats, &mut skipped, progress));
    }
    if wants("clustering") {
        first.push(tile_sizes::clustering(repeats, progress));
    }
    progress("rendering scenes");
    let scenes = subject::rendered(settings.quick)?;
    let photos = subject::photos(&settings.photos, settings.quick)?;
    let bench = measure::Bench { models: &settings.models, repeats };
    let mut experiments = first;
    let known = photos.iter().any(|p| p.disparity.is_some());
    let measured = if known { &photos } else { &scenes };
    experiments.extend(experiments::on_scenes(&bench, &scenes, settings, &mut skipped, progress)?);
    experiments.extend(depth_settings::run(&bench, measured, settings, &mut skipped, progress)?);
    if wants("ramps") {
        experiments.push(snapping::run(&bench, &scenes, progress)?);
    }
    if wants("without") {
        experiments.push(ablation::steps(&bench, &scenes, progress)?);
    }
    if wants("families") {
        experiments.push(scene_families::run(&bench, settings.quick, progress)?);
    }
    if wants("labels") {
        experiments.push(ablation::labels(&scenes, settings.quick, progress)?);
    }
    if wants("moves") {
        experiments.push(ablation::moves(&bench, &scenes, progress)?);
    }
    if wants("photos") && !photos.is_empty() {
        experiments.extend(experiments::on_photos(&bench, &photos, &mut skipped, progress)?);
    }
    if wants("mesh") {
        experiments.extend(mesh::against(&bench, &photos, progress)?);
    }
    if wants("discretisation") {
        experiments.push(discretisation::run(&bench, measured, progress)?);
    }
    if wants("drawing") {
        experiments.extend(drawing::run(&bench, &scenes, settings.quick, &mut skipped, progress)?);
    }
    let mut costs = None;
    if wants("budget") {
        experiments.push(costs::kept(&bench, &scenes, progress)?);
        costs = Some(costs::fitted(&bench, &scenes, progress)?);
    }
    if wants("measuring") {
        experiments.push(report_cost::run(&bench, &scenes, settings.quick, progress)?);
    }
    experiments.extend(scaling);
    for e in &mut experiments {
        e.mark();
    }
    Ok(Results {
        version: env!("CARGO_PKG_VERSION"),
        machine: Machine::this(),
        subjects: scenes.iter().chain(&photos).map(|s| s.name.clone()).collect(),
        repeats,
        experiments,
        costs,
        skipped,
        seconds: start.elapsed().as_secs_f64(),
    })
}

impl Experiment {
    /// Marks the Pareto-optimal points, among those that can be compared.
    pub(crate) fn mark(&mut self) {
        let (Some(x_up), Some(y_up)) = (self.x.up, self.y.up) else { return };
        let score = |p: &Point| (if x_up { p.x } else { -p.x }, if y_up { p.y } else { -p.y });
        let apart = self.is_apart();
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

impl Results {
    /// All figures of all points as CSV, one per line.
    #[must_use]
    pub fn csv(&self) -> String {
        let quoted = |s: &str| format!("\"{}\"", s.replace('"', "\"\""));
        let mut out = String::from("experiment,curve,setting,default,pareto,figure,value\n");
        for e in &self.experiments {
            for (c, p) in e.curves.iter().flat_map(|c| c.points.iter().map(move |p| (c, p))) {
                let head = format!("{},{},{},{},{}", e.id, quoted(&c.name), quoted(&p.setting), p.default, p.pareto);
                for (name, value) in [(e.x.label, p.x), (e.y.label, p.y), ("spread", p.spread)].iter().chain(&p.figures) {
                    // writing to a String cannot fail
                    let _ = writeln!(out, "{head},{},{value}", quoted(name));
                }
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn experiment(points: &[(f64, f64)]) -> Experiment {
        let points = points.iter().map(|&(x, y)| Point { x, y, setting: format!("{x}"), ..Point::default() }).collect();
        Experiment {
            id: "e",
            title: "E".into(),
            about: "about <it>".into(),
            x: Axis { label: "ms", log: true, up: Some(false) },
            y: Axis { label: "dB", log: false, up: Some(true) },
            curves: vec![Curve { name: "c, \"d\"".into(), points }],
        }
    }

    #[test]
    fn pareto_points_are_marked() {
        let mut e = experiment(&[(1.0, 10.0), (2.0, 20.0), (3.0, 15.0), (2.0, 19.0), (1.0, 10.0)]);
        e.mark();
        assert_eq!(e.curves[0].points.iter().map(|p| p.pareto).collect::<Vec<_>>(), [true, true, false, false, true]);
    }

    #[test]
    fn csv_and_page_contain_all_points() {
        let results = Results {
            version: "0",
            machine: Machine::this(),
            subjects: vec!["s".into()],
            repeats: 1,
            experiments: vec![experiment(&[(1.0, 10.0), (20.0, 30.0)])],
            costs: None,
            skipped: vec!["gpu: none & nothing".into()],
            seconds: 1.0,
        };
        assert_eq!(results.csv().lines().count(), 1 + 2 * 3);
        assert!(results.csv().contains("\"c, \"\"d\"\"\""));
        let page = html(&results);
        assert!(page.contains("about &lt;it&gt;") && page.contains("none &amp; nothing") && page.matches("<circle").count() >= 2);
        assert!(!page.contains("http://") || page.contains("http://www.w3.org/2000/svg"), "the page makes no requests");
    }
}
