//! What rooms do from frame to frame: depth brought to the scale of the frame before, and labels that follow what moves.

use std::time::Duration;

use tmpi_core::live::label_motion::MotionSearch;
use tmpi_core::{DisparityMap, Geometry, Grid, Intrinsics, Plane, Tile, ViewBox};
use tmpi_live::align::{Affine, fit};

use super::Checked;

pub(super) fn run(checked: &mut Checked) {
    alignment(checked, fit);
    following(checked, |geometry, frames| {
        let surface = geometry.surface();
        let motion = MotionSearch::new(geometry, &surface, frames, Duration::ZERO);
        let tile = |(t, tile): (u32, &Tile)| motion.vector(t, &[]).and_then(|way| motion.moved(t, way)).unwrap_or_else(|| tile.clone());
        (0..).zip(&geometry.tiles).map(tile).collect()
    });
}

/// Bits that look like noise, as a number of -.5 to .5.
fn noise(i: usize) -> f64 {
    let i = (i as u32).wrapping_mul(2_654_435_761);
    let i = (i ^ (i >> 15)).wrapping_mul(0x2C1B_3C6D);
    f64::from(i ^ (i >> 12)) / f64::from(u32::MAX) - 0.5
}

/// A value for each pixel.
type Frame<'a> = &'a dyn Fn(usize) -> f64;

const SIZE: (usize, usize) = (96, 64);

fn map(delta: impl Fn(usize) -> f64) -> DisparityMap {
    DisparityMap { width: SIZE.0 as u32, height: SIZE.1 as u32, delta: (0..SIZE.0 * SIZE.1).map(|i| delta(i) as f32).collect() }
}

/// `kernel` finds scale and shift between two frames; both are known here.
pub(super) fn alignment(checked: &mut Checked, kernel: impl Fn(&DisparityMap, &DisparityMap, &[bool]) -> Affine) {
    const FAMILY: &str = "alignment";
    let all = vec![true; SIZE.0 * SIZE.1];
    let relief = |i: usize| 0.3 + 0.3 * (i as f64 / 37.0).sin().powi(2) + 0.1 * (i % 96) as f64 / 96.0;
    let off = |got: Affine, scale: f64, shift: f64| {
        let worst = [0.0, 1.0].map(|d| (got.scale * d + got.shift - scale * d - shift).abs());
        worst[0].max(worst[1])
    };
    // name, bound, the new frame, what it hides: noise of both and wild values
    let cases: [(&str, f64, Frame, Frame); 4] = [
        ("exact", 1e-5, &relief, &|_| 0.0),
        ("two values", 1e-5, &|i| f64::from(u8::from(i % 96 < 40)) * 0.5 + 0.2, &|_| 0.0),
        ("noise", 0.02, &relief, &|i| 0.02 * noise(i)),
        ("a tenth is wild", 0.02, &relief, &|i| if i % 10 == 0 { noise(i) } else { 0.0 }),
    ];
    for (name, bound, new, spoilt) in cases {
        for (scale, shift) in [(1.0, 0.0), (0.8, 0.1), (1.3, -0.2), (0.5, 0.4)] {
            checked.case(FAMILY, &format!("{name}, {scale}·δ + {shift}"), "scale and shift", "δ", bound, || {
                off(kernel(&map(|i| new(i) + spoilt(i)), &map(|i| scale * new(i) + shift), &all), scale, shift)
            });
        }
    }
    // without relief the shift alone can be told
    checked.case(FAMILY, "one value each", "scale and shift", "δ", 1e-5, || {
        let got = kernel(&map(|_| 0.4), &map(|_| 0.6), &all);
        (got.scale * 0.4 + got.shift - 0.6).abs()
    });
    checked.case(FAMILY, "near and far have changed places: no negative scale", "scale and shift", "below 0", 0.0, || {
        (-kernel(&map(relief), &map(|i| 0.9 - relief(i)), &all).scale).max(0.0)
    });
    checked.case(FAMILY, "half is another scene, which is not steady", "scale and shift", "δ", 1e-5, || {
        let steady: Vec<bool> = (0..all.len()).map(|i| i % 96 < 48).collect();
        let last = map(|i| if i % 96 < 48 { 0.8 * relief(i) + 0.1 } else { 0.5 + noise(i) });
        off(kernel(&map(relief), &last, &steady), 0.8, 0.1)
    });
    checked.case(FAMILY, "nothing is steady: it stays as it is, near enough", "scale and shift", "δ", 1e-5, || {
        off(kernel(&map(relief), &map(relief), &vec![false; all.len()]), 1.0, 0.0)
    });
}

/// A wall, and before it a thing of 24 × 20 pixels whose corner is at `(x, y)`; labels as of there.
fn frame((x, y): (u32, u32), (far, near): (f64, f64)) -> (Geometry, Vec<u32>) {
    let (w, h) = (SIZE.0 as u32, SIZE.1 as u32);
    let inside = |i: u32| (x..x + 24).contains(&(i % w)) && (y..y + 20).contains(&(i / w));
    let wave = |a: u32, b: u32| (127.0 + 100.0 * (f64::from(a) / 3.0).sin() * (f64::from(b) / 4.0).cos()) as u8;
    let rgb = |i| if inside(i) { [200, wave(i % w - x, i / w - y), 40, 0] } else { [20, 40, wave(i % w, i / w) / 2, 0] };
    let grid = Grid::new(w, h, 64);
    let tile = |t: u32| {
        let r = grid.rect(t);
        let labels = (0..r.area() as u32).map(|i| inside((r.y + i / r.w) * w + r.x + i % r.w).into()).collect();
        Tile { planes: [far, near].map(Plane::fronto_parallel).to_vec(), labels, background: None }
    };
    let tiles = (0..grid.tiles()).map(tile).collect();
    let geometry = Geometry { grid, intrinsics: Intrinsics::centred(w, h, 50.0), view_box: ViewBox::default(), tiles, matted: false };
    (geometry, (0..w * h).map(|i| u32::from_le_bytes(rgb(i))).collect())
}

/// `kernel` moves the labels of all tiles from one frame to the next.
pub(super) fn following(checked: &mut Checked, kernel: impl Fn(&Geometry, (&[u32], &[u32])) -> Vec<Tile>) {
    let wrong = |got: &[Tile], want: &[Tile]| {
        let tile = |(a, b): (&Tile, &Tile)| {
            a.labels.iter().zip(&b.labels).filter(|(a, b)| a != b).count() + a.labels.len().abs_diff(b.labels.len())
        };
        if got.len() == want.len() { got.iter().zip(want).map(tile).sum::<usize>() as f64 } else { f64::INFINITY }
    };
    for deltas in [(0.2, 0.7), (0.0, 1.0), (0.5, 0.56)] {
        let (geometry, was) = frame((36, 20), deltas);
        for (dx, dy) in [(0, 0), (1, 0), (5, 0), (-4, 3), (8, -8), (0, 11), (-12, 12)] {
            let to = (36u32.saturating_add_signed(dx), 20u32.saturating_add_signed(dy));
            let (want, now) = frame(to, deltas);
            let name = format!("a thing at δ {} before {}, by {dx} and {dy} pixels", deltas.1, deltas.0);
            checked.case("following", &name, "labels", "pixels", 0.0, || wrong(&kernel(&geometry, (&was, &now)), &want.tiles));
        }
    }
    let (geometry, was) = frame((36, 20), (0.2, 0.7));
    let darker: Vec<u32> = was.iter().map(|word| (word >> 1) & 0x007f_7f7f).collect();
    let other: Vec<u32> = (0..was.len()).map(|i| ((noise(i) + 0.5) * f64::from(0x00ff_ffff)) as u32).collect();
    for (name, now) in [("half the light", darker), ("another picture", other)] {
        checked.case("following", name, "labels", "pixels", 0.0, || wrong(&kernel(&geometry, (&was, &now)), &geometry.tiles));
    }
}

#[cfg(test)]
mod tests {
    use super::super::failed;
    use super::*;

    #[test]
    fn a_fault_of_each_kernel_is_caught() {
        // least squares in place of the ratio of spreads
        let least_squares = |new: &DisparityMap, last: &DisparityMap, _: &[bool]| {
            let n = new.delta.len() as f64;
            let mean =
                |f: &dyn Fn(f64, f64) -> f64| new.delta.iter().zip(&last.delta).map(|(a, b)| f((*a).into(), (*b).into())).sum::<f64>() / n;
            let (x, y) = (mean(&|a, _| a), mean(&|_, b| b));
            let scale = mean(&|a, b| (a - x) * (b - y)) / mean(&|a, _| (a - x) * (a - x)).max(1e-12);
            Affine { scale, shift: y - scale * x }
        };
        assert!(failed(|c| alignment(c, least_squares)) > 0);
        assert!(failed(|c| following(c, |geometry, _| geometry.tiles.clone())) > 0);
    }
}
