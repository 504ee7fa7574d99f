//! `tmpi-lab bench`.

use super::{note, result};
use crate::bench::{self, Flags, Settings};
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;

/// Measure the error and run time of each approximation on this machine
#[derive(Clone, Debug, clap::Args)]
pub(super) struct BenchArgs {
    #[command(flatten)]
    flags: Flags,
    #[command(flatten)]
    models: ModelFlags,
}

pub(super) fn run(args: BenchArgs) -> anyhow::Result<()> {
    let networks = args.models.settings();
    let settings = Settings { flags: args.flags, models: models::load(&networks)?, networks };
    let results = bench::run(&settings, &|what| note(&format!("tmpi-lab bench: {what}")))?;
    for s in &results.skipped {
        note(&format!("skipped: {s}"));
    }
    let page = settings.flags.output.join("index.html");
    result(&format!("{}: {} experiments in {:.0} s", page.display(), results.experiments.len(), results.seconds))
}
