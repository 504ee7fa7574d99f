//! Error of planes fitted to clean and damaged disparity maps: the paper's third table.

use super::figures::Figures;
use super::measure::{Bench, in_turns};
use super::subject::Subject;
use super::{Axis, Curve, Experiment, Point, experiments};
use crate::LabError;
use tmpi_core::{DisparityMap, Grid, Photo};
use tmpi_pipeline::denoise::{local_planes, median_guided, theta};
use tmpi_pipeline::planes::{MAX_AUTO_PLANES, Method, Placement, discretisation_error, ghost_share, place};
use tmpi_pipeline::usage::Clock;
use tmpi_pipeline::{MakeError, edges};

/// Planes per tile, as in the paper.
const PLANES: u32 = 4;

const CPU: &str = "planes, CPU ms";
const MAE: &str = "MAE, 1e-3";

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
        (Cleaning::Snap, _) => (edges::snap(photo, map, edges::Rim::Photo), None),
        (Cleaning::Theta, Some(_)) if !theta::wanted(map) => (map.clone(), None),
        (Cleaning::Theta, Some(theta)) => {
            let (map, confidence) = theta::run(theta.as_ref(), photo, map)?;
            (map, Some(confidence))
        }
    })
}

/// Fits planes to clean and damaged maps, and measures their error against the clean map.
pub(super) fn run(bench: &Bench, subjects: &[Subject]) -> Result<Experiment, LabError> {
    let fixed = |(name, method): (&str, Method)| (format!("{name}, {PLANES} planes"), Placement::fixed(method, PLANES), Cleaning::Off);
    let mut settings: Vec<(String, Placement, Cleaning)> = experiments::METHODS.map(fixed).into();
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
        curves.push(Curve { name: name.into(), points: points(bench, subjects, &settings, damage)? });
    }
    Ok(Experiment {
        id: "discretisation".into(),
        title: "Planes on clean and damaged maps".into(),
        about: "Planes fitted to a clean map, to one with noise, and to one blurred by 5×5 pixels. All errors are relative to the clean map, in thousandths, as in the paper's third table. Ghosts are pixels whose plane is more than 0.05 from every true surface within two pixels. Subjects are photos with a disparity map beside them, otherwise rendered scenes.".into(),
        x: Axis::new(CPU, true, Some(false)),
        y: Axis::new(MAE, true, Some(false)),
        curves,
    })
}

/// One point per setting, for maps with this damage.
fn points(
    bench: &Bench,
    subjects: &[Subject],
    settings: &[(String, Placement, Cleaning)],
    damage: fn(&DisparityMap) -> DisparityMap,
) -> Result<Vec<Point>, LabError> {
    let mut all = vec![Figures::default(); settings.len()];
    let known = subjects.iter().filter_map(|s| Some((s, s.disparity.as_deref()?)));
    for (at, (s, clean)) in known.enumerate() {
        let (photo, damaged) = (s.decoded()?.photo, damage(clean));
        let map = |(_, _, cleaning): &(String, Placement, Cleaning)| cleaned(bench, *cleaning, &photo, &damaged);
        let maps = settings.iter().map(map).collect::<Result<Vec<_>, _>>();
        let maps = maps.map_err(|source| LabError::Make { subject: s.name.clone(), source })?;
        let grid = Grid::new(clean.width, clean.height, 64);
        in_turns(settings.len(), bench.repeats, |i, round| {
            let (f, (map, weights), placement) = (&mut all[i], &maps[i], &settings[i].1);
            let clock = Clock::start();
            let tiles = place(map, weights.as_deref(), &grid, placement);
            let ms = clock.ms();
            f.add_run(CPU, at, clock.cpu_ms());
            if round == 0 {
                let (mae, mse, q25) = discretisation_error(clean, &grid, &tiles);
                f.add(MAE, mae * 1e3);
                f.add("MSE, 1e-3", mse * 1e3);
                f.add("Q25, 1e-3", q25 * 1e3);
                f.add("planes per tile", tiles.iter().map(|t| t.planes.len()).sum::<usize>() as f64 / tiles.len().max(1) as f64);
                f.add("ghosts, % of pixels", 100.0 * ghost_share(clean, &grid, &tiles, GHOST));
            }
            Ok(ms)
        })?;
    }
    Ok(all.into_iter().zip(settings).map(|(f, (words, ..))| f.point(words.clone(), (CPU, MAE))).collect())
}
