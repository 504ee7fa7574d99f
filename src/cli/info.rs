//! `tmpi info`.

use std::path::PathBuf;

use anyhow::Context;
use serde_json::json;

use super::{files, result};
use tmpi_core::{Class, container};

/// Characters of a full bar.
const BAR: f64 = 40.0;

/// Show what a container holds
#[derive(Clone, Debug, clap::Args)]
pub(super) struct InfoArgs {
    /// The container
    #[arg(value_name = "IN.tmpi")]
    input: PathBuf,
    /// As JSON
    #[arg(long)]
    json: bool,
    /// Print only the SHA-256 of the decoded scene: layers, classes, alphas, hidden colours
    #[arg(long, conflicts_with = "json")]
    digest: bool,
}

pub(super) fn run(args: &InfoArgs) -> anyhow::Result<()> {
    let bytes = files::read(&args.input)?;
    let context = || args.input.display().to_string();
    let sections = container::sections(&bytes).with_context(context)?;
    let scene = container::decode(&bytes).with_context(context)?;
    if args.digest {
        return result(&scene.digest());
    }
    // a container that decodes has a complete header
    let version = bytes.get(4..8).map_or([0, 0], |v| [u16::from_le_bytes([v[0], v[1]]), u16::from_le_bytes([v[2], v[3]])]);
    let (g, k, b) = (&scene.grid, &scene.intrinsics, &scene.view_box);
    let tiles = g.tiles();
    let planes = scene.layers.len();
    let per_tile = planes as f64 / f64::from(tiles);
    let mut filled = [0usize; 3];
    for &class in &scene.texels.class {
        filled[usize::from(class.min(Class::Hidden as u8))] += 1;
    }
    if args.json {
        let sections: Vec<_> = sections
            .iter()
            .map(|s| json!({ "kind": s.kind, "codec": s.codec, "offset": s.offset, "bytes": s.length, "raw_bytes": s.raw_length }))
            .collect();
        let about = json!({
            "file": args.input,
            "bytes": bytes.len(),
            "version": version,
            "width": g.width,
            "height": g.height,
            "tile": { "size": g.size, "stride": g.stride },
            "tiles": tiles,
            "planes": planes,
            "planes_per_tile": per_tile,
            "texels": { "photo": filled[1], "hidden": filled[2], "empty": filled[0] },
            "fov_x": k.fov_x(g.width),
            "intrinsics": k,
            "view_box": b,
            "travel": tmpi_render::MotionRange::of(&scene).travel,
            "sections": sections,
        });
        return result(&about.to_string());
    }
    result(&format!("{}: {} bytes, version {}.{}", args.input.display(), bytes.len(), version[0], version[1]))?;
    result(&format!("photo     {}×{}, {:.1}° wide", g.width, g.height, k.fov_x(g.width)))?;
    result(&format!("view box  ±{} right, ±{} down, ±{} forward", b.x, b.y, b.z))?;
    result(&format!("tiles     {tiles} of {} px every {} px", g.size, g.stride))?;
    result(&format!("planes    {planes}, {per_tile:.2} a tile"))?;
    result(&format!("texels    {} of the photo, {} hidden", filled[1], filled[2]))?;
    result("section   codec       offset      bytes  unpacked   share")?;
    let header = bytes.len() as u64 - sections.iter().map(|s| s.length).sum::<u64>();
    let row = |kind: &str, codec: &str, offset: u64, length: u64, raw: u64| {
        let share = length as f64 / bytes.len() as f64;
        let bar = "█".repeat((share * BAR).round() as usize);
        result(&format!("{kind:<9} {codec:<8} {offset:>9} {length:>10} {raw:>9} {:>6.1}% {bar}", 100.0 * share))
    };
    row("header", "raw", 0, header, 0)?;
    sections.iter().try_for_each(|s| row(s.kind, s.codec, s.offset, s.length, s.raw_length))
}
