//! Disagreement of neighbouring tiles in their overlap, which appears as a seam in side views.

use tmpi_core::{Geometry, Rect};

/// For the pixels common to two neighbours: the mean distance, in pixels, between the positions at which they show the point, seen from the
/// border of the view box; and the fraction with a distance of more than a pixel.
pub fn seams(g: &Geometry) -> (f64, f64) {
    let (grid, columns) = (&g.grid, g.grid.columns());
    let all = Rect { x: 0, y: 0, w: grid.width, h: grid.height };
    let (x, y) = g.view_box.parallax(&g.intrinsics, all);
    let parallax = x.max(y);
    let shown: Vec<Vec<f32>> = (0..).zip(&g.tiles).map(|(t, tile)| tile.disparities(grid, t)).collect();
    let (mut sum, mut wide, mut count) = (0.0, 0usize, 0usize);
    for t in 0..grid.tiles() {
        let right = (t % columns + 1 < columns).then_some(t + 1);
        let below = (t + columns < grid.tiles()).then_some(t + columns);
        for other in [right, below].into_iter().flatten() {
            let (a, b) = (grid.rect(t), grid.rect(other));
            let at = |r: &Rect, x: u32, y: u32| ((y - r.y) * r.w + x - r.x) as usize;
            for y in a.y.max(b.y)..(a.y + a.h).min(b.y + b.h) {
                for x in a.x.max(b.x)..(a.x + a.w).min(b.x + b.w) {
                    let apart = (shown[t as usize][at(&a, x, y)] - shown[other as usize][at(&b, x, y)]).abs();
                    let pixels = f64::from(apart) * parallax;
                    sum += pixels;
                    wide += usize::from(pixels > 1.0);
                    count += 1;
                }
            }
        }
    }
    let count = count.max(1) as f64;
    (sum / count, wide as f64 / count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_core::{Grid, Intrinsics, Plane, Tile, ViewBox};

    #[test]
    fn seams_measure_the_disagreement_of_tiles() {
        let grid = Grid::new(120, 64, 64);
        let tile = |delta: f64, t: u32| Tile {
            planes: vec![Plane::fronto_parallel(delta)],
            labels: vec![0; grid.rect(t).area()],
            background: None,
        };
        let of = |deltas: [f64; 2]| {
            let tiles = vec![tile(deltas[0], 0), tile(deltas[1], 1)];
            // a box of its own, in which one unit of disparity moves by 3 pixels
            let view_box = ViewBox { x: 0.03, y: 0.03, z: 0.0 };
            seams(&Geometry { grid, intrinsics: Intrinsics::centred(120, 64, 100.0), view_box, tiles, matte_band: 0 })
        };
        assert_eq!(of([0.5, 0.5]), (0.0, 0.0));
        let (mean, wide) = of([0.2, 0.7]);
        assert!((mean - 1.5).abs() < 0.01 && (wide - 1.0).abs() < 1e-9, "{mean} {wide}");
        let (mean, wide) = of([0.2, 0.3]);
        assert!((mean - 0.3).abs() < 0.01 && wide < 1e-9, "{mean} {wide}");
    }
}
