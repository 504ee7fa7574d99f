//! What a budget of milliseconds makes of a room's frames.

use super::sweep::{self, OperatingPoint};
use super::{LiveBenchError, NAMES, SEED, Settings};
use crate::bench::{Axis, Curve, Experiment, Point};
use tmpi_pipeline::Models;
use tmpi_pipeline::networks;

/// Size of the frames, as the publishing page has them, and bits a second at which it sends them.
const SIZE: (u32, u32) = (320, 240);
const BITRATE: u32 = 384_000;
/// Times the usual budget; the last stands for none.
const BUDGETS: [f64; 6] = [0.25, 0.4, 0.6, 1.0, 1.5, 0.0];

/// Rendered sequences at several budgets; one and fewer frames where it is to be quick. What cannot be measured is added to `skipped`.
///
/// # Errors
/// [`LiveBenchError`].
pub fn experiment(models: &Models, quick: bool, skipped: &mut Vec<String>, progress: &dyn Fn(&str)) -> Result<Experiment, LiveBenchError> {
    let settings = Settings {
        size: SIZE,
        seed: SEED,
        frames: if quick { 30 } else { 150 },
        every: 1,
        bitrate: Some(BITRATE),
        frame_ms: 0.0,
        views: 10,
        models: models.clone(),
        depth: networks::available().is_ok(),
        true_scale: false,
        max_error: tmpi_live::MAX_ERROR,
        parallax: tmpi_live::PARALLAX,
        cooldown: tmpi_live::COOLDOWN,
        late: 0,
        follow: tmpi_core::live::MAX_MOTION_FRAMES,
        recheck: tmpi_live::RECHECK,
        only: quick.then(|| NAMES[0].into()),
        files: None,
    };
    let at = BUDGETS.map(|by| OperatingPoint { size: SIZE, bitrate: Some(BITRATE), budget_ms: by * tmpi_live::BUDGET_MS });
    let found = sweep::measure(&settings, &at, &|what| progress(&format!("budget of a room: {what}")))?;
    skipped.extend(found.skipped.iter().cloned());
    let curves = found.curves(|f| f.server_ms).into_iter().map(|c| Curve { points: marked(c.points, &at), ..c });
    let mut experiment = Experiment {
        id: "live-budget",
        title: "Budget of a room's frames".into(),
        about: format!(
            "Milliseconds that depth, planes and tiles of a frame may take: with less, depth is coarser and tiles wait. Rendered sequences of {} frames \
             of {}×{} pixels; views from beside the camera against the exact ones.",
            settings.frames, SIZE.0, SIZE.1
        ),
        x: Axis { label: "server, ms a frame", log: true, up: Some(false) },
        y: Axis { label: "view, dB", log: false, up: Some(true) },
        curves: curves.collect(),
    };
    experiment.mark();
    Ok(experiment)
}

/// The points of a sequence, with that of the usual budget told.
fn marked(points: Vec<Point>, at: &[OperatingPoint]) -> Vec<Point> {
    let usual = |at: &OperatingPoint| (at.budget_ms - tmpi_live::BUDGET_MS).abs() < 1e-9;
    let named = |at: &OperatingPoint| if at.budget_ms > 0.0 { format!("budget-ms {}", at.budget_ms) } else { "without a budget".into() };
    points.into_iter().zip(at).map(|(p, at)| Point { default: usual(at), setting: named(at), ..p }).collect()
}
