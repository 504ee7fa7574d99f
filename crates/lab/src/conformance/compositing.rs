//! Compositing: stacks of soft layers against closed sums in `f64`, the tie-break, and the exact identity view.

use std::sync::Arc;

use super::scenes::{all, stack};
use super::{Checked, Hosts};
use tmpi_core::{Camera, Pose, Scene};
use tmpi_render::Renderer;

const FAMILY: &str = "compositing";

/// (name, colours back to front, bound in levels)
fn stacks() -> Vec<(&'static str, Vec<[u8; 4]>, f64)> {
    let many = |f: fn(u8) -> [u8; 4]| (0..64).map(f).collect();
    vec![
        ("64 layers of alpha 1/255", vec![[200, 128, 255, 1]; 64], 0.51),
        ("64 layers of alpha 128/255", many(|i| [i * 4, 255 - i * 4, 90, 128]), 0.51),
        // 254/255 is above the alpha that counts as opaque, which leaves out 1/255 of what lies behind
        ("64 layers of alpha 254/255", many(|i| [i * 4, 255 - i * 4, 90, 254]), 1.51),
        ("64 layers of alpha 252/255 (transmittance underflow)", many(|i| [255 - i, i, 90, 252]), 0.51),
        ("one opaque under 8 thin", [vec![[10, 200, 30, 255]], vec![[255, 255, 255, 3]; 8]].concat(), 0.51),
        ("black and white by turns, alpha 3/255", many(|i| if i % 2 == 0 { [0, 0, 0, 3] } else { [255, 255, 255, 3] }), 0.51),
    ]
}

fn identity(scene: &Scene) -> Camera {
    Camera { pose: Pose::default(), intrinsics: scene.intrinsics, width: scene.photo.width, height: scene.photo.height }
}

/// Colours composited back to front, 0 to 255.
fn over(colours: impl Iterator<Item = [u8; 4]>) -> [f64; 4] {
    colours.fold([0.0; 4], |below, c| {
        let a = f64::from(c[3]) / 255.0;
        std::array::from_fn(|i| a * if i < 3 { f64::from(c[i]) } else { 255.0 } + (1.0 - a) * below[i])
    })
}

/// Largest difference of any channel of any pixel from `want`.
fn levels(host: &dyn Renderer, scene: &Arc<Scene>, want: [f64; 4]) -> f64 {
    let Ok(view) = host.render(scene, &identity(scene)) else { return f64::INFINITY };
    view.rgba.iter().flat_map(|p| p.iter().zip(want).map(|(p, w)| (f64::from(*p) - w).abs())).fold(0.0, f64::max)
}

pub(super) fn run(checked: &mut Checked, hosts: &Hosts) {
    for host in &hosts.all {
        let host = host.as_ref();
        // 16-bit floats round by up to a sixteenth of a level after each layer, up and down
        let rounding = if host.name() == "gpu" { 1.0 } else { 0.0 };
        for (name, colours, bound) in stacks() {
            let bound = bound + rounding;
            let n = colours.len();
            let delta = |i: usize| (i + 1) as f64 / n as f64;
            let want = over(colours.iter().copied());
            let sorted = Arc::new(stack(16, 16, &colours, &(0..n).map(delta).collect::<Vec<_>>()));
            checked.case(FAMILY, name, host.name(), "levels", bound, || levels(host, &sorted, want));
            // the same layers, their places in the scene shuffled by a step that is prime to every count
            let order: Vec<usize> = (0..n).map(|i| i * 37 % n).collect();
            let shuffled: Vec<[u8; 4]> = order.iter().map(|&i| colours[i]).collect();
            let scene = Arc::new(stack(16, 16, &shuffled, &order.iter().map(|&i| delta(i)).collect::<Vec<_>>()));
            checked.case(FAMILY, &format!("{name}, shuffled"), host.name(), "levels", bound, || levels(host, &scene, want));
        }
        ties(checked, host, 0.51 + rounding);
        for (name, scene) in all().into_iter().filter(|(n, _)| ["flat", "ground", "disc", "typical", "remnants"].contains(n)) {
            let scene = Arc::new(scene);
            let bound = if host.name() == "gpu" { 1.0 } else { 0.0 };
            checked.case(FAMILY, &format!("identity view of {name}"), host.name(), "levels", bound, || {
                let Ok(view) = host.render(&scene, &identity(&scene)) else { return f64::INFINITY };
                let off = |(p, q): (&[u8; 4], &[u8; 3])| (0..4).map(|c| p[c].abs_diff(if c < 3 { q[c] } else { 255 })).max().unwrap_or(0);
                view.rgba.iter().zip(&scene.photo.rgb).map(off).max().unwrap_or(u8::MAX).into()
            });
        }
    }
}

/// Equal disparities: the later layer lies in front.
fn ties(checked: &mut Checked, host: &dyn Renderer, bound: f64) {
    let soft: Vec<[u8; 4]> = (0..16_u8).map(|i| [i * 16, 255 - i * 16, if i % 2 == 0 { 255 } else { 0 }, 60 + i * 8]).collect();
    let mut opaque = soft.clone();
    opaque[3][3] = 255;
    opaque[9][3] = 255;
    for (name, colours) in [("ties in depth, soft", soft), ("ties in depth, two of them opaque", opaque)] {
        let scene = Arc::new(stack(16, 16, &colours, &vec![0.5; colours.len()]));
        let want = over(colours.iter().copied());
        checked.case(FAMILY, name, host.name(), "levels", bound, || levels(host, &scene, want));
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Faulty, failed};
    use super::*;

    #[test]
    fn a_fault_of_a_renderer_is_caught() {
        let right = Faulty::hosts(Renderer::render);
        assert_eq!(failed(|c| run(c, &right)), 0);
        // of equals the first lies in front
        let first = Faulty::hosts(|cpu, scene, camera| {
            let mut scene = Scene::clone(scene);
            scene.layers.reverse();
            cpu.render(&Arc::new(scene), camera)
        });
        assert!(failed(|c| ties(c, first.all[0].as_ref(), 1.51)) > 0);
        // three levels too bright
        let bright = Faulty::hosts(|cpu, scene, camera| {
            let mut view = cpu.render(scene, camera)?;
            view.rgba.iter_mut().for_each(|p| p[1] = p[1].saturating_add(3));
            Ok(view)
        });
        assert!(failed(|c| run(c, &bright)) > 0);
    }
}
