//! `tmpi-lab live-bench`: runs rendered sequences through encoder, room and reader, and measures error against time and bytes.

pub mod encode;
mod measure;
mod seams;
pub mod sequence;
mod side_view;
pub mod sweep;
mod tiles;

use std::path::PathBuf;
use std::time::Duration;

use serde::{Serialize, Serializer};

use tmpi_core::live::chunk::Area;
use tmpi_core::live::coder_prior::Learning;
use tmpi_live::{FramePipeline, GeometryError, Settings as Room, video};
use tmpi_pipeline::{Models, Options};

use encode::H264;
use sequence::{Kind, Sequence};

/// Short names of the sequences.
pub const NAMES: [&str; 4] = [Kind::ALL[0].slug(), Kind::ALL[1].slug(), Kind::ALL[2].slug(), Kind::ALL[3].slug()];
/// Default seed of the first scene, far from the seeds used for training.
pub const SEED: u64 = 900_100;
/// First seed of the training scenes of the chunk coders.
const TRAINING_SEED: u64 = 700_000;
/// Number of training scenes, and frames of each.
const LESSONS: (u64, u32) = (12, 40);

/// Why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum LiveBenchError {
    /// A frame could not be encoded.
    #[error("cannot encode a frame: {0}")]
    Encode(String),
    /// A frame could not be decoded.
    #[error(transparent)]
    Video(#[from] video::VideoError),
    /// The geometry of a frame could not be computed.
    #[error(transparent)]
    Geometry(#[from] GeometryError),
    /// A reader could not decode a message.
    #[error(transparent)]
    Live(#[from] tmpi_core::live::LiveError),
    /// A view could not be rendered.
    #[error(transparent)]
    Render(#[from] tmpi_render::RenderError),
    /// A file could not be written.
    #[error("{0}")]
    Write(PathBuf, #[source] std::io::Error),
}

/// Settings of a measurement.
#[derive(Clone)]
pub struct Settings {
    /// Size of the frames.
    pub size: (u32, u32),
    /// Seed of the first scene; the next two seeds are used too.
    pub seed: u64,
    /// Frames per sequence.
    pub frames: u32,
    /// Sends only every Nth frame; the camera takes 30 per second.
    pub every: u32,
    /// H.264 bits per second.
    pub bitrate: u32,
    /// Milliseconds that the geometry of a frame may take; 0: no limit.
    pub frame_ms: f64,
    /// Renders the side view every Nth frame, and for the frame after it.
    pub views: u32,
    /// The networks. Without a depth network, only measured depth can be used.
    pub models: Models,
    /// Whether depth can be estimated.
    pub depth: bool,
    /// Allowed parallax error of planes, in pixels.
    pub max_error: f64,
    /// Displacement, in pixels, below which a tile is not sent again.
    pub parallax: f64,
    /// Time after sending tiles during which no others are sent.
    pub cooldown: Duration,
    /// Number of frames by which tiles reach readers late.
    pub late: u32,
    /// Maximum number of frames for which readers' labels follow motion.
    pub follow: u32,
    /// When to estimate depth again near past motion.
    pub recheck: tmpi_live::RecheckSettings,
    /// Measures only the sequence of this name.
    pub only: Option<String>,
    /// Folder for the streams and some pictures.
    pub files: Option<PathBuf>,
}

/// Means over the frames of a sequence. Bytes and milliseconds are per frame.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Row {
    /// Name of the sequence.
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
    #[must_use]
    pub fn get(&self, name: &str) -> Option<f64> {
        self.figures.iter().find(|f| f.0 == name).map(|f| f.1)
    }
}

/// Measures all sequences, and calls `progress` with the name of each; returns a row for each, and those that were skipped with the reason.
fn run(settings: &Settings, progress: &dyn Fn(&str)) -> Result<(Vec<Row>, Vec<String>), LiveBenchError> {
    let (mut rows, mut skipped) = (Vec::new(), Vec::new());
    for kind in Kind::ALL {
        if settings.only.as_ref().is_some_and(|name| name != kind.slug()) {
            continue;
        }
        if !settings.depth && kind != Kind::Measured {
            skipped.push(format!("{}: there is no depth network", kind.name()));
            continue;
        }
        progress(kind.name());
        let sequence = Sequence::new(kind, settings.seed, settings.size, settings.frames * settings.every, measure::SIDE_OFFSET);
        rows.push(measure::run(settings, kind, &sequence)?);
    }
    Ok((rows, skipped))
}

/// Settings of the room for a sequence.
fn room(settings: &Settings, sequence: &Sequence, frame_ms: f64) -> Room {
    let (k, width) = (sequence.intrinsics(), 2.0 * sequence.intrinsics().cx);
    let options = Options { fov_x: Some(k.fov_x(width as u32)), max_error: settings.max_error, ..Options::default() };
    Room { options, parallax: settings.parallax, cooldown: settings.cooldown, recheck: settings.recheck, frame_ms, ..Room::default() }
}

/// Learns the initial state of the chunk coders (`crates/core/src/live/coder_prior.in`) from the chunks of rendered sequences.
///
/// # Errors
/// [`LiveBenchError`].
pub fn learn(settings: &Settings, progress: &dyn Fn(&str)) -> Result<String, LiveBenchError> {
    let mut learning = Learning::default();
    for lesson in 0..LESSONS.0 {
        progress(&format!("lesson {} of {}", lesson + 1, LESSONS.0));
        let kind = if lesson % 3 == 2 { Kind::Moving } else { Kind::Still };
        let sequence = Sequence::new(kind, TRAINING_SEED + 3 * lesson, settings.size, LESSONS.1, measure::SIDE_OFFSET);
        let (mut encoder, mut geometry) =
            (H264::new(settings.size, settings.bitrate)?, FramePipeline::new(settings.models.clone(), room(settings, &sequence, 0.0)));
        let mut decoder = video::decoder(H264::CODEC, settings.size)?;
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
