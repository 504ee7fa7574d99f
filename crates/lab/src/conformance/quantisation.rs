//! What the container rounds: planes to a grid, disparity to 16 bits, everything at the ends of its options.

use std::sync::Arc;

use super::photos::{by_brightness, identity, made};
use super::scenes::own_camera;
use super::views::{bound, wrong};
use super::{Checked, Host, cast, cast_in_layer_order};
use tmpi_core::{Camera, DisparityMap, Plane, Pose, Scene, ViewBox};
use tmpi_pipeline::depth::{DepthKind, from_map, to_png};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{Options, PlaneCount, PlaneMethod, TileSize};
use tmpi_render::{Cpu, Renderer};
use tmpi_testing::pictures::waves;

/// Layers a tile at most, as [`tmpi_pipeline::planes::MAX_PLANES`] and one behind them.
const LAYERS: usize = tmpi_pipeline::planes::MAX_PLANES as usize + 1;

pub(super) fn run(checked: &mut Checked, hosts: &[Host]) {
    let models = by_brightness();
    let make = |file: &[u8], options: &Options| made(&models, file, options);
    rounding(checked, Plane::quantised);
    sixteen_bits(checked, |map| {
        let png = to_png(map).ok()?;
        from_map(&png, DepthKind::Disparity, &Limits::default(), map.width, map.height).ok().map(|(back, _)| back)
    });
    options(checked, make, hosts);
}

/// `kernel` brings a plane to the container's grid.
pub(super) fn rounding(checked: &mut Checked, kernel: impl Fn(&Plane) -> Plane) {
    let coefficients: Vec<f64> = (0..400).map(|i| (i as f64 - 200.0) / 200.0 * 1.999).chain([0.0, -0.0, 1e-300, 1e-8, 1.0]).collect();
    checked.case("quantisation", "planes on the container's grid, anywhere on the tile", "planes", "δ", 1.5 * Plane::STEP, || {
        let off = |(a, b, c): (f64, f64, f64)| {
            let (p, corners) = (Plane { a, b, c }, [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)]);
            let q = kernel(&p);
            corners.into_iter().map(|(u, v)| (p.disparity(u, v) - q.disparity(u, v)).abs()).fold(0.0, f64::max)
        };
        let n = coefficients.len();
        (0..n).map(|i| off((coefficients[i], coefficients[i * 7 % n], coefficients[i * 13 % n]))).fold(0.0, f64::max)
    });
    checked.case("quantisation", "NaN, infinite and huge coefficients", "planes", "not finite", 0.0, || {
        let bad = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300, -1e300];
        bad.into_iter().filter(|&v| !kernel(&Plane { a: v, b: -v, c: v }).is_finite()).count() as f64
    });
}

/// `kernel` writes a map as a file and reads it.
pub(super) fn sixteen_bits(checked: &mut Checked, kernel: impl Fn(&DisparityMap) -> Option<DisparityMap>) {
    checked.case("quantisation", "disparity as 16 bits and back", "depth map", "δ", 0.501 / 65_535.0, || {
        let delta: Vec<f32> = (0..4096).map(|i| (i as f32 / 4095.0).powi(3)).collect();
        let map = DisparityMap { width: 64, height: 64, delta };
        kernel(&map).map_or(f64::INFINITY, |b| b.delta.iter().zip(&map.delta).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max))
    });
}

/// What a backend is to draw: 64 slanted planes a tile are single soft pixels on planes that cross, which a GPU blends in the order of layers.
fn expected(host: &dyn Renderer, options: &Options, scene: &Scene, camera: &Camera) -> Vec<[f64; 4]> {
    let crosses = options.planes == PlaneCount::Fixed(64) && options.plane_method != PlaneMethod::Linear;
    if host.name() == "gpu" && crosses { cast_in_layer_order(scene, camera) } else { cast(scene, camera) }
}

/// Cameras at two opposite corners of the view box, or nearly so far as the nearest surface where it reaches beyond that.
fn moved(scene: &Scene) -> [Camera; 2] {
    let v = scene.view_box;
    let far = |e: f64| e.min(0.9);
    [1.0, -1.0].map(|s| own_camera(scene, Pose::at(s * far(v.x), s * far(v.y), s * far(v.z))))
}

/// The way and the container at both ends of every option. `kernel` makes a photo.
pub(super) fn options(checked: &mut Checked, kernel: impl Fn(&[u8], &Options) -> Option<Arc<Scene>>, hosts: &[Host]) {
    let file = waves(150, 100);
    let cpu = Cpu::default();
    let plain = Options::default;
    let all = [
        ("64 planes a tile", Options { planes: PlaneCount::Fixed(64), plane_method: PlaneMethod::Linear, ..plain() }),
        ("64 slanted planes a tile", Options { planes: PlaneCount::Fixed(64), ..plain() }),
        ("1 plane a tile", Options { planes: PlaneCount::Fixed(1), ..plain() }),
        ("tiles of 8", Options { tile: TileSize::Pixels(8), ..plain() }),
        ("tiles of 1024", Options { tile: TileSize::Pixels(1024), ..plain() }),
        ("one tile", Options { tile: TileSize::Full, ..plain() }),
        ("view box of no extent", Options { view_box: ViewBox { x: 0.0, y: 0.0, z: 0.0 }, ..plain() }),
        ("view box of 10", Options { view_box: ViewBox { x: 10.0, y: 10.0, z: 10.0 }, ..plain() }),
        ("error 0", Options { max_error: 0.0, ..plain() }),
        ("error 1000 px", Options { max_error: 1000.0, ..plain() }),
        ("quality 1", Options { quality: 1, ..plain() }),
        ("field of view 0.1°", Options { fov_x: Some(0.1), ..plain() }),
        ("field of view 179°", Options { fov_x: Some(179.0), ..plain() }),
        ("largest side 1", Options { max_size: Some(1), ..plain() }),
    ];
    for (name, options) in all {
        checked.case("quantisation", &format!("identity view against the container's photo, {name}"), "container", "levels", 0.0, || {
            identity(kernel(&file, &options).as_ref(), &cpu)
        });
        let scene = kernel(&file, &options);
        for host in hosts {
            let (host, name) = (host.as_ref(), format!("views from the corners of the box, {name}"));
            checked.case("quantisation", &name, host.name(), "% of pixels", bound(host), || {
                let Some(scene) = &scene else { return f64::INFINITY };
                let wrong = |c: &Camera| wrong(host, scene, c, &expected(host, &options, scene, c));
                moved(scene).iter().map(wrong).fold(0.0, f64::max)
            });
        }
    }
    checked.case("quantisation", "layers a tile", "container", "more than there may be", 0.0, || {
        let options = Options { planes: PlaneCount::Fixed(64), plane_method: PlaneMethod::Linear, ..plain() };
        let Some(scene) = kernel(&file, &options) else { return f64::INFINITY };
        let most = (0..scene.grid.tiles()).map(|t| scene.layers.iter().filter(|l| l.tile == t).count()).max().unwrap_or(0);
        most.saturating_sub(LAYERS) as f64
    });
}
