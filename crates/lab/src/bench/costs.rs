//! Processing costs on this machine, and how well time budgets are kept with them.

use super::figures::median;
use super::measure::{Bench, Depth, REDUCED, in_turns};
use super::subject::Subject;
use super::{Axis, Curve, Experiment, Figures, Point};
use crate::LabError;
use tmpi_pipeline::run::time_budget::{Costs, Measured, fit};
use tmpi_pipeline::{Made, Options, networks};

/// Operating points, as multiples of the default parallax error.
const FACTORS: [f64; 4] = [1.0, 2.0, 4.0, 8.0];
/// Stages before planes are fitted.
const BEFORE: [&str; 4] = ["photo", "depth", "denoise", "snap"];
/// A budget that limits nothing, set only to get its report.
const PLENTY: f64 = 1e7;
/// Budgets that are asked for, in milliseconds.
const ASKED: [Option<f64>; 6] = [Some(25.0), Some(50.0), Some(100.0), Some(200.0), Some(500.0), None];
const TIME: &str = "time, ms";
const PARALLAX: &str = "parallax error, px";

fn median_of(runs: &[Made], of: impl Fn(&Made) -> f64) -> f64 {
    median(runs.iter().map(of).collect())
}

fn stages(made: &Made, names: &[&str]) -> f64 {
    made.report.stages.iter().filter(|s| names.contains(&s.name.as_str())).map(|s| s.ms).sum()
}

fn megapixels(made: &Made) -> f64 {
    f64::from(made.report.width) * f64::from(made.report.height) / 1e6
}

pub(super) fn fitted(bench: &Bench, scenes: &[Subject]) -> Result<Costs, LabError> {
    let mut costs = Costs::default();
    let mut before = Vec::new();
    let mut points = Vec::new();
    for s in scenes {
        let mut busy = 0.0;
        for factor in FACTORS {
            let budget_ms = (factor <= 1.0).then_some(PLENTY);
            let options = Options { max_error: Options::MAX_ERROR * factor, budget_ms, ..Options::default() };
            let runs = bench.runs(s, &Depth::Known, &options)?;
            let mp = runs.first().map_or(1.0, megapixels);
            if let Some(b) = runs.first().and_then(|m| m.report.budget.as_ref()) {
                busy = b.busy;
                before.push(median_of(&runs, |m| stages(m, &BEFORE)) / mp);
            }
            let ms = median_of(&runs, |m| stages(m, &["planes", "layers", "refine", "encode", "verify"])) / mp;
            points.push(Measured { factor, busy, ms });
        }
    }
    costs.before = median(before);
    (costs.plain, costs.points) = fit(&FACTORS, &points);
    if let (true, Some(s)) = (networks::available().is_ok(), scenes.first()) {
        // two sizes separate the fixed cost from the cost per pixel
        let ms = |max_size: Option<u32>| -> Result<(f64, f64), LabError> {
            let runs = bench.runs(s, &Depth::Estimated, &Options { max_size, ..Options::default() })?;
            Ok((runs.first().map_or(1.0, megapixels), median_of(&runs, |m| stages(m, &BEFORE))))
        };
        let ((small, a), (large, b)) = (ms(Some(192))?, ms(None)?);
        let slope = ((b - a) / (large - small)).max(0.0);
        costs.depth_megapixel = (slope - costs.before).max(0.0);
        costs.depth = (a - slope * small).max(0.0);
    }
    Ok(costs)
}

/// Runs with several budgets, with the built-in costs or those that `TMPI_COSTS` names.
pub(super) fn kept(bench: &Bench, scenes: &[Subject]) -> Result<Experiment, LabError> {
    let mut curves = Vec::new();
    for s in scenes.iter().take(3) {
        let mut runs = ASKED.map(|_| Vec::new());
        in_turns(ASKED.len(), bench.repeats, |i, _| {
            let made = bench.make(s, &Depth::Known, &Options { budget_ms: ASKED[i], ..Options::default() })?;
            let ms = made.report.total_ms;
            runs[i].push(made);
            Ok(ms)
        })?;
        let points = ASKED.into_iter().zip(&runs).map(|(asked, runs)| point(asked, runs)).collect();
        curves.push(Curve { name: s.name.clone(), points });
    }
    Ok(Experiment {
        id: "budget".into(),
        title: "Time budgets".into(),
        about: "Results of --budget-ms with the costs that TMPI_COSTS names, or the built-in ones, and results without a budget. The error is in \
                pixels of the original photo, so it is larger for a photo that was reduced."
            .into(),
        x: Axis::new(TIME, true, Some(false)),
        y: Axis::new(PARALLAX, true, Some(false)),
        curves,
    })
}

/// The point of the runs with a budget, or without one.
fn point(asked: Option<f64>, runs: &[Made]) -> Point {
    let mut f = Figures::default();
    for made in runs {
        let (r, budget) = (&made.report, &made.report.budget);
        let took = budget.as_ref().map_or(r.total_ms, |b| b.outcome_ms);
        f.add_run(TIME, 0, took);
        f.add_run(PARALLAX, 0, r.error.planes.mean_px / r.error.reduction.map_or(1.0, |r| r.scale));
        if let Some(psnr) = r.error.reduction.and_then(|r| r.psnr) {
            f.add_run(REDUCED, 0, psnr);
        }
        if let (Some(asked), Some(b)) = (asked, budget) {
            f.add_run("predicted, ms", 0, b.predicted_ms);
            f.add_run("over budget, %", 0, 100.0 * (took / asked - 1.0));
        }
    }
    let chose = runs.last().and_then(|m| m.report.budget.as_ref()).map_or(String::new(), |b| format!("{}: {}", b.chose, b.reason));
    let setting = asked.map_or("without a budget".to_owned(), |ms| format!("--budget-ms {ms} chose {chose}"));
    Point { default: asked.is_none(), ..f.point(setting, (TIME, PARALLAX)) }
}
