use proptest::prelude::*;

use super::*;
use crate::scene::{Camera, Class, Plane, Pose, homography};
use crate::{LayerMasks, Tile};

/// Where a homography takes a point, and its `w`.
fn shown(pose: Pose, k: &Intrinsics, delta: f64, [x, y]: [f64; 2]) -> [f64; 3] {
    let camera = Camera { pose, intrinsics: *k, width: 1, height: 1 };
    let [u, v, w] = homography([0.0, 0.0, delta], k, &camera).map(|row| row[0] * x + row[1] * y + row[2]);
    [u / w, v / w, w]
}

/// The photo's point at which the ray of a camera through the texel at `p` with disparity `far` has disparity `s`.
fn crossed([x, y, z]: [f64; 3], k: &Intrinsics, p: [f64; 2], far: f64, s: f64) -> [f64; 2] {
    let from = [p[0] - k.cx, p[1] - k.cy];
    let by = [k.fx * x - z * from[0], k.fy * y - z * from[1]].map(|d| (s - far) * d / (1.0 - z * far));
    [p[0] + by[0], p[1] + by[1]]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    /// No camera of the box sees a texel past an edge beyond the bound, and the camera in a corner sees one exactly there.
    #[test]
    fn edges_that_uncover_a_texel_are_within_the_bound(
        extent in [0.0f64..1.0, 0.0f64..1.0, 0.0f64..1.0], at in [-1.0f64..=1.0, -1.0f64..=1.0, -1.0f64..=1.0],
        p in [0u32..4000, 0u32..3000], far in 0.0f64..1.0, near in 0.0f64..1.0, part in 0.0f64..=1.0,
    ) {
        prop_assume!(far < near);
        let k = Intrinsics { fx: 2300.0, fy: 2200.0, cx: 1990.0, cy: 1530.0 };
        let view_box = ViewBox { x: extent[0], y: extent[1], z: extent[2] };
        let rect = Rect { x: p[0], y: p[1], w: 1, h: 1 };
        let bound = view_box.uncovered(&k, rect, near, far);
        prop_assert!(bound.0.is_finite() && bound.0 >= 0.0 && bound.1.is_finite() && bound.1 >= 0.0);
        let place = p.map(|v| f64::from(v) + 0.5);
        let c = [at[0] * extent[0], at[1] * extent[1], at[2] * extent[2]];
        let s = far + part * (near - far);
        let edge = crossed(c, &k, place, far, s);
        // both points are one in the camera's picture
        let [texel, occluder] = [(far, place), (s, edge)].map(|(delta, at)| shown(Pose::at(c[0], c[1], c[2]), &k, delta, at));
        if occluder[2] > 1e-3 {
            prop_assert!((0..2).all(|i| (texel[i] - occluder[i]).abs() < 1e-6 * (1.0 + texel[i].abs())), "{texel:?} {occluder:?}");
        }
        prop_assert!((edge[0] - place[0]).abs() <= bound.0 + 1e-6 && (edge[1] - place[1]).abs() <= bound.1 + 1e-6);
        let side = |from: f64, c: f64, extent: f64| if from > c { -extent } else { extent };
        let corner = [side(place[0], k.cx, extent[0]), side(place[1], k.cy, extent[1]), extent[2]];
        let reached = crossed(corner, &k, place, far, near);
        // the bound is that of the pixel's farthest border
        let slack = (near - far) / (1.0 - extent[2] * far) * extent[2] + 1e-6;
        prop_assert!((reached[0] - place[0]).abs() >= bound.0 - slack && (reached[1] - place[1]).abs() >= bound.1 - slack);
    }

    /// Even boxes that reach into a surface, and sides that differ by rounding alone, have a bound.
    #[test]
    fn the_bound_is_never_more_than_the_way_to_the_camera(
        x in 0.0f64..10.0, z in prop_oneof![Just(0.999), Just(1.0), 0.0f64..10.0],
        near in 0.0f64..2.0, step in prop_oneof![Just(1e-16), Just(1e-8), 0.0f64..2.0],
    ) {
        let (k, rect) = (Intrinsics::centred(4000, 3000, 2320.0), Rect { x: 100, y: 0, w: 64, h: 64 });
        let far = (near - step).max(0.0);
        let bound = ViewBox { x, y: x, z }.uncovered(&k, rect, near, far);
        prop_assert!(bound.0 <= (near * k.fx * x + 1900.0) * (1.0 + 1e-9) && bound.1 <= (near * k.fy * x + 1500.0) * (1.0 + 1e-9));
        prop_assert!(bound.0 >= 0.0 && bound.1 >= 0.0 && (far < near || bound == (0.0, 0.0)));
    }
}

/// A wall behind a screen. All tiles have both planes.
struct Screen {
    geometry: Geometry,
    /// What the screen covers, or leaves open if it is a frame.
    xs: Range<u32>,
    ys: Range<u32>,
    is_frame: bool,
}

impl Screen {
    fn new((width, height): (u32, u32), [far, near]: [f64; 2], view_box: ViewBox, [xs, ys]: [Range<u32>; 2], is_frame: bool) -> Self {
        let grid = Grid::new(width, height, 64);
        let planes = [far, near].map(|d| Plane::fronto_parallel(d).quantised());
        let tile = |t: u32| {
            let r = grid.rect(t);
            let covered = |i: u32| (xs.contains(&(r.x + i % r.w)) && ys.contains(&(r.y + i / r.w))) != is_frame;
            Tile { planes: planes.into(), labels: (0..r.area() as u32).map(|i| u8::from(covered(i))).collect(), background: None }
        };
        let intrinsics = Intrinsics::centred(width, height, Intrinsics::DEFAULT_FOCAL_PER_WIDTH * f64::from(width));
        let tiles = (0..grid.tiles()).map(tile).collect();
        let geometry = Geometry { grid, intrinsics, view_box, tiles, matte_band: 0 };
        Self { geometry, xs, ys, is_frame }
    }

    /// A slab that leaves a quarter of the photo at the left and right, and some rows above it.
    fn slab((width, height): (u32, u32), planes: [f64; 2], view_box: ViewBox) -> Self {
        Self::new((width, height), planes, view_box, [width / 4..width - width / 4, 20..height], false)
    }

    /// Two walls that leave a quarter of the photo in the middle.
    fn frame((width, height): (u32, u32), planes: [f64; 2], view_box: ViewBox) -> Self {
        Self::new((width, height), planes, view_box, [width * 3 / 8..width - width * 3 / 8, 0..height], true)
    }

    fn covers(&self, [x, y]: [f64; 2]) -> bool {
        let within = |v: f64, range: &Range<u32>| v >= f64::from(range.start) && v < f64::from(range.end);
        (within(x, &self.xs) && within(y, &self.ys)) != self.is_frame
    }

    /// Whether any pixel within a distance of a pixel is not covered.
    fn opens(&self, (x, y): (u32, u32), dx: u32, dy: u32) -> bool {
        if self.is_frame {
            x < self.xs.end + dx && x + dx >= self.xs.start
        } else {
            x < self.xs.start + dx || x + dx >= self.xs.end || y < self.ys.start + dy
        }
    }

    /// Whether a camera in a corner of the box sees a texel of the wall, by its ray.
    fn is_seen(&self, place: [f64; 2]) -> bool {
        let Geometry { grid, intrinsics, view_box: b, tiles, .. } = &self.geometry;
        let [far, near] = [0, 1].map(|i| tiles[0].planes[i].a);
        (0..8).any(|i| {
            let side = |bit: u32, extent: f64| if i >> bit & 1 == 0 { extent } else { -extent };
            let [x, y] = crossed([side(0, b.x), side(1, b.y), side(2, b.z)], intrinsics, place, far, near);
            let in_photo = (0.0..f64::from(grid.width)).contains(&x) && (0.0..f64::from(grid.height)).contains(&y);
            in_photo && !self.covers([x, y])
        })
    }

    /// Of the wall's hidden texels: those that are seen and left out, and those that are kept although no edge is within the bound, the
    /// margin and a block.
    fn wrong(&self, masks: &[LayerMasks]) -> (usize, usize) {
        let Geometry { grid, intrinsics, view_box, tiles, .. } = &self.geometry;
        let [far, near] = [0, 1].map(|i| tiles[0].planes[i].a);
        let (mut missing, mut excess) = (0, 0);
        for (t, masks) in (0..).zip(masks) {
            let r = grid.rect(t);
            let (dx, dy) = view_box.uncovered(intrinsics, r, near, far);
            let [dx, dy] = [dx, dy].map(|d| (d + MARGIN).ceil() as u32 + BLOCK);
            for (x, y) in (r.y..r.y + r.h).flat_map(|y| (r.x..r.x + r.w).map(move |x| (x, y))) {
                let place = [f64::from(x) + 0.5, f64::from(y) + 0.5];
                if !self.covers(place) {
                    continue;
                }
                let kept = is_kept(masks, (x, y));
                missing += usize::from(!kept && self.is_seen(place));
                excess += usize::from(kept && !self.opens((x, y), dx, dy));
            }
        }
        (missing, excess)
    }
}

fn is_kept(masks: &LayerMasks, (x, y): (u32, u32)) -> bool {
    masks.layers.iter().find(|l| l.label == Some(0)).is_some_and(|l| {
        let r = l.rect;
        let within = (r.x..r.x + r.w).contains(&x) && (r.y..r.y + r.h).contains(&y);
        within && l.class[((y - r.y) * r.w + x - r.x) as usize] == Class::Hidden as u8
    })
}

#[test]
fn cameras_that_move_forward_see_no_gaps() {
    for (z, planes) in [(0.5, [0.5, 1.0]), (0.5, [0.8, 1.0]), (0.9, [0.85, 1.0]), (0.999, [0.95, 1.0])] {
        let frame = Screen::frame((1000, 160), planes, ViewBox { x: 0.02, y: 0.0, z });
        assert_eq!(frame.wrong(&frame.geometry.masks()), (0, 0), "{z} {planes:?}");
        // pruned for cameras that do not, it has gaps
        let sideways = Geometry { view_box: ViewBox { z: 0.0, ..frame.geometry.view_box }, ..frame.geometry.clone() };
        assert!(frame.wrong(&sideways.masks()).0 > 1000, "{z} {planes:?}: the fault is not noticed");
    }
}

#[test]
fn a_photo_of_4000_pixels_has_no_gaps_in_the_box_of_the_options() {
    let slab = Screen::slab((4000, 180), [0.05, 1.0], ViewBox { x: 0.12, y: 0.0, z: 0.06 });
    assert!(slab.geometry.searches_blocks() && slab.geometry.tiles_beyond_reach() == 0);
    let (all, kept) = (slab.geometry.masks_unpruned(), slab.geometry.masks());
    assert_eq!(slab.wrong(&kept), (0, 0));
    let hidden = |m: &LayerMasks| m.layers.iter().flat_map(|l| &l.class).filter(|c| **c == Class::Hidden as u8).count();
    for (all, kept) in all.iter().zip(&kept) {
        assert_eq!(kept.never_seen, hidden(all) - hidden(kept));
    }
    // pruned for a third of the box, it has gaps
    let narrow = Geometry { view_box: ViewBox { x: 0.04, y: 0.0, z: 0.02 }, ..slab.geometry.clone() };
    assert!(slab.wrong(&narrow.masks()).0 > 10_000);
}

#[test]
fn the_search_has_a_limit_and_says_in_how_many_tiles_it_bites() {
    let at = |extent: f64| Screen::slab((9000, 70), [0.0, 1.0], ViewBox { x: extent, y: 0.0, z: 0.0 }).geometry;
    assert_eq!((at(0.3).tiles_beyond_reach(), at(0.3).reach()), (0, (1568, 2)));
    assert_eq!((at(0.4).tiles_beyond_reach(), at(0.4).reach()), (at(0.4).tiles.len(), (MAX_REACH, 2)));
    // with a single plane, nothing is hidden
    let mut flat = at(0.4);
    flat.tiles.iter_mut().for_each(|t| t.planes.truncate(1));
    assert_eq!(flat.tiles_beyond_reach(), 0);
}

#[test]
fn bands_of_rows_have_the_texels_of_the_whole() {
    let slab = Screen::slab((1300, 700), [0.1, 1.0], ViewBox { x: 0.05, y: 0.25, z: 0.3 });
    let (geometry, whole) = (&slab.geometry, slab.geometry.masks());
    let (columns, reach) = (geometry.grid.columns(), geometry.reach().1);
    assert!(reach > FINE_REACH);
    for row in 0..geometry.grid.rows() {
        let surface = geometry.surface_of(pixel_rows(&geometry.grid, reach, &(row..row + 1)));
        let tiles = row * columns..(row + 1) * columns;
        assert_eq!(geometry.masks_of(tiles.clone(), &surface, false), whole[tiles.start as usize..tiles.end as usize]);
    }
}

#[test]
fn a_nearer_surface_in_the_neighbourhood_counts() {
    // tile 0: a wall behind a board; the board rises to the right, and ends there
    let grid = Grid::new(640, 64, 64);
    let tile = |t: u32| {
        let near = Plane::fronto_parallel(if t < 4 { 0.4 } else { 0.95 }).quantised();
        let r = grid.rect(t);
        let labels = (0..r.area() as u32).map(|i| u8::from(r.x + i % r.w < 300)).collect();
        Tile { planes: vec![Plane::fronto_parallel(0.1).quantised(), near], labels, background: None }
    };
    let (tiles, view_box) = ((0..grid.tiles()).map(tile).collect(), ViewBox { x: 0.3, y: 0.0, z: 0.0 });
    let geometry = Geometry { grid, intrinsics: Intrinsics::centred(640, 64, 300.0), view_box, tiles, matte_band: 0 };
    let masks = geometry.masks();
    // 0.85 · 90 pixels from the edge at 300 lies in tile 3, whose own surface uncovers only 27
    let kept = |x: u32| {
        let t = (0..grid.columns()).find(|t| (grid.rect(*t).x..grid.rect(*t).x + grid.rect(*t).w).contains(&x)).unwrap();
        is_kept(&masks[t as usize], (x, 32))
    };
    assert!(kept(299) && kept(300 - 76) && !kept(300 - 100));
}

/// `tests/browser/decode/reach.test.mjs` has the same cases, at least 96.
#[test]
fn the_reach_follows_from_the_camera_and_its_box() {
    let (grid, k) = (Grid::new(150, 100, 64), Intrinsics::centred(150, 100, 300.0));
    let reach = |y: f64, z: f64| farthest(&grid, &k, &ViewBox { x: 0.0, y, z }).1;
    assert_eq!([reach(0.0, 0.0), reach(0.03, 0.03), reach(1.0, 0.03), reach(0.5, 5.0), reach(10.0, 0.0)], [2, 12, 303, 202, 1664]);
}

#[test]
fn rows_of_tiles_depend_on_whole_blocks_within_the_reach() {
    let grid = Grid { width: 100, height: 3000, size: 64, stride: 56 };
    let rows = grid.tiles() / grid.columns();
    for reach in [2, FINE_REACH, 400] {
        let farthest = reach.max(FINE_REACH);
        let middle = pixel_rows(&grid, reach, &(20..22));
        assert!(middle.start <= 20 * 56 - farthest && middle.start + BLOCK > 20 * 56 - farthest && middle.start.is_multiple_of(BLOCK));
        assert!(middle.end >= 21 * 56 + 64 + farthest && middle.end < 21 * 56 + 64 + farthest + BLOCK && middle.end.is_multiple_of(BLOCK));
        assert_eq!(pixel_rows(&grid, reach, &(0..1)).start, 0);
        assert_eq!(pixel_rows(&grid, reach, &(rows - 1..rows)).end, 3000);
    }
}

#[test]
fn work_counts_every_plane_and_the_window_once_more() {
    let grid = Grid { width: 300, height: 64, size: 64, stride: 64 };
    let window = |i: u32| u64::from((i * 64 + 64 + FINE_REACH).min(300) - (i * 64).saturating_sub(FINE_REACH)) * 64;
    // the blocks of the whole photo
    let blocks = (300 * 64u64).div_ceil(32 * 32);
    let want: u64 = [3u64, 0, 1, 2, 5].iter().zip(0..).map(|(n, i)| (window(i).min(300 * 64) + blocks) * (n + 1)).sum();
    assert_eq!(work_of(&grid, [3, 0, 1, 2, 5].into_iter()), want);
}
