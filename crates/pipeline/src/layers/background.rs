//! Background planes: surfaces that only the neighbourhood of a tile shows.

use rayon::prelude::*;

use tmpi_core::{DisparityMap, Geometry, Grid, Plane, Rect, Tile, TileFrame, grown};

use crate::planes::Moments;

/// Margin around a tile, in pixels, from which a background plane is fitted.
const BACKGROUND_REACH: u32 = 32;
/// The next margin, if there is no background so near. Each later one is twice as wide.
const NEXT_REACH: u32 = 96;
/// How much farther than the whole tile these pixels must be, in δ.
const BACKGROUND_STEP: f32 = 0.05;

/// Most tiles that a thread takes before another can take over the rest.
const MAX_PIECE: usize = 8;

/// Pixels of a row that are compared at once, in vectors.
const AT_ONCE: usize = 32;

/// Which pixels of a margin a background plane is fitted to, and how many it takes. `tmpi-lab bench --only backgrounds` compares other
/// rules than the default.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BackgroundSamples {
    /// Widest margin, in pixels, at least 1, in which every pixel counts. In one up to n times as wide, every nth pixel of every nth row
    /// does.
    pub dense: u32,
    /// Fewest pixels to fit a plane to, where every pixel counts.
    pub fewest: usize,
    /// Where every nth counts, the fewest are divided by n to this power.
    pub power: u32,
}

impl BackgroundSamples {
    /// How photos are made.
    pub const DEFAULT: Self = Self { dense: NEXT_REACH, fewest: 32, power: 1 };

    /// The distance of the pixels that count in a margin of `reach` pixels, and the fewest of them.
    fn within(&self, reach: u32) -> (usize, usize) {
        let step = reach.div_ceil(self.dense) as usize;
        (step, self.fewest.div_ceil(step.pow(self.power)))
    }
}

/// Adds a background plane to every tile whose neighbourhood shows background that the tile itself does not show.
pub fn add_backgrounds(geometry: &mut Geometry, delta: &DisparityMap) {
    add_backgrounds_to(geometry, delta, |_| true);
}

/// Like [`add_backgrounds`], for tiles that are `wanted` only; other tiles keep their background plane.
pub fn add_backgrounds_to(geometry: &mut Geometry, delta: &DisparityMap, wanted: impl Fn(u32) -> bool + Sync) {
    add_sampled(geometry, delta, wanted, BackgroundSamples::DEFAULT);
}

/// Like [`add_backgrounds`], with other samples. For benchmarks.
#[doc(hidden)]
pub fn add_backgrounds_by(geometry: &mut Geometry, delta: &DisparityMap, samples: BackgroundSamples) {
    add_sampled(geometry, delta, |_| true, samples);
}

fn add_sampled(geometry: &mut Geometry, delta: &DisparityMap, wanted: impl Fn(u32) -> bool + Sync, samples: BackgroundSamples) {
    let grid = geometry.grid;
    // as far as the farthest camera uncovers, and readers search
    let (x, y) = geometry.reach();
    let farthest_reach = x.max(y);
    // in a room's first frames some tiles may have no planes yet, and show nothing to uncover
    let of = |(i, t): (usize, &Tile)| if t.planes.is_empty() { f32::INFINITY } else { t.min_disparity(&grid, i as u32) };
    let farthest: Vec<f32> = geometry.tiles.par_iter().enumerate().map(of).collect();
    let tiles = geometry.tiles.par_iter_mut().with_max_len(MAX_PIECE).enumerate();
    tiles.filter(|(i, _)| wanted(*i as u32)).for_each_init(Vec::new, |us, (i, t)| {
        let (r, place) = (grid.rect(i as u32), TileFrame::of(&grid, i as u32));
        let uncovers = |reach: &u32| *reach == BACKGROUND_REACH || may_uncover(&grid, i as u32, &farthest, *reach);
        let within = |reach: u32| background(delta, grown(r, reach, reach, &grid), (r, place), farthest[i], samples.within(reach), us);
        t.background = margins(farthest_reach).filter(uncovers).find_map(within);
    });
}

/// Margins in which background is searched, one after the other, up to the `farthest`, in pixels.
fn margins(farthest: u32) -> impl Iterator<Item = u32> {
    let wider = std::iter::successors(Some(NEXT_REACH), move |reach| (*reach < farthest).then_some(2 * reach));
    std::iter::once(BACKGROUND_REACH).chain(wider.map(move |reach| reach.min(farthest)).filter(|reach| *reach > BACKGROUND_REACH))
}

/// Whether a tile within `reach` pixels of tile `index` shows something so much farther that a camera may uncover it behind tile `index`.
fn may_uncover(grid: &Grid, index: u32, farthest: &[f32], reach: u32) -> bool {
    let (columns, tiles) = (grid.columns(), reach.div_ceil(grid.stride));
    let around = |at: u32, count: u32| at.saturating_sub(tiles)..(at + tiles + 1).min(count);
    let (x, y) = (index % columns, index / columns);
    let far = farthest[index as usize] - BACKGROUND_STEP;
    around(y, grid.rows()).any(|row| around(x, columns).any(|column| farthest[(row * columns + column) as usize] < far))
}

/// Fits a plane to background that only the neighbourhood shows, from every `step`th pixel of every `step`th row, if these are at least
/// `fewest`. Without it, gaps wider than the tile's reach stay empty. `us` is scratch memory.
fn background(
    delta: &DisparityMap,
    win: Rect,
    (r, place): (Rect, TileFrame),
    farthest: f32,
    (step, fewest): (usize, usize),
    us: &mut Vec<f64>,
) -> Option<Plane> {
    place.columns(win.x, win.w, us);
    let far = farthest - BACKGROUND_STEP;
    let (left, right, end) = ((r.x - win.x) as usize, (r.x + r.w - win.x) as usize, win.w as usize);
    let mut points = Moments::default();
    for y in (win.y..win.y + win.h).step_by(step) {
        let (row, v) = (&delta.delta[y as usize * delta.width as usize + win.x as usize..][..end], place.v(y));
        // in the tile's own rows, only left and right of it
        let beside = if (r.y..r.y + r.h).contains(&y) { [0..left, right..end] } else { [0..end, 0..0] };
        for part in beside {
            for (us, row) in us[part.clone()].chunks(AT_ONCE * step).zip(row[part].chunks(AT_ONCE * step)) {
                // most pixels are not farther
                if row.iter().fold(0, |any, d| any | u8::from(*d < far)) == 0 {
                    continue;
                }
                for (u, d) in us.iter().zip(row).step_by(step) {
                    if *d < far {
                        points.add(*u, v, f64::from(*d), 1.0);
                    }
                }
            }
        }
    }
    if points.weight() < fewest as f64 {
        return None;
    }
    let plane = points.plane()?;
    // extrapolated into the tile, the plane must stay behind everything there; else its slope is not reliable
    let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|(u, v)| plane.disparity(u, v));
    let sane = corners.iter().all(|&d| d >= 0.0 && d < f64::from(farthest));
    Some(if sane { plane } else { Plane::fronto_parallel(points.mean()) }.quantised())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tmpi_core::{Intrinsics, ViewBox};

    use super::*;

    /// A scene of walls side by side, each at one disparity, in tiles of `size` pixels with one plane per wall.
    fn walls(width: u32, height: u32, size: u32, wall: impl Fn(u32, u32) -> f32) -> (Geometry, DisparityMap) {
        let grid = Grid::new(width, height, size);
        let map = DisparityMap { width, height, delta: (0..width * height).map(|i| wall(i % width, i / width)).collect() };
        let tile = |t: u32| {
            let r = grid.rect(t);
            let shown = || (0..r.area() as u32).map(|i| wall(r.x + i % r.w, r.y + i / r.w));
            let mut all: Vec<f32> = shown().collect();
            all.sort_by(f32::total_cmp);
            all.dedup();
            let labels = shown().map(|d| all.iter().position(|a| *a >= d).unwrap() as u8).collect();
            Tile { planes: all.into_iter().map(|d| Plane::fronto_parallel(d.into())).collect(), labels, background: None }
        };
        let tiles = (0..grid.tiles()).map(tile).collect();
        (Geometry { grid, intrinsics: Intrinsics::centred(width, height, 300.0), view_box: ViewBox::cube(0.03), tiles, matte_band: 0 }, map)
    }

    /// The background of a tile by definition, in `f64`: the least-squares plane, with a ridge on its slopes, through the pixels around
    /// the tile that lie a step behind all of it; flat at their mean if that plane does not stay behind the tile.
    fn by_definition(map: &DisparityMap, grid: &Grid, tile: u32, reach: u32, farthest: f64) -> Option<Plane> {
        let (r, half, (cx, cy)) = (grid.rect(tile), grid.half(), grid.centre(tile));
        let about = grown(r, reach, reach, grid);
        let points: Vec<[f64; 3]> = (0..about.area() as u32)
            .map(|i| (about.x + i % about.w, about.y + i / about.w))
            .filter(|&(x, y)| !((r.x..r.x + r.w).contains(&x) && (r.y..r.y + r.h).contains(&y)))
            .map(|(x, y)| {
                let delta = map.delta[(y * map.width + x) as usize];
                [(f64::from(x) + 0.5 - cx) / half, (f64::from(y) + 0.5 - cy) / half, f64::from(delta)]
            })
            .filter(|p| p[2] < farthest - 0.05)
            .collect();
        if points.len() < 32 {
            return None;
        }
        let n = points.len() as f64;
        let mean = [0, 1, 2].map(|k| points.iter().map(|p| p[k]).sum::<f64>() / n);
        let of = |i: usize, k: usize| points.iter().map(|p| (p[i] - mean[i]) * (p[k] - mean[k])).sum::<f64>();
        let ridge = 1e-4 * n + 0.02;
        let (uu, vv, uv) = (of(0, 0) + ridge, of(1, 1) + ridge, of(0, 1));
        let det = uu * vv - uv * uv;
        let slope = |by: f64| (by / det).clamp(-0.256, 0.256);
        let (b, c) = (slope(of(0, 2) * vv - of(1, 2) * uv), slope(of(1, 2) * uu - of(0, 2) * uv));
        let plane = Plane { a: mean[2] - b * mean[0] - c * mean[1], b, c };
        let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|(u, v)| plane.disparity(u, v));
        let stays = corners.iter().all(|d| (0.0..farthest).contains(d));
        Some(if stays { plane } else { Plane::fronto_parallel(mean[2]) })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Coefficients lie on the container's grid, at most half a step from those of the definition. The other order of the sums makes
        /// a far smaller difference.
        #[test]
        fn backgrounds_agree_with_their_definition_in_f64(
            width in 60u32..200, height in 40u32..120, walls_at in prop::collection::vec((0.0f32..1.0, -0.002f32..0.002), 4), patch in 20u32..90,
        ) {
            let (scene, mut map) = walls(width, height, 32, |x, y| walls_at[((x / patch + 2 * (y / patch)) % 4) as usize].0);
            // the map is slanted where planes are flat
            for (i, d) in (0..).zip(&mut map.delta) {
                let (x, y) = (i % width, i / width);
                *d += walls_at[((x / patch + 2 * (y / patch)) % 4) as usize].1 * (x + y) as f32;
            }
            let mut got = scene.clone();
            add_backgrounds(&mut got, &map);
            for (t, tile) in (0..).zip(&got.tiles) {
                let farthest = f64::from(scene.tiles[t as usize].min_disparity(&scene.grid, t));
                let within = |reach: u32, farthest: f64| by_definition(&map, &scene.grid, t, reach, farthest);
                // farther background is searched only near tiles that are known to be farther, which the map need not agree with
                let reach = if within(BACKGROUND_REACH, farthest).is_some() { BACKGROUND_REACH } else { wide(&scene) };
                let want = within(reach, farthest);
                // if a pixel or a corner is almost at its bound, rounding may decide
                let stable = within(reach, farthest - 1e-6) == within(reach, farthest + 1e-6);
                let steps = |p: Plane, want: Plane| [p.a - want.a, p.b - want.b, p.c - want.c].map(|d| d.abs() / Plane::STEP);
                let agrees = match (tile.background, want) {
                    (Some(is), Some(want)) => steps(is, want).iter().all(|d| *d <= 0.5 + 1e-5),
                    (None, want) => reach > BACKGROUND_REACH || want.is_none(),
                    (Some(_), None) => false,
                };
                prop_assert!(agrees || !stable, "tile {t}: {:?}, not {want:?}", tile.background);
            }
        }

        /// Planes are finite for any map, even with NaN and infinity.
        #[test]
        fn backgrounds_are_finite_for_any_map(
            values in prop::collection::vec(prop_oneof![4 => 0.0f32..1.0, 1 => any::<f32>()], 120 * 70), at in 0.0f32..1.0,
        ) {
            let (mut scene, mut map) = walls(120, 70, 32, |x, _| if x < 60 { 0.8 } else { at });
            map.delta = values;
            add_backgrounds(&mut scene, &map);
            prop_assert!(scene.tiles.iter().filter_map(|t| t.background).all(|p| p.is_finite()));
        }
    }

    fn wide(scene: &Geometry) -> u32 {
        let (x, y) = scene.reach();
        x.max(y).clamp(BACKGROUND_REACH, NEXT_REACH)
    }

    #[test]
    fn margins_double_until_the_farthest() {
        let all = |farthest| margins(farthest).collect::<Vec<_>>();
        assert_eq!((all(2), all(32), all(60), all(96)), (vec![32], vec![32], vec![32, 60], vec![32, 96]));
        assert_eq!((all(192), all(400)), (vec![32, 96, 192], vec![32, 96, 192, 384, 400]));
    }

    #[test]
    fn a_wide_photo_finds_walls_as_far_as_its_cameras_see() {
        // tile 0 ends at 64; the far wall begins beyond
        let behind = |from: u32, extent: f64| {
            let (mut scene, map) = walls(1500, 64, 64, |x, _| if x < from { 0.8 } else { 0.2 });
            scene.view_box = ViewBox { x: extent, y: 0.0, z: 0.0 };
            add_backgrounds(&mut scene, &map);
            scene.tiles[0].background
        };
        for from in [64 + 90, 64 + 150, 64 + 290, 64 + 350] {
            // 300 pixels per unit
            let reach = f64::from(from - 64);
            assert!(behind(from, (reach + 20.0) / 300.0).is_some_and(|p| (p.disparity(0.0, 0.0) - 0.2).abs() < 0.01), "{from}");
            assert_eq!(behind(from, (reach - 20.0) / 300.0), None, "{from}");
        }
    }

    #[test]
    fn a_larger_view_box_finds_farther_walls() {
        // the far wall begins 40 pixels right of tile 0
        let (scene, map) = walls(192, 64, 64, |x, _| if x < 104 { 0.8 } else { 0.2 });
        let behind = |extent: f64| {
            let mut scene = scene.clone();
            scene.view_box = ViewBox { x: extent, y: 0.0, z: 0.0 };
            add_backgrounds(&mut scene, &map);
            scene.tiles[0].background
        };
        assert_eq!(behind(0.03), None);
        assert!(behind(0.2).is_some_and(|p| (p.disparity(0.0, 0.0) - 0.2).abs() < 0.01));
    }

    #[test]
    fn wider_margins_take_fewer_samples() {
        let within = |power, reach| BackgroundSamples { power, ..BackgroundSamples::DEFAULT }.within(reach);
        assert_eq!([32, 96, 97, 288, 384].map(|reach| within(1, reach)), [(1, 32), (1, 32), (2, 16), (3, 11), (4, 8)]);
        assert_eq!([0, 2].map(|power| within(power, 384)), [(4, 32), (4, 2)]);
        assert_eq!(BackgroundSamples { dense: u32::MAX, ..BackgroundSamples::DEFAULT }.within(1664), (1, 32));
    }

    #[test]
    fn rules_of_samples_decide_whether_there_is_a_background() {
        // the far wall is 6 pixels wide and 64 high, 190 pixels right of tile 0
        let (mut scene, map) = walls(600, 64, 64, |x, _| if (254..260).contains(&x) { 0.2 } else { 0.8 });
        scene.view_box = ViewBox { x: 1.0, y: 0.0, z: 0.0 };
        let found = |samples| {
            let mut scene = scene.clone();
            add_backgrounds_by(&mut scene, &map, samples);
            scene.tiles[0].background.map(|p| (p.disparity(0.0, 0.0) - 0.2).abs() < 0.01)
        };
        let usual = BackgroundSamples::DEFAULT;
        // 32 samples within 192 pixels, 16 within 302
        assert_eq!([16, 2000].map(|fewest| found(BackgroundSamples { fewest, ..usual })), [Some(true), None]);
        // 384 pixels
        let every = |fewest| found(BackgroundSamples { dense: u32::MAX, fewest, ..usual });
        assert_eq!([384, 385].map(every), [Some(true), None]);
    }

    #[test]
    fn tiles_that_are_not_wanted_keep_their_background() {
        let (mut scene, map) = walls(128, 64, 64, |x, _| if x < 70 { 0.8 } else { 0.2 });
        let held = Some(Plane::fronto_parallel(0.5));
        scene.tiles.iter_mut().for_each(|t| t.background = held);
        add_backgrounds_to(&mut scene, &map, |t| t == 0);
        assert_ne!(scene.tiles[0].background, held);
        assert!(scene.tiles[1..].iter().all(|t| t.background == held));
    }
}
