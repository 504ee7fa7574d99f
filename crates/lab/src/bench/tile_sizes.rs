//! Costs of a photo of the paper's size, by tile size and number of planes (the paper's second table), and of plane fitting alone.

use super::measure::median;
use super::photo_size::ProcessRunner;
use super::{Axis, BenchError, Curve, Experiment, Point};
use crate::scenes;
use tmpi_core::{Grid, Rect};
use tmpi_pipeline::planes::{Method, Placement, discretisation_error, place};
use tmpi_pipeline::usage::Clock;
use tmpi_pipeline::{Options, Report};

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
pub(super) fn table(repeats: usize, skipped: &mut Vec<String>, progress: &dyn Fn(&str)) -> Option<Experiment> {
    progress("efficiency");
    match measured(repeats) {
        Ok(curves) => Some(Experiment {
            id: "efficiency",
            title: "Efficiency".into(),
            about: format!(
                "A rendered scene of {}×{} pixels with its disparity; each setting runs in {repeats} separate processes. Medians of each stage, the total and peak memory, and the container's size. Layers as RGBA8 correspond to the space in the paper.",
                SIZE.0, SIZE.1
            ),
            x: Axis { label: "photo and disparity to container, ms", log: true, up: Some(false) },
            y: Axis { label: "peak memory, MB", log: false, up: Some(false) },
            curves,
        }),
        Err(reason) => {
            skipped.push(format!("efficiency: {reason}"));
            None
        }
    }
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
    let mut figures: Vec<(&str, f64)> = STAGES.map(|(name, figure)| (figure, stage(name))).into();
    let last = runs.last();
    figures.extend([
        ("total, CPU ms", over(&|r| r.stages.iter().map(|s| s.cpu_ms).sum())),
        ("planes per tile", last.map_or(0.0, |r| r.planes_per_tile)),
        ("container, KB", last.map_or(0.0, |r| r.bytes.total as f64 / 1e3)),
        ("layers as RGBA8, KB", last.map_or(0.0, |r| 4.0 * r.texels as f64 / 1e3)),
    ]);
    Point {
        setting: if setting.is_empty() { "defaults".into() } else { setting.into() },
        x: over(&|r| r.total_ms),
        y: over(&|r| r.peak_rss_bytes as f64 / 1e6),
        default: setting.is_empty(),
        figures,
        ..Point::default()
    }
}

/// Plane fitting alone: CPU time and error by method and number of planes.
pub(super) fn clustering(repeats: usize, progress: &dyn Fn(&str)) -> Experiment {
    progress("clustering");
    let scenes = (0..4).map(|i| scenes::Scene::framed(SEED + i, SIZE.0, SIZE.1));
    let maps: Vec<_> = scenes.map(|s| (s.render(&s.camera(), 1).disparity, s.camera().intrinsics)).collect();
    let grid = Grid::new(SIZE.0, SIZE.1, Grid::DEFAULT_SIZE);
    let whole = Rect { x: 0, y: 0, w: SIZE.0, h: SIZE.1 };
    let point = |method: Method, n: u32| {
        let (mut cpu, mut wall, mut error, mut moved) = (0.0, 0.0, 0.0, 0.0);
        for (map, k) in &maps {
            let (mut times, mut tiles) = (Vec::new(), Vec::new());
            for _ in 0..3 * repeats {
                let clock = Clock::start();
                tiles = place(map, None, &grid, &Placement::fixed(method, n));
                times.push((clock.cpu_ms(), clock.ms()));
            }
            let mae = discretisation_error(map, &grid, &tiles).0;
            let parallax = Options::VIEW_BOX.parallax(k, whole);
            cpu += median(times.iter().map(|t| t.0).collect()) / maps.len() as f64;
            wall += median(times.iter().map(|t| t.1).collect()) / maps.len() as f64;
            error += mae * 1e3 / maps.len() as f64;
            moved += mae * parallax.0.max(parallax.1) / maps.len() as f64;
        }
        let figures = vec![("all tiles, ms", wall), ("parallax error, px", moved)];
        Point { setting: format!("{n} planes"), x: cpu, y: error, figures, ..Point::default() }
    };
    let methods = [("linear", Method::Linear), ("lloyd", Method::Lloyd), ("optimal", Method::Optimal), ("slanted", Method::Slanted)];
    let curve = |(name, method): (&str, Method)| Curve { name: name.into(), points: [1, 2, 4, 8].map(|n| point(method, n)).into() };
    Experiment {
        id: "clustering",
        title: "Plane fitting alone".into(),
        about: format!(
            "All {} tiles of {} rendered disparity maps of {}×{} pixels, means of medians: CPU time of all threads against the error of the planes.",
            grid.tiles(),
            maps.len(),
            SIZE.0,
            SIZE.1
        ),
        x: Axis { label: "all tiles, CPU ms", log: true, up: Some(false) },
        y: Axis { label: "disparity MAE, 1e-3", log: true, up: Some(false) },
        curves: methods.map(curve).into(),
    }
}
