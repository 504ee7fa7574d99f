//! Backends as a whole. `crates/lab/src/conformance` compares their views with `f64` ray casting, for many scenes and cameras.
#![allow(clippy::unwrap_used, reason = "test")]

use std::sync::Arc;

use tmpi_core::Pose;
use tmpi_lab::stiff_scenes::{camera, flat, own_camera};
use tmpi_render::{Backend, Cpu, Gpu, Reference, RenderError, Renderer, select};

/// The `gpu` backend on any adapter.
fn gpu() -> Option<Gpu> {
    tmpi_testing::Need::Gpu.or_skip(Gpu::new(true))
}

#[test]
fn inconsistent_scenes_are_refused() {
    let mut scene = flat(8, 8, 0.5);
    scene.texels.alpha.pop();
    let scene = Arc::new(scene);
    for backend in [&Reference as &dyn Renderer, &Cpu::default()] {
        assert!(matches!(backend.render(&scene, &own_camera(&scene, Pose::default())), Err(RenderError::Scene(_))));
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
    let view = select(Backend::Auto).unwrap().render(&scene, &own_camera(&scene, Pose::default())).unwrap();
    assert!(view.rgba.iter().zip(&scene.photo.rgb).all(|(p, q)| p[..3] == *q));
}
