//! `tmpi-lab eval`.

use std::path::PathBuf;

use super::{note, result};
use crate::eval::{self, Settings};
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;

/// Compare second views with the truth for tmpi, plain multiplane images and a mesh, on scenes with known views
#[derive(Clone, Debug, clap::Args)]
pub(super) struct EvalArgs {
    /// Folders of scenes: output of `tmpi-lab synth --views N`, rectified stereo pairs (`left.png`, `right.png`, `disp_left.png`, `meta.json`),
    /// light fields (`cameras.json`), frames of a depth camera with poses (`camera-intrinsics.txt`), or stereo photos (`NAME-left.jpg` with
    /// `NAME-right.jpg`, `NAME.left-right.jpg`)
    #[arg(required = true, value_name = "DIR")]
    folders: Vec<PathBuf>,
    #[command(flatten)]
    settings: Settings,
    /// Print the results as JSON, for each scene
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    models: ModelFlags,
}

pub(super) fn run(args: &EvalArgs) -> anyhow::Result<()> {
    let models = models::load(&args.models.settings())?;
    let results = eval::run(&models, &args.folders, &args.settings, &|scene| note(&format!("tmpi-lab eval: {scene}")))?;
    result(&if args.json { serde_json::to_string_pretty(&results)? } else { results.table() })
}
