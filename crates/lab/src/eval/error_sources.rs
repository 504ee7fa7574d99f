//! Finds where the error of a view comes from: replaces each part with the truth, one at a time.

use serde::Serialize;

use super::mesh::Warp;
use super::{Depth, Row};
use crate::table;
use tmpi_core::Camera;

/// Maximum distance from a depth border, in pixels, at which an error counts as the border's.
const NEAR_EDGE: usize = 3;
/// There is a depth border between two neighbours that move apart by more than this many pixels between photo and view.
const STEP: f64 = 1.0;

/// What a pixel of a view shows, according to the true depth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    /// A surface that no pixel of the photo shows.
    Hidden,
    /// A depth border, or a surface beside one.
    Edge,
    /// A surface that the photo shows.
    Surface,
}

/// Mean squared error of views by source, for colours in 0 to 1. The sum over all sources is the views' whole error.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Sources {
    /// Pixels that no pixel of the photo shows: invented colours.
    pub hidden: f64,
    /// Pixels within 3 of a depth border.
    pub edges: f64,
    /// All other pixels: the error beyond that of the photo as a mesh with the true depth. Its cause is the planes, and the depth if that
    /// is estimated. Below 0 if the planes are closer to the truth than that mesh.
    pub geometry: f64,
    /// The error of that mesh at those pixels: resampling, noise, and surfaces that move or shine differently from elsewhere.
    pub resampling: f64,
}

impl Sources {
    pub fn total(&self) -> f64 {
        self.hidden + self.edges + self.geometry + self.resampling
    }

    pub(super) fn mean(all: &[Self]) -> Self {
        let of = |f: fn(&Self) -> f64| all.iter().map(f).sum::<f64>() / all.len().max(1) as f64;
        Self { hidden: of(|s| s.hidden), edges: of(|s| s.edges), geometry: of(|s| s.geometry), resampling: of(|s| s.resampling) }
    }
}

/// The parts of a view, and the photo drawn as a mesh with the true depth.
pub(super) struct Parts<'a> {
    parts: Vec<Part>,
    mesh: &'a [[u8; 3]],
}

impl<'a> Parts<'a> {
    /// Classifies the pixels of a view that the mesh was drawn for.
    pub fn new(warp: &'a Warp, camera: &Camera) -> Self {
        let (w, h) = (camera.width as usize, camera.height as usize);
        let (k, p) = (camera.intrinsics, camera.pose);
        // if the camera moves along its axis, the points farthest from the centre move most
        let aside = |f: f64, t: f64, half: f64| f * t.abs() + half * p.tz.abs();
        let most = aside(k.fx, p.tx, w as f64 / 2.0).max(aside(k.fy, p.ty, h as f64 / 2.0));
        let apart = |a: usize, b: usize| match (warp.covers(a), warp.covers(b)) {
            (true, true) => (warp.depth[a] - warp.depth[b]).abs() * most > STEP,
            (a, b) => a != b,
        };
        let edge = |i: usize| (i % w + 1 < w && apart(i, i + 1)) || (i / w + 1 < h && apart(i, i + w));
        let edges: Vec<usize> = (0..w * h).filter(|&i| edge(i)).collect();
        let mut parts = vec![Part::Surface; w * h];
        for i in edges {
            let (x, y) = (i % w, i / w);
            for y in y.saturating_sub(NEAR_EDGE)..(y + NEAR_EDGE + 1).min(h) {
                parts[y * w + x.saturating_sub(NEAR_EDGE)..y * w + (x + NEAR_EDGE + 1).min(w)].fill(Part::Edge);
            }
        }
        for (_, part) in parts.iter_mut().enumerate().filter(|(i, _)| !warp.covers(*i)) {
            *part = Part::Hidden;
        }
        Self { parts, mesh: &warp.rgb }
    }

    /// Splits the error of a view against the truth by source, over the scored pixels.
    pub fn sources(&self, view: &[[u8; 3]], truth: &[[u8; 3]], inside: &[bool]) -> Sources {
        let mut all = Sources::default();
        let mut pixels = 0usize;
        for i in (0..view.len()).filter(|i| inside[*i]) {
            pixels += 1;
            let error = squared(view[i], truth[i]);
            match self.parts[i] {
                Part::Hidden => all.hidden += error,
                Part::Edge => all.edges += error,
                Part::Surface => {
                    let least = squared(self.mesh[i], truth[i]);
                    all.resampling += least;
                    all.geometry += error - least;
                }
            }
        }
        let n = pixels.max(1) as f64;
        Sources { hidden: all.hidden / n, edges: all.edges / n, geometry: all.geometry / n, resampling: all.resampling / n }
    }
}

/// Formats the sources as a table: mean squared error in 1e-4, and the PSNR of the whole view without each source.
pub(super) fn table(depth: Depth, rows: &[Row]) -> String {
    let geometry = if depth == Depth::Own { "depth" } else { "planes" };
    let head = ["way", "all", "hidden colours", "depth edges", geometry, "resampling"];
    let line = |r: &Row| {
        let s = r.sources;
        let parts = [s.hidden, s.edges, s.geometry, s.resampling].map(|part| {
            let rest = s.total() - part;
            format!("{:.2} ({:.2})", 1e4 * part, -10.0 * rest.max(f64::MIN_POSITIVE).log10())
        });
        [r.way.to_owned(), format!("{:.2}", 1e4 * s.total())].into_iter().chain(parts).collect::<Vec<_>>()
    };
    let table = table::table(1, &head, rows.iter().map(line));
    format!("\nmean squared error, 1e-4, by what it comes from; in brackets PSNR if that were right\n{table}")
}

/// Mean squared difference over the channels, of values in 0 to 1.
fn squared(a: [u8; 3], b: [u8; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (f64::from(a.abs_diff(b)) / 255.0).powi(2)).sum::<f64>() / 3.0
}

#[cfg(test)]
mod tests {
    use super::super::mesh::{LONGEST, warp};
    use super::*;
    use tmpi_core::{DisparityMap, Intrinsics, Photo, Pose};

    #[test]
    fn an_error_is_of_what_its_pixel_shows() {
        let (w, h) = (60usize, 40usize);
        let photo = Photo { width: 60, height: 40, rgb: vec![[100; 3]; w * h] };
        let map = DisparityMap { width: 60, height: 40, delta: (0..w * h).map(|i| if i % w < 30 { 1.0 } else { 0.0 }).collect() };
        let k = Intrinsics::centred(60, 40, 50.0);
        // what is near moves 10 pixels to the left, and uncovers as many
        let camera = Camera { pose: Pose::at(0.2, 0.0, 0.0), intrinsics: k, width: 60, height: 40 };
        let warp = warp(&photo, &map, &k, &camera, LONGEST);
        let parts = Parts::new(&warp, &camera);
        let part = |x: usize| parts.parts[20 * w + x];
        assert_eq!([15, 18, 25, 31, 34].map(part), [Part::Surface, Part::Edge, Part::Hidden, Part::Edge, Part::Surface]);
        let truth = vec![[100; 3]; w * h];
        let inside = vec![true; w * h];
        let error = (51.0f64 / 255.0).powi(2) / (w * h) as f64;
        for x in [5, 18, 25, 45] {
            let mut view = truth.clone();
            view[20 * w + x] = [151; 3];
            let s = parts.sources(&view, &truth, &inside);
            let of = [s.geometry, s.edges, s.hidden, s.geometry][[5, 18, 25, 45].iter().position(|v| *v == x).unwrap()];
            assert!((of - error).abs() < 1e-12 && (s.total() - error).abs() < 1e-12 && s.resampling == 0.0, "{x}: {s:?}");
            let none = parts.sources(&view, &truth, &vec![false; w * h]);
            assert_eq!(none, Sources::default());
        }
    }

    #[test]
    fn what_the_exact_mesh_has_wrong_too_is_resampling() {
        let photo = Photo { width: 20, height: 10, rgb: vec![[100; 3]; 200] };
        let map = DisparityMap { width: 20, height: 10, delta: vec![0.5; 200] };
        let k = Intrinsics::centred(20, 10, 20.0);
        let camera = Camera { pose: Pose::default(), intrinsics: k, width: 20, height: 10 };
        let warp = warp(&photo, &map, &k, &camera, LONGEST);
        let parts = Parts::new(&warp, &camera);
        // the truth is brighter than the photo, and the view half-way
        let s = parts.sources(&[[151; 3]; 200], &[[202; 3]; 200], &[true; 200]);
        assert!((s.resampling - 0.16).abs() < 1e-12 && (s.geometry + 0.12).abs() < 1e-12 && (s.total() - 0.04).abs() < 1e-12, "{s:?}");
    }
}
