//! Milliseconds a view of the `cpu` and `gpu` hosts; the scene is loaded before the clock starts.
#![allow(clippy::unwrap_used, reason = "bench")]

use std::sync::Arc;
use std::time::Duration;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use tmpi::check::scenes;
use tmpi::render::{Cpu, Gpu, Renderer};
use tmpi::tmpi::Pose;

fn views(c: &mut Criterion) {
    let scene = Arc::new(scenes::typical(640, 360));
    let mut group = c.benchmark_group("view");
    group.sample_size(20).warm_up_time(Duration::from_secs(1)).measurement_time(Duration::from_secs(3));
    let cpu = Cpu::default();
    let gpu = Gpu::new(true).map_err(|reason| eprintln!("gpu skipped: {reason}")).ok();
    let hosts = [&cpu as &dyn Renderer].into_iter().chain(gpu.iter().map(|gpu| gpu as &dyn Renderer));
    for host in hosts {
        for (width, height) in [(640, 360), (1280, 720)] {
            let camera = scenes::camera(&scene, Pose { tx: 0.03, ty: -0.02, tz: 0.03, yaw: 1.0, ..Pose::default() }, width, height);
            host.render(&scene, &camera).unwrap();
            let id = BenchmarkId::new(host.name(), format!("{width}x{height}"));
            group.bench_function(id, |b| b.iter(|| host.render(&scene, &camera).unwrap()));
        }
    }
    group.finish();
}

criterion_group!(benches, views);
criterion_main!(benches);
