//! Label smoothing: a Potts model on the labels of a tile, minimised by iterated conditional modes (Besag 1986). If two planes explain a
//! pixel equally well, it joins the plane of its neighbours.
//!
//! Where planes cross or lie close together, the nearest plane changes from pixel to pixel with the noise of the map. Each change costs
//! bits, a soft rim and hidden texels, but is invisible.

use super::Samples;
use tmpi_core::Plane;

/// Passes over the tile; further passes change almost nothing.
const PASSES: usize = 4;
/// Cost of each neighbour on another plane, against the squared error in units of the target. `tmpi-lab bench` compares values: label
/// changes decrease with it, without a loss in views.
pub const NEIGHBOUR_COST: f32 = 0.3;
/// Largest error of a label that is not the nearest plane's, in units of the target.
const MOST: f32 = 1.0;

/// Lowers the Potts energy in passes over the tile: a pixel takes the label of one of its four neighbours if that costs less. Such a change
/// never raises a pixel's error above `target`. Does nothing if `target` or `neighbour` is not positive.
pub fn smooth_labels(s: &Samples, planes: &[Plane], labels: &mut [u8], target: f64, neighbour: f32) {
    let (w, n) = (s.width, labels.len());
    if planes.len() < 2 || w == 0 || target <= 0.0 || neighbour <= 0.0 {
        return;
    }
    let h = n / w;
    let some: Vec<[f32; 3]> = planes.iter().map(|p| [p.a as f32, p.b as f32, p.c as f32]).collect();
    let scale = (1.0 / target) as f32;
    let error = |i: usize, l: u8| (s.error(i, some[usize::from(l)]) * scale).abs();
    // rows that changed in the last pass and in this one: a pixel keeps its label if no neighbour changed
    let (mut before, mut now) = (vec![true; h], vec![false; h]);
    for _ in 0..PASSES {
        for y in 0..h {
            let (y0, y1) = (y.saturating_sub(1), (y + 1).min(h - 1));
            if !(before[y0] || before[y] || before[y1] || now[y0]) {
                continue;
            }
            let mut next = 0;
            while next < w {
                let (x, i) = (next, y * w + next);
                if x > 0 && x + RUN < w && equal_runs(labels, [y0 * w + x, i - 1, i, i + 1, y1 * w + x]) {
                    next += RUN;
                    continue;
                }
                next += 1;
                let (x0, x1) = (x.saturating_sub(1), (x + 1).min(w - 1));
                let own = labels[i];
                if [y0 * w + x, y1 * w + x, y * w + x0, y * w + x1].iter().all(|&j| labels[j] == own) {
                    continue;
                }
                let around = |l: u8| {
                    (y0..=y1).map(|v| labels[v * w + x0..=v * w + x1].iter().filter(|&&k| k != l).count()).sum::<usize>()
                        - usize::from(own != l)
                };
                let cost = |l: u8, e: f32| e * e + neighbour * around(l) as f32;
                let mut best = (cost(own, error(i, own)), own);
                for j in [y0 * w + x, y1 * w + x, y * w + x0, y * w + x1] {
                    let (l, e) = (labels[j], error(i, labels[j]));
                    if l != own && e <= MOST && cost(l, e) < best.0 {
                        best = (cost(l, e), l);
                    }
                }
                if best.1 != own {
                    labels[i] = best.1;
                    now[y] = true;
                }
            }
        }
        if !now.contains(&true) {
            break;
        }
        std::mem::swap(&mut before, &mut now);
        now.fill(false);
    }
}

/// Pixels tested together: nothing changes if they and their neighbours have the same label.
const RUN: usize = 8;

/// Whether the runs of [`RUN`] labels that start at these five indices are equal.
fn equal_runs(labels: &[u8], at: [usize; 5]) -> bool {
    let run = |i: usize| labels[i..].first_chunk::<RUN>();
    let own = run(at[2]);
    at.iter().all(|&i| run(i) == own)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn samples(width: usize, delta: impl Fn(usize) -> f32, n: usize) -> Samples {
        let mut s = Samples::default();
        s.clear(width);
        for i in 0..n {
            s.push((i % width) as f32 / 32.0 - 1.0, (i / width) as f32 / 32.0 - 1.0, delta(i), 1.0);
        }
        s
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(96))]

        #[test]
        fn no_error_grows_beyond_the_target(
            values in prop::collection::vec(prop_oneof![20 => 0f32..1.0, 1 => any::<f32>()], 24 * 16),
            start in prop::collection::vec(0u8..3, 24 * 16), target in 1e-4f64..0.3,
        ) {
            let planes = [Plane::fronto_parallel(0.2), Plane { a: 0.5, b: 0.1, c: -0.2 }, Plane::fronto_parallel(0.8)];
            let s = samples(24, |i| values[i], values.len());
            let mut labels = start.clone();
            smooth_labels(&s, &planes, &mut labels, target, NEIGHBOUR_COST);
            let (was, is) = (s.errors(&planes, &start), s.errors(&planes, &labels));
            for i in 0..labels.len() {
                prop_assert!(labels[i] == start[i] || f64::from(is[i]) <= target * 1.001, "{} after {}, target {target}", is[i], was[i]);
            }
        }
    }
}
