//! Subjects of the benchmark: rendered scenes with exact disparity and second views, or photos.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::ExtendedColorType;

use crate::{LabError, files, scenes};
use tmpi_core::container::PhotoFormat;
use tmpi_core::{Camera, DisparityMap, Photo, Pose};
use tmpi_pipeline::MakeError;
use tmpi_pipeline::depth::{self, DepthKind};
use tmpi_pipeline::photo::{self, Decoded, Limits};
use tmpi_testing::pictures::png;

/// First seed of the benchmark's scenes, far from those that networks were trained on.
const SEED: u64 = 900_000;
/// First seed of the large scenes, and their size: 3.8 megapixels.
const LARGE_SEED: u64 = 900_200;
const LARGE: (u32, u32) = (2400, 1600);
/// Samples a pixel, across and down.
const SAMPLES: u32 = 3;

#[derive(Clone)]
pub(super) struct Subject {
    pub name: String,
    /// The photo file.
    pub file: Vec<u8>,
    /// Exact disparity, if known.
    pub disparity: Option<Arc<DisparityMap>>,
    /// Its file.
    pub map: Option<Vec<u8>>,
    /// Seed, if the scene is rendered.
    pub seed: Option<u64>,
    pub fov_x: Option<f64>,
    /// Exact views.
    pub views: Vec<(Camera, Photo)>,
}

impl Subject {
    pub fn decoded(&self) -> Result<Decoded, LabError> {
        photo::decode(&self.file, &Limits::default(), None)
            .map_err(|e| LabError::Make { subject: self.name.clone(), source: MakeError::Photo(e) })
    }
}

/// Rendered scenes with four views each: moved sideways, vertically, forward, and all combined with a rotation.
pub(super) fn rendered(quick: bool) -> Result<Vec<Subject>, LabError> {
    let (count, size) = if quick { (4, (384, 256)) } else { (16, (630, 350)) };
    (SEED..SEED + count).map(|seed| scene(seed, size, &poses(seed))).collect()
}

/// Rendered scenes as large as photos, with views from these poses.
pub(super) fn large(quick: bool, poses: impl Fn(u64) -> Vec<Pose>) -> Result<Vec<Subject>, LabError> {
    let count = if quick { 1 } else { 4 };
    (LARGE_SEED..LARGE_SEED + count).map(|seed| scene(seed, LARGE, &poses(seed))).collect()
}

/// The four poses of the views of a scene.
pub(super) fn poses(seed: u64) -> Vec<Pose> {
    let side = if seed.is_multiple_of(2) { 1.0 } else { -1.0 };
    vec![
        Pose::at(0.06 * side, 0.0, 0.0),
        Pose::at(0.0, 0.04 * side, 0.0),
        Pose::at(0.0, 0.0, 0.06),
        Pose { yaw: 1.5 * side, pitch: -1.0, roll: 2.0, ..Pose::at(-0.05 * side, 0.03, -0.04) },
    ]
}

/// A rendered scene with views from these poses.
pub(super) fn scene(seed: u64, (width, height): (u32, u32), poses: &[Pose]) -> Result<Subject, LabError> {
    let scene = scenes::Scene::framed(seed, width, height);
    let camera = scene.camera();
    let view = |pose: &Pose| {
        let c = Camera { pose: *pose, ..camera };
        (c, scene.render(&c, SAMPLES).photo)
    };
    let picture = scene.render(&camera, SAMPLES);
    Ok(Subject {
        name: format!("{} {seed}", scene.family()),
        file: png(width, height, picture.photo.rgb.as_flattened(), ExtendedColorType::Rgb8),
        map: Some(depth::to_png(&picture.disparity)?),
        disparity: Some(Arc::new(picture.disparity)),
        seed: Some(seed),
        fov_x: Some(camera.intrinsics.fov_x(width)),
        views: poses.iter().map(view).collect(),
    })
}

/// Reads the disparity map `NAME_disp16.png` beside a photo `NAME.jpg`, if it exists.
fn beside(photo: &Path, file: &[u8]) -> Result<Option<DisparityMap>, LabError> {
    let map = photo.with_file_name(format!("{}{MAP}", photo.file_stem().unwrap_or_default().to_string_lossy()));
    let Ok(png) = std::fs::read(&map) else { return Ok(None) };
    let (width, height) = tmpi_pipeline::photo::check(file, &Limits::default()).map_err(|e| LabError::file(photo, e))?.1;
    let read = depth::from_map(&png, DepthKind::Disparity, &Limits::default(), width, height);
    read.map(|(map, _)| Some(map)).map_err(|e| LabError::file(&map, e))
}

/// Suffix of the name of a disparity map beside a photo.
const MAP: &str = "_disp16.png";

/// Reads all photos in the folders, sorted by name; with `quick`, only four of each folder.
pub(super) fn photos(folders: &[PathBuf], quick: bool) -> Result<Vec<Subject>, LabError> {
    let mut all = Vec::new();
    for folder in folders {
        let mut found = 0;
        let map = |p: &PathBuf| p.to_string_lossy().ends_with(MAP);
        for path in files::entries(folder)?.into_iter().filter(|p| p.is_file() && !map(p)) {
            let file = files::read(&path)?;
            if PhotoFormat::sniff(&file).is_none() || (quick && found == 4) {
                continue;
            }
            found += 1;
            let disparity = beside(&path, &file)?.map(Arc::new);
            let map = disparity.as_deref().map(depth::to_png).transpose()?;
            all.push(Subject { name: files::name(&path), file, disparity, map, seed: None, fov_x: None, views: Vec::new() });
        }
        if found == 0 {
            return Err(LabError::file(folder, "contains no photo"));
        }
    }
    Ok(all)
}
