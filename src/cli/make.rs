//! `tmpi make`.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::flags::{MakeFlags, ModelFlags};
use super::progress::Bar;
use super::{Usage, files, result};
use tmpi_pipeline::Report;
use tmpi_pipeline::networks::models;
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{self, Made, Models, Options};

/// Make tiled multiplane images of photos
#[derive(Clone, Debug, clap::Args)]
#[allow(clippy::struct_excessive_bools, reason = "flags of a command")]
pub(super) struct MakeArgs {
    /// JPEG, PNG or WebP files
    #[arg(required = true, value_name = "PHOTO")]
    photos: Vec<PathBuf>,
    /// Container to write; with several photos, or where it is a folder, the folder for them
    #[arg(short, long, value_name = "OUT.tmpi|DIR")]
    output: PathBuf,
    /// Depth map of the one photo, a grey PNG of 8 or 16 bits
    #[arg(long, value_name = "FILE")]
    depth: Option<PathBuf>,
    /// Also write the report: of one photo an object, of several a list
    #[arg(long, value_name = "FILE.json")]
    report: Option<PathBuf>,
    /// A line of JSON on standard output for each photo
    #[arg(long)]
    json: bool,
    /// No progress
    #[arg(short, long)]
    quiet: bool,
    #[command(flatten)]
    flags: MakeFlags,
    #[command(flatten)]
    models: ModelFlags,
}

pub(super) fn run(args: &MakeArgs) -> anyhow::Result<()> {
    if args.depth.is_some() && args.photos.len() > 1 {
        return Err(Usage("--depth takes the map of one photo; several photos were given".into()).into());
    }
    if args.flags.strokes.is_some() && args.photos.len() > 1 {
        return Err(Usage("--strokes takes those of one photo; several photos were given".into()).into());
    }
    let outputs = outputs(&args.photos, &args.output)?;
    let depth = args.depth.as_deref().map(files::read).transpose()?;
    let (options, models) = (args.flags.options(), models::load(&args.models.settings())?);
    let mut reports = Vec::new();
    let mut failed = 0;
    for (photo, output) in args.photos.iter().zip(&outputs) {
        match one(&models, photo, depth.as_deref(), &options, output, args.quiet) {
            Ok(report) => {
                tell(photo, output, &report, args.json)?;
                reports.push((photo, output, report));
            }
            Err(error) if args.photos.len() == 1 => return Err(error),
            Err(error) => {
                failed += 1;
                eprintln!("tmpi: {error:#}");
            }
        }
    }
    if let Some(file) = &args.report {
        let text = match reports.as_slice() {
            [(_, _, report)] if args.photos.len() == 1 => serde_json::to_vec_pretty(report)?,
            all => {
                let list: Vec<_> = all.iter().map(|(p, o, r)| json!({ "photo": p, "output": o, "report": r })).collect();
                serde_json::to_vec_pretty(&list)?
            }
        };
        files::write(file, &text)?;
    }
    anyhow::ensure!(failed == 0, "{failed} of {} photos failed", args.photos.len());
    Ok(())
}

fn one(models: &Models, photo: &Path, depth: Option<&[u8]>, options: &Options, output: &Path, quiet: bool) -> anyhow::Result<Report> {
    let bytes = files::read(photo)?;
    let bar = Bar::new(&photo.display().to_string(), quiet);
    let made = tmpi_pipeline::make(models, &Limits::default(), &bytes, depth, options, &bar);
    drop(bar);
    let Made { container, report, .. } = made.map_err(|e| anyhow::Error::new(e).context(photo.display().to_string()))?;
    files::write(output, &container)?;
    Ok(report)
}

fn tell(photo: &Path, output: &Path, report: &Report, json: bool) -> anyhow::Result<()> {
    if json {
        return result(&json!({ "photo": photo, "output": output, "bytes": report.bytes.total, "report": report }).to_string());
    }
    let kb = |n: usize| n as f64 / 1000.0;
    let b = &report.bytes;
    result(&format!(
        "{}: {}×{}, {:.1} KB (photo {:.1}, alpha {:.1}, hidden {:.1}), {} planes in {} tiles, {:.0} ms",
        output.display(),
        report.width,
        report.height,
        kb(b.total),
        kb(b.photo),
        kb(b.alpha),
        kb(b.hidden),
        report.planes,
        report.tiles,
        report.total_ms
    ))
}

/// Where each photo's container goes.
fn outputs(photos: &[PathBuf], output: &Path) -> Result<Vec<PathBuf>, Usage> {
    let text = output.as_os_str().to_string_lossy();
    let folder = photos.len() > 1 || output.is_dir() || text.ends_with(['/', std::path::MAIN_SEPARATOR]);
    let all: Vec<PathBuf> = if folder {
        if output.is_file() {
            return Err(Usage(format!("--output {text} must be a folder for several photos; it is a file")));
        }
        photos.iter().map(|p| output.join(p.file_stem().unwrap_or_default()).with_added_extension("tmpi")).collect()
    } else {
        vec![output.to_owned()]
    };
    for (i, path) in all.iter().enumerate() {
        if let Some(j) = all[..i].iter().position(|p| p == path) {
            let (a, b) = (photos[j].display(), photos[i].display());
            return Err(Usage(format!("{a} and {b} would both be written to {}", path.display())));
        }
        if photos.contains(path) {
            return Err(Usage(format!("{} is a photo and would be overwritten", path.display())));
        }
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paths(names: &[&str]) -> Vec<PathBuf> {
        names.iter().map(PathBuf::from).collect()
    }

    #[test]
    fn one_photo_to_a_file_several_to_a_folder() {
        assert_eq!(outputs(&paths(&["a.jpg"]), Path::new("x.tmpi")).unwrap(), paths(&["x.tmpi"]));
        assert_eq!(outputs(&paths(&["in/a.b.jpg", "c.png"]), Path::new("out")).unwrap(), paths(&["out/a.b.tmpi", "out/c.tmpi"]));
        assert_eq!(outputs(&paths(&["a.jpg"]), Path::new("new/")).unwrap(), paths(&["new/a.tmpi"]));
    }

    #[test]
    fn nothing_is_overwritten_unawares() {
        assert!(outputs(&paths(&["a/x.jpg", "b/x.png"]), Path::new("out")).unwrap_err().to_string().contains("out/x.tmpi"));
        assert!(outputs(&paths(&["a.jpg"]), Path::new("a.jpg")).unwrap_err().to_string().contains("overwritten"));
        assert!(outputs(&paths(&["a.jpg", "b.jpg"]), Path::new("Cargo.toml")).unwrap_err().to_string().contains("folder"));
    }
}
