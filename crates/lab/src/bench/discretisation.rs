//! Error of planes fitted to clean and damaged disparity maps: the paper's third table.

use super::measure::{Bench, median};
use super::subject::Subject;
use super::{Axis, BenchError, Curve, Experiment, Point, experiments};
use tmpi_core::{DisparityMap, Grid, Photo};
use tmpi_pipeline::MakeError;
use tmpi_pipeline::denoise::{local_planes, median_guided, theta};
use tmpi_pipeline::edges;
use tmpi_pipeline::photo::{self, Limits};
use tmpi_pipeline::planes::{MAX_AUTO_PLANES, Method, Placement, discretisation_error, ghost_share, overlap_disagreement, place};
use tmpi_pipeline::usage::Clock;

/// Planes per tile, as in the paper.
const PLANES: u32 = 4;

/// How a map is cleaned before planes are fitted to it.
#[derive(Clone, Copy, PartialEq)]
enum Cleaning {
    Off,
    Classic,
    Auto,
    Theta,
    /// Snaps to the photo's edges, which is not cleaning but the remedy for ramps.
    Snap,
}

/// A pixel counts as a ghost if it is farther than this from every true surface nearby, in δ.
const GHOST: f32 = 0.05;

fn cleaned(bench: &Bench, how: Cleaning, photo: &Photo, map: &DisparityMap) -> Result<(DisparityMap, Option<Vec<f32>>), MakeError> {
    Ok(match (how, &bench.models.theta) {
        (Cleaning::Off, _) | (Cleaning::Theta, None) => (map.clone(), None),
        (Cleaning::Classic, _) => (median_guided::denoise(photo, map), None),
        (Cleaning::Auto, _) => (local_planes::denoise(map), None),
        (Cleaning::Snap, _) => (edges::snap(photo, map), None),
        (Cleaning::Theta, Some(_)) if !theta::wanted(map) => (map.clone(), None),
        (Cleaning::Theta, Some(theta)) => {
            let (map, confidence) = theta::run(theta.as_ref(), photo, map)?;
            (map, Some(confidence))
        }
    })
}

/// Fits planes to clean and damaged maps, and measures their error against the clean map.
pub(super) fn run(bench: &Bench, subjects: &[Subject], progress: &dyn Fn(&str)) -> Result<Experiment, BenchError> {
    progress("Planes on clean and damaged maps");
    let methods = [("linear", Method::Linear), ("lloyd", Method::Lloyd), ("optimal", Method::Optimal), ("slanted", Method::Slanted)];
    let mut settings: Vec<(String, Placement, Cleaning)> =
        methods.iter().map(|&(name, m)| (format!("{name}, {PLANES} planes"), Placement::fixed(m, PLANES), Cleaning::Off)).collect();
    settings.push(("slanted, error 0.005".into(), Placement::fewest(Method::Slanted, MAX_AUTO_PLANES, 0.005), Cleaning::Off));
    let mut cleanings = vec![("classic", Cleaning::Classic), ("auto", Cleaning::Auto)];
    if bench.models.theta.is_some() && tmpi_pipeline::networks::available().is_ok() {
        cleanings.push(("theta", Cleaning::Theta));
    }
    for (name, c) in cleanings {
        settings.push((format!("lloyd, {PLANES} planes, --denoise {name}"), Placement::fixed(Method::Lloyd, PLANES), c));
        settings.push((format!("slanted, {PLANES} planes, --denoise {name}"), Placement::fixed(Method::Slanted, PLANES), c));
    }
    settings.push((format!("slanted, {PLANES} planes, --snap on"), Placement::fixed(Method::Slanted, PLANES), Cleaning::Snap));
    let mut curves = Vec::new();
    for (name, damage) in [
        ("clean map", DisparityMap::clone as fn(&DisparityMap) -> DisparityMap),
        ("noise of variance 1e-3", experiments::noisy),
        ("edges blurred to ramps", experiments::blurred),
    ] {
        let mut points = Vec::new();
        for (setting, placement, cleaning) in &settings {
            points.push(point(bench, subjects, setting, placement, *cleaning, damage)?);
        }
        curves.push(Curve { name: name.into(), points });
    }
    Ok(Experiment {
        id: "discretisation",
        title: "Planes on clean and damaged maps".into(),
        about: "Planes fitted to a clean map, to one with noise, and to one blurred by 5×5 pixels. All errors are relative to the clean map, in thousandths, as in the paper's third table. Ghosts are pixels whose plane is more than 0.05 from every true surface within two pixels. Subjects are photos with a disparity map beside them, otherwise rendered scenes.".into(),
        x: Axis { label: "planes, CPU ms", log: true, up: Some(false) },
        y: Axis { label: "MAE, 1e-3", log: true, up: Some(false) },
        curves,
    })
}

fn point(
    bench: &Bench,
    subjects: &[Subject],
    setting: &str,
    placement: &Placement,
    cleaning: Cleaning,
    damage: fn(&DisparityMap) -> DisparityMap,
) -> Result<Point, BenchError> {
    let (mut sums, mut count) = ([0f64; 7], 0usize);
    for s in subjects {
        let Some(clean) = &s.disparity else { continue };
        let fail = |source| BenchError::Make { subject: s.name.clone(), source };
        let photo = photo::decode(&s.file, &Limits::default(), None).map_err(|e| fail(e.into()))?.photo;
        let (map, weights) = cleaned(bench, cleaning, &photo, &damage(clean)).map_err(fail)?;
        let grid = Grid::new(map.width, map.height, 64);
        let (mut times, mut tiles) = (Vec::new(), Vec::new());
        for _ in 0..bench.repeats {
            let clock = Clock::start();
            tiles = place(&map, weights.as_deref(), &grid, placement);
            times.push(clock.cpu_ms());
        }
        let (mae, mse, q25) = discretisation_error(clean, &grid, &tiles);
        let planes = tiles.iter().map(|t| t.planes.len()).sum::<usize>() as f64 / tiles.len().max(1) as f64;
        let apart = overlap_disagreement(&grid, &tiles) * 1e3;
        let ghosts = 100.0 * ghost_share(clean, &grid, &tiles, GHOST);
        for (sum, v) in sums.iter_mut().zip([median(times), mae * 1e3, mse * 1e3, q25 * 1e3, planes, apart, ghosts]) {
            *sum += v;
        }
        count += 1;
    }
    let [ms, mae, mse, q25, planes, apart, ghosts] = sums.map(|v| v / count.max(1) as f64);
    let figures = vec![
        ("MSE, 1e-3", mse),
        ("Q25, 1e-3", q25),
        ("planes per tile", planes),
        ("difference between neighbouring tiles, 1e-3", apart),
        ("ghosts, % of pixels", ghosts),
    ];
    Ok(Point { setting: setting.into(), x: ms, y: mae, figures, ..Point::default() })
}
