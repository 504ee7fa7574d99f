//! `tmpi-lab synth`: writes rendered scenes with exact ground truth as picture files.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use rayon::prelude::*;
use serde_json::json;

use super::{note, psi_training_data, size};
use crate::files;
use crate::scenes::{Assets, Model, Models, Picture, Pictures, Scene, Up};
use tmpi_core::{Camera, Photo, Pose};

/// Render scenes with exact disparity, exact second views and the exact hidden surface
#[derive(Clone, Debug, clap::Args)]
pub(super) struct SynthArgs {
    /// Output folder; each scene gets a subfolder named by its seed
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Number of scenes
    #[arg(long, default_value_t = 1, value_name = "N")]
    count: u32,
    /// Seed of the first scene; the others use the next seeds
    #[arg(long, default_value_t = 0, value_name = "S")]
    seed: u64,
    /// Picture size. By default, size and aspect ratio vary between scenes, with an area of about 256 × 384 pixels
    #[arg(long, value_parser = |text: &str| size(text, MAX_PIXELS), value_name = "WxH")]
    size: Option<(u32, u32)>,
    /// Number of second views per scene
    #[arg(long, default_value_t = 0, value_name = "N")]
    views: u32,
    /// Maximum shift of a second view along each axis, in units of the nearest distance
    #[arg(long, default_value_t = 0.08, value_name = "UNITS")]
    baseline: f64,
    /// Also write the surface behind the first one
    #[arg(long)]
    hidden: bool,
    /// Also write layers with the true colours of their hidden texels, to train Ψ
    #[arg(long)]
    layers: bool,
    /// Colour samples per pixel along each axis, at edges
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=16), value_name = "N")]
    supersampling: u32,
    /// Cut about half of all textures from the photos (PNG, JPEG, WebP) in this folder, in order of name, and use whole photos as backdrops
    /// of some figures
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
    /// Replace objects by textured models (binary glTF, in metres) of similar size from this folder, and place some scenes inside furnished
    /// models
    #[arg(long, value_name = "DIR")]
    models: Option<PathBuf>,
    /// Which axis of the models points up
    #[arg(long, default_value = "y", value_name = "AXIS", requires = "models")]
    models_up: Up,
    /// Skip scenes whose folder is complete
    #[arg(long)]
    resume: bool,
}

/// Maximum number of pixels in a scene's picture.
const MAX_PIXELS: u64 = 50_000_000;

/// A size that depends on the seed: multiples of 32, area about 256 × 384, aspect 9:16 to 16:9 and sometimes 1:3 to 3:1.
fn varied_size(seed: u64) -> (u32, u32) {
    const WIDTHS: [u32; 12] = [384, 352, 256, 416, 320, 384, 288, 352, 416, 224, 544, 192];
    const HEIGHTS: [u32; 12] = [256, 288, 384, 224, 320, 256, 352, 256, 256, 416, 192, 512];
    let which = (seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 33) as usize % WIDTHS.len();
    (WIDTHS[which], HEIGHTS[which])
}

pub(super) fn run(args: &SynthArgs) -> anyhow::Result<()> {
    let start = Instant::now();
    let pictures = args.pictures.as_deref().map(read_pictures).transpose()?.unwrap_or_default();
    let models = args.models.as_deref().map(|folder| read_models(folder, args.models_up)).transpose()?.unwrap_or_default();
    let assets = Assets { pictures, models };
    let families = (0..u64::from(args.count))
        .into_par_iter()
        .map(|i| {
            let seed = args.seed.wrapping_add(i);
            let folder = args.output.join(format!("{seed:08}"));
            if args.resume && folder.join("scene.json").exists() {
                return Ok(());
            }
            write_scene(args, &assets, seed, &folder).with_context(|| format!("writing {}", folder.display()))
        })
        .collect::<anyhow::Result<Vec<()>>>()?;
    let s = start.elapsed().as_secs_f64();
    note(&format!("{} scenes in {s:.1} s, {:.2} per second", families.len(), families.len() as f64 / s.max(1e-9)));
    Ok(())
}

/// Reads all models in a folder, sorted by name. Names and skips those that cannot be read.
fn read_models(folder: &Path, up: Up) -> anyhow::Result<Models> {
    let mut models = Vec::new();
    for f in files::entries(folder)?.iter().filter(|f| f.extension().is_some_and(|e| e.eq_ignore_ascii_case("glb"))) {
        match Model::read(&files::read(f)?, up) {
            Ok(model) => models.push(model),
            Err(e) => note(&format!("skipped {}: {e}", f.display())),
        }
    }
    anyhow::ensure!(!models.is_empty(), "{} contains no readable .glb file", folder.display());
    Ok(Models::new(models))
}

/// Reads all photos in a folder, sorted by name. Ignores other files.
fn read_pictures(folder: &Path) -> anyhow::Result<Pictures> {
    let mut photos = Vec::new();
    for f in files::entries(folder)? {
        if let Ok(p) = image::open(&f) {
            let p = p.to_rgb8();
            photos.push(Photo { width: p.width(), height: p.height(), rgb: p.pixels().map(|p| p.0).collect() });
        }
    }
    anyhow::ensure!(!photos.is_empty(), "{} contains no photo", folder.display());
    Ok(Pictures::new(&photos))
}

fn write_scene(args: &SynthArgs, assets: &Assets, seed: u64, folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder)?;
    let (width, height) = args.size.unwrap_or_else(|| varied_size(seed));
    let scene = Scene::of(seed, width, height, assets);
    let camera = scene.camera();
    let picture = scene.render(&camera, args.supersampling);
    write_picture(folder, "", &picture)?;
    if args.hidden {
        write_picture(folder, "hidden_", &scene.hidden(&camera, 1))?;
    }
    if args.layers {
        let layers = psi_training_data::layers(&scene, &picture, seed % 2 == 1);
        std::fs::write(folder.join("layers.npy"), layers)?;
    }
    let mut views = Vec::new();
    for i in 0..args.views {
        let pose = second_pose(seed, i, args.baseline);
        let view = scene.render(&Camera { pose, ..camera }, args.supersampling);
        write_picture(folder, &format!("view{i}_"), &view)?;
        views.push(json!({ "photo": format!("view{i}_photo.png"), "disparity": format!("view{i}_disparity.png"), "pose": pose }));
    }
    let about = json!({
        "seed": seed,
        "family": scene.family(),
        "width": width,
        "height": height,
        "intrinsics": camera.intrinsics,
        "fov_x": camera.intrinsics.fov_x(width),
        "views": views,
    });
    // written last: marks the folder as complete
    files::write_json(&folder.join("scene.json"), &about)?;
    Ok(())
}

/// Camera poses that fill the box of ± `baseline` evenly (a Halton sequence, shifted by the seed). The camera does not rotate.
fn second_pose(seed: u64, index: u32, baseline: f64) -> Pose {
    let halton = |base: u64| {
        let (mut n, mut f, mut r) = (u64::from(index) + 1 + seed % 1009 * 7, 1.0, 0.0);
        while n > 0 {
            f /= base as f64;
            r += f * (n % base) as f64;
            n /= base;
        }
        (2.0 * r - 1.0) * baseline
    };
    Pose::at(halton(2), halton(3), halton(5))
}

fn write_picture(folder: &Path, prefix: &str, p: &Picture) -> anyhow::Result<()> {
    let (w, h) = (p.photo.width, p.photo.height);
    let encoder = |name: &str| -> anyhow::Result<_> {
        let file = std::io::BufWriter::new(std::fs::File::create(folder.join(format!("{prefix}{name}.png")))?);
        Ok(PngEncoder::new_with_quality(file, CompressionType::Fast, FilterType::Adaptive))
    };
    encoder("photo")?.write_image(p.photo.rgb.as_flattened(), w, h, ExtendedColorType::Rgb8)?;
    // a second camera may be nearer than one unit; clip its disparity
    let grey: Vec<u16> = p.disparity.delta.iter().map(|d| (d * 65_535.0).round().clamp(0.0, 65_535.0) as u16).collect();
    encoder("disparity")?.write_image(bytemuck::cast_slice(&grey), w, h, ExtendedColorType::L16)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;

    use clap::Parser as _;

    use super::super::{Cli, Command};
    use super::*;

    #[test]
    fn varied_sizes_are_multiples_of_32() {
        assert!((0..200).map(varied_size).all(|(w, h)| w % 32 == 0 && h % 32 == 0));
    }

    #[test]
    fn poses_stay_in_the_box() {
        for seed in 0..50 {
            for i in 0..4 {
                let p = second_pose(seed, i, 0.08);
                assert!([p.tx, p.ty, p.tz].iter().all(|v| v.abs() <= 0.08));
            }
        }
        assert_ne!(second_pose(1, 0, 0.08), second_pose(1, 1, 0.08));
    }

    #[test]
    fn written_scenes_can_be_read_back() -> anyhow::Result<()> {
        let folder = tempfile::tempdir()?;
        let words = "tmpi-lab synth --count 2 --seed 5 --size 64x48 --views 1 --baseline 0.05 --hidden --layers --supersampling 1 --output";
        let words = words.split(' ').map(OsStr::new).chain([folder.path().as_os_str()]);
        let Cli { command: Command::Synth(args) } = Cli::try_parse_from(words)? else { panic!("another command") };
        run(&args)?;
        let scene = Scene::framed(6, 64, 48);
        let picture = scene.render(&scene.camera(), 1);
        let photo = image::open(folder.path().join("00000006/photo.png"))?.to_rgb8();
        assert_eq!(photo.as_raw().as_slice(), picture.photo.rgb.as_flattened());
        let map = image::open(folder.path().join("00000006/disparity.png"))?.to_luma16();
        assert!(map.iter().zip(&picture.disparity.delta).all(|(&v, d)| (f32::from(v) / 65_535.0 - d).abs() < 1e-5));
        let about: serde_json::Value = serde_json::from_slice(&std::fs::read(folder.path().join("00000006/scene.json"))?)?;
        assert_eq!(about["views"].as_array().map(Vec::len), Some(1));
        assert!(folder.path().join("00000006/hidden_photo.png").exists());
        let layers = std::fs::read(folder.path().join("00000006/layers.npy"))?;
        assert_eq!(&layers[..6], b"\x93NUMPY");
        Ok(())
    }
}
