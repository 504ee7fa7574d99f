//! `tmpi-lab live-bench`.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use clap::CommandFactory;
use clap::error::ErrorKind;

use super::{Cli, note, result, size, write};
use tmpi_core::live::{MAX_MOTION_FRAMES, MAX_PIXELS};
use tmpi_lab::live;
use tmpi_lab::live::sweep::OperatingPoint;
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::{self, models};

/// Measure rendered sequences from camera to viewer: error against time and bytes
#[derive(Clone, Debug, clap::Args)]
pub(super) struct LiveBenchArgs {
    /// Frame size. With several sizes, measures all sequences at each size, bit rate and budget, and prints one line for each
    #[arg(long, value_delimiter = ',', default_value = "320x240", value_parser = |text: &str| size(text, MAX_PIXELS), value_name = "WxH,…")]
    size: Vec<(u32, u32)>,
    /// Measure only this sequence
    #[arg(long, value_parser = live::NAMES, value_name = "NAME")]
    only: Option<String>,
    /// Seed of the first scene; the next two seeds are used too
    #[arg(long, default_value_t = live::SEED, value_name = "N")]
    scene: u64,
    /// Frames of each sequence
    #[arg(long, default_value_t = 240, value_parser = clap::value_parser!(u32).range(2..=100_000), value_name = "N")]
    frames: u32,
    /// Send only every Nth frame; the camera takes 30 per second
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=60), value_name = "N")]
    every: u32,
    /// H.264 bits per second; may be several. Default: that of the publishing page, 384 kbit/s at 320×240 and more for larger frames
    #[arg(long, value_delimiter = ',', value_name = "N,…")]
    bitrate: Vec<u32>,
    /// Milliseconds that the geometry of a frame may take; may be several. Sets depth size, planes and tiles by earlier measurements. 0: no
    /// limit
    #[arg(long, value_delimiter = ',', default_value = "0", value_parser = milliseconds, value_name = "MS,…")]
    budget_ms: Vec<f64>,
    /// Write plots of error against run time and bytes to this file, if several points are measured
    #[arg(long, value_name = "FILE.html")]
    page: Option<PathBuf>,
    /// Send a tile only if its new planes move some point by more than this many pixels, for some camera in the view box
    #[arg(long, default_value_t = tmpi_live::PARALLAX, value_parser = parallax, value_name = "PX")]
    parallax: f64,
    /// Allowed parallax error of planes, in pixels
    #[arg(long, default_value_t = tmpi_live::MAX_ERROR, value_parser = parallax, value_name = "PX")]
    max_error: f64,
    /// Frames between the last change near a block and a second estimate of its depth; 0: none
    #[arg(long, default_value_t = tmpi_live::RECHECK.frames, value_name = "N")]
    settle: u8,
    /// Radius around a changed block that counts as near, in blocks of 8 pixels
    #[arg(long, default_value_t = tmpi_live::RECHECK.blocks, value_name = "N")]
    settle_blocks: u8,
    /// With estimated depth, milliseconds after sending tiles during which no others are sent
    #[arg(long, default_value_t = tmpi_live::COOLDOWN.as_millis() as u16, value_parser = clap::value_parser!(u16).range(0..=1000), value_name = "MS")]
    rest_ms: u16,
    /// Frames by which tiles arrive late; meanwhile the reader moves labels along with motion
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=30), value_name = "N")]
    late: u32,
    /// Maximum number of frames for which labels follow motion; 0: they stay in place
    #[arg(long, default_value_t = MAX_MOTION_FRAMES, value_parser = clap::value_parser!(u32).range(0..=i64::from(MAX_MOTION_FRAMES)), value_name = "N")]
    follow: u32,
    /// Render the side view for two of every N frames
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(2..=100_000), value_name = "N")]
    views: u32,
    /// Write the streams, and pictures of the compared frames, views and true views, to this folder
    #[arg(long, value_name = "DIR")]
    files: Option<PathBuf>,
    /// Print the results as JSON
    #[arg(long)]
    json: bool,
    /// Instead, learn the initial state of the chunk coders and write it to this file
    #[arg(long, value_name = "FILE")]
    learn: Option<PathBuf>,
    #[command(flatten)]
    models: ModelFlags,
}

/// Bits per second and pixel, as on the publishing page (`static/live/encoders.js`): 384 kbit/s at 320×240.
const RATE: f64 = 5.0;

fn parallax(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|px: &f64| px.is_finite() && *px >= 0.0).ok_or_else(|| "expected pixels, 0 or more".into())
}

fn milliseconds(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|ms: &f64| ms.is_finite() && *ms >= 0.0).ok_or_else(|| "expected milliseconds, 0 or more".into())
}

/// All combinations of size, bit rate and budget.
fn points(args: &LiveBenchArgs) -> Vec<OperatingPoint> {
    let mut points = Vec::new();
    for &size in &args.size {
        let usual = [(RATE * f64::from(size.0) * f64::from(size.1)) as u32];
        let bitrates: &[u32] = if args.bitrate.is_empty() { &usual } else { &args.bitrate };
        for &bitrate in bitrates {
            points.extend(args.budget_ms.iter().map(|&budget_ms| OperatingPoint { size, bitrate, budget_ms }));
        }
    }
    points
}

pub(super) fn run(args: &LiveBenchArgs) -> anyhow::Result<()> {
    let points = points(args);
    let first = points.first().context("at least one size and one budget are required")?;
    if points.len() > 1 && (args.learn.is_some() || args.files.is_some()) {
        let reason = "--learn and --files accept only one size, bit rate and budget";
        Cli::command().error(ErrorKind::ArgumentConflict, reason).exit();
    }
    let progress = |what: &str| note(&format!("tmpi-lab live-bench: {what}"));
    let settings = live::Settings {
        size: first.size,
        seed: args.scene,
        frames: args.frames,
        every: args.every,
        bitrate: first.bitrate,
        frame_ms: first.budget_ms,
        views: args.views,
        models: models::load(&args.models.settings_of_rooms())?,
        depth: networks::available().is_ok(),
        parallax: args.parallax,
        max_error: args.max_error,
        cooldown: Duration::from_millis(args.rest_ms.into()),
        late: args.late,
        follow: args.follow,
        recheck: tmpi_live::RecheckSettings { frames: args.settle, blocks: args.settle_blocks },
        files: args.files.clone(),
        only: args.only.clone(),
    };
    if let Some(file) = &args.learn {
        return write(file, live::learn(&settings, &progress)?.as_bytes());
    }
    let found = live::sweep::measure(&settings, &points, &progress)?;
    found.skipped.iter().for_each(|s| note(&format!("skipped: {s}")));
    if let Some(file) = &args.page {
        write(file, found.page().as_bytes())?;
    }
    result(&if args.json { serde_json::to_string_pretty(&found)? } else { found.table() })
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;

    #[derive(clap::Parser)]
    struct Cli {
        #[command(flatten)]
        bench: LiveBenchArgs,
    }

    fn asked(args: &str) -> Vec<OperatingPoint> {
        let cli = Cli::try_parse_from(["bench"].into_iter().chain(args.split_whitespace())).map_err(|e| e.to_string());
        cli.map(|c| points(&c.bench)).unwrap_or_default()
    }

    #[test]
    fn sizes_rates_and_budgets_are_combined() {
        let at = |size, bitrate, budget_ms| OperatingPoint { size, bitrate, budget_ms };
        assert_eq!(asked(""), [at((320, 240), 384_000, 0.0)]);
        assert_eq!(
            asked("--size 320x240,640x480 --budget-ms 0,10"),
            [at((320, 240), 384_000, 0.0), at((320, 240), 384_000, 10.0), at((640, 480), 1_536_000, 0.0), at((640, 480), 1_536_000, 10.0)]
        );
        assert_eq!(asked("--bitrate 200000,800000").len(), 2);
        assert!(asked("--budget-ms nan").is_empty() && asked("--budget-ms=-1").is_empty());
    }
}
