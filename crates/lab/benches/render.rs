//! Milliseconds a view of the `cpu` and `gpu` hosts; the scene is loaded before the clock starts.
//!
//! `TMPI_SCENE=photo.tmpi cargo bench -p tmpi-lab --bench render` draws that container instead of a made-up scene. At the end the hosts are measured
//! in turns, which other work on the machine troubles less: medians of wall time and of processor time.
#![allow(clippy::unwrap_used, reason = "bench")]

use std::hint::black_box;
use std::sync::Arc;
use std::time::Duration;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use tmpi_core::container;
use tmpi_core::{Camera, Pose, Scene};
use tmpi_lab::stress::scenes;
use tmpi_pipeline::clock::Clock;
use tmpi_render::{Cpu, Gpu, Renderer};

/// Turns of the paired measurement.
const TURNS: usize = 40;

/// The container that `TMPI_SCENE` names, else a made-up scene.
fn scene() -> Arc<Scene> {
    Arc::new(match std::env::var_os("TMPI_SCENE") {
        Some(path) => container::decode(&std::fs::read(path).unwrap()).unwrap(),
        None => scenes::typical(640, 360),
    })
}

fn hosts() -> Vec<Box<dyn Renderer>> {
    let mut hosts: Vec<Box<dyn Renderer>> = vec![Box::new(Cpu::default())];
    match Gpu::new(true) {
        Ok(gpu) => hosts.push(Box::new(gpu)),
        Err(reason) => eprintln!("gpu skipped: {reason}"),
    }
    hosts
}

/// What is drawn: from aside at two sizes, and the photo's own view at its own size.
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

fn views(c: &mut Criterion) {
    let scene = scene();
    let mut group = c.benchmark_group("view");
    group.sample_size(20).warm_up_time(Duration::from_secs(1)).measurement_time(Duration::from_secs(3));
    let (hosts, cameras) = (hosts(), cameras(&scene));
    for host in &hosts {
        for (name, camera) in &cameras {
            host.render(&scene, camera).unwrap();
            group.bench_function(BenchmarkId::new(host.name(), name), |b| b.iter(|| host.render(&scene, camera).unwrap()));
        }
    }
    group.finish();
    for (name, camera) in &cameras {
        in_turns(&scene, &hosts, name, camera);
    }
}

/// Hosts in turns, and the copy of a finished view.
fn in_turns(scene: &Arc<Scene>, hosts: &[Box<dyn Renderer>], name: &str, camera: &Camera) {
    let view = hosts[0].render(scene, camera).unwrap();
    let mut times: Vec<[Vec<f64>; 2]> = vec![[Vec::new(), Vec::new()]; hosts.len() + 1];
    for _ in 0..TURNS {
        for (host, times) in times.iter_mut().enumerate() {
            let clock = Clock::start();
            match hosts.get(host) {
                Some(host) => black_box(host.render(scene, camera).unwrap()),
                None => black_box(view.clone()),
            };
            times[0].push(clock.ms());
            times[1].push(clock.cpu_ms());
        }
    }
    let names = hosts.iter().map(|h| h.name()).chain(["copy"]);
    for (host, times) in names.zip(&mut times) {
        let [wall, cpu] = times.each_mut().map(|t| {
            t.sort_by(f64::total_cmp);
            t[t.len() / 2]
        });
        println!("in turns, {name}: {host:4} {wall:7.2} ms, {cpu:7.2} ms of processor time");
    }
}

criterion_group!(benches, views);
criterion_main!(benches);
