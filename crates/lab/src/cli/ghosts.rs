//! `tmpi-lab ghosts`.

use std::path::PathBuf;

use super::{note, result};
use crate::files;
use crate::ghosts::{self, Ghosts, Pair};
use crate::table::table;
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;

/// Measure the outlines of things that stay on the background when the view moves, without matting and with it
#[derive(Clone, Debug, clap::Args)]
pub(super) struct GhostArgs {
    /// Photos; none: those of `crates/lab/lists/ghosts.txt` below the folder that `TMPI_DATA` names
    #[arg(value_name = "PHOTO")]
    photos: Vec<PathBuf>,
    /// The figures as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    models: ModelFlags,
}

pub(super) fn run(args: &GhostArgs) -> anyhow::Result<()> {
    let models = models::load(&args.models.settings())?;
    let data = std::env::var_os("TMPI_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let listed = || ghosts::listed(include_str!("../../lists/ghosts.txt")).map(|name| data.join(name)).collect();
    let photos: Vec<PathBuf> = if args.photos.is_empty() { listed() } else { args.photos.clone() };
    let (mut rows, mut all) = (Vec::new(), Pair::default());
    for photo in photos {
        let name = photo.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        note(&format!("tmpi-lab ghosts: {name}"));
        let pair = ghosts::of_photo(&models, &name, &files::read(&photo)?)?;
        all.unmatted.add(pair.unmatted);
        all.made.add(pair.made);
        rows.push((name, pair));
    }
    rows.push(("all".into(), all));
    if args.json {
        return result(&serde_json::to_string_pretty(&rows)?);
    }
    let heads = ["seen, %", "outlines of any colour, %", "residue, levels"];
    let [without, with] = ["without matting: ", "with: "].map(|how| heads.map(|head| format!("{how}{head}")).to_vec());
    let head = [vec![String::new(), "places".into()], without, with].concat();
    let lines = rows.into_iter().map(|(name, Pair { unmatted, made })| {
        let [without, with] = [unmatted, made].map(|g: Ghosts| {
            [format!("{:.1}", 100.0 * g.share()), format!("{:.1}", 100.0 * g.outline_share()), format!("{:.2}", g.mean())].to_vec()
        });
        [vec![name, unmatted.places.to_string()], without, with].concat()
    });
    result(table(1, &head, lines).trim_end())
}
