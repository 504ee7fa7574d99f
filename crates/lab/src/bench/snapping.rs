//! Detection of blurred maps, and the effect of snapping on blurred and exact ones.

use super::measure::{Bench, Depth};
use super::subject::Subject;
use super::{Axis, Curve, Experiment, Point, experiments};
use crate::LabError;
use tmpi_core::DisparityMap;
use tmpi_pipeline::{Options, Switch, depth, edges};

type Damage = fn(&DisparityMap) -> DisparityMap;

/// One point per scene and kind of damage: the fraction of ramps, and the gain of views by snapping.
pub(super) fn run(bench: &Bench, subjects: &[Subject]) -> Result<Experiment, LabError> {
    let damages: [(&str, Damage); 4] = [
        ("exact disparity", DisparityMap::clone),
        ("halved and enlarged", depth::halved),
        ("blurred by 3×3", |map| experiments::box_blurred(map, 1)),
        ("blurred by 5×5", experiments::blurred),
    ];
    // no time is shown
    let once = Bench { repeats: 1, ..*bench };
    let mut curves = Vec::new();
    for (name, damage) in damages {
        let mut points = Vec::new();
        for subject in subjects {
            let Some(exact) = &subject.disparity else { continue };
            let options = [Switch::Auto, Switch::On, Switch::Off].map(|snap| Options { snap, ..Options::default() });
            let depth = Depth::Given(damage);
            let measured = once.figures(std::slice::from_ref(subject), &options.each_ref().map(|o| (&depth, o, 0)))?;
            let [auto, on, off] = [0, 1, 2].map(|i| measured[i].mean("view, dB"));
            let x = edges::ramp_share(&damage(exact));
            let named = [("--snap auto, dB", auto), ("--snap on, dB", on), ("--snap off, dB", off)];
            let figures = named.map(|(name, value)| (name.to_owned(), value)).into();
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
