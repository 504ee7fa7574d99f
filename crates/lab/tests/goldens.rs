//! Twelve kinds of scenes from eight cameras: the reference against its goldens. `tmpi-lab check` holds all backends against rays.
//!
//! `TMPI_BLESS=1 cargo test --release -p tmpi-lab --test goldens` updates the goldens; `TMPI_BLESS=scenes` updates the scenes too.
#![allow(clippy::unwrap_used, clippy::cast_possible_truncation, clippy::cast_precision_loss, reason = "test")]

use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::ExtendedColorType;
use tmpi_core::{Camera, Pose, Scene, ViewBox, container};
use tmpi_lab::metrics::flip;
use tmpi_lab::scenes;
use tmpi_pipeline::Silent;
use tmpi_pipeline::networks::models;
use tmpi_render::{PictureFormat, Reference, Renderer, View, corners, encode};
use tmpi_testing::pictures::png;

/// Seeds of scenes of twelve families; no network was trained on them.
const SEEDS: std::ops::Range<u64> = 910_000..910_400;
const FAMILIES: [&str; 12] =
    ["room", "corridor", "kitchen", "street", "field", "terrain", "crowd", "thin", "foliage", "shelf", "heap", "floating"];
const SIZE: (u32, u32) = (192, 128);
/// JPEG quality of goldens.
const QUALITY: u8 = 92;
/// Allowed mean FLIP between a golden and the rendered view, both as JPEG of the same quality.
const MAX_GOLDEN: f64 = 0.0005;
/// Views per row of a golden.
const COLUMNS: usize = 4;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/scenes")
}

/// Cameras at corners of the view box, half of them rotated.
fn cameras(scene: &Scene) -> Vec<Camera> {
    let (width, height) = (scene.grid.width, scene.grid.height);
    let others = corners(&scene.view_box, 0.5).skip(1).step_by(2).enumerate();
    let turned = others.map(|(i, p)| Pose { roll: i as f64 - 1.5, yaw: p.yaw + 1.0, ..p });
    let poses = corners(&scene.view_box, 0.0).step_by(2).chain(turned);
    poses.map(|pose| Camera { pose, intrinsics: scene.intrinsics, width, height }).collect()
}

/// Processes the first scene of a family with its exact disparity.
fn make(family: &str) -> Vec<u8> {
    let scene = SEEDS.map(|seed| scenes::Scene::framed(seed, SIZE.0, SIZE.1)).find(|s| s.family() == family);
    let scene = scene.unwrap_or_else(|| panic!("no {family} among the seeds"));
    let camera = scene.camera();
    let picture = scene.render(&camera, 3);
    let disparity = tmpi_pipeline::depth::to_png(&picture.disparity).unwrap();
    let options = tmpi_pipeline::Options {
        fov_x: Some(camera.intrinsics.fov_x(SIZE.0)),
        // a box of their own, so that another default changes no golden
        view_box: ViewBox { x: 0.06, y: 0.06, z: 0.06 },
        ..tmpi_pipeline::Options::default()
    };
    let file = png(SIZE.0, SIZE.1, picture.photo.rgb.as_flattened(), ExtendedColorType::Rgb8);
    let models = models::load(&models::Settings::default()).unwrap();
    tmpi_pipeline::make(&models, &tmpi_pipeline::photo::Limits::default(), &file, Some(&disparity), &options, &Silent).unwrap().container
}

fn scene(family: &str) -> Arc<Scene> {
    let path = folder().join(format!("{family}.tmpi"));
    if std::env::var("TMPI_BLESS").is_ok_and(|v| v == "scenes") {
        std::fs::create_dir_all(folder()).unwrap();
        std::fs::write(&path, make(family)).unwrap();
    }
    let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    Arc::new(container::decode(&bytes).unwrap())
}

/// Arranges all views in one picture.
fn sheet(views: &[View]) -> View {
    let (w, h) = (views[0].width as usize, views[0].height as usize);
    let rows = views.len().div_ceil(COLUMNS);
    let mut out = View { width: (w * COLUMNS) as u32, height: (h * rows) as u32, rgba: vec![[0; 4]; w * COLUMNS * h * rows] };
    for (i, view) in views.iter().enumerate() {
        for (y, row) in view.rgba.chunks_exact(w).enumerate() {
            let at = (i / COLUMNS * h + y) * w * COLUMNS + i % COLUMNS * w;
            out.rgba[at..at + w].copy_from_slice(row);
        }
    }
    out
}

#[test]
fn the_reference_matches_its_goldens() {
    let bless = std::env::var_os("TMPI_BLESS").is_some();
    for family in FAMILIES {
        let scene = scene(family);
        let views: Vec<View> = cameras(&scene).iter().map(|camera| Reference.render(&scene, camera).unwrap()).collect();
        let (sheet, path) = (sheet(&views), folder().join(format!("{family}.jpg")));
        if bless {
            std::fs::write(&path, encode(&sheet, PictureFormat::Jpeg, QUALITY).unwrap()).unwrap();
        }
        let golden = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let golden = of_jpeg(&golden);
        assert_eq!(golden.len(), sheet.rgba.len(), "{family}");
        let width = sheet.width as usize;
        let seen = |views: &View| flip(&golden, &of_jpeg(&encode(views, PictureFormat::Jpeg, QUALITY).unwrap()), width);
        assert!(seen(&sheet) <= MAX_GOLDEN, "{family}: FLIP {:.5}", seen(&sheet));
        for (i, fault) in faults(&views).iter().map(&seen).enumerate() {
            assert!(fault > MAX_GOLDEN, "{family}: fault {i} in one view is not detected: FLIP {fault:.5}");
        }
    }
}

/// Pixels of a JPEG.
fn of_jpeg(file: &[u8]) -> Vec<[u8; 3]> {
    image::load(Cursor::new(file), image::ImageFormat::Jpeg).unwrap().into_rgb8().pixels().map(|p| p.0).collect()
}

/// Sheets with one slightly wrong view: moved by half a pixel, black in the leftmost column, or with one tile two levels darker.
fn faults(views: &[View]) -> [View; 3] {
    let with = |fault: &dyn Fn(&View, usize, usize) -> [u8; 4]| {
        let mut views = views.to_vec();
        let right = views.last().unwrap().clone();
        let width = right.width as usize;
        views.last_mut().unwrap().rgba = (0..right.rgba.len()).map(|i| fault(&right, i % width, i / width)).collect();
        sheet(&views)
    };
    let at = |view: &View, x: usize, y: usize| view.rgba[y * view.width as usize + x.min(view.width as usize - 1)];
    [
        with(&|v, x, y| std::array::from_fn(|i| at(v, x, y)[i].midpoint(at(v, x + 1, y)[i]))),
        with(&|v, x, y| if x == 0 { [0, 0, 0, 255] } else { at(v, x, y) }),
        with(&|v, x, y| at(v, x, y).map(|c| if x < 64 && y < 64 { c.saturating_sub(2) } else { c })),
    ]
}
