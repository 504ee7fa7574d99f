//! `tmpi-lab bench`.

use std::path::PathBuf;

use super::{note, result};
use tmpi_lab::bench::{self, Settings};
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;

/// Measure the error and run time of each approximation on this machine
#[derive(Clone, Debug, clap::Args)]
pub(super) struct BenchArgs {
    /// Folder for index.html, results.json, and costs.json, which `make --budget-ms` reads if `TMPI_COSTS` names it. All are written after
    /// each experiment
    #[arg(short, long, default_value = "bench", value_name = "DIR")]
    output: PathBuf,
    /// Use fewer scenes and settings; takes a few minutes
    #[arg(long)]
    quick: bool,
    /// Also measure the photos in this folder; repeatable. `NAME_disp16.png` beside `NAME.jpg` is the photo's disparity
    #[arg(long, value_name = "DIR")]
    photos: Vec<PathBuf>,
    /// Run only these experiments
    #[arg(long, value_delimiter = ',', value_parser = bench::EXPERIMENTS, value_name = "NAME,…")]
    only: Vec<String>,
    /// Keep the experiments of an earlier run that are in the folder, and run only the others
    #[arg(long)]
    resume: bool,
    #[command(flatten)]
    models: ModelFlags,
}

pub(super) fn run(args: &BenchArgs) -> anyhow::Result<()> {
    let networks = args.models.settings();
    let settings = Settings {
        quick: args.quick,
        photos: args.photos.clone(),
        only: args.only.clone(),
        output: args.output.clone(),
        resume: args.resume,
        models: models::load(&networks)?,
        networks,
    };
    let results = bench::run(&settings, &|what| note(&format!("tmpi-lab bench: {what}")))?;
    for s in &results.skipped {
        note(&format!("skipped: {s}"));
    }
    let page = args.output.join("index.html");
    result(&format!("{}: {} experiments in {:.0} s", page.display(), results.experiments.len(), results.seconds))
}
