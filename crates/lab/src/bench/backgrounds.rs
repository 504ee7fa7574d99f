//! Rules by which background planes are fitted to samples of wide margins, against fits to every pixel.

use super::ablation::{Prepared, Without};
use super::experiments::{VIEW, scaled};
use super::measure::{Bench, in_turns};
use super::subject::{self, Subject};
use super::{Axis, Curve, Experiment, Figures, Point};
use crate::LabError;
use tmpi_core::{Geometry, Plane, Pose, Rect, ViewBox};
use tmpi_pipeline::Parallax;
use tmpi_pipeline::layers::{BackgroundSamples, add_backgrounds_by};
use tmpi_pipeline::planes::NEIGHBOUR_COST;
use tmpi_pipeline::usage::Clock;

const TIME: &str = "backgrounds, ms";
const USUAL: BackgroundSamples = BackgroundSamples::DEFAULT;
const EVERY: BackgroundSamples = BackgroundSamples { dense: u32::MAX, ..USUAL };

/// Margins are wide in large photos and view boxes only: large scenes, seen from two corners of a wide box.
pub(super) fn run(bench: &Bench, quick: bool) -> Result<Experiment, LabError> {
    let view_box = scaled(2.0);
    let ViewBox { x, y, .. } = view_box;
    let scenes = subject::large(quick, |_| vec![Pose::at(x, -y, 0.0), Pose::at(-x, y, 0.0)])?;
    let fewest: &[usize] = if quick { &[8, 32, 128] } else { &[8, 16, 32, 64, 128] };
    Ok(Experiment {
        id: "backgrounds".into(),
        title: "Samples for background planes".into(),
        about: "Planes behind a tile are fitted to what is farther around it. In margins of more than 96 pixels, every nth pixel of every nth row counts, and it takes at least 32/n of them. Rendered scenes of 3.8 megapixels, with exact disparity and without compression, are drawn from two corners of a view box that is twice as wide as the default one, so that margins are as wide as those of 15 megapixels; compared with other rules, and with fits to every pixel.".into(),
        x: Axis::new(TIME, true, Some(false)),
        y: VIEW,
        curves: curves(bench, &scenes, view_box, fewest)?,
    })
}

fn curves(bench: &Bench, scenes: &[Subject], view_box: ViewBox, fewest: &[usize]) -> Result<Vec<Curve>, LabError> {
    let least = |&fewest: &usize| ("at least fewest / n", format!("{fewest}/n"), BackgroundSamples { fewest, ..USUAL });
    let others = [
        ("at least as many, whatever n", "32".to_owned(), BackgroundSamples { power: 0, ..USUAL }),
        ("at least fewest / n²", "32/n²".to_owned(), BackgroundSamples { power: 2, ..USUAL }),
        ("every pixel", "32 of all".to_owned(), EVERY),
    ];
    let rules: Vec<_> = fewest.iter().map(least).chain(others).collect();
    let mut all = vec![Figures::default(); rules.len()];
    for (at, s) in scenes.iter().enumerate() {
        let Some(prepared) = Prepared::new(s, view_box, None)? else { continue };
        let bare = prepared.geometry(Without::Backgrounds, NEIGHBOUR_COST);
        let with = |rule: BackgroundSamples| {
            let mut geometry = bare.clone();
            let clock = Clock::start();
            add_backgrounds_by(&mut geometry, &prepared.snapped, rule);
            (clock.ms(), geometry)
        };
        let (_, every) = with(EVERY);
        in_turns(rules.len(), bench.repeats, |i, round| {
            let (ms, geometry) = with(rules[i].2);
            all[i].add_run(TIME, at, ms);
            if round == 0 {
                add_distance(&mut all[i], &geometry, &every);
                prepared.add(&mut all[i], &geometry, Without::Nothing)?;
            }
            Ok(ms)
        })?;
    }
    let mut curves: Vec<Curve> = Vec::new();
    for ((name, words, rule), f) in rules.into_iter().zip(all) {
        let point = Point { default: rule == USUAL, ..f.point(words, (TIME, &VIEW.label)) };
        match curves.last_mut().filter(|c| c.name == name) {
            Some(curve) => curve.points.push(point),
            None => curves.push(Curve { name: name.into(), points: vec![point] }),
        }
    }
    Ok(curves)
}

/// Adds how many tiles have a background, and how far it is from the one fitted to every pixel.
fn add_distance(f: &mut Figures, got: &Geometry, every: &Geometry) {
    let whole = Rect { x: 0, y: 0, w: got.grid.width, h: got.grid.height };
    let shift = Parallax::new(got.intrinsics, got.view_box).most(whole);
    let both: Vec<(Option<Plane>, Option<Plane>)> = got.tiles.iter().zip(&every.tiles).map(|(a, b)| (a.background, b.background)).collect();
    let farthest = |(a, b): (Plane, Plane)| {
        let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)];
        corners.map(|(u, v)| (a.disparity(u, v) - b.disparity(u, v)).abs()).into_iter().fold(0.0, f64::max)
    };
    let distances: Vec<f64> = both.iter().filter_map(|&(a, b)| Some(farthest((a?, b?)))).collect();
    let share = |count: usize| 100.0 * count as f64 / both.len().max(1) as f64;
    f.add("from planes of every pixel, px", shift * distances.iter().sum::<f64>() / distances.len().max(1) as f64);
    f.add("tiles with a background, %", share(both.iter().filter(|(a, _)| a.is_some()).count()));
    f.add("tiles with one by this rule or by every pixel only, %", share(both.iter().filter(|(a, b)| a.is_some() != b.is_some()).count()));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::oracle_depth;

    #[test]
    fn rules_are_compared_with_every_pixel() {
        let models = oracle_depth::none();
        let bench = Bench { models: &models, repeats: 2 };
        let scene = subject::scene(900_300, (384, 128), &[Pose::at(0.05, 0.0, 0.0)]).unwrap();
        // margins of more than 96 pixels
        let curves = curves(&bench, &[scene], ViewBox { x: 1.0, y: 0.1, z: 0.0 }, &[8, 32]).unwrap();
        assert_eq!(curves.iter().map(|c| c.points.len()).collect::<Vec<_>>(), [2, 1, 1, 1]);
        let points: Vec<&Point> = curves.iter().flat_map(|c| &c.points).collect();
        assert_eq!(points.iter().map(|p| p.default).collect::<Vec<_>>(), [false, true, false, false, false]);
        assert!(points.iter().all(|p| p.x > 0.0 && p.y > 10.0 && p.figures.iter().all(|f| f.1.is_finite())), "{points:?}");
        let figure = |p: &Point, name: &str| p.figures.iter().find(|f| f.0 == name).map(|f| f.1);
        assert_eq!(figure(points[4], "from planes of every pixel, px"), Some(0.0));
        assert_eq!(figure(points[4], "tiles with one by this rule or by every pixel only, %"), Some(0.0));
    }

    #[test]
    fn other_planes_and_missing_ones_count() {
        let scene = subject::scene(900_300, (96, 64), &[]).unwrap();
        let prepared = Prepared::new(&scene, scaled(1.0), None).unwrap().unwrap();
        let bare = prepared.geometry(Without::Backgrounds, NEIGHBOUR_COST);
        let with = |planes: [Option<f64>; 2]| {
            let mut geometry = bare.clone();
            geometry.tiles.iter_mut().zip(planes).for_each(|(tile, delta)| tile.background = delta.map(Plane::fronto_parallel));
            geometry
        };
        let mut f = Figures::default();
        add_distance(&mut f, &with([Some(0.5), Some(0.25)]), &with([Some(0.25), None]));
        let tiles = bare.tiles.len() as f64;
        let shift = Parallax::new(bare.intrinsics, bare.view_box).most(Rect { x: 0, y: 0, w: 96, h: 64 });
        let figures = f.means().into_iter().map(|(_, value)| value).collect::<Vec<_>>();
        assert!(figures.iter().zip([0.25 * shift, 200.0 / tiles, 100.0 / tiles]).all(|(a, b)| (a - b).abs() < 1e-9), "{figures:?}");
    }
}
