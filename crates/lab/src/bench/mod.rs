//! Measures error against run time for each approximation, on rendered scenes with exact second views and on photos.
//!
//! For rendered scenes, the error is that of whole views (PSNR, SSIM, L1 over the view without 15 % on each side). Photos have no second
//! view; their error is that of the planes against the disparity that they were fitted to, in pixels of parallax over the view box. A point
//! is the mean over all subjects, with the standard deviation. Times are medians of repeated runs, with the range of these.

mod ablation;
mod backgrounds;
mod beyond_border;
mod costs;
mod depth_settings;
mod discretisation;
mod experiments;
mod figures;
mod least_size;
mod log;
mod machine;
mod measure;
mod page;
mod photo_size;
mod plot;
mod snapping;
mod subject;

use std::borrow::Cow;
use std::path::PathBuf;

use clap::builder::PossibleValuesParser;
use serde::{Deserialize, Serialize};

use crate::LabError;
pub(crate) use figures::Figures;
use log::Log;
pub use machine::Machine;
pub(crate) use measure::compared;
pub use page::html;
use tmpi_pipeline::Models;
use tmpi_pipeline::run::time_budget::Costs;

/// What a benchmark measures.
#[derive(Clone, Debug, clap::Args)]
pub struct Flags {
    /// Folder for index.html, results.json, and costs.json, which `make --budget-ms` reads if `TMPI_COSTS` names it. All are written after
    /// each experiment
    #[arg(short, long, default_value = "bench", value_name = "DIR")]
    pub output: PathBuf,
    /// Use fewer scenes and settings; takes a few minutes
    #[arg(long)]
    pub quick: bool,
    /// Also measure the photos in this folder; repeatable. `NAME_disp16.png` beside `NAME.jpg` is the photo's disparity
    #[arg(long, value_name = "DIR")]
    pub photos: Vec<PathBuf>,
    /// Run only these experiments
    #[arg(long, value_delimiter = ',', value_parser = PossibleValuesParser::new(EXPERIMENTS.split(' ')), value_name = "NAME,…")]
    pub only: Vec<String>,
    /// Keep the experiments of an earlier run that are in the folder, and run only the others
    #[arg(long)]
    pub resume: bool,
    /// Runs of each setting, in turns with the others; times are medians. What takes more than a second runs twice at most. Default: 5, or
    /// 3 with --quick
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..=100), value_name = "N")]
    pub repeats: Option<u16>,
}

#[derive(Clone)]
pub struct Settings {
    pub flags: Flags,
    pub models: Models,
    /// Settings that the networks were loaded with; an experiment varies those of the depth network.
    pub networks: tmpi_pipeline::networks::models::Settings,
}

/// Names of the experiments.
const EXPERIMENTS: &str = "scaling max-error planes tiles quality prune view-box size levels denoise depth depth-smoothing depth-ramp \
    depth-mirror ramps without labels photos discretisation backgrounds least-size beyond budget";

/// A measured setting: means over all subjects.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Point {
    /// The setting, as on the command line.
    pub setting: String,
    pub x: f64,
    pub y: f64,
    /// Standard deviation of `y` over the subjects; 0 for a single subject.
    pub spread: f64,
    pub default: bool,
    /// Whether no other point of the experiment is better on both axes.
    pub pareto: bool,
    /// All measured values, by name.
    pub figures: Vec<(String, f64)>,
    /// Of figures in which repeated runs differ, mostly times: the means, over the subjects, of the least and the most.
    pub ranges: Vec<(String, [f64; 2])>,
}

impl Point {
    /// The range of a figure; `None` if its runs do not differ, or there was one.
    fn range(&self, name: &str) -> Option<[f64; 2]> {
        self.ranges.iter().find(|r| r.0 == name).map(|r| r.1)
    }
}

/// Settings that differ in one number.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Curve {
    pub name: String,
    /// Points in the order of that number.
    pub points: Vec<Point>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Axis {
    /// Name and unit.
    pub label: Cow<'static, str>,
    pub log: bool,
    /// Whether more is better; `None` if neither direction is.
    pub up: Option<bool>,
}

impl Axis {
    pub(crate) const fn new(label: &'static str, log: bool, up: Option<bool>) -> Self {
        Self { label: Cow::Borrowed(label), log, up }
    }
}

/// Curves on common axes.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Experiment {
    pub id: String,
    pub title: String,
    pub about: String,
    pub x: Axis,
    pub y: Axis,
    pub curves: Vec<Curve>,
}

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Results {
    /// Version of the program.
    pub version: String,
    pub machine: Machine,
    /// Names of the measured scenes and photos.
    pub subjects: Vec<String>,
    /// Number of runs of a setting that takes at most a second; others ran twice at most. Times are medians.
    pub repeats: usize,
    pub experiments: Vec<Experiment>,
    /// Costs of this machine for `--budget-ms`, if they were measured.
    pub costs: Option<Costs>,
    /// Skipped experiments, each with the reason.
    pub skipped: Vec<String>,
    pub seconds: f64,
}

/// Runs the experiments, and writes the results to the folder after each; calls `progress` with the name of each.
pub fn run(settings: &Settings, progress: &dyn Fn(&str)) -> Result<Results, LabError> {
    let mut log = Log::new(settings, progress)?;
    let (quick, repeats) = (settings.flags.quick, log.results.repeats);
    if log.starts("scaling") {
        match photo_size::run(quick, repeats) {
            Ok(both) => both.into_iter().try_for_each(|e| log.add(e))?,
            Err(reason) => log.results.skipped.push(format!("scaling: {reason}")),
        }
    }
    progress("rendering scenes");
    let scenes = subject::rendered(quick)?;
    let photos = subject::photos(&settings.flags.photos, quick)?;
    log.results.subjects = scenes.iter().chain(&photos).map(|s| s.name.clone()).collect();
    let bench = measure::Bench { models: &settings.models, repeats };
    let known = photos.iter().any(|p| p.disparity.is_some());
    let measured = if known { &photos } else { &scenes };
    experiments::on_scenes(&bench, &scenes, &mut log)?;
    depth_settings::run(&bench, measured, &mut log)?;
    log.run("ramps", || snapping::run(&bench, &scenes))?;
    log.run("without", || ablation::steps(&bench, &scenes))?;
    log.run("labels", || ablation::labels(&scenes, quick))?;
    if !photos.is_empty() {
        experiments::on_photos(&bench, &photos, &mut log)?;
    }
    log.run("discretisation", || discretisation::run(&bench, measured))?;
    log.run("backgrounds", || backgrounds::run(&bench, quick))?;
    let large = if log.wants("least-size") || (log.wants("beyond") && photos.is_empty()) {
        progress("rendering large scenes");
        // from the side and from ahead: views of this size take long to compare
        subject::large(quick, |seed| subject::poses(seed).into_iter().step_by(2).collect())?
    } else {
        Vec::new()
    };
    log.run("least-size", || least_size::run(&bench, &large, &photos, quick))?;
    log.run("beyond", || beyond_border::run(&bench, if photos.is_empty() { &large } else { &photos }))?;
    if log.starts("budget") {
        log.results.costs = Some(costs::fitted(&bench, &scenes)?);
        log.add(costs::kept(&bench, &scenes)?)?;
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
