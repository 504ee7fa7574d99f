//! `tmpi make`.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc;

use anyhow::Context;
use serde_json::json;

use super::batch::{Batch, Item};
use super::flags::MakeFlags;
use super::progress::Bars;
use super::{Usage, files, is_broken_pipe, reasons, watch};
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{self, Made, Models, Options, Report, Stereo};

/// Make tiled multiplane images of photos
#[derive(Clone, Debug, clap::Args)]
#[allow(clippy::struct_excessive_bools, reason = "flags of a command")]
pub(super) struct MakeArgs {
    /// JPEG, PNG, WebP or MPO files, or folders of them with all folders below; there `photo_depth.png` (or -depth, `_depthmap`, `_disparity`, …; JPEG,
    /// WebP, PFM or OpenEXR, too) beside photo.jpg is that photo's depth map
    #[arg(required = true, value_name = "PHOTO|DIR")]
    pub photos: Vec<PathBuf>,
    /// Container to write; with several photos, or where it is a folder, the folder for them. Missing folders are made
    #[arg(short, long, value_name = "OUT.tmpi|DIR")]
    pub output: PathBuf,
    /// Follow the folder: make what is there, and then what appears or changes, until Ctrl+C or SIGTERM
    #[arg(long, conflicts_with_all = ["force", "depth", "second", "strokes", "report"])]
    watch: bool,
    /// Make again what is there already. Without it a container that is there is left in a folder, and is an error where it alone is named
    #[arg(short, long)]
    force: bool,
    /// Leave what is there already, also where it alone is named
    #[arg(long, conflicts_with = "force")]
    skip_existing: bool,
    /// Photos that are made side by side; each uses several cores already
    #[arg(short, long, value_parser = clap::value_parser!(u16).range(1..=256), default_value_t = 1, value_name = "N")]
    pub jobs: u16,
    /// Depth map of the one photo, a grey PNG of 8 or 16 bits, PFM or OpenEXR; in place of one that lies beside it
    #[arg(long, value_name = "FILE")]
    depth: Option<PathBuf>,
    /// The same scene by the other eye, from beside the one photo: depth is measured against it
    #[arg(long, value_name = "FILE", conflicts_with_all = ["depth", "stereo"])]
    second: Option<PathBuf>,
    /// Also write the report: of one photo an object, of several a list
    #[arg(long, value_name = "FILE.json")]
    report: Option<PathBuf>,
    /// A line of JSON on standard output for each photo
    #[arg(long)]
    json: bool,
    /// No progress, and nothing on standard output but what --json asks for
    #[arg(short, long)]
    pub quiet: bool,
    #[command(flatten)]
    flags: MakeFlags,
    #[command(flatten)]
    pub models: ModelFlags,
}

pub(super) fn run(args: &MakeArgs) -> anyhow::Result<()> {
    if args.watch {
        return watch::run(args);
    }
    check_count(args, args.photos.len())?;
    let Batch { items, folder, left_out } = Batch::of(&args.photos, &args.output)?;
    check_count(args, items.len())?;
    let total = items.len();
    let items: Vec<Item> = if args.force { items } else { items.into_iter().filter(|i| !i.output.exists()).collect() };
    let left = total - items.len();
    let bars = Bars::new(args.quiet);
    for line in &left_out {
        bars.note(line);
    }
    let named = args.output.display();
    anyhow::ensure!(
        left == 0 || folder || args.skip_existing,
        "{named} is there already: --force makes it again, --skip-existing leaves it"
    );
    if left > 0 && !args.quiet {
        let what = if folder { format!("{left} of {total} are") } else { format!("{named} is") };
        bars.note(&format!("{what} there already and left so; --force makes them again"));
    }
    if items.is_empty() {
        return Ok(());
    }
    let depth = args.depth.as_deref().or(args.second.as_deref()).map(files::read).transpose()?;
    let models = models::load(&args.models.settings())?;
    let work = Work { models: &models, depth: depth.as_deref(), args, bars: &bars, stop: &AtomicBool::new(false) };
    let (mut made, mut failed) = (Vec::new(), 0);
    work.all(&items, |index, result| {
        match result {
            Ok(report) => made.push((index, report)),
            Err(error) if !folder => return Err(error),
            Err(error) => {
                failed += 1;
                bars.note(&format!("tmpi: {}", reasons(&error)));
            }
        }
        Ok(())
    })?;
    if let Some(file) = &args.report {
        made.sort_by_key(|(index, _)| *index);
        let about = |(i, report): &(usize, Report)| json!({ "photo": items[*i].photo, "output": items[*i].output, "report": report });
        let text = match made.as_slice() {
            [(_, report)] if total == 1 => serde_json::to_vec_pretty(report)?,
            all => serde_json::to_vec_pretty(&all.iter().map(about).collect::<Vec<_>>())?,
        };
        files::write(file, &text)?;
    }
    anyhow::ensure!(failed == 0, "{failed} of {} photos failed", items.len());
    Ok(())
}

/// Refuses flags that are about one photo if there are several.
fn check_count(args: &MakeArgs, photos: usize) -> Result<(), Usage> {
    let about_one = [
        (args.depth.is_some(), "--depth takes the map"),
        (args.second.is_some(), "--second takes the other picture"),
        (args.flags.strokes.is_some(), "--strokes takes those"),
    ];
    match about_one.into_iter().find(|(is_given, _)| *is_given && photos > 1) {
        Some((_, takes)) => Err(Usage(format!("{takes} of one photo; several photos were given"))),
        None => Ok(()),
    }
}

/// What all photos are made with.
pub(super) struct Work<'a> {
    pub models: &'a Models,
    pub depth: Option<&'a [u8]>,
    pub args: &'a MakeArgs,
    pub bars: &'a Bars,
    /// Once set, no other photo is begun.
    pub stop: &'a AtomicBool,
}

impl Work<'_> {
    /// Makes all photos, `--jobs` side by side, and tells of each; `done` is called for each as it ends, here, and ends it all by an error.
    pub fn all(&self, items: &[Item], mut done: impl FnMut(usize, anyhow::Result<Report>) -> anyhow::Result<()>) -> anyhow::Result<()> {
        let next = AtomicUsize::new(0);
        let mut telling = true;
        std::thread::scope(|scope| {
            let (send, receive) = mpsc::channel();
            for _ in 0..usize::from(self.args.jobs).min(items.len()) {
                let (send, next) = (send.clone(), &next);
                scope.spawn(move || {
                    while !self.stop.load(Ordering::Relaxed) {
                        let index = next.fetch_add(1, Ordering::Relaxed);
                        let Some(item) = items.get(index) else { break };
                        let place = if items.len() > 1 { format!("[{}/{}] ", index + 1, items.len()) } else { String::new() };
                        if send.send((index, self.one(&place, item))).is_err() {
                            break;
                        }
                    }
                });
            }
            drop(send);
            receive.into_iter().try_for_each(|(index, result)| {
                if let Ok(report) = &result
                    && telling
                    && let Err(error) = tell(self.bars, &items[index], report, self.args)
                {
                    anyhow::ensure!(is_broken_pipe(&error), error);
                    // the containers are what was asked for, whether or not somebody reads about them
                    telling = false;
                }
                done(index, result)
            })
        })
    }

    fn one(&self, place: &str, item: &Item) -> anyhow::Result<Report> {
        let bytes = files::read(&item.photo)?;
        // a map that was named goes before one that was found
        let found = item.depth.as_deref().filter(|_| self.depth.is_none()).map(files::read).transpose()?;
        let name = item.photo.display().to_string();
        let bar = self.bars.bar(&format!("{place}{name}"));
        let flags = &self.args.flags;
        let stereo = if self.args.second.is_some() { Ok(Stereo::Beside) } else { flags.depth.stereo_of(&item.photo) };
        let options = Options { stereo: stereo.with_context(|| name.clone())?, ..flags.options() };
        let made = tmpi_pipeline::make(self.models, &Limits::default(), &bytes, self.depth.or(found.as_deref()), &options, &bar);
        drop(bar);
        let Made { container, report, .. } = made.map_err(|e| anyhow::Error::new(e).context(name))?;
        files::write(&item.output, &container)?;
        Ok(report)
    }
}

fn tell(bars: &Bars, item: &Item, report: &Report, args: &MakeArgs) -> anyhow::Result<()> {
    let Item { photo, output, .. } = item;
    let beside = item.depth.as_ref().filter(|_| args.depth.is_none());
    if !args.quiet
        && let Some(depth) = report.input.depth.as_ref().filter(|d| d.stretched)
    {
        let (map, name) = (format!("{}×{}", depth.width, depth.height), photo.display());
        bars.note(&format!("{name}: its depth map ({map}) has another shape than the photo and was stretched"));
    }
    if !args.quiet
        && let Some(problem) = &report.input.depth_problem
    {
        bars.note(&format!("{}: depth is estimated: {problem}", photo.display()));
    }
    if args.json {
        return bars.result(
            &json!({ "photo": photo, "output": output, "depth": beside, "bytes": report.bytes.total, "report": report }).to_string(),
        );
    }
    if args.quiet {
        return Ok(());
    }
    let kb = |n: usize| n as f64 / 1000.0;
    let b = &report.bytes;
    let (width, height, seconds) = (report.width, report.height, report.total_ms / 1e3);
    let share = format!("the photo {:.1}, its depth {:.1}", kb(b.photo), kb(b.total - b.photo));
    let from = beside.map_or_else(String::new, |map| format!(", depth from {}", map.display()));
    bars.result(&format!("{}: {width}×{height}, {:.1} KB ({share}), {seconds:.1} s{from}", output.display(), kb(b.total)))
}
