//! Milliseconds per view of the `cpu` and `gpu` backends. The scene is loaded before the clock starts.
//!
//! `TMPI_SCENE=photo.tmpi cargo bench -p tmpi-lab --bench render` renders that container instead of a synthetic scene. The backends run in
//! turns, which makes the comparison less sensitive to other load: medians of wall time and of CPU time.
#![allow(clippy::unwrap_used, reason = "bench")]

use std::hint::black_box;
use std::sync::Arc;

use tmpi_core::{Camera, Pose, Scene, container};
use tmpi_lab::stiff_scenes as scenes;
use tmpi_pipeline::usage::Clock;
use tmpi_render::{Cpu, Gpu, Renderer};

/// Measurements of each backend.
const TURNS: usize = 40;

/// The container that `TMPI_SCENE` names, otherwise a synthetic scene.
fn scene() -> Arc<Scene> {
    Arc::new(match std::env::var_os("TMPI_SCENE") {
        Some(path) => container::decode(&std::fs::read(path).unwrap()).unwrap(),
        None => scenes::typical(640, 360),
    })
}

fn backends() -> Vec<Box<dyn Renderer>> {
    let mut backends: Vec<Box<dyn Renderer>> = vec![Box::new(Cpu::default())];
    match Gpu::new(true) {
        Ok(gpu) => backends.push(Box::new(gpu)),
        Err(reason) => eprintln!("gpu skipped: {reason}"),
    }
    backends
}

/// Views to render: from the side at two sizes, and the photo's own view at its own size.
fn cameras(scene: &Scene) -> Vec<(String, Camera)> {
    let aside = Pose { yaw: 1.0, ..Pose::at(0.03, -0.02, 0.03) };
    let own = (scene.grid.width, scene.grid.height);
    [(aside, (640, 360)), (aside, (1280, 720)), (Pose::default(), own)]
        .map(|(pose, (w, h))| {
            let kind = if pose == Pose::default() { "own" } else { "aside" };
            (format!("{kind} {w}x{h}"), scenes::camera(scene, pose, w, h))
        })
        .into()
}

fn main() {
    let scene = scene();
    let backends = backends();
    for (name, camera) in cameras(&scene) {
        in_turns(&scene, &backends, &name, &camera);
    }
}

/// Measures the backends, and the copy of a finished view, in turns.
fn in_turns(scene: &Arc<Scene>, backends: &[Box<dyn Renderer>], name: &str, camera: &Camera) {
    // the first view loads the scene
    let views: Vec<_> = backends.iter().map(|backend| backend.render(scene, camera).unwrap()).collect();
    let mut times: Vec<[Vec<f64>; 2]> = vec![[Vec::new(), Vec::new()]; backends.len() + 1];
    for _ in 0..TURNS {
        for (backend, times) in times.iter_mut().enumerate() {
            let clock = Clock::start();
            match backends.get(backend) {
                Some(backend) => black_box(backend.render(scene, camera).unwrap()),
                None => black_box(views[0].clone()),
            };
            times[0].push(clock.ms());
            times[1].push(clock.cpu_ms());
        }
    }
    let names = backends.iter().map(|h| h.name()).chain(["copy"]);
    for (backend, times) in names.zip(&mut times) {
        let [wall, cpu] = times.each_mut().map(|t| {
            t.sort_by(f64::total_cmp);
            t[t.len() / 2]
        });
        println!("{name}: {backend:4} {wall:7.2} ms, {cpu:7.2} ms of CPU time");
    }
}
