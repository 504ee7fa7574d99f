//! Hidden colours, and what the container rounds: planes to a grid, disparity to 16 bits, everything at the ends of its options.

use std::sync::Arc;

use super::photos::{Brightness, identity, made, rgb_png};
use super::views::{bound, wrong};
use super::{Checked, Hosts, cast, cast_in_layer_order};
use tmpi_core::{Camera, Class, DisparityMap, Plane, Pose, Scene, ViewBox};
use tmpi_pipeline;
use tmpi_pipeline::depth::{DepthKind, from_map, to_png};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{Denoise, Models, Options, PlaneCount, PlaneMethod, Switch, TileSize};
use tmpi_render::{Cpu, Renderer};

/// Layers a tile at most, as [`tmpi_pipeline::planes::MAX_PLANES`] and one behind them.
const LAYERS: usize = tmpi_pipeline::planes::MAX_PLANES as usize + 1;

pub(super) fn run(checked: &mut Checked, hosts: &Hosts) {
    let models = Models { depth: Arc::new(Brightness), theta: None, psi: None };
    let make = |file: &[u8], options: &Options| made(&models, file, options);
    fill(checked, make);
    rounding(checked, Plane::quantised);
    sixteen_bits(checked, |map| {
        let png = to_png(map).ok()?;
        from_map(&png, DepthKind::Disparity, &Limits::default(), map.width, map.height).ok().map(|(back, _)| back)
    });
    options(checked, make, hosts);
}

type Paint = fn(u32, u32) -> [u8; 3];

/// A photo by its pixels, the least and greatest colour that may lie hidden in it, and how it is made.
type Hidden = (&'static str, Paint, [[u8; 3]; 2], Options);

/// Bright things lie in front of dark ones: what is hidden behind them has the colours of the dark ones. `kernel` makes a photo.
fn fill(checked: &mut Checked, kernel: impl Fn(&[u8], &Options) -> Option<Arc<Scene>>) {
    const SIDE: u32 = 96;
    const WALL: [u8; 3] = [40, 50, 30];
    let wide = || Options { quality: 100, view_box: ViewBox { x: 0.1, y: 0.1, z: 0.1 }, ..Options::default() };
    // where a step cleans the map, or planes spare one pixel in a hundred, no such pixel is left
    let (planes, plane_method) = (PlaneCount::Fixed(2), PlaneMethod::Lloyd);
    let exactly = Options { planes, plane_method, snap: Switch::Off, denoise: Denoise::Off, ..wide() };
    let photos: [Hidden; 4] = [
        (
            "bright disc before a dark wall",
            |x, y| if x.abs_diff(48).pow(2) + y.abs_diff(48).pow(2) < 400 { [250; 3] } else { WALL },
            [WALL, WALL],
            wide(),
        ),
        (
            "bright bars before dark noise",
            |x, y| if x % 24 < 10 { [255, 240, 250] } else { [(x * 7 + y * 13) as u8 % 60, (x * 5 + y) as u8 % 60, (y * 11) as u8 % 60] },
            [[0; 3], [59; 3]],
            wide(),
        ),
        // it touches what lies before it, so its colour counts as mixed and fills nothing
        (
            "background seen through one pixel",
            |x, y| if (x, y) == (48, 48) { [20; 3] } else { [240, 250, 255] },
            [[20; 3], [240, 250, 255]],
            exactly,
        ),
        ("black and white at infinity and nearest", |x, _| if x < 48 { [255; 3] } else { [0; 3] }, [[0; 3], [0; 3]], wide()),
    ];
    for (name, paint, [least, most], options) in photos {
        let rgb: Vec<u8> = (0..SIDE * SIDE).flat_map(|i| paint(i % SIDE, i / SIDE)).collect();
        // the photo is carried as a lossy picture, which the colours come from: beside a bright disc it is 3 levels off
        checked.case("filling", name, "pyramid", "levels off", 4.0, || {
            let file = super::photos::png(SIDE, SIDE, &rgb, image::ExtendedColorType::Rgb8);
            let Some(scene) = kernel(&file, &options) else { return f64::INFINITY };
            let off = |p: &[u8; 3]| (0..3).map(|c| least[c].saturating_sub(p[c]).max(p[c].saturating_sub(most[c]))).max().unwrap_or(0);
            // what is soft is the bright thing's foreground; where nothing is hidden, nothing is checked
            let hidden = scene.texels.class.iter().zip(&scene.texels.alpha).filter(|(c, _)| **c == Class::Hidden as u8).map(|(_, a)| *a);
            let behind = scene.texels.hidden.iter().zip(hidden).filter(|(_, alpha)| *alpha == u8::MAX).map(|(colour, _)| colour);
            behind.map(off).max().map_or(f64::INFINITY, f64::from)
        });
    }
}

/// `kernel` brings a plane to the container's grid.
fn rounding(checked: &mut Checked, kernel: impl Fn(&Plane) -> Plane) {
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
fn sixteen_bits(checked: &mut Checked, kernel: impl Fn(&DisparityMap) -> Option<DisparityMap>) {
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
    [1.0, -1.0].map(|s| Camera {
        pose: Pose::at(s * far(v.x), s * far(v.y), s * far(v.z)),
        intrinsics: scene.intrinsics,
        width: scene.photo.width,
        height: scene.photo.height,
    })
}

/// The way and the container at both ends of every option. `kernel` makes a photo.
fn options(checked: &mut Checked, kernel: impl Fn(&[u8], &Options) -> Option<Arc<Scene>>, hosts: &Hosts) {
    let file = rgb_png(150, 100);
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
        checked.case("quantisation", &format!("identity view, {name}"), "container", "levels", 0.0, || {
            identity(kernel(&file, &options).as_ref(), &cpu)
        });
        let scene = kernel(&file, &options);
        for host in &hosts.all {
            checked.case(
                "quantisation",
                &format!("views from the corners of the box, {name}"),
                host.name(),
                "% of pixels",
                bound(host.as_ref()),
                || {
                    scene.as_ref().map_or(f64::INFINITY, |scene| {
                        let cameras = moved(scene);
                        let host = host.as_ref();
                        cameras.iter().map(|c| wrong(host, scene, c, &expected(host, &options, scene, c))).fold(0.0, f64::max)
                    })
                },
            );
        }
    }
    checked.case("quantisation", "layers a tile", "container", "more than there may be", 0.0, || {
        let options = Options { planes: PlaneCount::Fixed(64), plane_method: PlaneMethod::Linear, ..plain() };
        let Some(scene) = kernel(&file, &options) else { return f64::INFINITY };
        let most = (0..scene.grid.tiles()).map(|t| scene.layers.iter().filter(|l| l.tile == t).count()).max().unwrap_or(0);
        most.saturating_sub(LAYERS) as f64
    });
}

#[cfg(test)]
mod tests {
    use super::super::{caught, failed};
    use super::*;

    /// The way with a fault in the scene that a reader finds.
    fn faulty(fault: impl Fn(&mut Scene)) -> impl Fn(&[u8], &Options) -> Option<Arc<Scene>> {
        let models = Models { depth: Arc::new(Brightness), theta: None, psi: None };
        move |file, options| {
            let mut scene = Scene::clone(&*made(&models, file, options)?);
            fault(&mut scene);
            Some(Arc::new(scene))
        }
    }

    #[test]
    fn a_fault_of_each_kernel_is_caught() {
        assert!(failed(|c| fill(c, faulty(|scene| scene.texels.hidden.iter_mut().for_each(|p| *p = [250; 3])))) > 0);
        assert!(failed(|c| rounding(c, |p| Plane { a: p.a + 4.0 * Plane::STEP, ..*p }.quantised())) > 0);
        assert!(failed(|c| rounding(c, |p| *p)) > 0);
        let eight_bits =
            |map: &DisparityMap| Some(DisparityMap { delta: map.delta.iter().map(|d| (d * 255.0).round() / 255.0).collect(), ..*map });
        assert!(failed(|c| sixteen_bits(c, eight_bits)) > 0);
        let none = Hosts { all: Vec::new() };
        let hole = faulty(|scene| scene.layers.truncate(scene.layers.len() - 1));
        assert_eq!(caught(|c| options(c, &hole, &none)), ["container"]);
        let double = faulty(|scene| scene.layers.extend(scene.layers.clone()));
        assert_eq!(caught(|c| options(c, &double, &none)), ["container"]);
    }
}
