//! `tmpi export`.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context;
use serde_json::json;

use super::{Usage, files, result};
use crate::atlas;
use crate::export::{ExportFormat, export};

/// Write a container as a page, a glTF model or an archive of its parts
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ExportArgs {
    /// The container
    #[arg(value_name = "IN.tmpi")]
    input: PathBuf,
    /// File to write: a page that opens from disk, a binary glTF model, or photo, layers and planes in an archive
    #[arg(short, long, value_name = "OUT.{html,glb,zip}")]
    output: PathBuf,
    /// Title of the page; without it the container's name
    #[arg(long, value_name = "TEXT")]
    title: Option<String>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &ExportArgs) -> anyhow::Result<()> {
    let format = ExportFormat::from_extension(&files::extension(&args.output))
        .ok_or_else(|| Usage(format!("--output {} must end in .html, .glb or .zip", args.output.display())))?;
    if args.title.is_some() && format != ExportFormat::Html {
        return Err(Usage("--title is only for .html".into()).into());
    }
    let container = files::read(&args.input)?;
    let context = || args.input.display().to_string();
    // a container that cannot be read must not become a page that cannot be shown
    let scene = atlas::decode(&container).with_context(context)?;
    let stem = args.input.file_stem().unwrap_or_default().to_string_lossy();
    let start = Instant::now();
    let bytes = export(format, &container, &scene, args.title.as_deref().unwrap_or(&stem)).with_context(context)?;
    let ms = start.elapsed().as_secs_f64() * 1e3;
    files::write(&args.output, &bytes)?;
    if args.json {
        let about = json!({ "output": args.output, "format": format, "bytes": bytes.len(), "container_bytes": container.len(), "ms": ms });
        return result(&about.to_string());
    }
    let times = bytes.len() as f64 / container.len() as f64;
    result(&format!("{}: {} bytes, {times:.2} × the container, in {ms:.1} ms", args.output.display(), bytes.len()))
}
