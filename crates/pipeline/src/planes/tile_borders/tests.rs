use super::super::{MAX_AUTO_PLANES, Method, Placement, place};
use super::*;

/// Of a pixel, for views of a photo 630 pixels wide.
const TARGET: f64 = 1.0 / 71.0;

/// δ at a pixel.
type Surface<'a> = &'a dyn Fn(f32, f32) -> f32;

fn fitted(map: &DisparityMap, grid: &Grid) -> Vec<Tile> {
    place(map, None, grid, &Placement::fewest(Method::Slanted, MAX_AUTO_PLANES, TARGET))
}

fn met(map: &DisparityMap, grid: &Grid, target: f64, tiles: &[Tile]) -> Vec<Tile> {
    let mut moved = tiles.to_vec();
    let mut before: Vec<Vec<Plane>> = tiles.iter().map(|t| t.planes.clone()).collect();
    meet_at_borders(map, grid, target, &mut moved, &mut before);
    for (plane, before) in moved.iter().flat_map(|t| &t.planes).zip(before.iter().flatten()) {
        // half a step for each coefficient
        assert!(largest_change(plane, before) <= 1.5 * Plane::STEP + 1e-12, "{plane:?} was {before:?}");
        assert_eq!(*plane, before.quantised());
    }
    moved
}

/// A map and its tiles before and after.
fn both(width: u32, height: u32, delta: impl Fn(f32, f32) -> f32) -> (DisparityMap, Grid, Vec<Tile>, Vec<Tile>) {
    let map = DisparityMap::from_fn(width, height, |x, y| delta(x as f32, y as f32));
    let grid = Grid::new(width, height, 64);
    let before = fitted(&map, &grid);
    let after = met(&map, &grid, TARGET, &before);
    (map, grid, before, after)
}

/// Mean disagreement of neighbours about their common pixels, in units of the target.
fn gap(grid: &Grid, tiles: &[Tile]) -> f64 {
    let shown: Vec<Vec<f32>> = (0..).zip(tiles).map(|(t, tile)| tile.disparities(grid, t)).collect();
    let (mut sum, mut count) = (0.0, 0_u32);
    for t in 0..grid.tiles() {
        for other in neighbours(grid, t) {
            let (a, b) = (grid.rect(t), grid.rect(other));
            let at = |r: &Rect, x: u32, y: u32| ((y - r.y) * r.w + x - r.x) as usize;
            for y in common((a.y, a.h), (b.y, b.h)) {
                for x in common((a.x, a.w), (b.x, b.w)) {
                    sum += f64::from((shown[t as usize][at(&a, x, y)] - shown[other as usize][at(&b, x, y)]).abs());
                    count += 1;
                }
            }
        }
    }
    sum / f64::from(count.max(1)) / TARGET
}

/// The 99th percentile of each tile's errors.
fn errors(map: &DisparityMap, grid: &Grid, tiles: &[Tile]) -> Vec<f64> {
    let mut samples = Samples::default();
    let one = |(t, tile): (u32, &Tile)| {
        samples.gather(map, None, grid, t);
        percentile_99(&mut samples.errors(&tile.planes, &tile.labels))
    };
    (0..).zip(tiles).map(one).collect()
}

fn most_moved(before: &[Tile], after: &[Tile]) -> f64 {
    let pairs = before.iter().zip(after).flat_map(|(a, b)| a.planes.iter().zip(&b.planes));
    pairs.map(|(p, q)| largest_change(p, q)).fold(0.0, f64::max)
}

#[test]
fn a_tilted_surface_stays_as_it_is() {
    let step = Plane::STEP as f32;
    // multiples of the container's steps in each tile, which rounding does not change
    let (.., before, after) = both(300, 200, |x, y| step * (4096.0 + 2.0 * (x + 0.5) - (y + 0.5)));
    assert!(before.iter().all(|t| t.planes.len() == 1));
    assert_eq!(before, after);
    let (.., before, after) = both(300, 200, |x, y| 0.2 + 0.0005 * x + 0.0007 * y);
    assert!(most_moved(&before, &after) <= 4.0 * Plane::STEP, "{}", most_moved(&before, &after));
}

#[test]
fn two_surfaces_stay_apart() {
    let (.., before, after) = both(300, 200, |x, y| if (x / 37.0) as u32 % 2 == (y / 41.0) as u32 % 2 { 0.3 } else { 0.7 });
    assert!(most_moved(&before, &after) <= 4.0 * Plane::STEP, "{}", most_moved(&before, &after));
}

#[test]
fn neighbours_on_one_surface_meet() {
    // what a plane cannot follow keeps a gap: tiles of a slope with ripples need one plane, those of a curved surface two
    let ripples = |x: f32, y: f32| 0.3 + 0.001 * x + 0.012 * (x / 9.0 + y / 31.0).sin() * (y / 7.0).cos();
    let curved = |x: f32, y: f32| 0.5 + 0.35 * (x / 90.0).sin() * (y / 70.0).cos();
    let cases: [(&str, Surface, f64); 2] = [("ripples", &ripples, 0.5), ("curved", &curved, 0.85)];
    for (name, delta, most) in cases {
        let (map, grid, before, after) = both(300, 200, delta);
        let [was, is] = [&before, &after].map(|tiles| gap(&grid, tiles));
        assert!(was > 0.03 && is < most * was, "{name}: {was} before, {is} after");
        assert!(errors(&map, &grid, &after).iter().all(|e| *e <= TARGET), "{name}");
    }
}

#[test]
fn no_tile_moves_beyond_its_bound() {
    let noise = |x: f32, y: f32| ((x * 12.9898 + y * 78.233).sin() * 43_758.547).fract().abs();
    let unknown = |x: f32, y: f32| if x < 30.0 || y as u32 % 50 == 7 { f32::NAN } else { noise(x, y) };
    let cases: [(u32, u32, Surface); 8] = [
        (150, 130, &noise),
        (150, 130, &|x, y| 0.5 + 0.02 * noise(x, y)),
        (150, 130, &unknown),
        (130, 70, &|_, _| f32::NAN),
        (1, 1, &noise),
        (1, 200, &noise),
        (200, 1, &noise),
        (65, 64, &noise),
    ];
    for (width, height, delta) in cases {
        let (map, grid, before, after) = both(width, height, delta);
        for ((was, is), tile) in errors(&map, &grid, &before).iter().zip(errors(&map, &grid, &after)).zip(&after) {
            assert!(is <= was.max(TARGET) + 1e-9, "{width}×{height}: {was} before, {is} after");
            assert!(tile.planes.iter().all(Plane::is_finite) && tile.planes.is_sorted_by(|p, q| far_to_near(p, q).is_lt()));
        }
        let kept = before.iter().zip(&after).all(|(a, b)| a.labels == b.labels && a.planes.len() == b.planes.len());
        assert!(kept && (grid.tiles() > 1 || before == after), "{width}×{height}");
    }
}

#[test]
fn the_number_of_threads_does_not_matter() {
    let map = DisparityMap::from_fn(300, 200, |x, y| 0.5 + 0.35 * (x as f32 / 60.0).sin() * (y as f32 / 50.0).cos());
    let grid = Grid::new(300, 200, 64);
    let before = fitted(&map, &grid);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| met(&map, &grid, TARGET, &before))
    };
    assert_ne!(on(1), before);
    assert_eq!(on(1), on(3));
}

/// Planes of four tiles of two surfaces, .3 to the left of column 50 and .6 from there on, all of them a little off.
fn two_surfaces() -> (DisparityMap, Grid, Vec<Tile>) {
    let map = DisparityMap::from_fn(100, 90, |x, _| if x < 50 { 0.3 } else { 0.6 });
    let grid = Grid::new(100, 90, 64);
    let off = [[0.012, 0.004, -0.006], [-0.009, -0.003, 0.005], [0.007, 0.006, 0.004], [-0.011, 0.005, -0.007]];
    let tile = |t: u32| {
        let (rect, [a, b, c]) = (grid.rect(t), off[t as usize]);
        let surfaces: &[f64] = if rect.x < 50 { &[0.3, 0.6] } else { &[0.6] };
        let planes = surfaces.iter().map(|delta| Plane { a: delta + a, b: delta * b, c }).collect();
        let label = |i: u32| u8::from(rect.x < 50 && rect.x + i % rect.w >= 50);
        Tile { planes, labels: (0..rect.w * rect.h).map(label).collect(), background: None }
    };
    let tiles = (0..grid.tiles()).map(tile).collect();
    (map, grid, tiles)
}

/// A pixel of a tile: its number among all planes, and 1, u, v there.
fn row(grid: &Grid, tiles: &[Tile], t: u32, (x, y): (u32, u32)) -> (usize, [f64; 3]) {
    let (r, frame) = (grid.rect(t), TileFrame::of(grid, t));
    let at = |v: u32, centre: f64| (f64::from(v) + 0.5 - centre) / frame.half;
    let before: usize = tiles[..t as usize].iter().map(|tile| tile.planes.len()).sum();
    let label = tiles[t as usize].labels[((y - r.y) * r.w + x - r.x) as usize];
    (before + usize::from(label), [1.0, at(x, frame.centre.0), at(y, frame.centre.1)])
}

/// The changes of all coefficients that minimise the sum, pixel by pixel, by Gauss's elimination.
fn reference(grid: &Grid, tiles: &[Tile], matching: f64) -> Vec<f64> {
    let start: Vec<[f64; 3]> = tiles.iter().flat_map(|t| t.planes.iter().map(|p| [p.a, p.b, p.c])).collect();
    let n = 3 * start.len();
    let mut system = vec![vec![0.0; n + 1]; n];
    let mut square = |terms: &[(usize, f64)], aim: f64, weight: f64| {
        for (i, a) in terms {
            for (j, b) in terms {
                system[*i][*j] += weight * a * b;
            }
            system[*i][n] += weight * a * aim;
        }
    };
    let value = |(plane, at): (usize, [f64; 3])| (0..3).map(|k| start[plane][k] * at[k]).sum::<f64>();
    let terms = |(plane, at): (usize, [f64; 3]), sign: f64| (0..3).map(move |k| (3 * plane + k, sign * at[k]));
    let mut pixels = vec![0.0; start.len()];
    for t in 0..grid.tiles() {
        let r = grid.rect(t);
        for place in (r.y..r.y + r.h).flat_map(|y| (r.x..r.x + r.w).map(move |x| (x, y))) {
            let own = row(grid, tiles, t, place);
            pixels[own.0] += 1.0;
            square(&terms(own, 1.0).collect::<Vec<_>>(), 0.0, 1.0);
            for other in neighbours(grid, t).filter(|other| *other > t) {
                let o = grid.rect(other);
                if (o.x..o.x + o.w).contains(&place.0) && (o.y..o.y + o.h).contains(&place.1) {
                    let its = row(grid, tiles, other, place);
                    let apart = value(its) - value(own);
                    if apart.abs() <= matching {
                        square(&terms(own, 1.0).chain(terms(its, -1.0)).collect::<Vec<_>>(), apart, BORDER_WEIGHT);
                    }
                }
            }
        }
    }
    for (plane, pixels) in pixels.iter().enumerate() {
        for k in [1, 2] {
            square(&[(3 * plane + k, 1.0)], 0.0, RIDGE.0 * pixels + RIDGE.1);
        }
    }
    for k in 0..n {
        let pivot = system[k].clone();
        for (i, line) in system.iter_mut().enumerate() {
            let share = if i == k { 0.0 } else { line[k] / pivot[k] };
            line.iter_mut().zip(&pivot).for_each(|(v, p)| *v -= share * p);
        }
    }
    (0..n).map(|k| system[k][n] / system[k][k]).collect()
}

#[test]
fn many_sweeps_give_the_least_squares_of_all_planes() {
    let (map, grid, tiles) = two_surfaces();
    let target = 0.05;
    let want = reference(&grid, &tiles, MATCHING * target);
    assert_eq!(want.len(), 3 * 6);
    let got = refine(&map, &grid, target, &tiles, 400);
    let planes = got.iter().flatten().zip(tiles.iter().flat_map(|t| &t.planes));
    let changes: Vec<f64> = planes.flat_map(|(p, q)| [p.a - q.a, p.b - q.b, p.c - q.c]).collect();
    let worst = changes.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst < 1e-7, "{worst}: {changes:?}, {want:?}");
    assert!(changes.iter().fold(0.0, |most: f64, v| most.max(v.abs())) > 0.005);
}
