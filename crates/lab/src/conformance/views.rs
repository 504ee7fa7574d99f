//! Planes and cameras: every scene for every camera on every renderer, against rays cast in `f64`. A scene is one case, named after the camera
//! whose view is worst.

use std::sync::Arc;

use super::scenes::{all, cameras, close, flat};
use super::{Checked, Hosts, cast, cast_in_layer_order};
use tmpi_core::{Camera, Intrinsics, Pose, Scene};
use tmpi_render::{NEAR, RenderError, Renderer};

/// Levels of 255 from which a pixel counts as wrong.
const LEVELS: f64 = 8.0;
/// A picture with fewer pixels than this is one border only.
const FEW: usize = 100;
/// Soft layers are drawn in one order for the whole picture. Beside them there is none: left of such a camera the near ones come
/// first, right of it the far ones.
const WITHOUT_ORDER: [(&str, &str); 2] = [("translucent stack", "edge-on"), ("translucent stack", "nearly edge-on")];

/// Percent of pixels that may be wrong: quad edges differ between rasterisers; in `f32` a pixel on the line where two surfaces cross
/// may show the other one, in `f64` only where tiles overlap on one surface.
pub(super) fn bound(host: &dyn Renderer) -> f64 {
    match host.name() {
        "reference" => 0.02,
        "cpu" => 0.05,
        _ => 1.5,
    }
}

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

pub(super) fn run(checked: &mut Checked, hosts: &Hosts) {
    let scenes: Vec<(&'static str, Arc<Scene>)> = all().into_iter().map(|(n, s)| (n, Arc::new(s))).collect();
    let names: Vec<&'static str> = scenes.first().map(|s| cameras(&s.1).into_iter().map(|c| c.0).collect()).unwrap_or_default();
    // [scene][camera]
    let wanted: Vec<Vec<(Camera, Vec<[f64; 4]>)>> =
        scenes.iter().map(|(_, s)| cameras(s).into_iter().map(|(_, c)| (c, cast(s, &c))).collect()).collect();
    for host in &hosts.all {
        let host = host.as_ref();
        let gpu = host.name() == "gpu";
        let excused = |s: usize, c: usize| gpu && WITHOUT_ORDER.contains(&(scenes[s].0, names[c]));
        let share = |s: usize, c: usize| {
            let (scene, (camera, want)) = (&scenes[s].1, &wanted[s][c]);
            if excused(s, c) { wrong(host, scene, camera, &cast_in_layer_order(scene, camera)) } else { wrong(host, scene, camera, want) }
        };
        let shares: Vec<Vec<f64>> = (0..scenes.len())
            .map(|s| {
                let one = |c: usize| std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| share(s, c))).unwrap_or(f64::INFINITY);
                (0..names.len()).map(one).collect()
            })
            .collect();
        let worst = |s: usize, wanted: &dyn Fn(usize) -> bool| {
            let share = |c: usize| shares[s][c];
            (0..names.len())
                .filter(|&c| wanted(c))
                .max_by(|a, b| share(*a).total_cmp(&share(*b)))
                .map_or(("no camera", 0.0), |c| (names[c], share(c)))
        };
        let mut told = |s: usize, order: &str, (camera, share): (&str, f64)| {
            let name = format!("{}{order}, worst of {}: {camera}", scenes[s].0, names.len());
            checked.case("planes", &name, host.name(), "% of pixels", bound(host), || share);
        };
        for s in 0..scenes.len() {
            told(s, "", worst(s, &|c| !excused(s, c)));
            if (0..names.len()).any(|c| excused(s, c)) {
                told(s, " in the order of layers", worst(s, &|c| excused(s, c)));
            }
        }
        near(checked, host);
        refusals(checked, host);
    }
}

/// Cameras ever nearer to the nearest surface, up to where it is no longer drawn, and past that.
fn near(checked: &mut Checked, host: &dyn Renderer) {
    let scenes = [("two values", close(&[0.0, 1.0])), ("nearest alone", close(&[1.0])), ("three values", close(&[0.0, 0.999, 1.0]))];
    for (name, scene) in scenes {
        let scene = Arc::new(scene);
        for tz in [0.9, 0.99, 0.997, 0.998, 0.999, 0.999_02, 1.0 - NEAR, 0.9991, 0.9993, 0.9995] {
            let camera =
                Camera { pose: Pose::at(0.0, 0.0, tz), intrinsics: scene.intrinsics, width: scene.photo.width, height: scene.photo.height };
            let want = cast(&scene, &camera);
            checked.case("near", &format!("{name}, {tz:.4} of the way"), host.name(), "% of pixels", bound(host), || {
                wrong(host, &scene, &camera, &want)
            });
        }
    }
}

/// Cameras that no picture exists for are refused, extreme but valid ones draw.
fn refusals(checked: &mut Checked, host: &dyn Renderer) {
    let scene = Arc::new(flat(32, 20, 0.5));
    let good = Camera { pose: Pose::default(), intrinsics: scene.intrinsics, width: 32, height: 20 };
    let pose = |pose: Pose| Camera { pose, ..good };
    let k = |intrinsics: Intrinsics| Camera { intrinsics, ..good };
    let bad = [
        ("pose of NaN", pose(Pose { yaw: f64::NAN, ..Pose::default() })),
        ("pose of infinity", pose(Pose::at(f64::INFINITY, 0.0, 0.0))),
        ("focal length 0", k(Intrinsics { fx: 0.0, ..good.intrinsics })),
        ("focal length NaN", k(Intrinsics { fy: f64::NAN, ..good.intrinsics })),
        ("principal point at infinity", k(Intrinsics { cy: f64::INFINITY, ..good.intrinsics })),
        ("width 0", Camera { width: 0, ..good }),
        ("height 16 385", Camera { height: 16_385, ..good }),
    ];
    for (name, camera) in bad {
        checked.case("cameras", &format!("{name} is refused"), host.name(), "accepted", 0.0, || {
            f64::from(u8::from(!matches!(host.render(&scene, &camera), Err(RenderError::Camera(_)))))
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

#[cfg(test)]
mod tests {
    use super::super::{Faulty, failed};
    use super::*;
    use tmpi_render::{Cpu, View};

    /// Whether a renderer with this fault fails in the cases.
    fn noticed(cases: fn(&mut Checked, &dyn Renderer), fault: fn(&Cpu, &Arc<Scene>, &Camera) -> Result<View, RenderError>) -> bool {
        let hosts = Faulty::hosts(fault);
        failed(|c| cases(c, hosts.all[0].as_ref())) > 0
    }

    #[test]
    fn a_fault_of_a_renderer_is_caught() {
        assert!(!noticed(near, Renderer::render) && !noticed(refusals, Renderer::render));
        // a surface is lost where it comes near
        assert!(noticed(near, |cpu, scene, camera| {
            let mut view = cpu.render(scene, camera)?;
            view.rgba.iter_mut().filter(|_| camera.pose.tz > 0.9985).for_each(|p| *p = [0; 4]);
            Ok(view)
        }));
        // what cannot be drawn is a black picture
        assert!(noticed(refusals, |cpu, scene, camera| {
            let black = View { width: camera.width, height: camera.height, rgba: vec![[0; 4]; 640] };
            Ok(cpu.render(scene, camera).unwrap_or(black))
        }));
        // half a degree of turn
        let hosts = Faulty::hosts(|cpu, scene, camera| {
            let pose = Pose { yaw: camera.pose.yaw + 0.5, ..camera.pose };
            cpu.render(scene, &Camera { pose, ..*camera })
        });
        assert!(failed(|c| run(c, &hosts)) > 0);
    }
}
