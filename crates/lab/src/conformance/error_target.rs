//! Planes to an error target, placed anew or from those of the last frame: their exact errors, in δ and in pixels seen from the view box.

use tmpi_core::{DisparityMap, Grid, Intrinsics, Plane, Rect, Tile, TileFrame, ViewBox};
use tmpi_pipeline::planes::{Method, Placement, place, place_again};
use tmpi_pipeline::{Options, Parallax};
use tmpi_testing::pictures::noise;

use super::Checked;
use super::clustering::{GRID, METHODS};
use super::map_filters::map;

/// Parallax errors asked for, in pixels.
const TARGETS: [f64; 3] = [0.25, 1.0, 8.0];
const VIEW_BOX: ViewBox = ViewBox { x: 0.1, y: 0.06, z: 0.2 };
const FOCAL: f64 = 100.0;
/// What errors in `f32` of values up to 1 differ from the exact ones by.
const ROUNDING: f64 = 1e-6;
/// A tile keeps its planes while their error is at most this multiple of the target; a pixel keeps its plane until the square of another one's
/// error is smaller by that many squared targets.
const KEPT: (f64, f64) = (1.5, 4.0);

pub(super) fn run(checked: &mut Checked) {
    targets(checked, |map, grid, placement| place(map, None, grid, placement));
    pixels(checked, |k, view_box, rect| Parallax::new(k, view_box).most(rect));
    warm_start(checked, |map, grid, placement, tiles| place_again(map, None, grid, placement, tiles, |_| true));
}

fn figure(x: u32, y: u32) -> bool {
    (f64::from(x) - 40.0).hypot(f64::from(y) - 30.0) < 20.0
}

fn maps() -> Vec<(&'static str, DisparityMap)> {
    let slope = |x: u32, y: u32| 0.1 + 0.004 * x as f32 + 0.002 * y as f32;
    let rare = |x: u32, y: u32| (x + y * 90).is_multiple_of(173);
    vec![
        ("one value", map(90, 70, |_, _| 0.3)),
        ("a slope", map(90, 70, slope)),
        ("a figure before a slope", map(90, 70, |x, y| if figure(x, y) { 0.9 } else { slope(x, y) })),
        ("a bowl", map(90, 70, |x, y| 0.5 + 0.3 * (x as f32 / 14.0).sin() * (y as f32 / 11.0).cos())),
        ("noise", map(90, 70, noise)),
        ("noise of 1e-4", map(90, 70, |x, y| 0.5 + 1e-4 * noise(x, y))),
        ("outliers, fewer than one in a hundred", map(90, 70, |x, y| if rare(x, y) { 1.0 } else { 0.2 })),
        ("stripes of one pixel", map(90, 70, |x, _| (x % 4) as f32 / 4.0)),
        ("NaN, infinite and negative", map(90, 70, |x, y| [0.3, f32::NAN, f32::INFINITY, 0.35, -0.1][((x / 9 + y / 7) % 5) as usize])),
        ("all NaN", map(90, 70, |_, _| f32::NAN)),
        ("infinity and the nearest", map(90, 70, |x, _| f32::from(u8::from(x > 33)))),
        ("one row", map(200, 1, |x, _| (x % 37) as f32 / 37.0)),
        ("one column", map(1, 200, |_, y| y as f32 / 200.0)),
        ("one pixel", map(1, 1, |_, _| 0.7)),
    ]
}

/// The 99th percentile: one pixel in a hundred lies above it, or none.
fn percentile(mut errors: Vec<f64>) -> f64 {
    errors.sort_by(f64::total_cmp);
    errors[(errors.len() * 99 / 100).min(errors.len() - 1)]
}

/// Exact errors in δ of a tile's pixels; what is unknown counts as infinitely far. `error` takes those of all planes, and the label.
fn errors(map: &DisparityMap, grid: &Grid, index: u32, tile: &Tile, error: impl Fn(&[f64], usize) -> f64) -> Vec<f64> {
    let (r, frame) = (grid.rect(index), TileFrame::of(grid, index));
    let pixel = |(i, label): (u32, &u8)| {
        let (x, y) = (r.x + i % r.w, r.y + i / r.w);
        let known = f64::from(map.delta[(y * map.width + x) as usize]);
        let known = if known.is_finite() { known } else { 0.0 };
        let at = |v: u32, centre: f64| (f64::from(v) + 0.5 - centre) / frame.half;
        let off = |p: &Plane| (p.disparity(at(x, frame.centre.0), at(y, frame.centre.1)) - known).abs();
        error(&tile.planes.iter().map(off).collect::<Vec<_>>(), usize::from(*label))
    };
    if tile.labels.len() == r.area() { (0..).zip(&tile.labels).map(pixel).collect() } else { vec![f64::INFINITY] }
}

/// Exact errors of the planes that a tile's labels show.
fn shown(map: &DisparityMap, grid: &Grid, index: u32, tile: &Tile) -> f64 {
    percentile(errors(map, grid, index, tile, |all, label| all.get(label).copied().unwrap_or(f64::INFINITY)))
}

/// `kernel` places as few planes as meet a target, or as many as there may be.
pub(super) fn targets(checked: &mut Checked, kernel: impl Fn(&DisparityMap, &Grid, &Placement) -> Vec<Tile>) {
    for (name, map) in maps() {
        let grid = Grid::new(map.width, map.height, 64);
        let parallax = Parallax::new(Intrinsics::centred(map.width, map.height, FOCAL), VIEW_BOX);
        let most = parallax.most(Rect { x: 0, y: 0, w: map.width, h: map.height });
        for (plane_method, subject) in METHODS {
            let placement = |pixels: f64| Options { plane_method, ..Options::default() }.placement(pixels, most);
            let counts = 1..=placement(1.0).most;
            // the error of each tile with so many planes
            let fixed: Vec<Vec<f64>> = counts
                .map(|n| {
                    (0..)
                        .zip(&place(&map, None, &grid, &Placement::fixed(plane_method, n)))
                        .map(|(i, t)| shown(&map, &grid, i, t))
                        .collect()
                })
                .collect();
            for pixels in TARGETS {
                let placement = placement(pixels);
                let target = placement.target.unwrap_or(f64::NAN);
                let worst = |of: &dyn Fn(u32, &Tile) -> f64| {
                    let tiles = kernel(&map, &grid, &placement);
                    let each = (0..).zip(&tiles).map(|(i, t)| of(i, t));
                    if tiles.len() == grid.tiles() as usize { each.fold(0.0, f64::max) } else { f64::INFINITY }
                };
                let name = format!("{name}, to {pixels} pixels");
                checked.case("error target", &format!("{name}: beyond it"), subject, "δ", GRID + ROUNDING, || {
                    worst(&|i, tile| {
                        let reached = fixed.last().map_or(f64::NAN, |f| f[i as usize]);
                        shown(&map, &grid, i, tile) - target.max(reached)
                    })
                });
                checked.case("error target", &format!("{name}: fewer planes would do"), subject, "δ", GRID + ROUNDING, || {
                    worst(&|i, tile| fixed[..tile.planes.len() - 1].iter().map(|f| target - f[i as usize]).fold(0.0, f64::max))
                });
            }
        }
    }
}

/// Cameras at the corners of a view box, on its edges and faces, and within.
fn cameras(v: ViewBox) -> impl Iterator<Item = [f64; 3]> {
    let at = |i: u32| [i % 5, i / 5 % 5, i / 25].map(|i| f64::from(i) / 2.0 - 1.0);
    (0..125).map(at).map(move |[x, y, z]| [x * v.x, y * v.y, z * v.z])
}

/// Pixels between a place at disparity `a` and the same place at `b`, in a camera at `c`.
fn apart(k: &Intrinsics, place: [f64; 2], [a, b]: [f64; 2], c: [f64; 3]) -> f64 {
    let seen = |delta: f64| {
        // a point at depth 1/δ, times δ
        let p = [(place[0] - k.cx) / k.fx - delta * c[0], (place[1] - k.cy) / k.fy - delta * c[1], 1.0 - delta * c[2]];
        [k.fx * p[0] / p[2], k.fy * p[1] / p[2]]
    };
    let (a, b) = (seen(a), seen(b));
    (a[0] - b[0]).abs().max((a[1] - b[1]).abs())
}

/// `kernel` bounds the pixels for each unit of δ within a rectangle.
pub(super) fn pixels(checked: &mut Checked, kernel: impl Fn(Intrinsics, ViewBox, Rect) -> f64) {
    let beside = Intrinsics { fx: 80.0, fy: 120.0, cx: -30.0, cy: 200.0 };
    let boxes = [
        ("no view box", ViewBox { x: 0.0, y: 0.0, z: 0.0 }),
        ("the default view box", Options::VIEW_BOX),
        ("a view box of .1 × .06 × .2", VIEW_BOX),
        ("forward", ViewBox { x: 0.0, y: 0.0, z: 0.5 }),
        ("nearly up to a surface", ViewBox { x: 0.3, y: 0.0, z: 0.94 }),
    ];
    let all = [("centred", Intrinsics::centred(90, 70, FOCAL)), ("principal point outside", beside)];
    for (view, view_box) in boxes {
        for (camera, k) in all {
            for (name, rect) in [
                ("all", Rect { x: 0, y: 0, w: 90, h: 70 }),
                ("a tile", Rect { x: 26, y: 6, w: 64, h: 64 }),
                ("a pixel", Rect { x: 44, y: 34, w: 1, h: 1 }),
            ] {
                checked.case("parallax", &format!("{name}, {camera}, {view}"), "pixels of δ", "pixels", 1e-9, || {
                    let most = kernel(k, view_box, rect);
                    let places = (0..9).map(|i| {
                        [(rect.x, rect.w, i % 3), (rect.y, rect.h, i / 3)].map(|(from, n, i)| f64::from(from) + f64::from(n * i) / 2.0)
                    });
                    let pairs = [[0.0, 1.0], [0.99, 1.0], [0.5, 0.5], [0.0, 1e-6], [0.3, 0.7], [-0.1, 0.2]];
                    let beyond = |place: [f64; 2], of: [f64; 2], c: [f64; 3]| apart(&k, place, of, c) - most * (of[0] - of[1]).abs();
                    places.flat_map(|p| pairs.map(|of| cameras(view_box).map(|c| beyond(p, of, c)).fold(0.0, f64::max))).fold(0.0, f64::max)
                });
            }
        }
    }
}

/// Frames, each of which starts from the tiles of the one before.
fn films() -> Vec<(&'static str, Vec<DisparityMap>)> {
    let step = |at: u32, off: f32| map(90, 70, move |x, y| if x < at { 0.2 } else { 0.8 } + off * (noise(x, y) - 0.5));
    let of = |values: &[f32]| values.iter().map(|v| map(90, 70, |_, _| *v)).collect::<Vec<_>>();
    let sides = [(64, 64), (64, 1), (1, 64), (1, 1)];
    let mut films = vec![
        ("a step that moves", (0..5).map(|i| step(30 + 7 * i, 0.0)).collect()),
        ("noise that grows", (0..6).map(|i| step(30, 0.02 * i as f32)).collect()),
        ("a surface that comes near", of(&[0.2, 0.22, 0.25, 0.4, 1.0])),
        (
            "a slope that turns",
            (0..5u8).map(|i| map(90, 70, move |x, y| 0.3 + 0.001 * f32::from(i) * x as f32 + 0.002 * (y as f32))).collect(),
        ),
        (
            "a figure that comes and goes",
            [0, 1, 0, 1].map(|on| map(90, 70, move |x, y| if on == 1 && figure(x, y) { 0.9 } else { 0.3 })).into(),
        ),
        ("noise, each frame another", (0..4).map(|i| map(90, 70, move |x, y| noise(x, y + 100 * i))).collect()),
        ("NaN and back", of(&[0.4, f32::NAN, 0.4])),
        ("infinity and back", of(&[0.4, f32::INFINITY, 0.0, 0.4])),
    ];
    films.extend(
        sides.map(|(w, h)| ("noise on few pixels", (0..4).map(|i| map(w, h, move |x, y| noise(x, y + 70 * i))).collect::<Vec<_>>())),
    );
    films
}

/// `kernel` places the planes of tiles again. They keep to the target, or to what new planes reach.
pub(super) fn warm_start(checked: &mut Checked, kernel: impl Fn(&DisparityMap, &Grid, &Placement, &mut [Tile])) {
    for (name, frames) in films() {
        let (w, h) = (frames[0].width, frames[0].height);
        let grid = Grid::new(w, h, 64);
        for target in [0.0, 0.01, 0.05] {
            let placement = Placement::fewest(Method::Slanted, 6, target);
            let name = format!("{name}, {w}×{h}, target {target}");
            checked.case("warm start", &name, "place again", "δ beyond the target", GRID + ROUNDING, || {
                let mut tiles = vec![Tile::default(); grid.tiles() as usize];
                let off = |map: &DisparityMap, tiles: &[Tile]| {
                    let cold = place(map, None, &grid, &placement);
                    let one = |(i, (t, cold)): (u32, (&Tile, &Tile))| {
                        let kept = target * (KEPT.0.powi(2) + KEPT.1).sqrt();
                        shown(map, &grid, i, t) - shown(map, &grid, i, cold).max(kept)
                    };
                    (0..).zip(tiles.iter().zip(&cold)).map(one).fold(0.0, f64::max)
                };
                let frame = |map: &DisparityMap| {
                    kernel(map, &grid, &placement, &mut tiles);
                    off(map, &tiles)
                };
                frames.iter().map(frame).fold(0.0, f64::max)
            });
            checked.case("warm start", &format!("{name}, one frame"), "place again", "tiles unlike new ones", 0.0, || {
                let mut tiles = vec![Tile::default(); grid.tiles() as usize];
                kernel(&frames[0], &grid, &placement, &mut tiles);
                tiles.iter().zip(place(&frames[0], None, &grid, &placement)).filter(|(a, b)| *a != b).count() as f64
            });
        }
    }
}
