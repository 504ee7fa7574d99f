//! Measures each family of rendered scenes separately. Shows which are difficult, above all thin structures, and how well neighbouring
//! tiles agree.

use super::ablation::{Prepared, Without};
use super::measure::Bench;
use super::subject::{self, Subject};
use super::{Axis, BenchError, Curve, Experiment};

/// Scenes per family.
const SCENES: usize = 3;

/// Measures views of each family with planes, planes and Ψ, and the mesh.
pub(super) fn run(bench: &Bench, quick: bool, progress: &dyn Fn(&str)) -> Result<Experiment, BenchError> {
    progress("Families of scenes");
    let subjects = subject::by_family(if quick { 1 } else { SCENES })?;
    let (x, y) = (
        Axis { label: "difference between neighbouring tiles, 1e-3", log: true, up: None },
        Axis { label: "view, dB", log: false, up: None },
    );
    let psi = bench.psi();
    let mut methods = vec![("planes", Without::Nothing), ("mesh", Without::Planes)];
    if psi.is_some() {
        methods.insert(1, ("planes and Ψ", Without::Refined));
    }
    let mut curves: Vec<Curve> = methods.iter().map(|(name, _)| Curve { name: (*name).into(), points: Vec::new() }).collect();
    for (family, scenes) in &subjects {
        let prepared = scenes.iter().filter_map(|s| Prepared::new(s, psi).transpose()).collect::<Result<Vec<_>, _>>()?;
        let apart = prepared.iter().map(Prepared::neighbour_difference).sum::<f64>() * 1e3 / prepared.len().max(1) as f64;
        for ((_, without), curve) in methods.iter().zip(&mut curves) {
            let mut p =
                super::ablation::point(&prepared, (*family).into(), *without, tmpi_pipeline::planes::NEIGHBOUR_COST, (x.label, y.label))?;
            (p.x, p.default) = (apart, *without == Without::Nothing);
            curve.points.push(p);
        }
    }
    Ok(Experiment {
        id: "families",
        title: "Families of scenes".into(),
        about: "Exact disparity and the photo's own pixels, without compression: views of each family of scenes, from wide rooms to wires and leaves, and the difference between neighbouring tiles in their overlap. The mesh has no tiles, so it has the x value of the planes.".into(),
        x,
        y,
        curves,
    })
}

/// Subjects by family name.
pub(super) type Families = Vec<(&'static str, Vec<Subject>)>;
