//! Costs of a photo of the paper's size, by tile size and number of planes (the paper's second table).

use super::figures::median;
use super::photo_size::ProcessRunner;
use super::{Axis, BenchError, Curve, Experiment, Point, figures};
use crate::scenes;
use tmpi_pipeline::Report;

/// The paper's picture size.
const SIZE: (u32, u32) = (630, 350);
/// Seed of the first scene.
const SEED: u64 = 900_200;
/// Stages in a row, and the names of their figures.
const STAGES: [(&str, &str); 6] = [
    ("denoise", "cleaning, ms"),
    ("snap", "edges, ms"),
    ("planes", "planes, ms"),
    ("layers", "layers, ms"),
    ("encode", "encoding, ms"),
    ("verify", "verifying, ms"),
];

/// Run time of each stage, peak memory and size, by tile size and number of planes.
pub(super) fn table(repeats: usize) -> Result<Experiment, BenchError> {
    Ok(Experiment {
        id: "efficiency".into(),
        title: "Efficiency".into(),
        about: format!(
            "A rendered scene of {}×{} pixels with its disparity; each setting runs in {repeats} separate processes. Medians of each stage, the total and peak memory, and the container's size. Layers as RGBA8 correspond to the space in the paper.",
            SIZE.0, SIZE.1
        ),
        x: Axis::new("photo and disparity to container, ms", true, Some(false)),
        y: Axis::new("peak memory, MB", false, Some(false)),
        curves: measured(repeats)?,
    })
}

fn measured(repeats: usize) -> Result<Vec<Curve>, BenchError> {
    let scene = scenes::Scene::framed(SEED, SIZE.0, SIZE.1);
    let picture = scene.render(&scene.camera(), 1);
    let runner = ProcessRunner::new()?;
    runner.put(&picture.photo, &picture.disparity)?;
    let curve = |name: &str, settings: &[&str]| -> Result<Curve, BenchError> {
        let points = settings.iter().map(|setting| {
            let arguments: Vec<&str> = setting.split_whitespace().collect();
            let runs = (0..repeats).map(|_| runner.make(&arguments)).collect::<Result<Vec<_>, _>>()?;
            Ok(row(setting, &runs))
        });
        Ok(Curve { name: name.into(), points: points.collect::<Result<_, BenchError>>()? })
    };
    Ok(vec![
        curve("tile size", &["--tile 32", "", "--tile 128", "--tile 256"])?,
        curve("planes per tile", &["--planes 1", "--planes 2", "--planes 4", "--planes 8"])?,
        curve("the paper's planes", &["--plane-method lloyd --planes 4", "--plane-method lloyd --planes 32 --tile full"])?,
    ])
}

fn row(setting: &str, runs: &[Report]) -> Point {
    let over = |of: &dyn Fn(&Report) -> f64| median(runs.iter().map(of).collect());
    let stage = |name: &str| over(&|r| r.stages.iter().filter(|s| s.name == name).map(|s| s.ms).sum());
    let mut all = figures(STAGES.map(|(name, figure)| (figure, stage(name))));
    let last = runs.last();
    all.extend(figures([
        ("total, CPU ms", over(&|r| r.stages.iter().map(|s| s.cpu_ms).sum())),
        ("planes per tile", last.map_or(0.0, |r| r.planes_per_tile)),
        ("container, KB", last.map_or(0.0, |r| r.bytes.total as f64 / 1e3)),
        ("layers as RGBA8, KB", last.map_or(0.0, |r| 4.0 * r.texels as f64 / 1e3)),
    ]));
    Point {
        setting: if setting.is_empty() { "defaults".into() } else { setting.into() },
        x: over(&|r| r.total_ms),
        y: over(&|r| r.peak_rss_bytes as f64 / 1e6),
        default: setting.is_empty(),
        figures: all,
        ..Point::default()
    }
}
