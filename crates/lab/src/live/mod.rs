//! `tmpi-lab live-bench`: runs rendered sequences through encoder, room and reader, and measures error against time and bytes.

pub mod encode;
mod measure;
mod seams;
pub mod sequence;
mod side_view;
pub mod sweep;
pub mod tears;
mod tiles;

use std::path::PathBuf;
use std::time::Duration;

use clap::ValueEnum;
use serde::{Serialize, Serializer};

use crate::LabError;
use tmpi_core::ViewBox;
use tmpi_core::live::MAX_MOTION_FRAMES;
use tmpi_core::live::chunk::Area;
use tmpi_core::live::coder_prior::Learning;
use tmpi_live::{COOLDOWN, FramePipeline, Settings as Room, video};
use tmpi_pipeline::{Models, Options};

use encode::H264;
use sequence::{Kind, Sequence};
use sweep::OperatingPoint;

/// Default seed of the first scene, far from the seeds used for training.
pub const SEED: u64 = 900_100;
/// View box of the measured rooms, which is that of the server's rooms. The side view is at its right border. Figures of views and flicker
/// in comments of `tmpi-live` were measured with the side view at a quarter of that, and without a budget.
pub const VIEW_BOX: ViewBox = Options::VIEW_BOX;
/// First seed of the training scenes of the chunk coders.
const TRAINING_SEED: u64 = 700_000;
/// Number of training scenes, and frames of each.
const LESSONS: (u64, u32) = (12, 40);

/// What is measured.
#[derive(Clone, Debug, clap::Args)]
pub struct Flags {
    /// Measure only this sequence
    #[arg(long, value_enum, value_name = "NAME")]
    pub only: Option<Kind>,
    /// Seed of the first scene; the next two seeds are used too
    #[arg(long, default_value_t = SEED, value_name = "N")]
    pub scene: u64,
    /// Frames of each sequence
    #[arg(long, default_value_t = 240, value_parser = clap::value_parser!(u32).range(2..=100_000), value_name = "N")]
    pub frames: u32,
    /// Send only every Nth frame; the camera takes 30 per second
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=60), value_name = "N")]
    pub every: u32,
    /// Send a tile only if its new planes move some point by more than this many pixels, for some camera in the view box
    #[arg(long, default_value_t = tmpi_live::PARALLAX, value_parser = not_negative, value_name = "PX")]
    pub parallax: f64,
    /// Allowed parallax error of planes, in pixels
    #[arg(long, default_value_t = tmpi_live::MAX_ERROR, value_parser = not_negative, value_name = "PX")]
    pub max_error: f64,
    /// With estimated depth, milliseconds after sending tiles during which no others are sent
    #[arg(long, default_value_t = COOLDOWN.as_millis() as u16, value_parser = clap::value_parser!(u16).range(0..=1000), value_name = "MS")]
    pub cooldown_ms: u16,
    /// Frames by which tiles arrive late; meanwhile the reader moves labels along with motion
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=30), value_name = "N")]
    pub late: u32,
    /// Maximum number of frames for which labels follow motion; 0: they stay in place
    #[arg(long, default_value_t = MAX_MOTION_FRAMES, value_parser = clap::value_parser!(u32).range(0..=i64::from(MAX_MOTION_FRAMES)), value_name = "N")]
    pub follow: u32,
    /// Render the side view for two of every N frames
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(2..=100_000), value_name = "N")]
    pub views: u32,
    /// Write the streams, and pictures of the compared frames, views and true views, to this folder
    #[arg(long, value_name = "DIR")]
    pub files: Option<PathBuf>,
}

pub fn not_negative(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|v: &f64| v.is_finite() && *v >= 0.0).ok_or_else(|| "expected a number, 0 or more".into())
}

#[derive(Clone)]
pub struct Settings {
    pub flags: Flags,
    /// Size of the frames, bit rate and budget.
    pub at: OperatingPoint,
    /// The networks. Without a depth network, only measured depth can be used.
    pub models: Models,
    /// Whether depth can be estimated.
    pub depth: bool,
}

/// Means over the frames of a sequence. Bytes and milliseconds are per frame.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Row {
    pub sequence: &'static str,
    /// Each figure by its name, which contains the unit.
    #[serde(serialize_with = "by_name")]
    pub figures: Vec<(String, f64)>,
}

fn by_name<S: Serializer>(figures: &[(String, f64)], to: S) -> Result<S::Ok, S::Error> {
    to.collect_map(figures.iter().map(|(name, value)| (name, value)))
}

impl Row {
    /// A figure; `None` if the sequence has none of this name.
    pub fn get(&self, name: &str) -> Option<f64> {
        self.figures.iter().find(|f| f.0 == name).map(|f| f.1)
    }
}

/// Measures all sequences, and calls `progress` with the name of each; returns a row for each, and those that were skipped with the reason.
fn run(settings: &Settings, progress: &dyn Fn(&str)) -> Result<(Vec<Row>, Vec<String>), LabError> {
    let (mut rows, mut skipped) = (Vec::new(), Vec::new());
    for &kind in Kind::value_variants() {
        if settings.flags.only.is_some_and(|only| only != kind) {
            continue;
        }
        if !settings.depth && kind != Kind::Measured {
            skipped.push(format!("{}: there is no depth network", kind.name()));
            continue;
        }
        progress(kind.name());
        let Flags { scene, frames, every, .. } = settings.flags;
        let sequence = Sequence::new(kind, scene, settings.at.size, frames * every, VIEW_BOX.x);
        rows.push(measure::run(settings, kind, &sequence)?);
    }
    Ok((rows, skipped))
}

fn room(settings: &Settings, sequence: &Sequence, frame_ms: f64) -> Room {
    let (k, width) = (sequence.camera.intrinsics, 2.0 * sequence.camera.intrinsics.cx);
    let Flags { parallax, max_error, cooldown_ms, .. } = settings.flags;
    let options = Options { fov_x: Some(k.fov_x(width as u32)), max_error, view_box: VIEW_BOX, ..Options::default() };
    Room { options, parallax, cooldown: Duration::from_millis(cooldown_ms.into()), frame_ms }
}

/// Learns the initial state of the chunk coders (`crates/core/src/live/coder_prior.in`) from the chunks of rendered sequences.
pub fn learn(settings: &Settings, progress: &dyn Fn(&str)) -> Result<String, LabError> {
    let mut learning = Learning::default();
    for lesson in 0..LESSONS.0 {
        progress(&format!("lesson {} of {}", lesson + 1, LESSONS.0));
        let kind = if lesson % 3 == 2 { Kind::Moving } else { Kind::Still };
        let sequence = Sequence::new(kind, TRAINING_SEED + 3 * lesson, settings.at.size, LESSONS.1, VIEW_BOX.x);
        let (mut encoder, mut geometry) = (
            H264::new(settings.at.size, settings.at.bitrate)?,
            FramePipeline::new(settings.models.clone(), room(settings, &sequence, 0.0)),
        );
        let mut decoder = video::decoder(H264::CODEC, settings.at.size)?;
        for n in 0..LESSONS.1 {
            let shot = sequence.shot(n);
            let Some(photo) = decoder.decode(&encoder.encode(&shot.noisy)?.0)? else { continue };
            let depth = (!settings.depth || lesson % 2 == 0).then_some(shot.delta);
            let update = geometry.next(&tmpi_live::Frame { number: n.into(), at: measure::at(n), photo, depth })?;
            let Some(g) = geometry.geometry() else { continue };
            for area in Area::covering(&g.grid, |t| update.sent.contains(&t)) {
                learning.take(&g.grid, area, &g.tiles)?;
            }
        }
    }
    Ok(learning.finish())
}
