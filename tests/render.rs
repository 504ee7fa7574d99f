//! The `cpu` and `gpu` backends held against the `f64` reference, and the reference against what is known.
#![allow(clippy::unwrap_used, clippy::cast_precision_loss, clippy::cast_lossless, clippy::cast_possible_truncation, reason = "test")]

use std::sync::Arc;

use tmpi_core::{Camera, Intrinsics, Pose, Scene, ViewBox};
use tmpi_lab::metrics::{psnr, share_off};
use tmpi_lab::stress::scenes::{all, camera, cameras, flat, stack};
use tmpi_render::{Backend, Cpu, Gpu, MAX_SIDE, Reference, RenderError, Renderer, View, corners, select};

fn db(view: &View, photo: &[[u8; 3]]) -> f64 {
    psnr(rgb(view).as_flattened(), photo.as_flattened())
}

/// The `gpu` backend on whatever adapter there is; none, said aloud, where there is none at all.
fn gpu() -> Option<Gpu> {
    Gpu::new(true).map_err(|reason| eprintln!("skipped: {reason}")).ok()
}

/// `excused` pairs of scene and camera must only draw.
fn compare(backend: &dyn Renderer, excused: &[(&str, &str)]) {
    let (mut worst, mut failed) = ((0.0, String::new()), Vec::new());
    for (scene_name, scene) in all() {
        scene.validate().unwrap();
        let scene = Arc::new(scene);
        for (camera_name, camera) in cameras(&scene) {
            let want = Reference.render(&scene, &camera).unwrap();
            let got = backend.render(&scene, &camera).unwrap();
            if excused.contains(&(scene_name, camera_name)) {
                assert_eq!(got.rgba.len(), want.rgba.len());
                continue;
            }
            let share = share_off(&got.rgba, &want.rgba, 8);
            // a few pixels on borders between planes are all that a very small picture has
            let bound = if want.rgba.len() < 100 { 0.0 } else { 0.015 };
            let name = format!("{scene_name} / {camera_name}: {:.3} %", share * 100.0);
            if share > bound {
                failed.push(name.clone());
            }
            if share > worst.0 {
                worst = (share, name);
            }
        }
    }
    println!("{}: worst {}", backend.name(), worst.1);
    assert!(failed.is_empty(), "{} differs from reference:\n{}", backend.name(), failed.join("\n"));
}

#[test]
fn cpu_agrees_with_reference() {
    compare(&Cpu::default(), &[]);
}

#[test]
fn gpu_agrees_with_reference() {
    // Soft layers are drawn in one order for the whole picture. Beside such a camera there is none: left of it the near ones come first,
    // right of it the far ones.
    let excused = [("translucent stack", "edge-on"), ("translucent stack", "nearly edge-on")];
    if let Some(gpu) = gpu() {
        compare(&gpu, &excused);
    }
}

fn identity(scene: &Scene) -> Camera {
    camera(scene, Pose::default(), scene.photo.width, scene.photo.height)
}

fn rgb(view: &View) -> Vec<[u8; 3]> {
    view.rgba.iter().map(|p| [p[0], p[1], p[2]]).collect()
}

/// Scenes whose visible texels are the photo's.
fn faithful() -> impl Iterator<Item = (&'static str, Arc<Scene>)> {
    all()
        .into_iter()
        .filter(|(name, _)| ["flat", "ground", "disc", "disc before infinity", "typical", "remnants"].contains(name))
        .map(|(n, s)| (n, Arc::new(s)))
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
fn the_identity_view_on_the_gpu_is_within_50_db() {
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
fn no_corner_of_the_view_box_sees_past_the_border() {
    let (cpu, gpu) = (Cpu::default(), gpu());
    let backends = [&Reference as &dyn Renderer, &cpu].into_iter().chain(gpu.iter().map(|gpu| gpu as &dyn Renderer));
    for backend in backends {
        for (name, scene) in faithful() {
            for pivot in [0.0, 0.4, 1.0] {
                for pose in corners(&scene.view_box, pivot) {
                    let view = backend.render(&scene, &camera(&scene, pose, scene.photo.width, scene.photo.height)).unwrap();
                    let (w, h) = (view.width as usize, view.height as usize);
                    // a band as wide as the parallax; further in, what is uncovered is no matter of the border
                    let band = (0..w * h).filter(|i| (i % w).min(w - 1 - i % w) < 8 || (i / w).min(h - 1 - i / w) < 8);
                    let open = band.filter(|&i| view.rgba[i][3] < 250).count();
                    assert_eq!(open, 0, "{name} on {} from {pose:?}", backend.name());
                }
            }
        }
    }
}

#[test]
fn beyond_the_border_the_scene_is_its_own_mirror_image() {
    let mut scene = flat(160, 100, 1.0);
    scene.view_box = ViewBox { x: 0.1, y: 0.0, z: 0.0 };
    let scene = Arc::new(scene);
    // ten pixels of parallax
    let pose = Pose::at(-10.0 / scene.intrinsics.fx, 0.0, 0.0);
    let view = Reference.render(&scene, &camera(&scene, pose, 160, 100)).unwrap();
    for y in 0..100 {
        for x in 0..10 {
            let (got, want) = (view.rgba[y * 160 + 9 - x], scene.photo.at(x as u32, y as u32));
            assert!(got[3] == 255 && (0..3).all(|c| got[c].abs_diff(want[c]) <= 1), "{x} {y}: {got:?} {want:?}");
        }
    }
}

/// Mean column of the pixels that are red.
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
fn signs_are_those_of_the_design() {
    signs(&Reference);
    signs(&Cpu::default());
    if let Some(gpu) = gpu() {
        signs(&gpu);
    }
}

/// Largest difference of any channel from `f64` compositing of one-colour layers, farthest first.
fn error_of_stack(backend: &dyn Renderer, colours: &[[u8; 4]]) -> f64 {
    let delta: Vec<f64> = (0..colours.len()).map(|i| (i + 1) as f64 / colours.len() as f64).collect();
    let scene = Arc::new(stack(16, 16, colours, &delta));
    let view = backend.render(&scene, &identity(&scene)).unwrap();
    let mut want = [0.0; 4];
    for c in colours {
        let a = f64::from(c[3]) / 255.0;
        for (w, v) in want.iter_mut().zip([f64::from(c[0]), f64::from(c[1]), f64::from(c[2]), 255.0]) {
            *w = a * v + (1.0 - a) * *w;
        }
    }
    let off = |p: &[u8; 4]| (0..4).map(|c| (f64::from(p[c]) - want[c]).abs()).fold(0.0, f64::max);
    view.rgba.iter().map(off).fold(0.0, f64::max)
}

/// (name, layers, bound in levels for `f64` and `f32`, bound for blending in 16-bit floats)
fn stacks() -> Vec<(&'static str, Vec<[u8; 4]>, f64, f64)> {
    vec![
        ("64 layers of alpha 1/255", vec![[200, 128, 255, 1]; 64], 0.51, 1.51),
        ("64 layers of alpha 128/255", (0..64).map(|i| [i * 4, 255 - i * 4, 90, 128]).collect(), 0.51, 2.0),
        ("64 layers of alpha 254/255", (0..64).map(|i| [i * 4, 255 - i * 4, 90, 254]).collect(), 1.51, 2.0),
        ("64 layers of alpha 252/255 (transmittance underflow)", (0..64).map(|i| [255 - i, i, 90, 252]).collect(), 0.51, 2.0),
        ("one opaque under 8 thin", [vec![[10, 200, 30, 255]], vec![[255, 255, 255, 3]; 8]].concat(), 0.51, 1.51),
    ]
}

#[test]
fn compositing_is_stable() {
    let (cpu, gpu) = (Cpu::default(), gpu());
    for (name, colours, bound, bound8) in stacks() {
        let exact = [(&Reference as &dyn Renderer, bound), (&cpu, bound)];
        for (backend, bound) in exact.into_iter().chain(gpu.iter().map(|gpu| (gpu as &dyn Renderer, bound8))) {
            let error = error_of_stack(backend, &colours);
            println!("{name} on {}: {error:.2} of {bound} levels", backend.name());
            assert!(error <= bound, "{name} on {}: {error} > {bound} levels", backend.name());
        }
    }
}

#[test]
fn a_camera_out_of_range_is_refused_with_the_fields_name() {
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
fn a_scene_that_does_not_fit_together_is_refused() {
    let mut scene = flat(8, 8, 0.5);
    scene.texels.alpha.pop();
    let scene = Arc::new(scene);
    for backend in [&Reference as &dyn Renderer, &Cpu::default()] {
        assert!(matches!(backend.render(&scene, &identity(&scene)), Err(RenderError::Scene(_))));
    }
}

#[test]
fn extreme_numbers_give_no_panic() {
    let scene = Arc::new(flat(32, 20, 0.5));
    let gpu = gpu();
    for focal in [1e-300, 1e-9, 1e9, 1e300] {
        for t in [1e-300, 1e9, 1e300] {
            let camera = Camera { pose: Pose::at(t, -t, t), intrinsics: Intrinsics::centred(32, 20, focal), width: 32, height: 20 };
            for backend in [&Reference as &dyn Renderer, &Cpu::default()].into_iter().chain(gpu.iter().map(|gpu| gpu as &dyn Renderer)) {
                assert_eq!(backend.render(&scene, &camera).unwrap().rgba.len(), 640);
            }
        }
    }
}

/// Many callers at once, of two scenes: each gets its own view.
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
fn a_host_serves_many_callers_at_once() {
    shared(&Cpu::default());
    if let Some(gpu) = gpu() {
        shared(&gpu);
    }
}

#[test]
fn auto_always_finds_a_host() {
    let scene = Arc::new(flat(8, 8, 0.5));
    let backend = select(Backend::Auto).unwrap();
    assert_eq!(rgb(&backend.render(&scene, &identity(&scene)).unwrap()), scene.photo.rgb);
}
