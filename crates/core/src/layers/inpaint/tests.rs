use proptest::prelude::*;

use super::*;
use crate::{Intrinsics, Tile, ViewBox};

/// How far in front of the layer a source may lie, and the distance behind it at which its weight is one half, both in δ.
const IN_FRONT: f64 = 0.015;
const BEHIND: f64 = 0.06;
/// A pixel has a mixed colour if it touches a surface that is nearer by more than this, in δ.
const TOUCH: f64 = 0.03;

/// A level of the pyramid: colour times weight, and weight, of each texel.
struct Plain {
    width: usize,
    height: usize,
    texels: Vec<[f64; 4]>,
}

/// Reference: colours, in levels, of the pixels of `win` on a layer, by the steps of RECIPE in `f64`, each step over a whole level of the
/// pyramid. `None` if no pixel is a source.
fn push_pull(photo: &Photo, geometry: &Geometry, tile: u32, plane: &Plane, win: Rect) -> Option<Vec<[f64; 3]>> {
    let (surface, place) = (geometry.surface(), TileFrame::of(&geometry.grid, tile));
    let (width, height) = (photo.width as i64, photo.height as i64);
    let shown = |x: i64, y: i64| f64::from(surface.all()[(y * width + x) as usize]);
    let is_mixed = |x: i64, y: i64| {
        let about = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy)));
        about.filter(|&(x, y)| (0..width).contains(&x) && (0..height).contains(&y)).any(|(nx, ny)| shown(nx, ny) - shown(x, y) > TOUCH)
    };
    let source = |i: usize| {
        let (x, y) = (win.x + i as u32 % win.w, win.y + i as u32 / win.w);
        let behind = f64::from(place.disparity(plane, x, y)) - shown(x.into(), y.into());
        let weight = 1.0 / (1.0 + (behind.max(0.0) / BEHIND).powi(2));
        let weight = if is_mixed(x.into(), y.into()) || behind < -IN_FRONT { 0.0 } else { weight };
        let [r, g, b] = photo.at(x, y).map(f64::from);
        [r, g, b, 1.0].map(|c| c * weight)
    };
    let mut levels = vec![Plain { width: win.w as usize, height: win.h as usize, texels: (0..win.area()).map(source).collect() }];
    while let Some(fine) = levels.last().filter(|l| l.width > 1 || l.height > 1) {
        let coarse = pulled(fine);
        levels.push(coarse);
    }
    let mut full = levels.pop()?;
    let weight = full.texels[0][3];
    if weight <= 0.0 {
        return None;
    }
    full.texels[0] = full.texels[0].map(|c| c / weight);
    for mut fine in levels.into_iter().rev() {
        for i in 0..fine.texels.len() {
            let behind = interpolated(&full, i % fine.width, i / fine.width);
            let weight = fine.texels[i][3];
            fine.texels[i] = std::array::from_fn(|k| fine.texels[i][k] + (1.0 - weight) * behind[k]);
        }
        full = fine;
    }
    Some(full.texels.iter().map(|t| [t[0], t[1], t[2]]).collect())
}

/// Sums of 2×2 texels, scaled to a weight of at most 1.
fn pulled(fine: &Plain) -> Plain {
    let (width, height) = (fine.width.div_ceil(2), fine.height.div_ceil(2));
    let mut texels = vec![[0.0; 4]; width * height];
    for (i, t) in fine.texels.iter().enumerate() {
        let at = i / fine.width / 2 * width + i % fine.width / 2;
        texels[at] = std::array::from_fn(|k| texels[at][k] + t[k]);
    }
    let texels = texels.into_iter().map(|t| t.map(|c| c / t[3].max(1.0))).collect();
    Plain { width, height, texels }
}

/// The coarser level at the centre of texel `(x, y)` of the finer one: bilinear between texel centres, clamped at the border.
fn interpolated(coarse: &Plain, x: usize, y: usize) -> [f64; 4] {
    let corner = |v: usize, n: usize| {
        let at = f64::midpoint(v as f64, 0.5) - 0.5;
        let low = at.floor();
        let inside = |v: f64| v.clamp(0.0, n as f64 - 1.0) as usize;
        (inside(low), inside(low + 1.0), at - low)
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (corner(x, coarse.width), corner(y, coarse.height));
    let at = |x: usize, y: usize, k: usize| coarse.texels[y * coarse.width + x][k];
    std::array::from_fn(|k| {
        let row = |y: usize| at(x0, y, k) * (1.0 - fx) + at(x1, y, k) * fx;
        row(y0) * (1.0 - fy) + row(y1) * fy
    })
}

/// A scene of small tiles with two or three planes in patches, and a noisy photo.
fn any_scene() -> impl Strategy<Value = (Photo, Geometry)> {
    let coefficients = prop::collection::vec([0.0..1.0f64, -0.1..0.1f64, -0.1..0.1f64], 2..4);
    (3u32..60, 3u32..60, 16u32..40, coefficients, 3u32..20, any::<u32>()).prop_map(|(width, height, size, slants, patch, seed)| {
        let grid = Grid::new(width, height, size);
        let mut planes: Vec<Plane> = slants.iter().map(|[a, b, c]| Plane { a: *a, b: *b, c: *c }.quantised()).collect();
        planes.sort_by(|p, q| p.a.total_cmp(&q.a));
        let noise =
            |i: u32, k: u32| (i.wrapping_mul(2_654_435_761).wrapping_add(k.wrapping_mul(40_503)) ^ seed).wrapping_mul(0x85EB_CA77) >> 24;
        let count = planes.len() as u32;
        let label = |x: u32, y: u32| (noise(x / patch + y / patch * 64, 9) % count) as u8;
        let tile = |t: u32| {
            let r = grid.rect(t);
            let labels = (0..r.area() as u32).map(|i| label(r.x + i % r.w, r.y + i / r.w)).collect();
            Tile { planes: planes.clone(), labels, background: Some(Plane::fronto_parallel(0.01).quantised()) }
        };
        let tiles = (0..grid.tiles()).map(tile).collect();
        let intrinsics = Intrinsics::centred(width, height, f64::from(width));
        let rgb = (0..width * height).map(|i| [1, 2, 3].map(|k| noise(i, k) as u8)).collect();
        (Photo { width, height, rgb }, Geometry { grid, intrinsics, view_box: ViewBox { x: 0.2, y: 0.2, z: 0.1 }, tiles, matte_band: 0 })
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Levels are stored in `f32`, so a colour may be off by a thousandth of a level; rounding can widen that to one level.
    #[test]
    fn hidden_colours_match_a_reference_pyramid((photo, geometry) in any_scene()) {
        let masks = geometry.masks();
        let got = Inpainter::new(&photo, &geometry).fill_all(&masks);
        for (t, (mask, colours)) in (0..).zip(masks.iter().zip(&got)) {
            for (layer, colours) in mask.layers.iter().zip(colours) {
                let hidden = || (0..layer.class.len() as u32).filter(|i| layer.class[*i as usize] == Class::Hidden as u8);
                let places: Vec<(u32, u32)> = hidden().map(|i| (layer.rect.x + i % layer.rect.w, layer.rect.y + i / layer.rect.w)).collect();
                prop_assert_eq!(places.len(), colours.len());
                let Some(bounds) = bounds(&places) else { continue };
                let win = crate::layers::grown(bounds, CONTEXT, CONTEXT, &geometry.grid);
                let Some(want) = push_pull(&photo, &geometry, t, &layer.plane, win) else {
                    prop_assert!(colours.iter().all(|c| *c == colours[0]), "one colour where nothing is a source");
                    continue;
                };
                for (&(x, y), got) in places.iter().zip(colours) {
                    let want = want[((y - win.y) * win.w + x - win.x) as usize];
                    let off = |k: usize| (f64::from(got[k]) - want[k]).abs();
                    prop_assert!((0..3).all(|k| off(k) <= 0.501), "tile {t} at {x}, {y}: {got:?}, not {want:?}");
                }
            }
        }
    }

    /// Each colour is a mean of the photo's colours for any planes, including NaN and infinity.
    #[test]
    fn a_photo_of_one_colour_hides_no_other_colour(
        colour in any::<[u8; 3]>(), planes in prop::collection::vec([wild(), wild(), wild()], 1..4), layer in [wild(), wild(), wild()],
        width in 1u32..40, height in 1u32..40,
    ) {
        let plane = |[a, b, c]: [f64; 3]| Plane { a, b, c };
        let grid = Grid::new(width, height, 64);
        let count = planes.len();
        let labels = (0..grid.rect(0).area()).map(|i| (i / 3 % count) as u8).collect();
        let scene = geometry(grid, planes.into_iter().map(plane).collect(), labels);
        let photo = Photo { width, height, rgb: vec![colour; (width * height) as usize] };
        let class = vec![Class::Hidden as u8; photo.rgb.len()];
        let colours = Inpainter::new(&photo, &scene).fill(0, &plane(layer), grid.rect(0), &class, &mut Pyramid::default());
        prop_assert_eq!(colours, photo.rgb);
    }
}

/// A plane coefficient, sometimes an invalid one.
fn wild() -> impl Strategy<Value = f64> {
    prop_oneof![6 => -1.0..1.0f64, 1 => prop::sample::select(vec![f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300, -1e300])]
}

/// The smallest rectangle around some positions; `None` if there are none.
fn bounds(places: &[(u32, u32)]) -> Option<Rect> {
    let (x0, x1) = (places.iter().map(|p| p.0).min()?, places.iter().map(|p| p.0).max()?);
    let (y0, y1) = (places.iter().map(|p| p.1).min()?, places.iter().map(|p| p.1).max()?);
    Some(Rect { x: x0, y: y0, w: x1 - x0 + 1, h: y1 - y0 + 1 })
}

fn geometry(grid: Grid, planes: Vec<Plane>, labels: Vec<u8>) -> Geometry {
    let tiles = vec![Tile { planes, labels, background: None }];
    Geometry { grid, intrinsics: Intrinsics::centred(grid.width, grid.height, 50.0), view_box: ViewBox::cube(0.03), tiles, matte_band: 0 }
}

#[test]
fn without_sources_the_fill_is_the_mean_of_the_layers_rectangle() {
    let photo = Photo { width: 8, height: 8, rgb: (0..64).map(|i| if i % 8 < 4 { [90, 80, 70] } else { [110, 80, 75] }).collect() };
    let grid = Grid::new(8, 8, 64);
    let b = geometry(grid, vec![Plane::fronto_parallel(0.9)], vec![0; 64]);
    let class = vec![Class::Hidden as u8; 64];
    let colours = Inpainter::new(&photo, &b).fill(0, &Plane::fronto_parallel(0.1), grid.rect(0), &class, &mut Pyramid::default());
    assert_eq!(colours, vec![[100, 80, 72]; 64]);
}
