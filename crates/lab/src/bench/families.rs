//! Every family of rendered scenes by itself: what is hard, thin structures before all, and how well neighbouring tiles agree there.

use super::ablation::{Prepared, Without};
use super::measure::Bench;
use super::subject::{self, Subject};
use super::{Axis, BenchError, Curve, Experiment};

/// Scenes of a family.
const SCENES: usize = 3;

/// Views of scenes of each family: planes, planes with Ψ, and the mesh.
pub(super) fn run(bench: &Bench, quick: bool, progress: &dyn Fn(&str)) -> Result<Experiment, BenchError> {
    progress("Families of scenes");
    let subjects = subject::by_family(if quick { 1 } else { SCENES })?;
    let (x, y) = (Axis { label: "neighbours apart, 1e-3", log: true, up: None }, Axis { label: "view, dB", log: false, up: None });
    let psi = bench.psi();
    let mut ways = vec![("planes", Without::Nothing), ("mesh", Without::Planes)];
    if psi.is_some() {
        ways.insert(1, ("planes and Ψ", Without::Refined));
    }
    let mut curves: Vec<Curve> = ways.iter().map(|(name, _)| Curve { name: (*name).into(), points: Vec::new() }).collect();
    for (family, scenes) in &subjects {
        let prepared = scenes.iter().filter_map(|s| Prepared::new(s, psi).transpose()).collect::<Result<Vec<_>, _>>()?;
        let apart = prepared.iter().map(Prepared::neighbours_apart).sum::<f64>() * 1e3 / prepared.len().max(1) as f64;
        for ((_, without), curve) in ways.iter().zip(&mut curves) {
            let mut p =
                super::ablation::point(&prepared, (*family).into(), *without, tmpi_pipeline::planes::NEIGHBOUR, (x.label, y.label))?;
            (p.x, p.default) = (apart, *without == Without::Nothing);
            curve.points.push(p);
        }
    }
    Ok(Experiment {
        id: "families",
        title: "Families of scenes".into(),
        about: "Exact disparity and the photo's own pixels, no coding: views of scenes of each family, from wide rooms to wires and leaves, and how far neighbouring tiles are from showing the same where both lie. The mesh has no tiles; it stands at the place of the planes.".into(),
        x,
        y,
        curves,
    })
}

/// Scenes by the name of their family.
pub(super) type Families = Vec<(&'static str, Vec<Subject>)>;
