//! `tmpi-lab ghosts`.

use std::path::PathBuf;

use super::{note, result};
use crate::files;
use crate::ghosts::{self, BANDS, Ghosts, OfBand, OfPhoto};
use crate::table::table;
use tmpi_core::MATTE_BAND;
use tmpi_pipeline::networks::cli_flags::ModelFlags;
use tmpi_pipeline::networks::models;

/// Measure the outlines of things that stay on the background when the view moves, for several widths of the band of mattes; and, for the
/// default width, if things that the depth network draws too small are not widened
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
    let (mut rows, mut all) = (Vec::new(), OfPhoto::default());
    for photo in photos {
        let name = photo.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        note(&format!("tmpi-lab ghosts: {name}"));
        let found = ghosts::of_photo(&models, &name, &files::read(&photo)?)?;
        for (all, one) in all.bands.iter_mut().zip(found.bands) {
            all.ghosts.add(one.ghosts);
            all.ms += one.ms;
        }
        all.not_widened.add(found.not_widened);
        rows.push((name, found));
    }
    if args.json {
        rows.push(("all".into(), all));
        return result(&serde_json::to_string_pretty(&rows)?);
    }
    let outlines = |of: OfBand| format!("{:.1}", 100.0 * of.ghosts.outline_share());
    let head: Vec<String> =
        [String::new(), "places".into()].into_iter().chain(BANDS.map(|band| format!("outlines at {band} px, %"))).collect();
    let lines =
        rows.iter().map(|(name, of)| [vec![name.clone(), of.bands[0].ghosts.places.to_string()], of.bands.map(outlines).to_vec()].concat());
    let photos = table(1, &head, lines);
    let line = |name: String, of: Ghosts, ms: Option<f64>| {
        let figures = [100.0 * of.share(), 100.0 * of.outline_share(), of.mean()].map(|figure| format!("{figure:.1}"));
        let ms = ms.map_or_else(String::new, |ms| format!("{:.1}", ms / rows.len().max(1) as f64));
        [vec![name, of.places.to_string()], figures.to_vec(), vec![ms]].concat()
    };
    let bands = BANDS.into_iter().zip(all.bands).map(|(band, of)| line(band.to_string(), of.ghosts, Some(of.ms)));
    let not_widened = line(format!("{MATTE_BAND}, not widened"), all.not_widened, None);
    let head = ["band, px", "places", "seen, %", "outlines of any colour, %", "residue, levels", "layers, ms"];
    result(format!("{photos}\n{}", table(0, &head, bands.chain([not_widened]))).trim_end())
}
