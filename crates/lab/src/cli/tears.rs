//! `tmpi-lab tears`.

use std::path::PathBuf;

use image::ExtendedColorType;

use super::{note, result, size};
use crate::live::tears::{Case, FRAMES, Settings, count};
use crate::table::table;
use crate::{files, live};
use tmpi_core::live::{MAX_MOTION_FRAMES, MAX_PIXELS};
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;
use tmpi_testing::pictures::png;

/// Count the pictures of a room in which a fast box is torn, seen from the side; measures all combinations
#[derive(Clone, Debug, clap::Args)]
pub(super) struct TearsArgs {
    /// Frame sizes
    #[arg(long, value_delimiter = ',', default_value = "320x240,640x480", value_parser = |text: &str| size(text, MAX_PIXELS), value_name = "WxH,…")]
    size: Vec<(u32, u32)>,
    /// Frames by which tiles arrive late
    #[arg(long, value_delimiter = ',', default_value = "2,5", value_parser = clap::value_parser!(u32).range(0..=30), value_name = "N,…")]
    late: Vec<u32>,
    /// The server makes tiles of every Nth frame, at most
    #[arg(long, value_delimiter = ',', default_value = "1", value_parser = clap::value_parser!(u32).range(1..=30), value_name = "N,…")]
    tiles: Vec<u32>,
    /// The viewer shows every Nth frame
    #[arg(long, value_delimiter = ',', default_value = "1,3", value_parser = clap::value_parser!(u32).range(1..=30), value_name = "N,…")]
    shown: Vec<u32>,
    /// Milliseconds that the geometry of a frame should take; 0: no limit, and results repeat exactly
    #[arg(long, value_delimiter = ',', default_value = "0", value_parser = live::not_negative, value_name = "MS,…")]
    budget_ms: Vec<f64>,
    /// Frames of the film
    #[arg(long, default_value_t = FRAMES, value_parser = clap::value_parser!(u32).range(31..=100_000), value_name = "N")]
    frames: u32,
    /// Maximum number of frames for which labels follow motion; 0: they stay in place
    #[arg(long, default_value_t = MAX_MOTION_FRAMES, value_parser = clap::value_parser!(u32).range(0..=i64::from(MAX_MOTION_FRAMES)), value_name = "N")]
    follow: u32,
    /// The viewer forgets frames that it does not show, although their tiles arrive later
    #[arg(long)]
    forget: bool,
    /// Write the pictures to a folder for each case in this one; names end with the percentage of torn rows
    #[arg(long, value_name = "DIR")]
    files: Option<PathBuf>,
    #[command(flatten)]
    models: ModelFlags,
}

fn cases(args: &TearsArgs) -> Vec<Case> {
    let mut cases = Vec::new();
    for &size in &args.size {
        for &budget_ms in &args.budget_ms {
            for &tiles in &args.tiles {
                for &late in &args.late {
                    cases.extend(args.shown.iter().map(|&shown| Case { size, budget_ms, tiles, late, shown }));
                }
            }
        }
    }
    cases
}

pub(super) fn run(args: &TearsArgs) -> anyhow::Result<()> {
    let models = models::load(&args.models.settings_of_rooms())?;
    let settings = Settings { models, frames: args.frames, follow: args.follow, remember: !args.forget };
    let mut lines = Vec::new();
    for case in cases(args) {
        let Case { size: (w, h), budget_ms, tiles, late, shown } = case;
        note(&format!("tmpi-lab tears: {w}x{h}, tiles of every {tiles}, {late} late, every {shown} shown"));
        let mut failed = None;
        let found = count(&settings, &case, &mut |n, left, picture, rows| {
            let Some(folder) = &args.files else { return };
            let name = format!("{n:04}-{}-{:.0}.png", if left { "left" } else { "right" }, 100.0 * rows);
            let of_case = folder.join(format!("{w}x{h}-budget-{budget_ms}-tiles-{tiles}-late-{late}-shown-{shown}"));
            let data = png(w, h, picture.rgb.as_flattened(), ExtendedColorType::Rgb8);
            failed = failed.take().or(files::write(&of_case.join(name), &data).err());
        })?;
        if let Some(error) = failed {
            return Err(error.into());
        }
        let budget = if budget_ms > 0.0 { budget_ms.to_string() } else { "none".into() };
        let own = [format!("{w}x{h}"), budget, tiles.to_string(), late.to_string(), shown.to_string()];
        lines.push(own.into_iter().chain([found.pictures.to_string(), format!("{:.1}", found.percent())]).collect());
    }
    let head = ["size", "budget ms", "tiles of every", "late", "every shown", "pictures", "torn, %"];
    result(table(1, &head, lines).trim_end())
}
