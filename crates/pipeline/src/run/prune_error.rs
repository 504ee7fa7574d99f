//! Measures the effect of pruning: draws what it leaves out, in views from the view box.

use std::sync::Arc;

use rayon::prelude::*;

use tmpi_core::{
    Camera, Class, Geometry, Grid, Intrinsics, LayerMask, LayerMasks, Photo, Plane, Pose, Rect, Scene, TexturedLayer, Tile, compose,
};
use tmpi_render::{Cpu, RenderError, Renderer};

use super::{Parallax, PruneError};

/// Longest side of the compared views, in pixels.
const SIDE: u32 = 512;

/// A pixel counts as changed if texels that are left out take more than this many levels of it.
const LEVELS: u8 = 8;

/// Draws what pruning leaves out, from the corners of the view box and the centres of its faces.
///
/// # Errors
/// [`RenderError`] if a view cannot be drawn.
pub fn verify(geometry: &Geometry) -> Result<PruneError, RenderError> {
    compare(geometry, &Geometry::masks, &cameras(geometry))
}

/// One of this many tiles is in a part that [`sample`] compares, unless a single part takes more.
const SHARE: u32 = 16;
/// Fewest tiles of a photo that is sampled.
const FEWEST: u32 = 32;
/// Largest parallax between near and far, in pixels, that a part is made for: that of the default view box on a photo of 1600 pixels.
const MAX_PARALLAX: f64 = 160.0;
/// Pixels around a texel that a view blends with it, and rounding.
const FOOTPRINT: f64 = 2.0;
/// One of this many pixels tells which planes a tile shows; no divisor of a usual tile size, so that all columns count.
const LABEL_STEP: usize = 7;

/// Like [`verify`], but on parts of the photo, seen from two opposite corners of the view box, or from so far on the way to them as
/// [`MAX_PARALLAX`] allows. A part is a tile and all around it that parallax moves across. Of every stretch of tiles it is the tile with
/// the largest step in depth, where pruning matters most. Returns `None` if the photo has fewer than 32 tiles, so that this would not be
/// quick compared to making, or fewer than two rows or columns of tiles.
///
/// # Errors
/// [`RenderError`] if a view cannot be drawn.
pub fn sample(geometry: &Geometry) -> Result<Option<PruneError>, RenderError> {
    sample_of(geometry, &Geometry::masks)
}

/// [`sample`] of pruning by `masks`.
fn sample_of(geometry: &Geometry, masks: &Masks) -> Result<Option<PruneError>, RenderError> {
    let (grid, tiles) = (&geometry.grid, geometry.tiles.len() as u32);
    if tiles < FEWEST || grid.columns() < 2 || grid.rows() < 2 {
        return Ok(None);
    }
    let reach = Reach::of(geometry);
    let side = 2 * reach.tiles(grid) + 1;
    let stretch = SHARE * side.min(grid.columns()) * side.min(grid.rows());
    let starts: Vec<u32> = (0..tiles).step_by(stretch as usize).collect();
    let one = |start: &u32| {
        let all = *start..(start + stretch).min(tiles);
        // the first on ties
        let deepest =
            all.rev().map(|tile| (tile, step(geometry, tile))).max_by(|a, b| a.1.total_cmp(&b.1)).map_or(*start, |(tile, _)| tile);
        let Part { geometry, tile } = Part::around(geometry, deepest, reach.tiles(grid));
        compare(&geometry, masks, &[1.0, -1.0].map(|side| reach.camera(&geometry, tile, side)))
    };
    let changes = starts.par_iter().map(one).collect::<Result<Vec<PruneError>, _>>()?;
    Ok(changes.into_iter().reduce(|a, b| PruneError {
        max_abs: a.max_abs.max(b.max_abs),
        share_off: a.share_off.max(b.share_off),
        tiles: a.tiles + b.tiles,
    }))
}

/// Derives the kept texels of a geometry.
type Masks = dyn Fn(&Geometry) -> Vec<LayerMasks> + Sync;

/// Largest step in depth within a tile: between the nearest and the farthest plane that it shows, or its background, at its centre.
fn step(geometry: &Geometry, tile: u32) -> f64 {
    let Tile { planes, labels, background } = &geometry.tiles[tile as usize];
    let mut shown = [false; 1 << u8::BITS];
    for label in labels.iter().step_by(LABEL_STEP) {
        shown[usize::from(*label)] = true;
    }
    let all = || planes.iter().zip(shown).filter(|(_, shown)| *shown).map(|(p, _)| p).chain(background).map(|p| p.a);
    all().fold(f64::NEG_INFINITY, f64::max) - all().fold(f64::INFINITY, f64::min)
}

/// How far the surfaces of a photo move apart in views from the view box.
#[derive(Clone, Copy)]
struct Reach {
    /// Disparity midway between the farthest and the nearest surface.
    middle: f64,
    /// How far cameras go to the corners of the view box, as a share of the way.
    share: f64,
    /// Parallax in pixels between the farthest and the nearest surface, from there.
    apart: f64,
}

impl Reach {
    fn of(geometry: &Geometry) -> Self {
        let grid = &geometry.grid;
        let ends = |p: &Plane| [p.a - p.b.abs() - p.c.abs(), p.a + p.b.abs() + p.c.abs()].map(|d| d.clamp(0.0, 1.0));
        let planes = geometry.tiles.iter().flat_map(|t| t.planes.iter().chain(&t.background));
        let (far, near) = planes.flat_map(ends).fold((1.0, 0.0), |(far, near), d| (f64::min(far, d), f64::max(near, d)));
        let all = Rect { x: 0, y: 0, w: grid.width, h: grid.height };
        let most = Parallax::new(geometry.intrinsics, geometry.view_box).most(all) * (near - far).max(0.0);
        let share = if most > MAX_PARALLAX { MAX_PARALLAX / most } else { 1.0 };
        Self { middle: f64::midpoint(far, near), share, apart: most * share }
    }

    /// Tiles to each side of a tile that are in views of it. Edges that uncover texels there are among them: on its way to a texel, a ray
    /// passes such an edge at a disparity between those of the nearest and the farthest surface.
    fn tiles(&self, grid: &Grid) -> u32 {
        ((self.apart + FOOTPRINT + f64::from(grid.size)) / f64::from(grid.stride)) as u32
    }

    /// A camera near the corner of the view box on this `side`, 1 or -1. Its picture is as large as the tile and half the parallax around
    /// it, and has the tile in the middle.
    fn camera(&self, geometry: &Geometry, tile: u32, side: f64) -> Camera {
        let (k, v, by) = (&geometry.intrinsics, geometry.view_box, side * self.share);
        let pose = Pose::at(by * v.x, by * v.y, by * v.z);
        let (centre, closer) = (geometry.grid.centre(tile), 1.0 - pose.tz * self.middle);
        let size = (f64::from(geometry.grid.size) + self.apart).ceil();
        // where the middle of the tile would be seen, less half the picture
        let left = (centre.0 - k.cx - k.fx * pose.tx * self.middle) / closer + k.cx - size / 2.0;
        let top = (centre.1 - k.cy - k.fy * pose.ty * self.middle) / closer + k.cy - size / 2.0;
        let intrinsics = Intrinsics { cx: k.cx - left, cy: k.cy - top, ..*k };
        Camera { pose, intrinsics, width: size as u32, height: size as u32 }
    }
}

/// Tiles cut out as a photo of their own.
struct Part {
    geometry: Geometry,
    /// Index of the tile that it was cut around.
    tile: u32,
}

impl Part {
    /// A tile and so many tiles to each side.
    fn around(geometry: &Geometry, tile: u32, by: u32) -> Self {
        let Geometry { grid, intrinsics: k, view_box, tiles, .. } = geometry;
        let (column, row) = (tile % grid.columns(), tile / grid.columns());
        let around = |at: u32, count: u32| at.saturating_sub(by)..(at + by + 1).min(count);
        let (columns, rows) = (around(column, grid.columns()), around(row, grid.rows()));
        let (rect, own) = grid.part(columns.clone(), rows.clone());
        let index = |row: u32| columns.clone().map(move |column| row * grid.columns() + column);
        let tiles = rows.clone().flat_map(index).map(|i| tiles[i as usize].clone()).collect();
        let intrinsics = Intrinsics { cx: k.cx - f64::from(rect.x), cy: k.cy - f64::from(rect.y), ..*k };
        Self {
            geometry: Geometry { grid: own, intrinsics, view_box: *view_box, tiles, matte_band: 0 },
            tile: (row - rows.start) * own.columns() + column - columns.start,
        }
    }
}

/// Draws all texels: in white what pruning by `masks` leaves out, the rest in black. With the true colours, no channel of a view would
/// differ by more than white has levels there.
fn compare(geometry: &Geometry, masks: &Masks, cameras: &[Camera]) -> Result<PruneError, RenderError> {
    let (scene, cpu) = (Arc::new(marked(geometry, masks)), Cpu::default().sharp_beyond_borders());
    let mut change = PruneError { tiles: geometry.tiles.len(), ..PruneError::default() };
    for camera in cameras {
        let view = cpu.render(&scene, camera)?;
        let levels = || view.rgba.iter().map(|pixel| pixel[0]);
        let off = levels().filter(|white| *white > LEVELS).count();
        change.max_abs = levels().fold(change.max_abs, u8::max);
        change.share_off = change.share_off.max(off as f64 / view.rgba.len() as f64);
    }
    Ok(change)
}

/// Cameras at the corners of the view box and the centres of its faces.
fn cameras(geometry: &Geometry) -> Vec<Camera> {
    let (w, h) = (geometry.grid.width, geometry.grid.height);
    let scale = (f64::from(SIDE) / f64::from(w.max(h))).min(1.0);
    let size = |v: u32| ((f64::from(v) * scale).round() as u32).max(1);
    let (width, height) = (size(w), size(h));
    let intrinsics = geometry.intrinsics.resized((w, h), (width, height));
    let v = geometry.view_box;
    let step = |i: u32| f64::from(i % 3) - 1.0;
    let all = (0..27).map(|i| [step(i), step(i / 3), step(i / 9)]);
    all.filter(|p| [1, 3].contains(&p.iter().filter(|c| **c != 0.0).count()))
        .map(|[x, y, z]| Camera { pose: Pose::at(x * v.x, y * v.y, z * v.z), intrinsics, width, height })
        .collect()
}

/// A black scene with all texels; those that pruning by `masks` leaves out or changes are white.
fn marked(geometry: &Geometry, masks: &Masks) -> Scene {
    let tile = |(all, kept): (LayerMasks, LayerMasks)| {
        let layer = |l: LayerMask| marked_layer(kept.layers.iter().find(|k| k.label == l.label), l);
        all.layers.into_iter().map(layer).collect::<Vec<TexturedLayer>>()
    };
    let tiles = geometry.masks_unpruned().into_par_iter().zip(masks(geometry)).map(tile).collect();
    let Grid { width, height, .. } = geometry.grid;
    compose(Photo::from_fn(width, height, |_, _| [0; 3]), geometry, tiles)
}

/// A layer with all texels, of which `kept` remain.
fn marked_layer(kept: Option<&LayerMask>, mut shape: LayerMask) -> TexturedLayer {
    let (r, mut hidden) = (shape.rect, Vec::new());
    let rows = shape.class.chunks_mut(r.w as usize).zip(shape.alpha.chunks_mut(r.w as usize));
    for (y, (class, alpha)) in (r.y..).zip(rows) {
        for (x, (class, alpha)) in (r.x..).zip(class.iter_mut().zip(alpha)) {
            let left = kept.map_or(EMPTY, |kept| texel(kept, x, y));
            let changed = left != (*class, *alpha);
            if changed {
                (*class, *alpha) = (Class::Hidden as u8, left.1.max(*alpha));
            }
            if *class == Class::Hidden as u8 {
                hidden.push(if changed { [u8::MAX; 3] } else { [0; 3] });
            }
        }
    }
    TexturedLayer { shape, hidden }
}

/// Class and alpha where there is no texel.
const EMPTY: (u8, u8) = (Class::Empty as u8, 0);

/// Class and alpha of a layer at pixel `(x, y)`.
fn texel(layer: &LayerMask, x: u32, y: u32) -> (u8, u8) {
    let r = layer.rect;
    if x < r.x || x >= r.x + r.w || y < r.y || y >= r.y + r.h {
        return EMPTY;
    }
    let at = ((y - r.y) * r.w + x - r.x) as usize;
    (layer.class[at], layer.alpha[at])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Options;
    use tmpi_core::{ViewBox, texture};
    use tmpi_render::difference::max_abs;

    /// A near square in front of a far wall of another colour.
    fn scene() -> (Photo, Geometry) {
        let near = |i: u32| (16..48).contains(&(i % 64)) && (16..48).contains(&(i / 64));
        let photo = Photo { width: 64, height: 64, rgb: (0..4096).map(|i| if near(i) { [200, 20, 20] } else { [20, 90, 200] }).collect() };
        let tile = Tile {
            planes: vec![Plane::fronto_parallel(0.25), Plane::fronto_parallel(1.0)],
            labels: (0..4096).map(|i| u8::from(near(i))).collect(),
            background: None,
        };
        let geometry = Geometry {
            grid: Grid::new(64, 64, 64),
            intrinsics: Intrinsics::centred(64, 64, 100.0),
            view_box: ViewBox { x: 0.01, y: 0.01, z: 0.0 },
            tiles: vec![tile],
            matte_band: 0,
        };
        (photo, geometry)
    }

    /// Geometry of a wide photo of a wall behind a slab.
    fn wide(width: u32) -> Geometry {
        let grid = Grid::new(width, 600, 64);
        let near = |x: u32, y: u32| (width / 3..width * 2 / 3).contains(&x) && (150..450).contains(&y);
        let planes = [0.05, 1.0].map(|d| Plane::fronto_parallel(d).quantised());
        let tile = |t: u32| {
            let r = grid.rect(t);
            let labels = (0..r.area() as u32).map(|i| u8::from(near(r.x + i % r.w, r.y + i / r.w))).collect();
            Tile { planes: planes.into(), labels, background: None }
        };
        let intrinsics = Intrinsics::centred(width, 600, Intrinsics::DEFAULT_FOCAL_PER_WIDTH * f64::from(width));
        let tiles = (0..grid.tiles()).map(tile).collect();
        Geometry { grid, intrinsics, view_box: Options::VIEW_BOX, tiles, matte_band: 0 }
    }

    /// Prunes for a view box of this share of the photo's own.
    fn within(share: f64) -> impl Fn(&Geometry) -> Vec<LayerMasks> + Sync {
        move |g| {
            let ViewBox { x, y, z } = g.view_box;
            Geometry { view_box: ViewBox { x: share * x, y: share * y, z: share * z }, ..g.clone() }.masks()
        }
    }

    #[test]
    fn the_share_of_missing_pixels_is_that_of_the_band_beyond_the_search() {
        let geometry = Geometry { view_box: ViewBox { x: 0.12, y: 0.0, z: 0.0 }, ..wide(4000) };
        let planes = &geometry.tiles[0].planes;
        // a third of the way is searched sideways, and 2 pixels up and down
        let band = geometry.intrinsics.fx * 0.08 * (planes[1].a - planes[0].a);
        let want = band * (300.0 - 4.0) / (4000.0 * 600.0);
        let found = compare(&geometry, &within(1.0 / 3.0), &cameras(&geometry)).unwrap().share_off;
        assert!((found - want).abs() < 0.15 * want, "{found} of {want}");
    }

    #[test]
    fn a_photo_that_is_pruned_rightly_shows_no_difference() {
        for width in [960, 4000] {
            let geometry = wide(width);
            let (all, some) = (verify(&geometry).unwrap(), sample(&geometry).unwrap().unwrap());
            assert_eq!([all.max_abs, some.max_abs], [0, 0], "{width}: {all:?} {some:?}");
        }
    }

    #[test]
    fn a_sample_sees_pruning_for_a_smaller_view_box() {
        for (width, share) in [(960, 0.7), (4000, 0.2)] {
            let geometry = wide(width);
            let all = compare(&geometry, &within(share), &cameras(&geometry)).unwrap();
            let some = sample_of(&geometry, &within(share)).unwrap().unwrap();
            assert!(all.max_abs > 100 && all.share_off > 0.0, "{width}: {all:?}");
            assert!(some.max_abs > 100 && some.share_off > 0.0, "{width}: {some:?}");
            assert!(width == 960 || some.tiles < all.tiles, "{width}: {some:?}");
        }
    }

    #[test]
    fn views_from_outside_the_box_miss_pruned_texels_and_differ_by_no_more_than_their_white() {
        let (photo, geometry) = scene();
        let camera = Camera { pose: Pose::at(0.2, 0.0, 0.0), intrinsics: geometry.intrinsics, width: 64, height: 64 };
        let draw = |scene: Scene| {
            assert_eq!(scene.validate(), Ok(()));
            Cpu::default().sharp_beyond_borders().render(&Arc::new(scene), &camera).unwrap().rgba
        };
        let coloured = |masks| draw(compose(photo.clone(), &geometry, texture(&photo, &geometry, masks)));
        let (all, kept) = (coloured(geometry.masks_unpruned()), coloured(geometry.masks()));
        let white = draw(marked(&geometry, &Geometry::masks));
        assert!(max_abs(&all, &kept) > 50);
        // colours are rounded
        let excess = all.iter().zip(&kept).zip(&white).map(|((a, b), white)| max_abs(&[*a], &[*b]).saturating_sub(white[0]));
        assert!(excess.max().unwrap() <= 2);
    }
}
