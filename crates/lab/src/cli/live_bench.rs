//! `tmpi-lab live-bench`.

use std::path::PathBuf;

use anyhow::Context;
use clap::CommandFactory;
use clap::error::ErrorKind;

use super::{Cli, note, result, size};
use crate::live::encode::H264;
use crate::live::sweep::OperatingPoint;
use crate::{files, live};
use tmpi_core::live::MAX_PIXELS;
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::{self, models};

/// Measure rendered sequences from camera to viewer: error against time and bytes
#[derive(Clone, Debug, clap::Args)]
pub(super) struct LiveBenchArgs {
    /// Frame size. With several sizes, measures all sequences at each size, bit rate and budget, and prints one line for each
    #[arg(long, value_delimiter = ',', default_value = "320x240", value_parser = |text: &str| size(text, MAX_PIXELS), value_name = "WxH,…")]
    size: Vec<(u32, u32)>,
    /// H.264 bits per second; may be several. Default: that of the publishing page, 384 kbit/s at 320×240 and more for larger frames
    #[arg(long, value_delimiter = ',', value_name = "N,…")]
    bitrate: Vec<u32>,
    /// Milliseconds that the geometry of a frame should take; may be several. Sets how large and how frequent depth is, and the number of
    /// planes, by earlier measurements. 0: no limit. Default: that of the server's rooms
    #[arg(long, value_delimiter = ',', default_values_t = [tmpi_live::BUDGET_MS], value_parser = live::not_negative, value_name = "MS,…")]
    budget_ms: Vec<f64>,
    /// Write plots of error against run time and bytes to this file, if several points are measured
    #[arg(long, value_name = "FILE.html")]
    page: Option<PathBuf>,
    /// Print the results as JSON
    #[arg(long)]
    json: bool,
    /// Instead, learn the initial state of the chunk coders and write it to this file
    #[arg(long, value_name = "FILE")]
    learn: Option<PathBuf>,
    #[command(flatten)]
    flags: live::Flags,
    #[command(flatten)]
    models: ModelFlags,
}

/// All combinations of size, bit rate and budget.
fn points(args: &LiveBenchArgs) -> Vec<OperatingPoint> {
    let mut points = Vec::new();
    for &size in &args.size {
        let usual = [H264::usual_bitrate(size)];
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
    if points.len() > 1 && (args.learn.is_some() || args.flags.files.is_some()) {
        let reason = "--learn and --files accept only one size, bit rate and budget";
        Cli::command().error(ErrorKind::ArgumentConflict, reason).exit();
    }
    let progress = |what: &str| note(&format!("tmpi-lab live-bench: {what}"));
    let models = models::load(&args.models.settings_of_rooms())?;
    let settings = live::Settings { flags: args.flags.clone(), at: *first, models, depth: networks::available().is_ok() };
    if let Some(file) = &args.learn {
        return Ok(files::write(file, live::learn(&settings, &progress)?.as_bytes())?);
    }
    let found = live::sweep::measure(&settings, &points, &progress)?;
    found.skipped.iter().for_each(|s| note(&format!("skipped: {s}")));
    if let Some(file) = &args.page {
        files::write(file, found.page().as_bytes())?;
    }
    result(&if args.json { serde_json::to_string_pretty(&found)? } else { found.table() })
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::super::Command;
    use super::*;

    fn asked(args: &str) -> Vec<OperatingPoint> {
        let cli = Cli::try_parse_from(["tmpi-lab", "live-bench"].into_iter().chain(args.split_whitespace()));
        if let Ok(Cli { command: Command::LiveBench(args) }) = cli { points(&args) } else { Vec::new() }
    }

    #[test]
    fn sizes_rates_and_budgets_are_combined() {
        let at = |size, bitrate, budget_ms| OperatingPoint { size, bitrate, budget_ms };
        assert_eq!(asked(""), [at((320, 240), 384_000, tmpi_live::BUDGET_MS)]);
        assert_eq!(
            asked("--size 320x240,640x480 --budget-ms 0,10"),
            [at((320, 240), 384_000, 0.0), at((320, 240), 384_000, 10.0), at((640, 480), 1_536_000, 0.0), at((640, 480), 1_536_000, 10.0)]
        );
        assert_eq!(asked("--bitrate 200000,800000").len(), 2);
        assert!(asked("--budget-ms nan").is_empty() && asked("--budget-ms=-1").is_empty());
    }
}
