//! Compares planes with the mesh that other viewers render from a photo and its depth map.

use std::sync::Arc;

use super::measure::{Bench, Depth};
use super::subject::Subject;
use super::{Axis, BenchError, Curve, Experiment, Point};
use crate::eval::mesh;
use crate::metrics;
use tmpi_core::{Camera, DisparityMap, Intrinsics, Pose, Scene};
use tmpi_pipeline::{Options, PlaneCount, PlaneMethod, Switch};
use tmpi_render::{Cpu, RenderError, Renderer};

/// Samples per pixel along each axis, to make edges smooth in both pictures.
const SAMPLES: u32 = 4;
/// PSNR of a view of `scene` against the mesh of its photo and `map` where the mesh is not torn, and the fraction of the view that this
/// covers.
///
/// With `samples` above 1, both pictures are rendered larger by that factor and averaged. The mesh has hard edges and layers fade out over
/// a pixel, so only then are edges comparable.
fn compared(scene: &Arc<Scene>, map: &DisparityMap, pose: Pose, samples: u32) -> Result<(f64, f64), RenderError> {
    let (w, h, k, n) = (scene.photo.width, scene.photo.height, scene.intrinsics, f64::from(samples));
    let enlarged = Intrinsics { fx: k.fx * n, fy: k.fy * n, cx: k.cx * n, cy: k.cy * n };
    let camera = Camera { pose, intrinsics: enlarged, width: w * samples, height: h * samples };
    let drawn = Cpu::default().render(scene, &camera)?;
    let mesh = mesh::warp(&scene.photo, map, &k, &camera, mesh::LONGEST * n);
    let (mut want, mut got) = (Vec::new(), Vec::new());
    for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
        let within = |i: u32| (y * samples + i / samples) as usize * camera.width as usize + (x * samples + i % samples) as usize;
        let all = (0..samples * samples).map(within);
        if all.clone().all(|i| mesh.covered[i]) {
            let mean = |of: &dyn Fn(usize, usize) -> u8| -> [u8; 3] {
                std::array::from_fn(|c| {
                    let sum: u32 = all.clone().map(|i| u32::from(of(i, c))).sum();
                    ((sum + samples * samples / 2) / (samples * samples)) as u8
                })
            };
            want.push(mean(&|i, c| mesh.rgb[i][c]));
            got.push(mean(&|i, c| drawn.rgba[i][c]));
        }
    }
    let share = got.len() as f64 / (f64::from(w) * f64::from(h));
    Ok((metrics::psnr(got.as_flattened(), want.as_flattened()), share))
}

/// Compares views of photos with known disparity with the mesh, where it is not torn: the error that planes add to that of the
/// disparity.
pub(super) fn against(bench: &Bench, photos: &[Subject], progress: &dyn Fn(&str)) -> Result<Option<Experiment>, BenchError> {
    /// Camera step to the right: twice the default view box.
    const STEP: f64 = 0.06;
    // repeats would differ only in time
    let bench = &Bench { models: bench.models, repeats: 1 };
    let known: Vec<&Subject> = photos.iter().filter(|s| s.disparity.is_some()).collect();
    if known.is_empty() {
        return Ok(None);
    }
    progress("Planes against the mesh");
    let with = |change: &dyn Fn(&mut Options)| {
        let mut options = Options::default();
        change(&mut options);
        options
    };
    let settings = [
        ("defaults", Options::default()),
        ("--max-error 0.9", with(&|o| o.max_error = 0.9)),
        ("--max-error 3.5", with(&|o| o.max_error = 3.5)),
        ("--snap off", with(&|o| o.snap = Switch::Off)),
        ("--plane-method lloyd --planes 4", with(&|o| (o.plane_method, o.planes) = (PlaneMethod::Lloyd, PlaneCount::Fixed(4)))),
    ];
    let (planes, view) = (
        Axis { label: "planes per tile", log: false, up: Some(false) },
        Axis { label: "view against the mesh, dB", log: false, up: Some(true) },
    );
    let mut points = Vec::new();
    for (name, options) in settings {
        let (mut count, mut psnr, mut smooth, mut covered) = (0.0, 0.0, 0.0, 0.0);
        for s in &known {
            let Some(made) = bench.runs(s, &Depth::Degraded(DisparityMap::clone), &options)?.pop() else { continue };
            let scene = Arc::new(tmpi_core::container::decode(&made.container)?);
            let pose = Pose::at(STEP, 0.0, 0.0);
            let (db, share) = compared(&scene, &made.disparity, pose, 1)?;
            // NaN if the enlarged view exceeds the size limit: no figure is better than one for only some of the photos
            let default = options == Options::default();
            let averaged = default.then(|| compared(&scene, &made.disparity, pose, SAMPLES).ok()).flatten();
            smooth += averaged.map_or(f64::NAN, |(db, _)| db) / known.len() as f64;
            count += scene.layers.len() as f64 / f64::from(scene.grid.tiles()) / known.len() as f64;
            psnr += db / known.len() as f64;
            covered += 100.0 * share / known.len() as f64;
        }
        let mut figures = vec![("covered by the mesh, % of pixels", covered)];
        if smooth.is_finite() {
            figures.push(("with 16 samples per pixel, dB", smooth));
        }
        points.push(Point { setting: name.into(), x: count, y: psnr, default: options == Options::default(), figures, ..Point::default() });
    }
    Ok(Some(Experiment {
        id: "mesh",
        title: "Planes against the mesh".into(),
        about: format!(
            "A step of {STEP} to the right, for {} photos with a disparity map beside them, against the mesh of photo and disparity where the mesh is not torn. The mesh has hard edges and layers fade out over a pixel; 16 samples per pixel in both pictures remove that difference.",
            known.len()
        ),
        x: planes,
        y: view,
        curves: vec![Curve { name: "settings".into(), points }],
    }))
}
