//! Labels that follow motion: an object that moves by known pixels in front of a wall, and pictures in which nothing moves.

use std::time::Duration;

use tmpi_core::live::label_motion::MotionSearch;
use tmpi_core::{Geometry, Plane};
use tmpi_testing::pictures::noise;

use super::Checked;
use super::readers::geometry;

const FAMILY: &str = "live motion";
const SIZE: (u32, u32) = (96, 64);
/// Where the object is in the first frame: in both tiles.
const AT: (u32, u32) = (40, 16);

pub(super) fn run(checked: &mut Checked) {
    labels(checked, followed);
}

/// Labels of all tiles in the second frame.
pub(super) fn followed(geometry: &Geometry, was: &[u32], now: &[u32]) -> Vec<Vec<u8>> {
    let surface = geometry.surface();
    let search = MotionSearch::new(geometry, &surface, (was, now), Duration::ZERO);
    let vectors = search.vectors(&[]);
    let of = |t: u32| vectors[t as usize].and_then(|vector| search.moved(t, vector));
    (0..).zip(&geometry.tiles).map(|(t, tile)| of(t).map_or_else(|| tile.labels.clone(), |moved| moved.labels)).collect()
}

/// An object of 24 × 30 pixels with its corner at `(x, y)`, and its picture.
fn frame(deltas: [f64; 2], (x, y): (u32, u32)) -> (Geometry, Vec<u32>) {
    let inside = |u: u32, v: u32| (x..x + 24).contains(&u) && (y..y + 30).contains(&v);
    let wave = |a: u32, b: u32| (127.0 + 100.0 * (f64::from(a) / 3.0).sin() * (f64::from(b) / 4.0).cos()) as u8;
    let colour = |u, v| if inside(u, v) { [200, wave(u - x, v - y), 40] } else { [20, 40, wave(u, v) / 2] };
    (geometry(SIZE, 64, &deltas.map(Plane::fronto_parallel), |u, v| u8::from(inside(u, v))), words(SIZE, colour))
}

fn words((w, h): (u32, u32), colour: impl Fn(u32, u32) -> [u8; 3]) -> Vec<u32> {
    (0..w * h).map(|i| colour(i % w, i / w)).map(|[r, g, b]| u32::from_le_bytes([r, g, b, 0])).collect()
}

/// `kernel` gives the labels of all tiles in the second frame.
pub(super) fn labels(checked: &mut Checked, kernel: impl Fn(&Geometry, &[u32], &[u32]) -> Vec<Vec<u8>>) {
    let off = |geometry: &Geometry, was: &[u32], now: &[u32], want: &Geometry| {
        let pixels = |(got, want): (&Vec<u8>, &Vec<u8>)| got.iter().zip(want).filter(|(a, b)| a != b).count();
        let want: Vec<Vec<u8>> = want.tiles.iter().map(|t| t.labels.clone()).collect();
        kernel(geometry, was, now).iter().zip(&want).map(pixels).sum::<usize>() as f64
    };
    for (deltas, (dx, dy)) in [[0.2, 0.7], [0.0, 1.0], [0.5, 0.56]]
        .into_iter()
        .flat_map(|d| [(0, 0), (1, 0), (5, 0), (-4, 3), (8, -8), (0, 11), (-12, 12)].map(|by| (d, by)))
    {
        let ((first, was), to) = (frame(deltas, AT), (AT.0.saturating_add_signed(dx), AT.1.saturating_add_signed(dy)));
        let (second, now) = frame(deltas, to);
        checked
            .case(FAMILY, &format!("{dx} right, {dy} down, from {deltas:?}"), "labels", "pixels", 0.0, || off(&first, &was, &now, &second));
    }
    let (first, was) = frame([0.2, 0.7], AT);
    let light = was.iter().map(|w| w >> 1 & 0x007f_7f7f).collect();
    let chance = words(SIZE, |x, y| [0, 64, 128].map(|k| (noise(x, y + k) * 256.0) as u8));
    for (name, now) in [("half the light", light), ("another picture", chance)] {
        checked.case(FAMILY, name, "labels", "pixels", 0.0, || off(&first, &was, &now, &first));
    }
    for (w, h) in [(1, 1), (90, 1), (1, 90)] {
        let small = geometry((w, h), 64, &[0.2, 0.7].map(Plane::fronto_parallel), |x, y| u8::from(x + y > 20 && x + y < 50));
        let [was, now] = [0, 7].map(|k| words((w, h), |x, y| [(noise(x, y + k) * 256.0) as u8; 3]));
        checked.case(FAMILY, &format!("{w}×{h} of noise"), "labels", "pixels", 0.0, || off(&small, &was, &now, &small));
    }
}
