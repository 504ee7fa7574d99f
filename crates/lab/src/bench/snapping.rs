//! Detection of blurred maps, and the effect of snapping on blurred and exact ones.

use super::measure::{Bench, Depth};
use super::subject::Subject;
use super::{Axis, Curve, Experiment, Point, experiments, figures};
use crate::LabError;
use tmpi_core::DisparityMap;
use tmpi_pipeline::depth;
use tmpi_pipeline::edges;
use tmpi_pipeline::{Options, Switch};

/// A function that degrades a map.
type Damage = fn(&DisparityMap) -> DisparityMap;

/// One point per scene and kind of damage: the fraction of ramps, and the gain of views by snapping.
pub(super) fn run(bench: &Bench, subjects: &[Subject]) -> Result<Experiment, LabError> {
    let damages: [(&str, Damage); 4] = [
        ("exact disparity", DisparityMap::clone),
        ("halved and enlarged", depth::halved),
        ("blurred by 3×3", |map| experiments::box_blurred(map, 1)),
        ("blurred by 5×5", experiments::blurred),
    ];
    let mut curves = Vec::new();
    for (name, damage) in damages {
        let mut points = Vec::new();
        for subject in subjects {
            let Some(exact) = &subject.disparity else { continue };
            let view = |snap: Switch| -> Result<f64, LabError> {
                let options = Options { snap, ..Options::default() };
                Ok(bench.figures(std::slice::from_ref(subject), &Depth::Given(damage), &options, 0)?.mean("view, dB"))
            };
            let (x, auto, on, off) = (edges::ramp_share(&damage(exact)), view(Switch::Auto)?, view(Switch::On)?, view(Switch::Off)?);
            let figures = figures([("--snap auto, dB", auto), ("--snap on, dB", on), ("--snap off, dB", off)]);
            points.push(Point { setting: subject.name.clone(), x: 100.0 * x, y: on - off, figures, ..Point::default() });
        }
        curves.push(Curve { name: name.into(), points });
    }
    Ok(Experiment {
        id: "ramps".into(),
        title: "Detection of blurred maps".into(),
        about: format!(
            "Exact maps and maps degraded in three ways, each provided as a file; one point per scene. Above {} % of ramps, tmpi treats a map as blurred and snaps it to the photo's edges; below, it applies only the careful median.",
            100.0 * edges::BLURRED
        ),
        x: Axis::new("ramps, % of pixels at edges", false, None),
        y: Axis::new("views with --snap on − off, dB", false, Some(true)),
        curves,
    })
}
