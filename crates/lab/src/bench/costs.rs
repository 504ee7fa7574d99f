//! Processing costs on this machine, and how well time budgets are kept with them.

use super::figures::median;
use super::measure::{Bench, Depth};
use super::subject::Subject;
use super::{Axis, Curve, Experiment, Point, figures};
use crate::LabError;
use tmpi_pipeline::Silent;
use tmpi_pipeline::networks;
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::run::time_budget::{Costs, Measured, fit};
use tmpi_pipeline::{self, Made, Options};

/// Operating points, as multiples of the default parallax error.
const FACTORS: [f64; 4] = [1.0, 2.0, 4.0, 8.0];
/// Stages before planes are fitted.
const BEFORE: [&str; 4] = ["photo", "depth", "denoise", "snap"];
/// A budget that limits nothing, set only to get its report.
const PLENTY: f64 = 1e7;

/// Median of `of` over the repeated runs.
fn median_of(runs: &[Made], of: impl Fn(&Made) -> f64) -> f64 {
    median(runs.iter().map(of).collect())
}

fn stages(made: &Made, names: &[&str]) -> f64 {
    made.report.stages.iter().filter(|s| names.contains(&s.name.as_str())).map(|s| s.ms).sum()
}

fn megapixels(made: &Made) -> f64 {
    f64::from(made.report.width) * f64::from(made.report.height) / 1e6
}

/// Fits the costs to the scenes.
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
        let map = s.disparity.as_deref().map(tmpi_pipeline::depth::to_png).transpose()?;
        let make = |budget_ms: Option<f64>| {
            let options = Options { budget_ms, fov_x: s.fov_x, ..Options::default() };
            tmpi_pipeline::make(bench.models, &Limits::default(), &s.file, map.as_deref(), &options, &Silent)
                .map_err(|source| LabError::Make { subject: s.name.clone(), source })
        };
        let mut points: Vec<Point> = Vec::new();
        for asked in [25.0, 50.0, 100.0, 200.0, 500.0] {
            let runs = (0..bench.repeats).map(|_| make(Some(asked))).collect::<Result<Vec<_>, _>>()?;
            let budget = |of: fn(&tmpi_pipeline::Budget) -> f64| median_of(&runs, |m| m.report.budget.as_ref().map_or(0.0, of));
            let chose = runs.last().and_then(|m| m.report.budget.as_ref()).map_or(String::new(), |b| format!("{}: {}", b.chose, b.reason));
            let outcome = budget(|b| b.outcome_ms);
            points.push(point(format!("--budget-ms {asked} chose {chose}"), &runs, outcome));
            if let Some(p) = points.last_mut() {
                let predicted = budget(|b| b.predicted_ms);
                p.figures.extend(figures([("predicted, ms", predicted), ("over budget, %", 100.0 * (outcome / asked - 1.0))]));
            }
        }
        let unbounded = (0..bench.repeats).map(|_| make(None)).collect::<Result<Vec<_>, _>>()?;
        let free = point("without a budget".into(), &unbounded, median_of(&unbounded, |m| m.report.total_ms));
        points.push(Point { default: true, ..free });
        curves.push(Curve { name: s.name.clone(), points });
    }
    Ok(Experiment {
        id: "budget".into(),
        title: "Time budgets".into(),
        about: "Results of --budget-ms with the costs that TMPI_COSTS names, or the built-in ones, and results without a budget. The error is in \
                pixels of the original photo, so it is larger for a photo that was reduced."
            .into(),
        x: Axis::new("time, ms", true, Some(false)),
        y: Axis::new("parallax error, px", true, Some(false)),
        curves,
    })
}

/// A point with time on the x axis and error on the y axis.
fn point(setting: String, runs: &[Made], ms: f64) -> Point {
    let scale = |m: &Made| m.report.error.reduction.map_or(1.0, |r| r.scale);
    let error = median_of(runs, |m| m.report.error.planes.mean_px / scale(m));
    let reduced = runs.last().and_then(|m| m.report.error.reduction?.psnr);
    let figures = reduced.map(|psnr| ("photo after reduction and enlargement, dB".into(), psnr)).into_iter().collect();
    Point { setting, x: ms, y: error, figures, ..Point::default() }
}
