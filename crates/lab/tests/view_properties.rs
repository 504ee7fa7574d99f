//! Properties of rendered views. `crates/lab/src/conformance` compares the backends with `f64` ray casting, for many scenes and cameras.
#![allow(clippy::unwrap_used, clippy::cast_precision_loss, clippy::cast_lossless, clippy::cast_possible_truncation, reason = "test")]

use std::sync::Arc;

use tmpi_core::{Camera, Intrinsics, Pose, Scene, ViewBox};
use tmpi_lab::conformance::scenes::{all, camera, flat};
use tmpi_lab::metrics::psnr;
use tmpi_render::{Backend, Cpu, Gpu, MAX_SIDE, Reference, RenderError, Renderer, View, corners, select};

fn db(view: &View, photo: &[[u8; 3]]) -> f64 {
    psnr(rgb(view).as_flattened(), photo.as_flattened())
}

/// The `gpu` backend on any adapter.
fn gpu() -> Option<Gpu> {
    tmpi_testing::Need::Gpu.or_skip(Gpu::new(true))
}

fn identity(scene: &Scene) -> Camera {
    camera(scene, Pose::default(), scene.photo.width, scene.photo.height)
}

fn rgb(view: &View) -> Vec<[u8; 3]> {
    view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect()
}

/// Scenes whose identity view shows the photo.
fn faithful() -> Vec<(&'static str, Arc<Scene>)> {
    let names = ["flat", "ground", "disc", "disc before infinity", "typical", "remnants"];
    let found: Vec<_> = all().into_iter().filter(|(name, _)| names.contains(name)).map(|(n, s)| (n, Arc::new(s))).collect();
    assert_eq!(found.len(), names.len(), "a scene was renamed");
    found
}

#[test]
fn the_identity_view_is_the_photo() {
    for (name, scene) in faithful() {
        for backend in [&Reference as &dyn Renderer, &Cpu::default()] {
            let view = backend.render(&scene, &identity(&scene)).unwrap();
            assert!(rgb(&view) == scene.photo.rgb, "{name} on {}: {:.1} dB", backend.name(), db(&view, &scene.photo.rgb));
            assert!(view.rgba.iter().all(|p| p[3] == 255), "{name} on {}: covered everywhere", backend.name());
        }
    }
}

#[test]
fn the_gpus_identity_view_reaches_50_db() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in faithful() {
        let view = gpu.render(&scene, &identity(&scene)).unwrap();
        let got = db(&view, &scene.photo.rgb);
        println!("{name}: {got:.1} dB");
        assert!(got >= 50.0, "{name}: {got:.1} dB");
        assert!(view.rgba.iter().all(|p| p[3] == 255), "{name}: covered everywhere");
    }
}

#[test]
fn view_box_corners_do_not_see_past_the_border() {
    let (cpu, gpu) = (Cpu::default(), gpu());
    let backends = [&Reference as &dyn Renderer, &cpu].into_iter().chain(gpu.iter().map(|gpu| gpu as &dyn Renderer));
    for backend in backends {
        for (name, scene) in faithful() {
            for pivot in [0.0, 0.4, 1.0] {
                for pose in corners(&scene.view_box, pivot) {
                    let view = backend.render(&scene, &camera(&scene, pose, scene.photo.width, scene.photo.height)).unwrap();
                    let (w, h) = (view.width as usize, view.height as usize);
                    // a band as wide as the parallax; holes further in are not caused by the border
                    let band = (0..w * h).filter(|i| (i % w).min(w - 1 - i % w) < 8 || (i / w).min(h - 1 - i / w) < 8);
                    let open = band.filter(|&i| view.rgba[i][3] < 250).count();
                    assert_eq!(open, 0, "{name} on {} from {pose:?}", backend.name());
                }
            }
        }
    }
}

#[test]
fn beyond_the_border_is_a_blurred_mirror_image() {
    let mut scene = flat(160, 100, 1.0);
    // stripes of eight pixels
    for (x, p) in (0..160).cycle().zip(&mut scene.photo.rgb) {
        *p = [x / 4 % 2 * 240; 3];
    }
    scene.view_box = ViewBox { x: 0.1, y: 0.0, z: 0.0 };
    let scene = Arc::new(scene);
    // ten pixels of parallax
    let pose = Pose::at(-10.0 / scene.intrinsics.fx, 0.0, 0.0);
    let view = Reference.render(&scene, &camera(&scene, pose, 160, 100)).unwrap();
    for row in view.rgba.chunks(160) {
        // from the border outwards: the first stripe, then the next two
        let beyond: Vec<u8> = row[..10].iter().rev().map(|p| p[0]).collect();
        assert!(row[..10].iter().all(|p| p[3] == 255), "{row:?}");
        let contrast = |pixels: &[u8]| pixels.iter().max().unwrap() - pixels.iter().min().unwrap();
        assert!(beyond[0] < 10 && beyond[5] > 120, "mirrored: {beyond:?}");
        assert!((40..200).contains(&contrast(&beyond[4..])), "blurred: {beyond:?}");
        assert!((10..160).all(|x| [0, 240].contains(&row[x][0])), "sharp within the photo");
    }
}

/// Mean column of the red pixels.
fn column_of_red(view: &View) -> f64 {
    let red: Vec<f64> =
        (0..).zip(&view.rgba).filter(|(_, p)| p[0] > 200 && p[1] < 60).map(|(i, _): (u32, _)| f64::from(i % view.width)).collect();
    assert!(!red.is_empty());
    red.iter().sum::<f64>() / red.len() as f64
}

fn spot(delta: f64) -> Arc<Scene> {
    let mut scene = flat(160, 100, delta);
    for (i, p) in (0..).zip(&mut scene.photo.rgb) {
        let (x, y) = (i % 160_u32, i / 160_u32);
        *p = if (70..90).contains(&x) && (40..60).contains(&y) { [250, 20, 20] } else { [20, 90, 200] };
    }
    Arc::new(scene)
}

fn signs(backend: &dyn Renderer) {
    let shift = |delta: f64, pose: Pose| {
        let scene = spot(delta);
        column_of_red(&backend.render(&scene, &camera(&scene, pose, 160, 100)).unwrap()) - 79.5
    };
    let f = 160.0 * Intrinsics::DEFAULT_FOCAL_PER_WIDTH;
    let (near, far) = (shift(1.0, Pose::at(0.1, 0.0, 0.0)), shift(0.3, Pose::at(0.1, 0.0, 0.0)));
    assert!((near + 0.1 * f).abs() < 0.6, "{}: nearest moves left by tx·f = {:.1}, got {near}", backend.name(), 0.1 * f);
    assert!((far + 0.03 * f).abs() < 0.6, "{}: farther moves less, got {far}", backend.name());
    assert!(shift(0.0, Pose::at(0.1, 0.1, 0.1)).abs() < 0.1, "{}: infinity stays", backend.name());
    assert!(shift(0.5, Pose { yaw: 5.0, ..Pose::default() }) < -5.0, "{}: looking right moves the scene left", backend.name());
}

#[test]
fn camera_motion_has_the_right_sign() {
    signs(&Reference);
    signs(&Cpu::default());
    if let Some(gpu) = gpu() {
        signs(&gpu);
    }
}

#[test]
fn invalid_cameras_are_refused_by_field() {
    let scene = Arc::new(flat(8, 8, 0.5));
    let good = identity(&scene);
    let bad = [
        (Camera { pose: Pose { yaw: f64::NAN, ..Pose::default() }, ..good }, "pose"),
        (Camera { intrinsics: Intrinsics { fx: 0.0, ..good.intrinsics }, ..good }, "intrinsics"),
        (Camera { intrinsics: Intrinsics { cy: f64::INFINITY, ..good.intrinsics }, ..good }, "intrinsics"),
        (Camera { width: 0, ..good }, "width"),
        (Camera { height: MAX_SIDE + 1, ..good }, "height"),
        (Camera { width: 8192, height: 8193, ..good }, "pixels"),
    ];
    for (camera, field) in bad {
        for backend in [&Reference as &dyn Renderer, &Cpu::default()] {
            let error = backend.render(&scene, &camera).unwrap_err();
            assert!(matches!(error, RenderError::Camera(text) if text.contains(field)), "{field}: {error}");
        }
    }
}

#[test]
fn inconsistent_scenes_are_refused() {
    let mut scene = flat(8, 8, 0.5);
    scene.texels.alpha.pop();
    let scene = Arc::new(scene);
    for backend in [&Reference as &dyn Renderer, &Cpu::default()] {
        assert!(matches!(backend.render(&scene, &identity(&scene)), Err(RenderError::Scene(_))));
    }
}

/// Renders two scenes from many threads: each gets the right view.
fn shared(backend: &dyn Renderer) {
    let scenes = [0.2, 0.9].map(|delta| Arc::new(flat(48, 32, delta)));
    let pose = Pose::at(0.05, 0.0, 0.0);
    let want = scenes.clone().map(|scene| backend.render(&scene, &camera(&scene, pose, 96, 64)).unwrap());
    assert_ne!(want[0], want[1]);
    std::thread::scope(|threads| {
        for caller in 0..12 {
            let (scenes, want) = (&scenes, &want);
            threads.spawn(move || {
                for turn in 0..5 {
                    let which = (caller + turn) % 2;
                    let camera = camera(&scenes[which], pose, 96, 64);
                    assert!(backend.render(&scenes[which], &camera).unwrap() == want[which], "{}", backend.name());
                }
            });
        }
    });
}

#[test]
fn backends_can_be_shared_between_threads() {
    shared(&Cpu::default());
    if let Some(gpu) = gpu() {
        shared(&gpu);
    }
}

#[test]
fn auto_always_finds_a_backend() {
    let scene = Arc::new(flat(8, 8, 0.5));
    let backend = select(Backend::Auto).unwrap();
    assert_eq!(rgb(&backend.render(&scene, &identity(&scene)).unwrap()), scene.photo.rgb);
}
