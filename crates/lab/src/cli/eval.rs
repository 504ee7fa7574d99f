//! `tmpi-lab eval`.

use std::path::PathBuf;

use super::{note, result};
use tmpi_lab::eval::{self, Depth, Settings};
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
    /// Source of depth
    #[arg(long, value_enum, default_value_t, value_name = "DEPTH")]
    depth: Depth,
    /// Run only these methods
    #[arg(long, value_delimiter = ',', value_parser = eval::names(), value_name = "WAY,…")]
    only: Vec<String>,
    /// Also compute LPIPS with this network: an ONNX file with two inputs [1, 3, height, width] in −1 to 1
    #[arg(long, value_name = "FILE.onnx")]
    lpips: Option<PathBuf>,
    /// Write the true views and those of each method to this folder
    #[arg(long, value_name = "DIR")]
    files: Option<PathBuf>,
    /// Print the results as JSON, for each scene
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    models: ModelFlags,
}

pub(super) fn run(args: &EvalArgs) -> anyhow::Result<()> {
    let models = models::load(&args.models.settings())?;
    let settings = Settings { depth: args.depth, only: args.only.clone(), lpips: args.lpips.clone(), files: args.files.clone() };
    let results = eval::run(&models, &args.folders, &settings, &|scene| note(&format!("tmpi-lab eval: {scene}")))?;
    result(&if args.json { serde_json::to_string_pretty(&results)? } else { results.table() })
}
