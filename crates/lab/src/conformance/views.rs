//! Planes and cameras: every scene for every camera on every renderer, against rays cast in `f64`. A scene is one case, named after the camera
//! whose view is worst.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use super::scenes::{all, cameras, close, flat, own_camera};
use super::{Checked, Host, cast, cast_in_layer_order};
use tmpi_core::{Camera, Intrinsics, Pose, Scene};
use tmpi_render::{NEAR, RenderError, Renderer};

/// Levels of 255 from which a pixel counts as wrong.
const LEVELS: f64 = 8.0;
/// A picture with fewer pixels than this is one border only.
const FEW: usize = 100;
/// Views in which no order of soft layers is right. A GPU draws them in one order for the whole picture, but seen from beside the tiles, near
/// ones come first on one side of the camera and far ones on the other. In these views it is held against rays that blend in its order.
const WITHOUT_ORDER: [(&str, [&str; 2]); 2] = [("translucent stack", BESIDE), ("holes", BESIDE)];
const BESIDE: [&str; 2] = ["edge-on", "nearly edge-on"];

/// Percent of pixels that may be wrong: quad edges differ between rasterisers; in `f32` a pixel on the line where two surfaces cross
/// may show the other one, in `f64` only where tiles overlap on one surface. The largest shares found: 0.017 by the reference, 0.021 by
/// the CPU, and by Vulkan in software 0.67 (two pixels of a row) and 0.62.
pub(super) fn bound(host: &dyn Renderer) -> f64 {
    match host.name() {
        "reference" => 0.02,
        "cpu" => 0.05,
        _ => 0.7,
    }
}

/// [`bound`] where no quad is seen edge-on: the share found is 0 on every backend.
const NEAR_BOUND: f64 = 0.02;

/// Percent of pixels of a view that are wrong; infinite where nothing was drawn.
pub(super) fn wrong(host: &dyn Renderer, scene: &Arc<Scene>, camera: &Camera, want: &[[f64; 4]]) -> f64 {
    let Ok(view) = host.render(scene, camera) else { return f64::INFINITY };
    let off = |p: &[u8; 4], q: &[f64; 4]| (0..4).any(|c| (f64::from(p[c]) - q[c]).abs() > LEVELS);
    let bad = view.rgba.iter().zip(want).filter(|(p, q)| off(p, q)).count();
    if view.rgba.len() != want.len() {
        return f64::INFINITY;
    }
    // a few pixels on borders between planes are all that a very small picture has
    if want.len() < FEW && bad > 0 { f64::INFINITY } else { 100.0 * bad as f64 / want.len() as f64 }
}

pub(super) fn run(checked: &mut Checked, hosts: &[Host]) {
    for (name, scene) in all() {
        let scene = Arc::new(scene);
        let wanted: Vec<_> = cameras(&scene).into_iter().map(|(of, camera)| (of, camera, cast(&scene, &camera))).collect();
        for host in hosts {
            let host = host.as_ref();
            let view = |(of, camera, want): &(&'static str, Camera, Vec<[f64; 4]>)| {
                let excused = host.name() == "gpu" && WITHOUT_ORDER.iter().any(|(scene, cameras)| *scene == name && cameras.contains(of));
                let in_order = excused.then(|| cast_in_layer_order(&scene, camera));
                let share = || wrong(host, &scene, camera, in_order.as_ref().unwrap_or(want));
                (excused, *of, catch_unwind(AssertUnwindSafe(share)).unwrap_or(f64::INFINITY))
            };
            let views: Vec<_> = wanted.iter().map(view).collect();
            for (order, excused) in [("", false), (" in the order of layers", true)] {
                let worst = views.iter().filter(|v| v.0 == excused).max_by(|a, b| a.2.total_cmp(&b.2));
                if let Some((_, camera, share)) = worst {
                    let name = format!("{name}{order}, worst of {}: {camera}", wanted.len());
                    checked.case("planes", &name, host.name(), "% of pixels", bound(host), || *share);
                }
            }
        }
    }
    for host in hosts {
        near(checked, host.as_ref());
        refusals(checked, host.as_ref());
    }
}

/// Cameras ever nearer to the nearest surface, up to where it is no longer drawn, and past that.
pub(super) fn near(checked: &mut Checked, host: &dyn Renderer) {
    let scenes = [("two values", close(&[0.0, 1.0])), ("nearest alone", close(&[1.0])), ("three values", close(&[0.0, 0.999, 1.0]))];
    for (name, scene) in scenes {
        let scene = Arc::new(scene);
        for tz in [0.9, 0.99, 0.997, 0.998, 0.999, 0.999_02, 1.0 - NEAR, 0.9991, 0.9993, 0.9995] {
            let camera = own_camera(&scene, Pose::at(0.0, 0.0, tz));
            let want = cast(&scene, &camera);
            checked.case("near", &format!("{name}, {tz:.4} of the way"), host.name(), "% of pixels", NEAR_BOUND, || {
                wrong(host, &scene, &camera, &want)
            });
        }
    }
}

/// Cameras that no picture exists for are refused, extreme but valid ones draw.
pub(super) fn refusals(checked: &mut Checked, host: &dyn Renderer) {
    let scene = Arc::new(flat(32, 20, 0.5));
    let good = own_camera(&scene, Pose::default());
    let pose = |pose: Pose| Camera { pose, ..good };
    let k = |intrinsics: Intrinsics| Camera { intrinsics, ..good };
    // the field that the message names
    let bad = [
        ("pose of NaN", pose(Pose { yaw: f64::NAN, ..Pose::default() }), "pose"),
        ("pose of infinity", pose(Pose::at(f64::INFINITY, 0.0, 0.0)), "pose"),
        ("focal length 0", k(Intrinsics { fx: 0.0, ..good.intrinsics }), "intrinsics"),
        ("focal length NaN", k(Intrinsics { fy: f64::NAN, ..good.intrinsics }), "intrinsics"),
        ("principal point at infinity", k(Intrinsics { cy: f64::INFINITY, ..good.intrinsics }), "intrinsics"),
        ("width 0", Camera { width: 0, ..good }, "width"),
        ("height 16 385", Camera { height: 16_385, ..good }, "height"),
        ("8192×8193", Camera { width: 8192, height: 8193, ..good }, "pixels"),
    ];
    for (name, camera, field) in bad {
        checked.case("cameras", &format!("{name} is refused"), host.name(), "accepted", 0.0, || {
            f64::from(u8::from(!matches!(host.render(&scene, &camera), Err(RenderError::Camera(text)) if text.contains(field))))
        });
    }
    checked.case("cameras", "focal 1e-300 to 1e300, camera 1e-300 to 1e300 away", host.name(), "not drawn", 0.0, || {
        let pairs = [1e-300, 1e-9, 1e9, 1e300].map(|f| [1e-300, 1e9, 1e300].map(|t| (f, t)));
        let drawn = |&(f, t): &(f64, f64)| {
            let camera = Camera { pose: Pose::at(t, -t, t), intrinsics: Intrinsics::centred(32, 20, f), ..good };
            host.render(&scene, &camera).is_ok_and(|v| v.rgba.len() == 640)
        };
        pairs.as_flattened().iter().filter(|p| !drawn(p)).count() as f64
    });
}
