//! What readers make of planes and labels: which texels are there, which of them are seen, what colour hides behind.

use tmpi_core::{Class, Geometry, Grid, Intrinsics, LayerMasks, Photo, Plane, Rect, TexturedLayer, Tile, TileFrame, ViewBox, texture};
use tmpi_testing::pictures::noise;

use super::Checked;

pub(super) fn run(checked: &mut Checked) {
    visibility(checked, Geometry::masks_unpruned);
    pruning(checked, Geometry::masks);
    inpainting(checked, |photo, geometry| texture(photo, geometry, geometry.masks()));
}

/// A geometry of which every tile has `planes`, given in its own coordinates, and each pixel the label that `label` says.
pub(super) fn geometry((w, h): (u32, u32), size: u32, planes: &[Plane], label: impl Fn(u32, u32) -> u8) -> Geometry {
    let grid = Grid::new(w, h, size);
    let tile = |t: u32| {
        let r = grid.rect(t);
        let labels = (0..r.area() as u32).map(|i| label(r.x + i % r.w, r.y + i / r.w)).collect();
        Tile { planes: planes.iter().map(Plane::quantised).collect(), labels, background: None }
    };
    Geometry {
        grid,
        intrinsics: Intrinsics::centred(w, h, 100.0),
        view_box: ViewBox { x: 0.1, y: 0.06, z: 0.0 },
        tiles: (0..grid.tiles()).map(tile).collect(),
        matte_band: 0,
    }
}

fn photo(geometry: &Geometry) -> Photo {
    let (width, height) = (geometry.grid.width, geometry.grid.height);
    Photo { width, height, rgb: (0..width * height).map(|i| [i % 251, i / 3 % 241, i * 7 % 239].map(|v| v as u8)).collect() }
}

type Paint = fn(u32, u32) -> [u8; 3];
type Label = fn(u32, u32) -> u8;

/// Pixels of parallax over a box of .03 up to which a rim that folds is a crease.
const SEAM: f64 = 1.0;

const FLAT: fn(f64) -> Plane = Plane::fronto_parallel;

const SQUARE: Label = |x, y| u8::from((20..70).contains(&x) && (15..50).contains(&y));

fn geometries() -> Vec<(&'static str, Geometry)> {
    // in order, as containers have them
    let steep = [Plane { a: -0.1, b: 0.25, c: 0.0 }, Plane { a: 0.1, b: -0.25, c: 0.0 }];
    let many: Vec<Plane> =
        (0..64).map(|i| Plane { a: f64::from(i) / 64.0, b: f64::from(i % 5) / 40.0 - 0.05, c: f64::from(i % 3) / 50.0 }).collect();
    let two = [FLAT(0.2), FLAT(0.8)];
    vec![
        ("a square before a wall", geometry((100, 70), 64, &two, SQUARE)),
        ("crossing zero within a tile", geometry((100, 70), 64, &steep, |x, _| u8::from(x / 8 % 2 == 0))),
        (
            "a crease",
            geometry((64, 64), 64, &[Plane { a: 0.5, b: 0.3, c: 0.0 }, Plane { a: 0.501, b: -0.3, c: 0.1 }], |x, _| u8::from(x > 31)),
        ),
        ("near the horizon", geometry((100, 70), 64, &[FLAT(0.0), FLAT(0.0002)], SQUARE)),
        ("64 planes, labels of noise", geometry((100, 70), 64, &many, |x, y| (noise(x, y) * 64.0) as u8)),
        ("two values, labels of noise", geometry((100, 70), 32, &[FLAT(0.0), FLAT(1.0)], |x, y| (noise(x, y) * 2.0) as u8)),
        ("one row", geometry((300, 1), 64, &two, |x, _| u8::from(x / 10 % 2 == 0))),
        ("one column", geometry((1, 300), 64, &two, |_, y| u8::from(y / 10 % 2 == 0))),
        ("one pixel", geometry((1, 1), 64, &two, |_, _| 1)),
        ("a panorama", geometry((900, 40), 64, &two, |x, y| u8::from((x / 30 + y / 20) % 3 == 0))),
    ]
}

/// `kernel` finds the texels of all layers, seen or not: the photo's where a pixel lies on the layer, hidden ones where the layer lies behind
/// what shows, and else a rim of one pixel or nothing. A rim is as opaque as the 3 × 3 texels around are full, but all of it at a crease.
pub(super) fn visibility(checked: &mut Checked, kernel: impl Fn(&Geometry) -> Vec<LayerMasks>) {
    for (name, geometry) in geometries() {
        checked.case("visibility", name, "texels", "texels", 0.0, || {
            let masks = kernel(&geometry);
            if masks.len() != geometry.tiles.len() {
                return f64::INFINITY;
            }
            masks.iter().zip(0..).map(|(m, t)| wrong_texels(&geometry, t, m) as f64).sum()
        });
    }
}

/// Class of each texel of a layer over its whole tile, and its alpha.
fn texel(tile: Rect, masks: &LayerMasks, label: u8, at: (u32, u32)) -> (u8, u8) {
    let Some(layer) = masks.layers.iter().find(|l| l.label == Some(label)) else { return (0, 0) };
    let (x, y) = (tile.x + at.0, tile.y + at.1);
    let r = layer.rect;
    let within = (r.x..r.x + r.w).contains(&x) && (r.y..r.y + r.h).contains(&y);
    let i = within.then(|| ((y - r.y) * r.w + x - r.x) as usize);
    i.map_or((0, 0), |i| (layer.class[i], layer.alpha[i]))
}

fn wrong_texels(geometry: &Geometry, index: u32, masks: &LayerMasks) -> usize {
    let (tile, r, frame) = (&geometry.tiles[index as usize], geometry.grid.rect(index), TileFrame::of(&geometry.grid, index));
    let delta = |label: u8, (x, y): (u32, u32)| {
        let (u, v) = ((f64::from(r.x + x) + 0.5 - frame.centre.0) / frame.half, (f64::from(r.y + y) + 0.5 - frame.centre.1) / frame.half);
        tile.planes[usize::from(label)].disparity(u, v)
    };
    let shown = |(x, y): (u32, u32)| tile.labels[(y * r.w + x) as usize];
    let (across, down) = ViewBox::cube(0.03).parallax(&geometry.intrinsics, r);
    let usual = across.max(down);
    let mut wrong = 0;
    for label in 0..tile.planes.len() as u8 {
        for at in (0..r.h).flat_map(|y| (0..r.w).map(move |x| (x, y))) {
            let (class, alpha) = texel(r, masks, label, at);
            let (own, visible) = (delta(label, at), delta(shown(at), at));
            // a tie that rounding decides
            if shown(at) != label && ((own - visible).abs() < 1e-6 || own.abs() < 1e-6) {
                continue;
            }
            let columns = at.0.saturating_sub(1)..(at.0 + 2).min(r.w);
            let around: Vec<_> = (at.1.saturating_sub(1)..(at.1 + 2).min(r.h)).flat_map(|y| columns.clone().map(move |x| (x, y))).collect();
            let set = around.iter().filter(|p| shown(**p) == label || (0.0..delta(shown(**p), **p)).contains(&delta(label, **p))).count();
            let rim = || {
                let soft = (255.0 * set as f64 / around.len() as f64).round() as u8;
                // what shows at the rim has no texel behind this layer beside it
                let folds = |p: &(u32, u32)| shown(*p) == label && !(0.0..delta(label, *p)).contains(&delta(shown(at), *p));
                if (own - visible) * usual <= SEAM && around.iter().any(folds) { u8::MAX } else { soft }
            };
            let right = if shown(at) == label {
                (class, alpha) == (Class::Photo as u8, u8::MAX)
            } else if own >= 0.0 && own < visible {
                (class, alpha) == (Class::Hidden as u8, u8::MAX)
            } else if own > visible && set > 0 {
                (class, alpha) == (Class::Photo as u8, rim())
            } else {
                (class, alpha) == (Class::Empty as u8, 0)
            };
            wrong += usize::from(!right);
        }
    }
    wrong
}

/// `kernel` leaves out what no camera of the view box sees. With two parallel planes a camera looks past an edge by the parallax between them, so that
/// a texel is seen exactly where so near to it, right or down, the far plane shows.
pub(super) fn pruning(checked: &mut Checked, kernel: impl Fn(&Geometry) -> Vec<LayerMasks>) {
    let labels: [(&str, (u32, u32), Label); 6] = [
        ("a square before a wall", (128, 100), |x, y| u8::from((20..90).contains(&x) && (15..80).contains(&y))),
        ("one far pixel", (100, 80), |x, y| u8::from((x, y) != (50, 40))),
        ("noise of single pixels", (100, 80), |x, y| u8::from(noise(x, y) > 0.01)),
        ("a panorama of bars", (900, 30), |x, _| u8::from(x % 60 > 5)),
        ("one row", (400, 1), |x, _| u8::from(x % 70 > 2)),
        ("one column", (1, 400), |_, y| u8::from(y % 70 > 2)),
    ];
    for (name, size, label) in labels {
        for (far, near) in [(0.2, 0.8), (0.0, 1.0), (0.5, 0.55)] {
            let geometry = geometry(size, 64, &[FLAT(far), FLAT(near)], label);
            let (grid, step) = (geometry.grid, geometry.tiles[0].planes[1].a - geometry.tiles[0].planes[0].a);
            let reach = [geometry.intrinsics.fx * geometry.view_box.x * step, geometry.intrinsics.fy * geometry.view_box.y * step];
            // whether the far plane shows within so many pixels of the photo
            let near_far = |x: u32, y: u32, [dx, dy]: [f64; 2]| {
                let range = |at: u32, d: f64, side: u32| at.saturating_sub(d as u32)..(at + d as u32 + 1).min(side);
                range(y, dy, size.1).any(|y| range(x, dx, size.0).any(|x| label(x, y) == 0))
            };
            let count = |wrong: &dyn Fn(bool, u32, u32) -> bool| {
                let masks = kernel(&geometry);
                let tile = |t: u32| {
                    let r = grid.rect(t);
                    let pixels = (0..r.h).flat_map(|y| (0..r.w).map(move |x| (x, y)));
                    let hidden = pixels.filter(|&(x, y)| label(r.x + x, r.y + y) != 0);
                    let masks = &masks[t as usize];
                    hidden.filter(|&at| wrong(texel(r, masks, 0, at).0 == Class::Hidden as u8, r.x + at.0, r.y + at.1)).count()
                };
                (0..grid.tiles()).map(tile).sum::<usize>() as f64
            };
            let name = format!("{name}, δ {far} behind {near}");
            checked.case("pruning", &format!("{name}: seen and left out"), "texels", "texels", 0.0, || {
                count(&|kept, x, y| !kept && near_far(x, y, reach))
            });
            // two samples beside each other, and rounding up
            checked.case("pruning", &format!("{name}: never seen and kept"), "texels", "texels", 0.0, || {
                count(&|kept, x, y| kept && !near_far(x, y, reach.map(|r| r + 3.0)))
            });
        }
    }
}

/// `kernel` colours what is hidden: by what lies behind alone.
pub(super) fn inpainting(checked: &mut Checked, kernel: impl Fn(&Photo, &Geometry) -> Vec<Vec<TexturedLayer>>) {
    // a name, labels, far colours, the least and the greatest that may lie hidden, planes
    type Hidden = (&'static str, Label, Paint, [[u8; 3]; 2], [Plane; 2]);
    const WALL: [u8; 3] = [40, 50, 30];
    const HOLE: Label = |x, y| u8::from((x, y) != (50, 35));
    let colours = |geometry: &Geometry, label: Label, far: Paint| {
        let pixel = |x: u32, y: u32| {
            // what touches an edge counts as mixed, and fills nothing: a far colour stands there, too
            let near = (x.saturating_sub(2)..x + 3).all(|x| (y.saturating_sub(2)..y + 3).all(|y| label(x, y) == 1));
            if near { [250; 3] } else { far(x, y) }
        };
        Photo::from_fn(geometry.grid.width, geometry.grid.height, pixel)
    };
    let two = [FLAT(0.2), FLAT(0.8)];
    let cases: [Hidden; 5] = [
        ("one colour", SQUARE, |_, _| WALL, [WALL, WALL], two),
        ("noise", SQUARE, |x, y| [0, 100, 200].map(|s| (noise(x, y + s) * 60.0) as u8), [[0; 3], [59; 3]], two),
        ("a slope", SQUARE, |x, y| [x as u8, y as u8, 99], [[0, 0, 99], [100, 70, 99]], two),
        ("black at infinity", SQUARE, |_, _| [0; 3], [[0; 3]; 2], [FLAT(0.0), FLAT(1.0)]),
        // it touches what lies before it, so nothing fills
        ("a single far pixel", HOLE, |_, _| [20; 3], [[20; 3], [250; 3]], two),
    ];
    for (name, label, far, [least, most], planes) in cases {
        let geometry = geometry((100, 70), 64, &planes, label);
        checked.case("inpainting", &format!("{name} behind white"), "pyramid", "levels off", 0.0, || {
            let photo = colours(&geometry, label, far);
            let off = |p: &[u8; 3]| (0..3).map(|c| least[c].saturating_sub(p[c]).max(p[c].saturating_sub(most[c]))).max().unwrap_or(0);
            let layers = kernel(&photo, &geometry);
            let hidden = layers.iter().flatten().flat_map(|l| &l.hidden);
            // where nothing is hidden, nothing is checked
            hidden.map(off).max().map_or(f64::INFINITY, f64::from)
        });
    }
    checked.case("inpainting", "a colour for every hidden texel", "pyramid", "texels", 0.0, || {
        let one = |(_, geometry): (&str, Geometry)| {
            let layers = kernel(&photo(&geometry), &geometry);
            let hidden = |l: &TexturedLayer| l.shape.class.iter().filter(|c| **c == Class::Hidden as u8).count();
            layers.iter().flatten().map(|l| hidden(l).abs_diff(l.hidden.len())).sum::<usize>()
        };
        geometries().into_iter().map(one).sum::<usize>() as f64
    });
}
