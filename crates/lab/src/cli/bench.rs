//! `tmpi-lab bench`.

use std::path::PathBuf;

use anyhow::Context;

use super::{note, read, result, write};
use tmpi_lab::bench::serve::{Load, Target};
use tmpi_lab::bench::{self, Settings};
use tmpi_lab::live::budget;
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;

/// Measure the error and run time of each approximation on this machine
#[derive(Clone, Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(super) struct BenchArgs {
    #[command(subcommand)]
    what: Option<What>,
    /// Folder for index.html, results.json, results.csv, and costs.json, which `make --budget-ms` reads if `TMPI_COSTS` names it
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
    #[command(flatten)]
    models: ModelFlags,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum What {
    Serve(ServeArgs),
}

/// Measure the server under load: views per second, latency with 1, 8 and 64 clients, and memory
#[derive(Clone, Debug, clap::Args)]
struct ServeArgs {
    /// Address of a running server; requests views of its newest photo
    #[arg(value_name = "URL", required_unless_present = "photo")]
    url: Option<String>,
    /// Start a server with this photo instead
    #[arg(long, conflicts_with = "url", value_name = "FILE")]
    photo: Option<PathBuf>,
    /// Views for each number of clients
    #[arg(long, default_value_t = 200, value_name = "N")]
    views: usize,
    /// Additional views during which the server's memory is recorded (with --photo)
    #[arg(long, default_value_t = 2000, value_name = "N")]
    memory_views: usize,
    /// Width of the views in pixels
    #[arg(long, default_value_t = 640, value_parser = clap::value_parser!(u32).range(1..=4096), value_name = "PX")]
    width: u32,
    /// Print the results as JSON
    #[arg(long)]
    json: bool,
}

fn serve(args: &ServeArgs) -> anyhow::Result<()> {
    let target = match (&args.url, &args.photo) {
        (_, Some(photo)) => Target::Photo(read(photo)?),
        (url, None) => Target::Url(url.clone().context("a URL or --photo is required")?),
    };
    let load = Load { views: args.views, memory_views: args.memory_views, width: args.width };
    let results = bench::serve::run(&target, &load, &|what| note(&format!("tmpi-lab bench serve: {what}")))?;
    result(&if args.json { serde_json::to_string_pretty(&results)? } else { results.table() })
}

pub(super) fn run(args: &BenchArgs) -> anyhow::Result<()> {
    if let Some(What::Serve(args)) = &args.what {
        return serve(args);
    }
    let networks = args.models.settings();
    let models = models::load(&networks)?;
    let settings = Settings { quick: args.quick, photos: args.photos.clone(), only: args.only.clone(), models, networks };
    let told = |what: &str| note(&format!("tmpi-lab bench: {what}"));
    let mut results = bench::run(&settings, &told)?;
    if settings.wants("live-budget") {
        let rooms = models::load(&args.models.settings_of_rooms())?;
        results.experiments.push(budget::experiment(&rooms, args.quick, &mut results.skipped, &told)?);
    }
    write(&args.output.join("results.json"), &serde_json::to_vec_pretty(&results)?)?;
    write(&args.output.join("results.csv"), results.csv().as_bytes())?;
    if let Some(costs) = &results.costs {
        write(&args.output.join("costs.json"), &serde_json::to_vec_pretty(costs)?)?;
    }
    let page = args.output.join("index.html");
    write(&page, bench::html(&results).as_bytes())?;
    for s in &results.skipped {
        note(&format!("skipped: {s}"));
    }
    result(&format!("{}: {} experiments in {:.0} s", page.display(), results.experiments.len(), results.seconds))
}
