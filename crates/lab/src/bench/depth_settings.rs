//! What can be set of the depth network.

use super::experiments::{Plan, Set, brief};
use super::measure::{Bench, Depth};
use super::subject::Subject;
use super::{Axis, Log};
use crate::LabError;
use tmpi_pipeline::Options;
use tmpi_pipeline::networks::{self, models};

const MS: Axis = Axis::new("depth, ms", true, Some(false));
const ERROR: Axis = Axis::new("disparity error, 1e-3", false, Some(false));

/// Makes a plan from the given settings; a short one if it is to be quick.
type Make = fn(&models::Settings, bool) -> Plan;

/// Experiments on what the depth network makes of subjects whose disparity is known.
pub(super) fn run(bench: &Bench, subjects: &[Subject], log: &mut Log) -> Result<(), LabError> {
    if let Err(reason) = networks::available() {
        log.results.skipped.push(format!("depth network: {}", brief(&reason)));
        return Ok(());
    }
    let plans: [(&str, Make); 4] = [("depth", pixels), ("depth-smoothing", smoothing), ("depth-ramp", ramp), ("depth-mirror", mirror)];
    let settings = log.settings;
    // a plan loads networks
    let run = |id, plan: Make| Plan { id, ..plan(&settings.networks, settings.flags.quick) }.run(bench, subjects);
    plans.into_iter().try_for_each(|(id, plan)| log.run(id, || run(id, plan)))
}

/// The network with a setting changed; `None` if it cannot be loaded.
fn network(words: String, default: bool, given: &models::Settings, change: impl FnOnce(&mut models::Settings)) -> Option<Set> {
    let mut settings = given.clone();
    change(&mut settings);
    let models = models::load(&settings).ok()?;
    Some(Set { default, ..Set::new(words, Options::default(), Depth::By(models.depth)) })
}

fn plan(title: &'static str, about: &'static str, x: Axis, sets: impl IntoIterator<Item = Set>) -> Plan {
    Plan { id: "", title, about, axes: (x, ERROR), curves: vec![("network", sets.into_iter().collect())] }
}

fn pixels(given: &models::Settings, quick: bool) -> Plan {
    let areas: &[u32] = if quick { &[25_000, 50_000, 200_000] } else { &[25_000, 50_000, 100_000, 200_000, 400_000] };
    let sets = areas
        .iter()
        .filter_map(|&p| network(format!("--depth-pixels {p}"), given.depth_pixels == Some(p), given, |n| n.depth_pixels = Some(p)));
    let own = network("the network's default size".into(), given.depth_pixels.is_none(), given, |_| {});
    let about = "How many pixels of the photo the network sees; its disparity against the exact one, after alignment of scale and shift.";
    plan("Depth network: pixels", about, MS, sets.chain(own))
}

fn smoothing(given: &models::Settings, quick: bool) -> Plan {
    let own = given.depth_smoothing.unwrap_or(given.depth.smoothing);
    let factors: &[f64] = if quick { &[0.0, 1.0, 2.0] } else { &[0.0, 0.25, 0.5, 1.0, 2.0] };
    let sets = factors.iter().map(|by| own.max(0.01) * by).filter_map(|s| {
        let set = network(format!("--depth-smoothing {s}"), (s - own).abs() < 1e-12, given, |n| n.depth_smoothing = Some(s))?;
        Some(Set { at: Some(s), ..set })
    });
    let about = "How strongly the network's map is smoothed up to the photo's edges. It takes as long at any strength above 0.";
    plan("Depth network: smoothing", about, Axis::new("--depth-smoothing", false, None), sets)
}

fn ramp(given: &models::Settings, _: bool) -> Plan {
    let own = given.depth_ramp.unwrap_or(given.depth.ramp);
    let mut ramps = vec![0.0, 0.125, 0.25, 0.5, own];
    ramps.sort_by(f64::total_cmp);
    ramps.dedup();
    let sets = ramps.into_iter().filter_map(|r| {
        let set = network(format!("--depth-ramp {r}"), (r - own).abs() < 1e-12, given, |n| n.depth_ramp = Some(r))?;
        Some(Set { at: Some(r), ..set })
    });
    let about = "How much of a ramp, nearer below, is added to the network's map. It takes no time.";
    plan("Depth network: vertical ramp", about, Axis::new("--depth-ramp", false, None), sets)
}

fn mirror(given: &models::Settings, _: bool) -> Plan {
    let own = given.flip.unwrap_or(given.depth.flip);
    let sets = [false, true].into_iter().filter_map(|flip| network(format!("--flip {flip}"), flip == own, given, |n| n.flip = Some(flip)));
    let about = "The network's map alone, and its mean with the map of the mirrored photo.";
    plan("Depth network: mirror image", about, MS, sets)
}
