//! Rendering: time of each backend by picture size, and its difference from the reference.

use std::sync::Arc;
use std::time::Instant;

use super::measure::{Bench, median};
use super::subject::Subject;
use super::{Axis, BenchError, Curve, Experiment, Point};
use crate::metrics::share_off;
use tmpi_core::container;
use tmpi_core::{Camera, Pose, Scene};
use tmpi_pipeline::Silent;
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{self, Options, PlaneCount};
use tmpi_render::{Cpu, Gpu, Reference, Renderer};

/// Width of the views for the plane counts, in pixels.
const PLANES_WIDTH: u32 = 1280;

pub(super) fn run(
    bench: &Bench,
    scenes: &[Subject],
    quick: bool,
    skipped: &mut Vec<String>,
    progress: &dyn Fn(&str),
) -> Result<Vec<Experiment>, BenchError> {
    progress("drawing");
    let Some(s) = scenes.first() else { return Ok(Vec::new()) };
    let scene = made(bench, s, PlaneCount::Auto)?;
    let mut backends: Vec<Box<dyn Renderer>> = vec![Box::new(Cpu::default())];
    match Gpu::new(true) {
        Ok(gpu) => backends.push(Box::new(gpu)),
        Err(reason) => skipped.push(format!("gpu: {reason}")),
    }
    let sizes: &[u32] = if quick { &[320, 640, 1280] } else { &[320, 640, 1280, 1920, 3840] };
    let camera = |width: u32| {
        let (w, h) = (scene.photo.width, scene.photo.height);
        let height = (f64::from(width) * f64::from(h) / f64::from(w)).round().max(1.0) as u32;
        let intrinsics = scene.intrinsics.resized((w, h), (width, height));
        Camera { pose: Pose { yaw: 1.0, ..Pose::at(0.03, -0.02, 0.03) }, intrinsics, width, height }
    };
    let timed = |backend: &dyn Renderer, scene: &Arc<Scene>, camera: &Camera| -> Result<f64, BenchError> {
        // the first view loads the scene
        backend.render(scene, camera)?;
        let times = (0..bench.repeats * 3).map(|_| {
            let start = Instant::now();
            backend.render(scene, camera).map(|_| start.elapsed().as_secs_f64() * 1e3)
        });
        Ok(median(times.collect::<Result<_, _>>()?))
    };
    let mut curves = Vec::new();
    for backend in &backends {
        let mut points = Vec::new();
        for &width in sizes {
            let camera = camera(width);
            let view = backend.render(&scene, &camera)?;
            let ms = timed(backend.as_ref(), &scene, &camera)?;
            let mut figures = Vec::new();
            if width <= 1280 {
                let want = Reference.render(&scene, &camera)?;
                figures.push(("% of pixels off the reference by more than 8 levels", 100.0 * share_off(&view.rgba, &want.rgba, 8)));
            }
            let megapixels = f64::from(camera.width) * f64::from(camera.height) / 1e6;
            let setting = format!("{}×{}", camera.width, camera.height);
            points.push(Point { setting, x: megapixels, y: ms, figures, ..Point::default() });
        }
        curves.push(Curve { name: backend.name().into(), points });
    }
    let counts = [1, 2, 4, 8, 16].map(|n| Ok((n, made(bench, s, PlaneCount::Fixed(n))?)));
    let counts = counts.into_iter().collect::<Result<Vec<_>, BenchError>>()?;
    let of_planes = |backend: &dyn Renderer| {
        let points = counts.iter().map(|(n, scene)| {
            let ms = timed(backend, scene, &camera(PLANES_WIDTH))?;
            let planes = scene.layers.len() as f64 / f64::from(scene.grid.tiles());
            let megabytes = 4.0 * scene.texels.class.len() as f64 / 1e6;
            let figures = vec![("layers", scene.layers.len() as f64), ("texels as RGBA8, MB", megabytes)];
            Ok(Point { setting: format!("--planes {n}"), x: planes, y: ms, figures, ..Point::default() })
        });
        Ok(Curve { name: backend.name().into(), points: points.collect::<Result<_, BenchError>>()? })
    };
    let by_planes = backends.iter().map(|backend| of_planes(backend.as_ref())).collect::<Result<Vec<_>, BenchError>>()?;
    Ok(vec![
        Experiment {
            id: "drawing",
            title: "Rendering".into(),
            about: format!("A view of “{}” from inside the view box, by backend and picture size. The scene is already loaded.", s.name),
            x: Axis { label: "picture, megapixels", log: true, up: None },
            y: Axis { label: "view, ms", log: true, up: Some(false) },
            curves,
        },
        Experiment {
            id: "drawing-planes",
            title: "Rendering: planes".into(),
            about: format!(
                "A view of “{}”, {PLANES_WIDTH} pixels wide, by backend and planes per tile, including backgrounds. The scene is already loaded.",
                s.name
            ),
            x: Axis { label: "planes per tile", log: true, up: None },
            y: Axis { label: "view, ms", log: true, up: Some(false) },
            curves: by_planes,
        },
    ])
}

fn made(bench: &Bench, s: &Subject, planes: PlaneCount) -> Result<Arc<Scene>, BenchError> {
    let options = Options { fov_x: s.fov_x, planes, ..Options::default() };
    let depth = s.disparity.as_deref().map(tmpi_pipeline::depth::to_png).transpose().map_err(|e| BenchError::Picture(e.to_string()))?;
    let made = tmpi_pipeline::make(bench.models, &Limits::default(), &s.file, depth.as_deref(), &options, &Silent)
        .map_err(|source| BenchError::Make { subject: s.name.clone(), source })?;
    Ok(Arc::new(container::decode(&made.container)?))
}
