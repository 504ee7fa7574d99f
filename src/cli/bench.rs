//! `tmpi bench`.

use std::path::PathBuf;

use super::flags::ModelFlags;
use super::{files, result};
use crate::bench::{self, Settings};
use crate::models;

/// Measure error against run time of every approximation, on this machine
#[derive(Clone, Debug, clap::Args)]
pub(super) struct BenchArgs {
    /// Folder for index.html, results.json, results.csv, and costs.json for `make --budget-ms` (name it in `TMPI_COSTS`)
    #[arg(short, long, default_value = "bench", value_name = "DIR")]
    output: PathBuf,
    /// Fewer scenes, fewer settings: a few minutes
    #[arg(long)]
    quick: bool,
    /// Also measure on the photos of this folder; may be given several times
    #[arg(long, value_name = "DIR")]
    photos: Vec<PathBuf>,
    #[command(flatten)]
    models: ModelFlags,
}

pub(super) fn run(args: &BenchArgs) -> anyhow::Result<()> {
    let models = models::load(&args.models.settings())?;
    let settings = Settings { quick: args.quick, photos: args.photos.clone(), models };
    let results = bench::run(&settings, &|what| eprintln!("tmpi bench: {what}"))?;
    files::write(&args.output.join("results.json"), &serde_json::to_vec_pretty(&results)?)?;
    files::write(&args.output.join("results.csv"), results.csv().as_bytes())?;
    files::write(&args.output.join("costs.json"), &serde_json::to_vec_pretty(&results.costs)?)?;
    let page = args.output.join("index.html");
    files::write(&page, bench::html(&results).as_bytes())?;
    for s in &results.skipped {
        eprintln!("left out: {s}");
    }
    result(&format!("{}: {} experiments in {:.0} s", page.display(), results.experiments.len(), results.seconds))
}
