//! `tmpi bench codec`.

use std::path::PathBuf;

use super::flags::{MakeFlags, ModelFlags};
use super::{Usage, files, note, result};
use tmpi_lab::bench::BenchError;
use tmpi_lab::bench::codec::{self, Settings};
use tmpi_pipeline::networks::models;

/// Measure bytes, time and quality of the container against other ways to send the same layers
#[allow(clippy::struct_excessive_bools, reason = "each is a flag of its own")]
#[derive(Clone, Debug, clap::Args)]
pub(super) struct CodecArgs {
    /// Folders of photos
    #[arg(required = true, value_name = "DIR")]
    photos: Vec<PathBuf>,
    /// Folder for codec.json and codec.csv
    #[arg(short, long, default_value = "bench", value_name = "DIR")]
    output: PathBuf,
    /// Cut and reduce photos to this size first
    #[arg(long, value_name = "WxH")]
    size: Option<String>,
    /// Runs a figure of time is the median of
    #[arg(long, default_value_t = 3, value_name = "N")]
    repeats: usize,
    /// Four photos of each folder
    #[arg(long)]
    quick: bool,
    /// The container alone, not the other ways
    #[arg(long)]
    ours: bool,
    /// The container alone, with labels in bands of several sizes
    #[arg(long, conflicts_with = "ours")]
    bands: bool,
    /// Also write the files that were compared, a folder for each photo
    #[arg(long)]
    files: bool,
    #[command(flatten)]
    flags: MakeFlags,
    #[command(flatten)]
    models: ModelFlags,
}

pub(super) fn run(args: &CodecArgs) -> anyhow::Result<()> {
    let size = args.size.as_deref().map(size).transpose()?;
    let settings = Settings {
        photos: args.photos.clone(),
        size,
        options: args.flags.options(),
        models: models::load(&args.models.settings())?,
        repeats: args.repeats,
        quick: args.quick,
        ours: args.ours,
        bands: args.bands,
    };
    let keep = |scene: &str, name: &str, bytes: &[u8]| {
        let path = args.output.join(scene).join(name);
        let kept = if args.files { files::write(&path, bytes) } else { Ok(()) };
        kept.map_err(|e| BenchError::File { path, reason: e.to_string() })
    };
    let results = codec::run(&settings, &|what| note(&format!("tmpi bench codec: {what}")), &keep)?;
    files::write(&args.output.join("codec.json"), &serde_json::to_vec_pretty(&results)?)?;
    files::write(&args.output.join("codec.csv"), results.csv().as_bytes())?;
    result(results.table().trim_end())
}

fn size(text: &str) -> Result<(u32, u32), Usage> {
    let side = |s: &str| s.parse().ok().filter(|v| (8..=16_384).contains(v));
    let both = text.split_once('x').and_then(|(w, h)| Some((side(w)?, side(h)?)));
    both.ok_or_else(|| Usage(format!("--size must be WIDTHxHEIGHT, 8 to 16384 pixels each, not {text:?}")))
}
