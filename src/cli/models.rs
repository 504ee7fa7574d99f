//! `tmpi models`.

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;

use super::{Usage, note, reasons, result};
use tmpi_pipeline::networks::models::download::{Digest, RemoteFile, fetch};
use tmpi_pipeline::networks::models::external_data_files;
use tmpi_pipeline::networks::models::registry::{BETTER, BY_FILE, PUBLISHED, default_model, folder, published, recommended_download};

#[derive(Clone, Debug, clap::Subcommand)]
pub(super) enum ModelsCommand {
    /// List names, sizes, licences and URLs, and which networks are installed
    List {
        /// JSON on standard output
        #[arg(long)]
        json: bool,
    },
    /// Fetch a network; resumes an interrupted download
    Get {
        /// Name of the network; any name with --url; auto fetches the recommended network unless one as good is installed. If auto cannot
        /// fetch it, that is no error: the best installed network is used, else the embedded one
        #[arg(value_name = "NAME")]
        name: String,
        /// URL of an ONNX file that is not in the list
        #[arg(long, requires = "sha256", value_name = "URL")]
        url: Option<String>,
        /// Expected SHA-256 of the file, 64 hexadecimal digits
        #[arg(long, requires = "url", value_name = "HEX")]
        sha256: Option<Digest>,
        /// File to write instead of NAME.onnx in the folder of networks
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
        /// No progress
        #[arg(short, long)]
        quiet: bool,
    },
}

pub(super) fn run(command: &ModelsCommand) -> anyhow::Result<()> {
    match command {
        ModelsCommand::List { json } => list(*json),
        ModelsCommand::Get { name, url, sha256, output, quiet } if name == "auto" => {
            let here = default_model().filter(|_| output.is_none());
            let enough = here.as_ref().is_some_and(|(adapter, _)| recommended_download(adapter.name).is_none());
            if let Some((_, file)) = here.as_ref().filter(|_| enough) {
                return result(&file.display().to_string());
            }
            let Err(error) = get(BETTER, url.as_deref().zip(*sha256), output.clone(), *quiet) else { return Ok(()) };
            let used = here.as_ref().map_or("the embedded one".into(), |(_, file)| file.display().to_string());
            note(&format!("could not fetch a better depth network; using {used}: {}", reasons(&error)));
            here.map_or(Ok(()), |(_, file)| result(&file.display().to_string()))
        }
        ModelsCommand::Get { name, url, sha256, output, quiet } => get(name, url.as_deref().zip(*sha256), output.clone(), *quiet),
    }
}

fn list(json: bool) -> anyhow::Result<()> {
    for p in &PUBLISHED {
        let here = p.file().is_file() && external_data_files(&p.file()).is_ok();
        if json {
            let line = json!({
                "name": p.name, "adapter": p.adapter, "url": p.url, "bytes": p.bytes, "sha256": p.sha256, "licence": p.licence,
                "weights": p.weights.map(|w| json!({ "url": w.url, "bytes": w.bytes, "sha256": w.sha256 })),
                "file": here.then(|| p.file()),
            });
            result(&line.to_string())?;
        } else {
            let state = if here { p.file().display().to_string() } else { format!("not installed: tmpi models get {}", p.name) };
            let weights = p.weights.map_or_else(String::new, |w| format!("\n  {}\n  sha256 {}", w.url, w.sha256));
            let megabytes = p.total() as f64 / 1e6;
            result(&format!("{}\n  {megabytes:.1} MB, {}\n  {}\n  sha256 {}{weights}\n  {state}", p.name, p.licence, p.url, p.sha256))?;
        }
    }
    for (name, licence) in BY_FILE.iter().filter(|_| !json) {
        result(&format!("{name}\n  {licence}\n  by file: --depth-model {name}=FILE.onnx"))?;
    }
    Ok(())
}

fn get(name: &str, own: Option<(&str, Digest)>, output: Option<PathBuf>, quiet: bool) -> anyhow::Result<()> {
    let known = published(name);
    let (url, sha256, bytes) = match (own, known) {
        (Some((url, sha256)), _) => (url, sha256, None),
        (None, Some(p)) => (p.url, p.sha256.parse().map_err(Usage)?, Some(p.bytes)),
        (None, None) => {
            let names = PUBLISHED.iter().map(|p| p.name).collect::<Vec<_>>().join(", ");
            return Err(Usage(format!("{name} is not in the list ({names}); another file needs --url and --sha256")).into());
        }
    };
    if own.is_some() && (name.is_empty() || name.contains(['/', '\\']) || name.starts_with('.')) && output.is_none() {
        return Err(Usage(format!("{name:?} cannot be part of a file name")).into());
    }
    let file = output.unwrap_or_else(|| folder().join(format!("{name}.onnx")));
    let licence = known.filter(|_| own.is_none()).map_or_else(String::new, |p| format!("\nlicence: {}", p.licence));
    let mut about = (!quiet).then(|| format!("{url}{licence}"));
    // fetch the weights before the file that names them: a server that starts meanwhile finds both or neither
    if let Some(weights) = known.and_then(|p| p.weights).filter(|_| own.is_none()) {
        let wanted = RemoteFile { url: weights.url, bytes: Some(weights.bytes), sha256: weights.sha256.parse().map_err(Usage)? };
        fetch_shown(&wanted, &file.with_extension("onnx_data"), quiet, &mut about)?;
    }
    if !fetch_shown(&RemoteFile { url, bytes, sha256 }, &file, quiet, &mut about)? && !quiet {
        note("already installed");
    }
    result(&file.display().to_string())
}

/// [`fetch`] with a progress bar on a terminal. Prints `about` once the download has begun, so that without a network only the error shows.
fn fetch_shown(wanted: &RemoteFile<'_>, file: &Path, quiet: bool, about: &mut Option<String>) -> anyhow::Result<bool> {
    let bar = (!quiet && std::io::stderr().is_terminal()).then(|| ProgressBar::new(0));
    if let (Some(bar), Ok(style)) = (&bar, ProgressStyle::with_template("[{bar:30}] {bytes}/{total_bytes} {bytes_per_sec} {eta}")) {
        bar.set_style(style);
    }
    let fetched = fetch(wanted, file, |have, all| {
        if let Some(about) = about.take() {
            note(&about);
        }
        if let Some(bar) = &bar {
            bar.set_length(all.unwrap_or(have));
            bar.set_position(have);
        }
    });
    if let Some(bar) = &bar {
        bar.finish_and_clear();
    }
    Ok(fetched?)
}
