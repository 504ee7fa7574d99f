//! `tmpi-lab live-bench`.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use clap::CommandFactory;
use clap::error::ErrorKind;

use super::{Cli, note, result, size, write};
use tmpi_core::live::{FOLLOWS, MAX_PIXELS};
use tmpi_lab::live;
use tmpi_lab::live::sweep::OperatingPoint;
use tmpi_pipeline::networks::flags::ModelFlags;
use tmpi_pipeline::networks::{self, models};

/// Measure rendered sequences from camera to reader: error against time and bytes
#[derive(Clone, Debug, clap::Args)]
pub(super) struct LiveBenchArgs {
    /// Size of the frames; several, separated by commas: all sequences at each of them, with each bit rate and budget, a line for each
    #[arg(long, value_delimiter = ',', default_value = "320x240", value_parser = |text: &str| size(text, MAX_PIXELS), value_name = "WxH,…")]
    size: Vec<(u32, u32)>,
    /// One sequence alone
    #[arg(long, value_parser = live::NAMES, value_name = "NAME")]
    only: Option<String>,
    /// Number of the first scene; the next two are used, too
    #[arg(long, default_value_t = live::SEED, value_name = "N")]
    scene: u64,
    /// Frames of each sequence
    #[arg(long, default_value_t = 240, value_parser = clap::value_parser!(u32).range(2..=100_000), value_name = "N")]
    frames: u32,
    /// Of the sequence every so many frames are sent, 30 being taken a second
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=60), value_name = "N")]
    every: u32,
    /// How frames are sent
    #[arg(long, default_value = "h264", value_parser = ["h264", "jpeg"], value_name = "CODEC")]
    codec: String,
    /// Bits a second of H.264; 384 kbit/s for 320×240 as the publishing page has it, more for larger frames, where nothing is said. Or several
    #[arg(long, value_delimiter = ',', value_name = "N,…")]
    bitrate: Vec<u32>,
    /// Milliseconds that the geometry of a frame may take, for which the size of depth, planes and tiles are chosen by what they took before; 0: as
    /// long as it takes. Or several
    #[arg(long, value_delimiter = ',', default_value = "0", value_parser = milliseconds, value_name = "MS,…")]
    budget_ms: Vec<f64>,
    /// Write drawings of error against run time and against bytes to this file, where several points are measured
    #[arg(long, value_name = "FILE.html")]
    page: Option<PathBuf>,
    /// Pixels by which a tile that is not sent anew may show any point beside where its new planes would, from any camera of the view box
    #[arg(long, default_value_t = tmpi_live::PARALLAX, value_parser = parallax, value_name = "PX")]
    parallax: f64,
    /// Parallax error that planes may leave, in pixels
    #[arg(long, default_value_t = tmpi_live::MAX_ERROR, value_parser = parallax, value_name = "PX")]
    max_error: f64,
    /// Frames after the last change near a block for which its estimated depth waits to be looked at once more; 0: it is not
    #[arg(long, default_value_t = tmpi_live::SETTLES.frames, value_name = "N")]
    settle: u8,
    /// Blocks of 8 pixels that count as near
    #[arg(long, default_value_t = tmpi_live::SETTLES.blocks, value_name = "N")]
    settle_blocks: u8,
    /// Milliseconds for which frames rest after one of which tiles were sent, where depth is estimated
    #[arg(long, default_value_t = tmpi_live::REST.as_millis() as u16, value_parser = clap::value_parser!(u16).range(0..=1000), value_name = "MS")]
    rest_ms: u16,
    /// Frames by which tiles come after theirs: meanwhile the reader moves labels along with what moves
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=30), value_name = "N")]
    late: u32,
    /// Frames after the one that tiles are of up to which it does; 0: labels stay where they were
    #[arg(long, default_value_t = FOLLOWS, value_parser = clap::value_parser!(u32).range(0..=i64::from(FOLLOWS)), value_name = "N")]
    follow: u32,
    /// Bring the network's disparity to the truth's scale before it is used: what is left is not the scale's
    #[arg(long)]
    true_scale: bool,
    /// Damage so many access units of a stream of that size, decode them and measure time and memory instead; 1 where these are not bounded, or the decoder
    /// has panicked though that was contained
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=100_000_000), value_name = "N")]
    damaged: Option<u64>,
    /// Draw the view from beside the camera for two frames of every so many
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(2..=100_000), value_name = "N")]
    views: u32,
    /// Write the streams to this folder, and as pictures the frames, views and true views that are compared
    #[arg(long, value_name = "DIR")]
    files: Option<PathBuf>,
    /// The figures as JSON
    #[arg(long)]
    json: bool,
    /// Learn what the coders of chunks begin with, write it to this file and measure nothing
    #[arg(long, value_name = "FILE")]
    learn: Option<PathBuf>,
    #[command(flatten)]
    models: ModelFlags,
}

/// Bits a second and pixel, as the publishing page has them (`static/live/encoders.js`): 384 kbit/s at 320×240.
const RATE: f64 = 5.0;

fn parallax(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|px: &f64| px.is_finite() && *px >= 0.0).ok_or_else(|| "pixels, 0 or more".into())
}

fn milliseconds(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|ms: &f64| ms.is_finite() && *ms >= 0.0).ok_or_else(|| "milliseconds, 0 or more".into())
}

/// Every size with every bit rate and budget.
fn points(args: &LiveBenchArgs) -> Vec<OperatingPoint> {
    let mut points = Vec::new();
    for &size in &args.size {
        let rate = (RATE * f64::from(size.0) * f64::from(size.1)) as u32;
        let bitrates = match (args.codec.as_str(), args.bitrate.as_slice()) {
            ("h264", []) => vec![Some(rate)],
            ("h264", some) => some.iter().copied().map(Some).collect(),
            _ => vec![None],
        };
        for bitrate in bitrates {
            points.extend(args.budget_ms.iter().map(|&budget_ms| OperatingPoint { size, bitrate, budget_ms }));
        }
    }
    points
}

pub(super) fn run(args: &LiveBenchArgs) -> anyhow::Result<()> {
    let points = points(args);
    let first = points.first().context("at least one size and one budget are wanted")?;
    if points.len() > 1 && (args.damaged.is_some() || args.learn.is_some() || args.files.is_some()) {
        let reason = "--damaged, --learn and --files take one size, bit rate and budget";
        Cli::command().error(ErrorKind::ArgumentConflict, reason).exit();
    }
    let told = |what: &str| note(&format!("tmpi-lab live-bench: {what}"));
    if let Some(count) = args.damaged {
        let found = live::damaged::run(first.size, first.bitrate, count, &told)?;
        result(&if args.json { serde_json::to_string_pretty(&found)? } else { found.table() })?;
        return found.check().map_err(anyhow::Error::msg);
    }
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
        true_scale: args.true_scale,
        parallax: args.parallax,
        max_error: args.max_error,
        rest: Duration::from_millis(args.rest_ms.into()),
        late: args.late,
        follow: args.follow,
        settles: tmpi_live::Settling { frames: args.settle, blocks: args.settle_blocks },
        files: args.files.clone(),
        only: args.only.clone(),
    };
    if let Some(file) = &args.learn {
        return write(file, live::learn(&settings, &told)?.as_bytes());
    }
    let left_out = |skipped: &[String]| skipped.iter().for_each(|s| note(&format!("left out: {s}")));
    if points.len() > 1 || args.page.is_some() {
        let found = live::sweep::measure(&settings, &points, &told)?;
        left_out(&found.skipped);
        if let Some(file) = &args.page {
            write(file, found.page().as_bytes())?;
        }
        return result(&if args.json { serde_json::to_string_pretty(&found)? } else { found.table() });
    }
    let results = live::run(&settings, &told)?;
    left_out(&results.skipped);
    result(&if args.json { serde_json::to_string_pretty(&results)? } else { results.table() })
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
    fn every_size_is_measured_with_every_rate_and_budget() {
        let at = |size, bitrate, budget_ms| OperatingPoint { size, bitrate, budget_ms };
        assert_eq!(asked("--codec h264"), [at((320, 240), Some(384_000), 0.0)]);
        assert_eq!(
            asked("--codec h264 --size 320x240,640x480 --budget-ms 0,10"),
            [
                at((320, 240), Some(384_000), 0.0),
                at((320, 240), Some(384_000), 10.0),
                at((640, 480), Some(1_536_000), 0.0),
                at((640, 480), Some(1_536_000), 10.0)
            ]
        );
        assert_eq!(asked("--codec h264 --bitrate 200000,800000").len(), 2);
        assert_eq!(asked("--codec jpeg --size 64x64"), [at((64, 64), None, 0.0)]);
        assert!(asked("--budget-ms nan").is_empty() && asked("--budget-ms=-1").is_empty());
    }
}
