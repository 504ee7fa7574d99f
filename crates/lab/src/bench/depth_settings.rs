//! What can be set of the depth network.

use super::experiments::{self, Plan, Set, brief};
use super::measure::{Bench, Depth};
use super::subject::Subject;
use super::{Axis, BenchError, Experiment, Settings};
use tmpi_pipeline::Options;
use tmpi_pipeline::networks::{self, models};

/// Experiments on what the depth network makes of subjects whose disparity is known.
pub(super) fn run(
    bench: &Bench,
    subjects: &[Subject],
    settings: &Settings,
    skipped: &mut Vec<String>,
    progress: &dyn Fn(&str),
) -> Result<Vec<Experiment>, BenchError> {
    if let Err(reason) = networks::available() {
        skipped.push(format!("depth network: {}", brief(&reason)));
        return Ok(Vec::new());
    }
    let mut plans = vec![depth()];
    plans.extend(depth_settings(settings.quick, &settings.networks));
    experiments::run(bench, subjects, plans, settings, progress)
}

/// A network that is given a setting.
fn network(words: String, default: bool, settings: &models::Settings) -> Option<Set> {
    let models = models::load(settings).ok()?;
    Some(Set { default, ..Set::new(words, Options::default(), Depth::By(models.depth)) })
}

const DEPTH_MS: Axis = Axis { label: "depth, ms", log: true, up: Some(false) };
const DEPTH_ERROR: Axis = Axis { label: "disparity error, 1e-3", log: false, up: Some(false) };

/// What can be set of the depth network.
fn depth_settings(quick: bool, given: &models::Settings) -> [Plan; 4] {
    let with = |change: &dyn Fn(&mut models::Settings)| {
        let mut settings = given.clone();
        change(&mut settings);
        settings
    };
    let own = |v: f64, own: f64| (v - own).abs() < 1e-12;
    let numbers: &[f64] = if quick { &[0.0, 1.0, 2.0] } else { &[0.0, 0.25, 0.5, 1.0, 2.0] };
    let smoothing = given.depth_smoothing.unwrap_or(given.depth.smoothing);
    let at = |v: f64, set: Set| Set { at: Some(v), ..set };
    let smoothed = numbers.iter().map(|s| smoothing.max(0.01) * s).filter_map(|s| {
        network(format!("--depth-smoothing {s}"), own(s, smoothing), &with(&|n| n.depth_smoothing = Some(s))).map(|set| at(s, set))
    });
    let ramp = given.depth_ramp.unwrap_or(given.depth.ramp);
    let mut steps: Vec<f64> = numbers.iter().map(|s| 0.25 * s).chain([ramp]).collect();
    steps.sort_by(f64::total_cmp);
    steps.dedup_by(|a, b| own(*a, *b));
    let ramps = steps
        .into_iter()
        .filter_map(|r| network(format!("--depth-ramp {r}"), own(r, ramp), &with(&|n| n.depth_ramp = Some(r))).map(|set| at(r, set)));
    let areas: &[u32] = if quick { &[25_000, 50_000, 200_000] } else { &[25_000, 50_000, 100_000, 200_000, 400_000] };
    let mut pixels: Vec<Set> = areas
        .iter()
        .filter_map(|&p| network(format!("--depth-pixels {p}"), given.depth_pixels == Some(p), &with(&|n| n.depth_pixels = Some(p))))
        .collect();
    pixels.extend(network("the network's default size".into(), given.depth_pixels.is_none(), given));
    let flip = given.flip.unwrap_or(given.depth.flip);
    let flips = [false, true].into_iter().filter_map(|f| network(format!("--flip {f}"), f == flip, &with(&|n| n.flip = Some(f))));
    let plan = |id, title, about, x, curve| Plan { id, title, about, axes: (x, DEPTH_ERROR), curves: vec![curve] };
    let set = |label| Axis { label, log: false, up: None };
    [
        plan("depth-pixels", "Depth network: pixels", "How many pixels of the photo the network sees.", DEPTH_MS, ("pixels", pixels)),
        plan(
            "depth-smoothing",
            "Depth network: smoothing",
            "How strongly the network's map is smoothed up to the photo's edges. It takes as long at any strength above 0.",
            set("--depth-smoothing"),
            ("smoothing", smoothed.collect()),
        ),
        plan(
            "depth-ramp",
            "Depth network: vertical ramp",
            "How much of a ramp, nearer below, is added to the network's map. It takes no time.",
            set("--depth-ramp"),
            ("ramp", ramps.collect()),
        ),
        plan(
            "depth-mirror",
            "Depth network: mirror image",
            "The network's map alone, and its mean with the map of the mirrored photo.",
            DEPTH_MS,
            ("mirror image", flips.collect()),
        ),
    ]
}

fn depth() -> Plan {
    Plan {
        id: "depth",
        title: "Depth network",
        about: "Disparity of the network against the exact one, after alignment of scale and shift.",
        axes: (DEPTH_MS, DEPTH_ERROR),
        curves: vec![("estimated", vec![Set::new("the network of --depth-model", Options::default(), Depth::Estimated)])],
    }
}
