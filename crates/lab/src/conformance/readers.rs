//! What readers make of planes and labels: which texels are there, which of them are seen, what colour hides behind; and how all of it is
//! written and cut.

use tmpi_core::container::{self, EncodedPhoto, OptionalSections, RegionPhoto, TileRect};
use tmpi_core::{
    Class, Geometry, Grid, Intrinsics, LayerMasks, Photo, Plane, Rect, Scene, Texels, TexturedLayer, Tile, TileFrame, ViewBox, texture,
};

use super::Checked;

pub(super) fn run(checked: &mut Checked) {
    visibility(checked, Geometry::masks_unpruned);
    pruning(checked, Geometry::masks);
    inpainting(checked, |photo, geometry| texture(photo, geometry, geometry.masks()));
    codecs(checked, |geometry| written(&photo(geometry), geometry).and_then(|file| container::read_geometry(&file).ok()));
    levels(checked, |file, level| container::level(file, level).ok());
    regions(checked, |file, tiles| container::region(file, tiles, 0, RegionPhoto::Lossless).ok());
}

/// 32 bits that look like noise.
fn mixed(i: u32) -> u32 {
    let i = i.wrapping_mul(2_654_435_761);
    (i ^ (i >> 15)).wrapping_mul(0x2C1B_3C6D) ^ (i >> 12)
}

/// A geometry of which every tile has `planes`, given in its own coordinates, and each pixel the label that `label` says.
fn geometry((w, h): (u32, u32), size: u32, planes: &[Plane], label: impl Fn(u32, u32) -> u8) -> Geometry {
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
        matted: false,
    }
}

fn photo(geometry: &Geometry) -> Photo {
    let (width, height) = (geometry.grid.width, geometry.grid.height);
    Photo { width, height, rgb: (0..width * height).map(|i| [i % 251, i / 3 % 241, i * 7 % 239].map(|v| v as u8)).collect() }
}

fn written(photo: &Photo, geometry: &Geometry) -> Option<Vec<u8>> {
    let Geometry { grid, intrinsics, view_box, .. } = *geometry;
    let photo_file = EncodedPhoto::lossless(photo).ok()?;
    let scene = Scene { grid, intrinsics, view_box, photo: photo.clone(), layers: Vec::new(), texels: Texels::default() };
    container::encode(geometry, &scene, &photo_file, OptionalSections::default()).ok().map(|file| file.0)
}

/// Colour of a pixel.
type Paint = fn(u32, u32) -> [u8; 3];

const FLAT: fn(f64) -> Plane = Plane::fronto_parallel;

fn geometries() -> Vec<(&'static str, Geometry)> {
    let square = |x: u32, y: u32| u8::from((20..70).contains(&x) && (15..50).contains(&y));
    // in order, as containers have them
    let steep = [Plane { a: -0.1, b: 0.25, c: 0.0 }, Plane { a: 0.1, b: -0.25, c: 0.0 }];
    let many: Vec<Plane> =
        (0..64).map(|i| Plane { a: f64::from(i) / 64.0, b: f64::from(i % 5) / 40.0 - 0.05, c: f64::from(i % 3) / 50.0 }).collect();
    let two = [FLAT(0.2), FLAT(0.8)];
    vec![
        ("a square before a wall", geometry((100, 70), 64, &two, square)),
        ("crossing zero within a tile", geometry((100, 70), 64, &steep, |x, _| u8::from(x / 8 % 2 == 0))),
        ("near the horizon", geometry((100, 70), 64, &[FLAT(0.0), FLAT(0.0002)], square)),
        ("64 planes, labels of noise", geometry((100, 70), 64, &many, |x, y| (mixed(x * 71 + y) % 64) as u8)),
        ("two values, labels of noise", geometry((100, 70), 32, &[FLAT(0.0), FLAT(1.0)], |x, y| (mixed(x * 71 + y) % 2) as u8)),
        ("one row", geometry((300, 1), 64, &two, |x, _| u8::from(x / 10 % 2 == 0))),
        ("one column", geometry((1, 300), 64, &two, |_, y| u8::from(y / 10 % 2 == 0))),
        ("one pixel", geometry((1, 1), 64, &two, |_, _| 1)),
        ("a panorama", geometry((900, 40), 64, &two, |x, y| u8::from((x / 30 + y / 20) % 3 == 0))),
    ]
}

/// `kernel` finds the texels of all layers, seen or not: the photo's where a pixel lies on the layer, hidden ones where the layer lies behind
/// what shows, and else a rim of one pixel or nothing.
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
    let mut wrong = 0;
    for label in 0..tile.planes.len() as u8 {
        for at in (0..r.h).flat_map(|y| (0..r.w).map(move |x| (x, y))) {
            let (class, alpha) = texel(r, masks, label, at);
            let (own, visible) = (delta(label, at), delta(shown(at), at));
            // a tie that rounding decides
            if shown(at) != label && ((own - visible).abs() < 1e-6 || own.abs() < 1e-6) {
                continue;
            }
            let opaque = |x: u32, y: u32| {
                let (class, alpha) = texel(r, masks, label, (x, y));
                class != Class::Empty as u8 && alpha == u8::MAX
            };
            let beside = || {
                let columns = at.0.saturating_sub(1)..(at.0 + 2).min(r.w);
                (at.1.saturating_sub(1)..(at.1 + 2).min(r.h)).any(|y| columns.clone().any(|x| (x, y) != at && opaque(x, y)))
            };
            let right = if shown(at) == label {
                (class, alpha) == (Class::Photo as u8, u8::MAX)
            } else if own >= 0.0 && own < visible {
                class == Class::Hidden as u8
            } else {
                class == Class::Empty as u8 || (class == Class::Photo as u8 && own > visible && beside())
            };
            wrong += usize::from(!right);
        }
    }
    wrong
}

/// `kernel` leaves out what no camera of the view box sees. With two parallel planes a camera looks past an edge by the parallax between them, so that
/// a texel is seen exactly where so near to it, right or down, the far plane shows.
pub(super) fn pruning(checked: &mut Checked, kernel: impl Fn(&Geometry) -> Vec<LayerMasks>) {
    type Label = fn(u32, u32) -> u8;
    let labels: [(&str, (u32, u32), Label); 6] = [
        ("a square before a wall", (128, 100), |x, y| u8::from((20..90).contains(&x) && (15..80).contains(&y))),
        ("one far pixel", (100, 80), |x, y| u8::from((x, y) != (50, 40))),
        ("noise of single pixels", (100, 80), |x, y| u8::from(!mixed(x * 93 + y).is_multiple_of(97))),
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
    const WALL: [u8; 3] = [40, 50, 30];
    let two = [FLAT(0.2), FLAT(0.8)];
    let square = |x: u32, y: u32| u8::from((20..70).contains(&x) && (15..50).contains(&y));
    let colours = |geometry: &Geometry, far: &dyn Fn(u32, u32) -> [u8; 3]| {
        let (w, h) = (geometry.grid.width, geometry.grid.height);
        let pixel = |x: u32, y: u32| {
            // what touches an edge counts as mixed, and fills nothing: a far colour stands there, too
            let near = (x.saturating_sub(2)..x + 3).all(|x| (y.saturating_sub(2)..y + 3).all(|y| square(x, y) == 1));
            if near { [250; 3] } else { far(x, y) }
        };
        Photo { width: w, height: h, rgb: (0..w * h).map(|i| pixel(i % w, i / w)).collect() }
    };
    let cases: [(&str, Paint, [[u8; 3]; 2]); 3] = [
        ("one colour", |_, _| WALL, [WALL, WALL]),
        ("noise", |x, y| [0, 8, 16].map(|s| ((mixed(x * 71 + y) >> s) % 60) as u8), [[0; 3], [59; 3]]),
        ("a slope", |x, y| [x as u8, y as u8, 99], [[0, 0, 99], [100, 70, 99]]),
    ];
    for (name, far, [least, most]) in cases {
        let geometry = geometry((100, 70), 64, &two, square);
        checked.case("inpainting", &format!("{name} behind white"), "pyramid", "levels off", 0.0, || {
            let photo = colours(&geometry, &far);
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

/// What of two geometries differs: labels, and planes of any tile.
fn differences(a: &Geometry, b: &Geometry) -> f64 {
    if a.grid != b.grid || a.tiles.len() != b.tiles.len() {
        return f64::INFINITY;
    }
    let labels =
        |(a, b): (&Tile, &Tile)| a.labels.iter().zip(&b.labels).filter(|(a, b)| a != b).count() + a.labels.len().abs_diff(b.labels.len());
    let planes = |(a, b): (&Tile, &Tile)| usize::from(a.planes != b.planes || a.background != b.background);
    a.tiles.iter().zip(&b.tiles).map(|pair| labels(pair) + planes(pair)).sum::<usize>() as f64
}

/// `kernel` writes planes and labels and reads them again, by the range coder.
pub(super) fn codecs(checked: &mut Checked, kernel: impl Fn(&Geometry) -> Option<Geometry>) {
    let ends =
        [Plane { a: -1.999, b: -2.0, c: 1.999 }, Plane { a: 0.0, b: Plane::STEP, c: -Plane::STEP }, Plane { a: 1.999, b: 1.999, c: -2.0 }];
    let none = [FLAT(0.0)];
    let two = [FLAT(0.2), FLAT(0.8)];
    let more = [
        ("planes at the ends of their range", geometry((200, 130), 64, &ends, |x, y| ((x / 9 + y / 7) % 3) as u8)),
        // the likeliest symbol over and over, then the least likely one
        ("one label, and one other pixel at the end", geometry((640, 480), 64, &two, |x, y| u8::from((x, y) == (639, 479)))),
        ("one plane in each of 10 000 tiles", geometry((700, 700), 8, &none, |_, _| 0)),
        ("labels that change with each pixel", geometry((300, 200), 64, &two, |x, y| ((x + y) % 2) as u8)),
        ("long runs of different labels", geometry((640, 480), 64, &ends, |x, y| ((x / 200 + y / 150) % 3) as u8)),
    ];
    for (name, geometry) in geometries().into_iter().chain(more) {
        checked.case("codecs", name, "planes and labels", "pixels", 0.0, || {
            kernel(&geometry).map_or(f64::INFINITY, |got| differences(&got, &geometry))
        });
    }
}

/// `kernel` gives a container at half the size, so many times over.
pub(super) fn levels(checked: &mut Checked, kernel: impl Fn(&[u8], u8) -> Option<Vec<u8>>) {
    for (name, geometry) in geometries() {
        let photo = photo(&geometry);
        checked.case("levels", name, "labels of half the size", "pixels", 0.0, || {
            let Some(half) =
                written(&photo, &geometry).and_then(|file| kernel(&file, 1)).and_then(|file| container::read_geometry(&file).ok())
            else {
                return f64::INFINITY;
            };
            half.tiles.iter().zip(0..).map(|(tile, t)| wrong_votes(&geometry, &half, t, tile) as f64).sum()
        });
        checked.case("levels", name, "photo of half the size", "levels, deviation", 12.0, || {
            let Some((small, _)) =
                written(&photo, &geometry).and_then(|file| kernel(&file, 1)).and_then(|file| container::read(&file).ok())
            else {
                return f64::INFINITY;
            };
            let value = |x: u32, y: u32, c: usize| f64::from(photo.at(x.min(photo.width - 1), y.min(photo.height - 1))[c]);
            let off = |i: usize, c: usize| {
                let (x, y) = (2 * (i as u32 % small.width), 2 * (i as u32 / small.width));
                let mean = (value(x, y, c) + value(x + 1, y, c) + value(x, y + 1, c) + value(x + 1, y + 1, c)) / 4.0;
                (f64::from(small.rgb[i][c]) - mean).powi(2)
            };
            let n = small.rgb.len();
            // it is a JPEG of quality 90, of colours that change from pixel to pixel
            ((0..n).map(|i| (0..3).map(|c| off(i, c)).sum::<f64>()).sum::<f64>() / (3 * n).max(1) as f64).sqrt()
        });
    }
}

/// Pixels of a tile of half the size whose plane is not one that most of the four above it lie on, or not there.
fn wrong_votes(whole: &Geometry, half: &Geometry, index: u32, tile: &Tile) -> usize {
    let (from, r, to) = (&whole.tiles[index as usize], whole.grid.rect(index), half.grid.rect(index));
    if half.grid.size * 2 != whole.grid.size {
        return usize::MAX >> 12;
    }
    let wrong = |i: u32| {
        let (x, y) = (2 * (i % to.w), 2 * (i / to.w));
        let four =
            [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| from.labels[((y + dy).min(r.h - 1) * r.w + (x + dx).min(r.w - 1)) as usize]);
        let votes = |l: u8| four.iter().filter(|k| **k == l).count();
        let most = four.iter().map(|l| votes(*l)).max().unwrap_or(0);
        let shown = tile.planes[usize::from(tile.labels[i as usize])];
        // of equals the nearest, whose label is the highest
        let want = four.into_iter().filter(|l| votes(*l) == most).max().unwrap_or(0);
        from.planes[usize::from(want)] != shown
    };
    (0..to.area() as u32).filter(|i| wrong(*i)).count()
}

/// `kernel` cuts some tiles out of a container.
pub(super) fn regions(checked: &mut Checked, kernel: impl Fn(&[u8], &TileRect) -> Option<Vec<u8>>) {
    for (name, geometry) in geometries() {
        let (photo, grid) = (photo(&geometry), geometry.grid);
        let (columns, rows) = (grid.columns() / 2..grid.columns(), 0..grid.rows().div_ceil(2));
        let (rect, part) = grid.part(columns.clone(), rows.clone());
        checked.case("regions", name, "tiles and photo", "pixels", 0.0, || {
            let tiles = TileRect { columns: columns.clone(), rows: rows.clone() };
            let Some((got_photo, got)) =
                written(&photo, &geometry).and_then(|file| kernel(&file, &tiles)).and_then(|file| container::read(&file).ok())
            else {
                return f64::INFINITY;
            };
            let all = rows.clone().flat_map(|row| columns.clone().map(move |column| row * grid.columns() + column));
            let k = geometry.intrinsics;
            let want = Geometry {
                grid: part,
                intrinsics: Intrinsics { cx: k.cx - f64::from(rect.x), cy: k.cy - f64::from(rect.y), ..k },
                tiles: all.map(|t| geometry.tiles[t as usize].clone()).collect(),
                ..geometry
            };
            if got.intrinsics != want.intrinsics || got_photo.rgb.len() != rect.area() {
                return f64::INFINITY;
            }
            let pixel = |i: usize| got_photo.rgb[i] != photo.at(rect.x + i as u32 % rect.w, rect.y + i as u32 / rect.w);
            differences(&got, &want) + (0..got_photo.rgb.len()).filter(|i| pixel(*i)).count() as f64
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::failed;
    use super::*;

    /// Masks of which one texel of a far layer is changed.
    fn spoilt(mut masks: Vec<LayerMasks>, from: Class, to: Class) -> Vec<LayerMasks> {
        let mut classes = masks.iter_mut().flat_map(|m| &mut m.layers).filter(|l| l.label == Some(0)).flat_map(|l| &mut l.class);
        if let Some(class) = classes.find(|c| **c == from as u8) {
            *class = to as u8;
        }
        masks
    }

    #[test]
    fn a_fault_of_each_kernel_is_caught() {
        assert!(failed(|c| visibility(c, |g| spoilt(g.masks_unpruned(), Class::Hidden, Class::Empty))) > 0);
        assert!(failed(|c| visibility(c, |g| spoilt(g.masks_unpruned(), Class::Photo, Class::Hidden))) > 0);
        // texels of a smaller and of a larger view box
        let of = |g: &Geometry, x: f64| Geometry { view_box: ViewBox { x, ..g.view_box }, ..g.clone() }.masks();
        assert!(failed(|c| pruning(c, |g| of(g, 0.07))) > 0);
        assert!(failed(|c| pruning(c, |g| of(g, 0.15))) > 0);
        let near_colours = |photo: &Photo, g: &Geometry| {
            let mut layers = texture(photo, g, g.masks());
            layers.iter_mut().flatten().filter_map(|l| l.hidden.first_mut()).for_each(|p| *p = [250; 3]);
            layers
        };
        assert!(failed(|c| inpainting(c, near_colours)) > 0);
        let one_label = |g: &Geometry| {
            let mut g = g.clone();
            *g.tiles.last_mut()?.labels.last_mut()? ^= 1;
            Some(g)
        };
        assert!(failed(|c| codecs(c, one_label)) > 0);
        assert!(failed(|c| levels(c, |file, _| Some(file.to_vec()))) > 0);
        let one_less = |file: &[u8], tiles: &TileRect| {
            let tiles =
                TileRect { columns: tiles.columns.start..(tiles.columns.end - 1).max(tiles.columns.start + 1), rows: tiles.rows.clone() };
            container::region(file, &tiles, 0, RegionPhoto::Lossless).ok()
        };
        assert!(failed(|c| regions(c, one_less)) > 0);
    }
}
