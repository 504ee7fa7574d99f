//! Compositing: stacks of soft layers against closed sums in `f64`, the tie-break, the exact identity view, and the photo's borders.

use std::sync::Arc;

use super::photos::identity;
use super::scenes::{all, own_camera, stack};
use super::{Checked, Host};
use tmpi_core::{Pose, Scene};
use tmpi_render::{Renderer, View, corners};

const FAMILY: &str = "compositing";
/// Scenes that show the photo, and cover it.
const FAITHFUL: [&str; 6] = ["flat", "ground", "disc", "disc before infinity", "typical", "remnants"];

/// (name, colours back to front, bound in levels)
fn stacks() -> Vec<(&'static str, Vec<[u8; 4]>, f64)> {
    let many = |f: fn(u8) -> [u8; 4]| (0..64).map(f).collect();
    vec![
        ("64 layers of alpha 1/255", vec![[200, 128, 255, 1]; 64], 0.51),
        ("64 layers of alpha 128/255", many(|i| [i * 4, 255 - i * 4, 90, 128]), 0.51),
        // 254/255 is above the alpha that counts as opaque: what lies behind, of a similar colour, is left out
        ("64 layers of alpha 254/255", many(|i| [i * 4, 255 - i * 4, 90, 254]), 0.51),
        ("64 layers of alpha 252/255 (transmittance underflow)", many(|i| [255 - i, i, 90, 252]), 0.51),
        ("one opaque under 8 thin", [vec![[10, 200, 30, 255]], vec![[255, 255, 255, 3]; 8]].concat(), 0.51),
        ("black and white by turns, alpha 3/255", many(|i| if i % 2 == 0 { [0, 0, 0, 3] } else { [255, 255, 255, 3] }), 0.51),
    ]
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
    let Ok(view) = host.render(scene, &own_camera(scene, Pose::default())) else { return f64::INFINITY };
    view.rgba.iter().flat_map(|p| p.iter().zip(want).map(|(p, w)| (f64::from(*p) - w).abs())).fold(0.0, f64::max)
}

pub(super) fn run(checked: &mut Checked, hosts: &[Host]) {
    for host in hosts {
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
        for (name, scene) in all().into_iter().filter(|(n, _)| FAITHFUL.contains(n)) {
            let scene = Arc::new(scene);
            checked.case(FAMILY, &format!("identity view of {name}"), host.name(), "levels", rounding, || identity(Some(&scene), host));
            checked.case(FAMILY, &format!("borders of {name} from the corners of the view box"), host.name(), "open pixels", 0.0, || {
                [0.0, 0.4, 1.0].into_iter().flat_map(|pivot| corners(&scene.view_box, pivot)).map(|pose| open(host, &scene, pose)).sum()
            });
        }
    }
}

/// Pixels in a band along the borders, as wide as the parallax, through which one sees; holes further in are not caused by the border.
fn open(host: &dyn Renderer, scene: &Arc<Scene>, pose: Pose) -> f64 {
    let Ok(View { width, height, rgba }) = host.render(scene, &own_camera(scene, pose)) else { return f64::INFINITY };
    let side = |i: u32| (i % width).min(width - 1 - i % width).min(i / width).min(height - 1 - i / width);
    (0..).zip(&rgba).filter(|(i, p)| side(*i) < 8 && p[3] < 250).count() as f64
}

/// Equal disparities: the later layer lies in front.
pub(super) fn ties(checked: &mut Checked, host: &dyn Renderer, bound: f64) {
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
