//! Photos: what cameras at the corners of the view box see, on scenes made of them by default.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::{Checked, scenes};
use crate::files;
use tmpi_core::container::{self, PhotoFormat};
use tmpi_core::{Scene, ViewBox};
use tmpi_pipeline::photo::Limits;
use tmpi_pipeline::{self, Models, Options, Silent};
use tmpi_render::{Cpu, Renderer, corners};

const FAMILY: &str = "corners of the view box";
/// Longer side that photos are reduced to.
const SIDE: u32 = 1024;
/// Alpha of 255 below which a pixel is a hole.
const HOLE: u8 = 128;
/// Alpha of 255 below which it is a seam: rims of layers are soft, and where two meet a little shows through.
const SEAM: u8 = 250;
/// Share of the way to the corners, and percent of pixels that may be holes and seams there: half-way is as far as viewers go by
/// themselves.
const PLACES: [(f64, f64, f64); 2] = [(0.5, 0.001, 0.05), (1.0, 0.005, 0.1)];

/// Pixels that are holes, and those that are seams, so far on the way to the eight corners, whether cameras look straight ahead or at the
/// nearest things, in percent of all.
fn uncovered(scene: &Arc<Scene>, share: f64) -> [f64; 2] {
    let ViewBox { x, y, z } = scene.view_box;
    let reached = ViewBox { x: x * share, y: y * share, z: z * share };
    let cpu = Cpu::default();
    let (mut open, mut all) = ([0, 0], 0);
    for pivot in [0.0, 1.0] {
        for pose in corners(&reached, pivot) {
            let Ok(view) = cpu.render(scene, &scenes::own_camera(scene, pose)) else { return [f64::INFINITY; 2] };
            for (open, least) in open.iter_mut().zip([HOLE, SEAM]) {
                *open += view.rgba.iter().filter(|p| p[3] < least).count();
            }
            all += view.rgba.len();
        }
    }
    open.map(|open| 100.0 * open as f64 / all as f64)
}

/// A disc before a wall in the default view box. `kernel` changes it.
pub(super) fn disc(checked: &mut Checked, kernel: impl FnOnce(Scene) -> Scene) {
    let scene = Scene { view_box: Options::VIEW_BOX, ..scenes::disc(200, 120, 64, 0.2) };
    corners_of(checked, "a disc", || Some(Arc::new(kernel(scene))));
}

/// A photo's scene by the default options, at most [`SIDE`] pixels a side.
fn scene(models: &Models, path: &Path) -> Option<Arc<Scene>> {
    let file = std::fs::read(path).ok()?;
    let options = Options { max_size: Some(SIDE), ..Options::default() };
    let made = tmpi_pipeline::make(models, &Limits::default(), &file, None, &options, &Silent).ok()?;
    container::decode(&made.container).ok().map(Arc::new)
}

/// Counts holes and seams of the scene that `kernel` makes.
fn corners_of(checked: &mut Checked, name: &str, kernel: impl FnOnce() -> Option<Arc<Scene>>) {
    let made = std::panic::catch_unwind(std::panic::AssertUnwindSafe(kernel)).ok().flatten();
    for (share, holes, seams) in PLACES {
        let mut found = [f64::INFINITY; 2];
        let name = format!("{} them, {name}", if share < 1.0 { "half-way to" } else { "at" });
        checked.case(FAMILY, &format!("{name}, holes"), "cpu", "% holes", holes, || {
            found = made.as_ref().map_or(found, |s| uncovered(s, share));
            found[0]
        });
        checked.case(FAMILY, &format!("{name}, seams"), "cpu", "% seams", seams, || found[1]);
    }
}

/// Checks every photo of the folders; a folder without one is a skipped case.
pub fn run_on_photos(folders: &[PathBuf], models: &Models) -> Checked {
    let mut checked = Checked::default();
    for folder in folders {
        let mut photos = files::entries(folder).unwrap_or_default();
        photos.retain(|p| is_photo(p));
        if photos.is_empty() {
            checked.skipped.push(format!("{}: no photo in it", folder.display()));
        }
        for path in photos {
            corners_of(&mut checked, &files::name(&path), || scene(models, &path));
        }
    }
    checked
}

fn is_photo(path: &Path) -> bool {
    use std::io::Read;
    let mut start = [0; 32];
    let read = std::fs::File::open(path).and_then(|mut f| f.read(&mut start)).unwrap_or(0);
    PhotoFormat::sniff(&start[..read]).is_some()
}
