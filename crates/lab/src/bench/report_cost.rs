//! How much of its time a photo's report costs.

use super::figures::{Figures, median};
use super::measure::{Bench, Depth};
use super::subject::{self, Subject};
use super::{Axis, Curve, Experiment};
use crate::LabError;
use tmpi_core::container;
use tmpi_pipeline::planes::discretisation_error;
use tmpi_pipeline::usage::Clock;
use tmpi_pipeline::{Denoise, Options, Parallax, Switch};

/// Larger pictures than those of the other experiments: where there are few tiles, samples are most of them.
const LARGE: [(u32, u32); 2] = [(1280, 720), (1920, 1080)];
const SHARE: &str = "measuring, % of the time";
const SIZE: &str = "photo, megapixels";

/// A point for each size: the share of the time that a photo takes, with its map given, which goes into figures of its report.
pub(super) fn run(bench: &Bench, scenes: &[Subject], quick: bool) -> Result<Experiment, LabError> {
    let larger: Vec<Subject> = LARGE[..if quick { 1 } else { 2 }].iter().map(|&size| subject::large(size)).collect();
    let mut points = Vec::new();
    for subjects in [scenes].into_iter().chain(larger.iter().map(std::slice::from_ref)) {
        let mut f = Figures::default();
        subjects.iter().try_for_each(|s| add(bench, s, &mut f))?;
        points.push(f.point(subjects.first().map_or("", |s| &s.name).into(), (SIZE, SHARE)));
    }
    Ok(Experiment {
        id: "measuring".into(),
        title: "What the report costs".into(),
        about: "Wall time of the figures in a photo's report: views drawn anew, errors of planes, and how far steps moved the map. Where all of it \
                would take more than a twentieth, samples are measured, and the report says of how many tiles. The first point is the mean of \
                all scenes."
            .into(),
        x: Axis::new(SIZE, true, None),
        y: Axis::new(SHARE, false, Some(false)),
        curves: vec![Curve { name: "defaults".into(), points }],
    })
}

fn add(bench: &Bench, s: &Subject, f: &mut Figures) -> Result<(), LabError> {
    let runs = bench.runs(s, &Depth::Known, &Options::default())?;
    let raw = bench.runs(s, &Depth::Known, &Options { denoise: Denoise::Off, snap: Switch::Off, ..Options::default() })?;
    let (Some(made), Some(raw)) = (runs.last(), raw.last()) else { return Ok(()) };
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
    let steps = [made.report.error.denoise, made.report.error.snap].iter().flatten().count() as f64;
    let maps = steps
        * timed(&|| {
            std::hint::black_box(movement.between(&raw.disparity, &made.disparity));
        });
    let planes = timed(&|| {
        std::hint::black_box(movement.of_planes(&made.disparity, &geometry));
        std::hint::black_box(discretisation_error(&made.disparity, &geometry.grid, &geometry.tiles));
    });
    f.add(SIZE, f64::from(made.report.width) * f64::from(made.report.height) / 1e6);
    f.add(SHARE, 100.0 * (verify + maps + planes) / total);
    f.add("all, ms", total);
    f.add("views drawn anew, ms", verify);
    f.add("errors of planes, ms", planes);
    f.add("steps on the map, ms", maps);
    Ok(())
}
