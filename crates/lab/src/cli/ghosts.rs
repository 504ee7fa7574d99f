//! `tmpi-lab ghosts`.

use std::path::PathBuf;

use super::{note, result};
use crate::files;
use crate::ghosts::{self, BANDS, OfBand};
use crate::table::table;
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;

/// Measure the outlines of things that stay on the background when the view moves, by the width of the band of mattes
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
    let (mut rows, mut all) = (Vec::new(), [OfBand::default(); BANDS.len()]);
    for photo in photos {
        let name = photo.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        note(&format!("tmpi-lab ghosts: {name}"));
        let found = ghosts::of_photo(&models, &name, &files::read(&photo)?)?;
        for (all, one) in all.iter_mut().zip(found) {
            all.ghosts.add(one.ghosts);
            all.ms += one.ms;
        }
        rows.push((name, found));
    }
    if args.json {
        rows.push(("all".into(), all));
        return result(&serde_json::to_string_pretty(&rows)?);
    }
    let outlines = |of: OfBand| format!("{:.1}", 100.0 * of.ghosts.outline_share());
    let head: Vec<String> =
        [String::new(), "places".into()].into_iter().chain(BANDS.map(|band| format!("outlines at {band} px, %"))).collect();
    let lines = rows.iter().map(|(name, of)| [vec![name.clone(), of[0].ghosts.places.to_string()], of.map(outlines).to_vec()].concat());
    let photos = table(1, &head, lines);
    let bands = BANDS.into_iter().zip(all).map(|(band, of)| {
        let figures = [100.0 * of.ghosts.share(), 100.0 * of.ghosts.outline_share(), of.ghosts.mean(), of.ms / rows.len().max(1) as f64];
        [vec![band.to_string()], figures.map(|figure| format!("{figure:.1}")).to_vec()].concat()
    });
    let head = ["band, px", "seen, %", "outlines of any colour, %", "residue, levels", "layers, ms"];
    result(format!("{photos}\n{}", table(0, &head, bands)).trim_end())
}
