//! Disparity errors in pixels: how far they shift a point in views from the view box.

use rayon::prelude::*;

use tmpi_core::{DisparityMap, Geometry, Intrinsics, Plane, Rect, Tile, TileFrame, ViewBox};

use super::report::ParallaxShift;
use crate::photo::bilinear;

/// Most pixels that [`Parallax::resampled`] compares.
const SAMPLES: usize = 1 << 16;
/// Columns and rows of pixels that [`Parallax::of_rounding`] compares in a tile.
const ROUNDING_SAMPLES: u32 = 8;
/// Least distance of a surface from a camera of the view box, as a share of its distance from the reference camera. In a box that reaches
/// into a surface, a disparity error would shift the surface's points without bound.
const MIN_DISTANCE: f64 = 0.05;

/// Largest shift in pixels that a disparity error causes in views from a view box.
///
/// Take a point of disparity δ, `x` pixels from the principal point. A camera moved by `(X, Y, Z)` shows it at `(x − f·X·δ) / (1 − Z·δ)`.
/// Seen from the corners of the box, disparities a and b are therefore at most `|a − b| · (f·X + |x|·Z) / ((1 − Z·a)(1 − Z·b))` pixels
/// apart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parallax {
    intrinsics: Intrinsics,
    view_box: ViewBox,
}

impl Parallax {
    /// Shifts in views of a photo with these `intrinsics` from `view_box`.
    pub const fn new(intrinsics: Intrinsics, view_box: ViewBox) -> Self {
        Self { intrinsics, view_box }
    }

    /// Distance in pixels between the photo's point `(x, y)` at disparity `a` and at disparity `b`, in the camera of the view box where it
    /// is largest: the horizontal or the vertical distance, whichever is larger.
    pub fn pixels(&self, (x, y): (f64, f64), a: f64, b: f64) -> f64 {
        let (k, v) = (&self.intrinsics, &self.view_box);
        let step = (k.fx * v.x + (x - k.cx).abs() * v.z).max(k.fy * v.y + (y - k.cy).abs() * v.z);
        (a - b).abs() * step / (self.distance(a) * self.distance(b))
    }

    /// Upper bound, in pixels per unit of δ, of the shift anywhere within `rect`, for surfaces with δ ≤ 1.
    pub fn most(&self, rect: Rect) -> f64 {
        let (x, y) = self.view_box.parallax(&self.intrinsics, rect);
        x.max(y) / self.distance(1.0).powi(2)
    }

    /// Distance of a surface from the nearest camera of the view box, as a share of its distance from the reference camera.
    fn distance(&self, delta: f64) -> f64 {
        (1.0 - self.view_box.z * delta).max(MIN_DISTANCE)
    }

    /// Shift between two maps of the same size, over all pixels.
    pub fn between(&self, before: &DisparityMap, after: &DisparityMap) -> ParallaxShift {
        let width = (before.width as usize).max(1);
        let row = |(y, (a, b)): (usize, (&[f32], &[f32]))| {
            let each = a.iter().zip(b).enumerate();
            each.filter(|(_, (a, b))| a.to_bits() != b.to_bits()).fold([0.0, 0.0], |[sum, most], (x, (a, b))| {
                let px = self.pixels((x as f64 + 0.5, y as f64 + 0.5), f64::from(*a), f64::from(*b));
                [sum + px, f64::max(most, px)]
            })
        };
        // sum in row order, so that the number of threads does not change the result
        let rows: Vec<[f64; 2]> = before.delta.par_chunks(width).zip(after.delta.par_chunks(width)).enumerate().map(row).collect();
        moved(rows.into_iter(), before.delta.len(), false)
    }

    /// Shift between a map and `after`, the same map resampled to the photo's size, at the pixel centres of `before`. Compares at most
    /// 65536 pixels; pixels with a non-finite shift count as 0.
    pub fn resampled(&self, before: &DisparityMap, after: &DisparityMap) -> ParallaxShift {
        let (w, h) = (before.width as usize, before.height as usize);
        let step = before.delta.len().div_ceil(SAMPLES).max(1);
        let scale = [f64::from(after.width) / w.max(1) as f64, f64::from(after.height) / h.max(1) as f64];
        let one = |i: usize| {
            let place = ((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
            let place = (place.0 * scale[0], place.1 * scale[1]);
            let px = self.pixels(place, f64::from(before.delta[i]), at(after, place));
            if px.is_finite() { [px, px] } else { [0.0; 2] }
        };
        // a step coprime to the width, so that no column is missed
        let step = (step..=step + w).find(|s| step == 1 || gcd(*s, w) == 1).unwrap_or(step);
        let places: Vec<usize> = (0..before.delta.len()).step_by(step).collect();
        moved(places.iter().map(|i| one(*i)), places.len(), step > 1)
    }

    /// Errors of each tile's planes against the map that they were fitted to.
    pub fn of_planes(&self, delta: &DisparityMap, geometry: &Geometry) -> Vec<TileError> {
        let one = |errors: &mut Vec<f32>, (index, tile): (usize, &Tile)| self.of_tile(delta, geometry, (index as u32, tile), errors);
        geometry.tiles.par_iter().enumerate().map_init(Vec::new, one).collect()
    }

    /// Largest shift of a pixel by rounding its plane, for tiles whose planes were `before` rounding, in the same order. Compares 8 × 8 pixels
    /// of each tile, from corner to corner.
    pub fn of_rounding(&self, geometry: &Geometry, before: &[Vec<Plane>]) -> f64 {
        let grid = &geometry.grid;
        let one = |(index, (tile, before)): (usize, (&Tile, &Vec<Plane>))| {
            let (rect, place) = (grid.rect(index as u32), TileFrame::of(grid, index as u32));
            let at = |x: u32, y: u32| {
                let label = usize::from(tile.labels[(y * rect.w + x) as usize]);
                let (x, y) = (f64::from(rect.x + x) + 0.5, f64::from(rect.y + y) + 0.5);
                let delta =
                    |planes: &[Plane]| planes[label].disparity((x - place.centre.0) / place.half, (y - place.centre.1) / place.half);
                self.pixels((x, y), delta(before), delta(&tile.planes))
            };
            let spread = |i: u32, length: u32| i * (length - 1) / (ROUNDING_SAMPLES - 1);
            let samples = (0..ROUNDING_SAMPLES * ROUNDING_SAMPLES).map(|i| (i % ROUNDING_SAMPLES, i / ROUNDING_SAMPLES));
            samples.map(|(i, j)| at(spread(i, rect.w), spread(j, rect.h))).fold(0.0, f64::max)
        };
        geometry.tiles.par_iter().zip(before).enumerate().map(one).reduce(|| 0.0, f64::max)
    }

    fn of_tile(&self, delta: &DisparityMap, geometry: &Geometry, (index, tile): (u32, &Tile), errors: &mut Vec<f32>) -> TileError {
        let grid = &geometry.grid;
        let (rect, centre, half) = (grid.rect(index), grid.centre(index), grid.half());
        errors.clear();
        let (mut sum, mut nearest) = (0.0, 0.0);
        for (i, label) in tile.labels.iter().enumerate() {
            let (x, y) = (rect.x + i as u32 % rect.w, rect.y + i as u32 / rect.w);
            let place = (f64::from(x) + 0.5, f64::from(y) + 0.5);
            let (u, v) = ((place.0 - centre.0) / half, (place.1 - centre.1) / half);
            let known = f64::from(delta.delta[y as usize * delta.width as usize + x as usize]);
            let Some(plane) = tile.planes.get(usize::from(*label)) else { continue };
            let px = self.pixels(place, plane.disparity(u, v), known);
            let least = || tile.planes.iter().map(|p| p.disparity(u, v)).min_by(|a, b| (a - known).abs().total_cmp(&(b - known).abs()));
            nearest += if tile.planes.len() > 1 { least().map_or(px, |d| self.pixels(place, d, known)) } else { px };
            sum += px;
            errors.push(px as f32);
        }
        let n = errors.len().max(1) as f64;
        TileError { mean: sum / n, p99: crate::planes::percentile_99(errors), smoothing: (sum - nearest) / n, pixels: errors.len() }
    }
}

/// Errors of a tile's planes against the disparity map that they were fitted to, in pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TileError {
    /// Mean over the tile's pixels.
    pub mean: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Part of the mean that label smoothing adds, beyond the error of each pixel's nearest plane.
    pub smoothing: f64,
    /// Number of the tile's pixels.
    pub pixels: usize,
}

fn moved(each: impl Iterator<Item = [f64; 2]>, count: usize, sampled: bool) -> ParallaxShift {
    let [sum, most] = each.fold([0.0, 0.0], |all: [f64; 2], one| [all[0] + one[0], all[1].max(one[1])]);
    ParallaxShift { mean_px: sum / count.max(1) as f64, most_px: most, sampled }
}

/// δ at a position in pixels, by bilinear interpolation.
fn at(map: &DisparityMap, (x, y): (f64, f64)) -> f64 {
    let (w, h) = (map.width as usize, map.height as usize);
    bilinear((x - 0.5, y - 0.5), (w, h), |x, y| f64::from(map.delta[y * w + x]))
}

fn gcd(a: usize, b: usize) -> usize {
    if b == 0 { a } else { gcd(b, a % b) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Options;
    use tmpi_core::{Camera, Grid, Pose, homography};
    use tmpi_render::{MotionRange, corners};

    const BOX: ViewBox = ViewBox { x: 0.12, y: 0.08, z: 0.06 };

    fn movement() -> Parallax {
        Parallax::new(Intrinsics { fx: 60.0, fy: 62.0, cx: 51.0, cy: 29.0 }, BOX)
    }

    #[test]
    fn viewers_that_move_by_themselves_show_a_part_of_the_error() {
        let (k, most) = (Intrinsics::centred(1000, 750, 1000.0 * Intrinsics::DEFAULT_FOCAL_PER_WIDTH), MotionRange::TRAVEL);
        // the shortest travel and the longest
        for (travel, [middle, edge]) in
            [(ViewBox { x: 0.02, y: 0.02, z: 0.04 }, [0.16, 0.31]), (ViewBox { x: most, y: most, z: 0.06 }, [0.5, 0.65])]
        {
            let px = |view_box, x: f64| Parallax::new(k, view_box).pixels((x, 375.0), 0.5, 0.6);
            for (x, share) in [(500.0, middle), (0.0, edge), (1000.0, edge)] {
                let found = px(travel, x) / px(Options::VIEW_BOX, x);
                assert!((found - share).abs() < 0.006, "{found} at {x}");
            }
        }
    }

    #[test]
    fn pixels_match_homographies_at_the_corners_of_the_view_box() {
        let m = movement();
        let k = m.intrinsics;
        for (place, a, b) in [((3.5, 20.5), 0.2, 0.9), ((99.5, 59.5), 1.0, 0.98), ((51.0, 29.0), 0.0, 1.0), ((20.5, 1.5), 0.5, 0.5)] {
            let corners = corners(&BOX, 0.0).map(|pose| {
                let camera = Camera { pose, intrinsics: k, width: 100, height: 60 };
                let shown = |delta: f64| {
                    let h = homography([0.0, 0.0, delta], &k, &camera);
                    let [x, y, w] = h.map(|row| row[0] * place.0 + row[1] * place.1 + row[2]);
                    [x / w, y / w]
                };
                let (a, b) = (shown(a), shown(b));
                (a[0] - b[0]).abs().max((a[1] - b[1]).abs())
            });
            let farthest = corners.fold(0.0, f64::max);
            let px = m.pixels(place, a, b);
            assert!((px - farthest).abs() < 1e-9, "{place:?} {a} {b}: {px}, drawn {farthest}");
            let all = Rect { x: 0, y: 0, w: 100, h: 60 };
            assert!(px <= (a - b).abs() * m.most(all) + 1e-9);
        }
    }

    #[test]
    fn the_shift_by_rounding_is_that_of_the_pixels() {
        let grid = Grid::new(200, 150, 64);
        let noise = |t: u32, k: u32| f64::from(tmpi_testing::pictures::noise(t, k));
        let exact =
            |t: u32| [0, 3].map(|k| Plane { a: noise(t, k), b: 0.2 * noise(t, k + 1) - 0.1, c: 0.2 * noise(t, k + 2) - 0.1 }).to_vec();
        let before: Vec<Vec<Plane>> = (0..grid.tiles()).map(exact).collect();
        // the second plane has no pixel of tile 0
        let tile = |(t, planes): (u32, &Vec<Plane>)| {
            let labels = (0..grid.rect(t).area()).map(|i| u8::from(t > 0 && i % 7 < 3)).collect();
            Tile { planes: planes.iter().map(Plane::quantised).collect(), labels, background: None }
        };
        let tiles: Vec<Tile> = (0..).zip(&before).map(tile).collect();
        let k = Intrinsics::centred(200, 150, 116.0);
        let geometry = Geometry { grid, intrinsics: k, view_box: BOX, tiles, matte_band: 0 };
        // by homographies of all pixels, in the cameras at the corners of the box
        let mut most = 0.0f64;
        for (t, (tile, before)) in (0..).zip(geometry.tiles.iter().zip(&before)) {
            let (r, place) = (grid.rect(t), TileFrame::of(&grid, t));
            for (i, label) in (0..).zip(&tile.labels) {
                let at = [f64::from(r.x + i % r.w) + 0.5, f64::from(r.y + i / r.w) + 0.5];
                let (u, v) = ((at[0] - place.centre.0) / place.half, (at[1] - place.centre.1) / place.half);
                let [a, b] = [before, &tile.planes].map(|planes| planes[usize::from(*label)].disparity(u, v));
                let corner = |Pose { tx: x, ty: y, tz: z, .. }| {
                    let shown = |d: f64| [(at[0] - k.cx - k.fx * x * d) / (1.0 - z * d), (at[1] - k.cy - k.fy * y * d) / (1.0 - z * d)];
                    let (p, q) = (shown(a), shown(b));
                    (p[0] - q[0]).abs().max((p[1] - q[1]).abs())
                };
                most = corners(&BOX, 0.0).map(corner).fold(most, f64::max);
            }
        }
        let found = Parallax::new(k, BOX).of_rounding(&geometry, &before);
        assert!(found <= most + 1e-9 && found > 0.8 * most, "{found} of {most}");
    }

    #[test]
    fn enlarging_does_not_shift_a_ramp_but_blurring_shifts_a_step() {
        let m = movement();
        let ramp = DisparityMap::from_fn(50, 30, |x, y| x as f32 * 0.01 + y as f32 * 0.002);
        let enlarged = DisparityMap::from_fn(100, 60, |x, y| (x as f32 / 2.0 - 0.25) * 0.01 + (y as f32 / 2.0 - 0.25) * 0.002);
        // what remains is rounding, and the border, which has no neighbours to interpolate
        assert!(m.resampled(&ramp, &enlarged).mean_px < 1e-3, "{:?}", m.resampled(&ramp, &enlarged));
        let flat = DisparityMap::from_fn(100, 60, |_, _| 0.5);
        let step = DisparityMap::from_fn(50, 30, |x, _| if x < 25 { 0.25 } else { 0.75 });
        let moved = m.resampled(&step, &flat);
        assert!(moved.mean_px > 0.25 * 60.0 * 0.08 && !moved.sampled, "{moved:?}");
        let large = DisparityMap::from_fn(1000, 600, |_, _| 0.5);
        assert_eq!(m.resampled(&large, &flat), ParallaxShift { mean_px: 0.0, most_px: 0.0, sampled: true });
    }
}
