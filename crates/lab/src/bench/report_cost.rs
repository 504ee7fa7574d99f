//! What the figures of a photo's report cost.

use super::measure::{Bench, Depth, Figures, median};
use super::subject::{self, Subject};
use super::{Axis, BenchError, Curve, Experiment, Point};
use tmpi_core::container;
use tmpi_pipeline::planes::discretisation_error;
use tmpi_pipeline::usage::Clock;
use tmpi_pipeline::{Denoise, Options, Parallax, Switch};

/// Larger pictures than those of the other experiments: where there are few tiles, samples are most of them.
const LARGE: [(u32, u32); 2] = [(1280, 720), (1920, 1080)];
const SHARE: &str = "measuring, % of the time";
const SIZE: &str = "photo, megapixels";

/// A point for each size: the share of the time that a photo takes, with its map given, which goes into figures of its report.
pub(super) fn run(bench: &Bench, scenes: &[Subject], quick: bool, progress: &dyn Fn(&str)) -> Result<Experiment, BenchError> {
    progress("What the report costs");
    let larger = LARGE[..if quick { 1 } else { LARGE.len() }].iter().map(|&size| subject::large(size)).collect::<Result<Vec<_>, _>>()?;
    let groups = [scenes].into_iter().chain(larger.iter().map(std::slice::from_ref));
    let points = groups.map(|subjects| point(bench, subjects)).collect::<Result<Vec<_>, _>>()?;
    Ok(Experiment {
        id: "measuring",
        title: "What the report costs".into(),
        about: "Wall time of the figures in a photo's report: views drawn anew, errors of planes, and how far steps moved the map. Where all of it \
                would take more than a twentieth, samples are measured, and the report says of how many tiles."
            .into(),
        x: Axis { label: SIZE, log: true, up: None },
        y: Axis { label: SHARE, log: false, up: Some(false) },
        curves: vec![Curve { name: "defaults".into(), points }],
    })
}

fn point(bench: &Bench, subjects: &[Subject]) -> Result<Point, BenchError> {
    let mut figures = Figures::default();
    for s in subjects {
        for (name, value) in of(bench, s)? {
            figures.add(name, value);
        }
    }
    let name = subjects.first().map_or("", |s| s.name.as_str());
    let setting = if subjects.len() > 1 { format!("{} scenes", subjects.len()) } else { name.into() };
    Ok(figures.point(setting, (SIZE, SHARE)))
}

fn of(bench: &Bench, s: &Subject) -> Result<Vec<(&'static str, f64)>, BenchError> {
    let runs = bench.runs(s, &Depth::Known, &Options::default())?;
    let raw = bench.runs(s, &Depth::Known, &Options { denoise: Denoise::Off, snap: Switch::Off, ..Options::default() })?;
    let (Some(made), Some(raw)) = (runs.last(), raw.last()) else { return Ok(Vec::new()) };
    let verify = median(runs.iter().map(|m| m.report.stages.iter().filter(|s| s.name == "verify").map(|s| s.ms).sum()).collect());
    let total = median(runs.iter().map(|m| m.report.total_ms).collect());
    let geometry = container::read_geometry(&made.container)?;
    let movement = Parallax::new(geometry.intrinsics, geometry.view_box);
    let timed = |work: &dyn Fn()| {
        let one = |_| {
            let clock = Clock::start();
            work();
            clock.ms()
        };
        median((0..bench.repeats).map(one).collect())
    };
    // of a step that changes nothing nothing is measured
    let steps = [made.report.error.denoise, made.report.error.snap].iter().flatten().count();
    let maps = steps as f64
        * timed(&|| {
            std::hint::black_box(movement.between(&raw.disparity, &made.disparity));
        });
    let planes = timed(&|| {
        std::hint::black_box(movement.of_planes(&made.disparity, &geometry));
        std::hint::black_box(discretisation_error(&made.disparity, &geometry.grid, &geometry.tiles));
    });
    let megapixels = f64::from(made.report.width) * f64::from(made.report.height) / 1e6;
    Ok(vec![
        (SIZE, megapixels),
        (SHARE, 100.0 * (verify + maps + planes) / total),
        ("all, ms", total),
        ("views drawn anew, ms", verify),
        ("errors of planes, ms", planes),
        ("steps on the map, ms", maps),
    ])
}
