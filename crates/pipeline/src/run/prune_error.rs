//! Measures the effect of pruning: draws views from the view box with and without the pruned texels.

use std::sync::Arc;

use rayon::prelude::*;

use tmpi_core::{Camera, Class, Geometry, Intrinsics, LayerMask, Photo, Pose, Rect, Scene, TexturedLayer, compose, texture};
use tmpi_render::difference::{max_abs, share_off};
use tmpi_render::{Cpu, RenderError, Renderer};

use super::PruneError;

/// Longest side of the compared views, in pixels.
const SIDE: u32 = 512;

/// A pixel counts as changed if a channel differs by more than this many levels.
const LEVELS: u8 = 8;

/// Compares views with all texels and with the kept texels, from the corners of the view box and the centres of its faces.
/// Both use the same colours and no matting, so that pruning is the only difference.
///
/// # Errors
/// [`RenderError`] if a view cannot be drawn.
pub fn verify(photo: &Photo, geometry: &Geometry) -> Result<PruneError, RenderError> {
    compare(photo, &Geometry { matted: false, ..geometry.clone() }, cameras)
}

/// Tiles per sample of [`sample`]. A sample makes the layers of 4 tiles, a sixteenth, again with and without pruning.
const TILES_PER_SAMPLE: u32 = 64;

/// Like [`verify`], but on small parts of the photo: for every [`TILES_PER_SAMPLE`] tiles, 2×2 tiles at the one with the most planes, cut
/// out of their surroundings and seen from two opposite corners of the view box. Returns `None` if the photo has fewer than 32 tiles, so
/// that this would not be quick compared to making, or fewer than two rows or columns of tiles.
///
/// # Errors
/// [`RenderError`] if a view cannot be drawn.
pub fn sample(photo: &Photo, geometry: &Geometry) -> Result<Option<PruneError>, RenderError> {
    let (grid, tiles) = (&geometry.grid, geometry.tiles.len() as u32);
    if tiles < TILES_PER_SAMPLE / 2 || grid.columns() < 2 || grid.rows() < 2 {
        return Ok(None);
    }
    let starts: Vec<u32> = (0..tiles).step_by(TILES_PER_SAMPLE as usize).collect();
    let one = |start: &u32| {
        // the first on ties
        let busiest = (*start..(start + TILES_PER_SAMPLE).min(tiles))
            .rev()
            .max_by_key(|i| geometry.tiles[*i as usize].planes.len())
            .unwrap_or(*start);
        let (column, row) = ((busiest % grid.columns()).min(grid.columns() - 2), (busiest / grid.columns()).min(grid.rows() - 2));
        let (photo, geometry) = part(photo, geometry, (column, row));
        compare(&photo, &geometry, |scene| opposite(scene).into())
    };
    let changes = starts.par_iter().map(one).collect::<Result<Vec<PruneError>, _>>()?;
    Ok(changes.into_iter().reduce(|a, b| PruneError {
        max_abs: a.max_abs.max(b.max_abs),
        share_off: a.share_off.max(b.share_off),
        tiles: a.tiles + b.tiles,
    }))
}

/// Cuts out 2×2 tiles, starting at `column` and `row`, as a photo of their own.
fn part(photo: &Photo, geometry: &Geometry, (column, row): (u32, u32)) -> (Photo, Geometry) {
    let Geometry { grid, intrinsics: k, view_box, tiles, .. } = geometry;
    let (rect, own) = grid.part(column..column + 2, row..row + 2);
    let line = |y: u32| &photo.rgb[y as usize * photo.width as usize + rect.x as usize..][..rect.w as usize];
    let rgb = (rect.y..rect.y + rect.h).flat_map(line).copied().collect();
    let tiles = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(x, y)| tiles[((row + y) * grid.columns() + column + x) as usize].clone());
    let intrinsics = Intrinsics { cx: k.cx - f64::from(rect.x), cy: k.cy - f64::from(rect.y), ..*k };
    let Rect { w: width, h: height, .. } = rect;
    (Photo { width, height, rgb }, Geometry { grid: own, intrinsics, view_box: *view_box, tiles: tiles.into(), matted: false })
}

/// Cameras at two opposite corners of the view box, at the photo's own size.
fn opposite(scene: &Scene) -> [Camera; 2] {
    let (v, width, height) = (scene.view_box, scene.photo.width, scene.photo.height);
    [1.0, -1.0].map(|s| Camera { pose: Pose::at(s * v.x, s * v.y, s * v.z), intrinsics: scene.intrinsics, width, height })
}

fn compare(photo: &Photo, geometry: &Geometry, cameras: impl Fn(&Scene) -> Vec<Camera>) -> Result<PruneError, RenderError> {
    let all = texture(photo, geometry, geometry.masks_unpruned());
    let kept: Vec<Vec<TexturedLayer>> = all.iter().zip(geometry.masks()).map(|(all, kept)| cut(all, &kept.layers)).collect();
    let compose = |tiles| Arc::new(compose(photo.clone(), geometry, tiles));
    let (all, kept) = (compose(all), compose(kept));
    let cpu = Cpu::default().sharp_beyond_borders();
    let mut change = PruneError { tiles: geometry.tiles.len(), ..PruneError::default() };
    for camera in cameras(&all) {
        let (a, b) = (cpu.render(&all, &camera)?.rgba, cpu.render(&kept, &camera)?.rgba);
        change.max_abs = change.max_abs.max(max_abs(&a, &b));
        change.share_off = change.share_off.max(share_off(&a, &b, LEVELS));
    }
    Ok(change)
}

/// Cameras at the corners of the view box and the centres of its faces.
fn cameras(scene: &Scene) -> Vec<Camera> {
    let (w, h) = (scene.photo.width, scene.photo.height);
    let scale = (f64::from(SIDE) / f64::from(w.max(h))).min(1.0);
    let size = |v: u32| ((f64::from(v) * scale).round() as u32).max(1);
    let (width, height) = (size(w), size(h));
    let intrinsics = scene.intrinsics.resized((w, h), (width, height));
    let v = scene.view_box;
    let step = |i: u32| f64::from(i % 3) - 1.0;
    let all = (0..27).map(|i| [step(i), step(i / 3), step(i / 9)]);
    all.filter(|p| [1, 3].contains(&p.iter().filter(|c| **c != 0.0).count()))
        .map(|[x, y, z]| Camera { pose: Pose::at(x * v.x, y * v.y, z * v.z), intrinsics, width, height })
        .collect()
}

/// Layers of a tile reduced to the texels of `kept`.
fn cut(all: &[TexturedLayer], kept: &[LayerMask]) -> Vec<TexturedLayer> {
    all.iter().filter_map(|l| kept.iter().find(|k| k.label == l.shape.label).map(|k| cut_layer(l, k))).collect()
}

fn cut_layer(full: &TexturedLayer, kept: &LayerMask) -> TexturedLayer {
    let (r, k) = (full.shape.rect, kept.rect);
    let (mut shape, mut hidden) = (full.shape.clone(), Vec::new());
    let mut colours = full.hidden.iter();
    for i in 0..shape.class.len() {
        let (x, y) = (r.x + i as u32 % r.w, r.y + i as u32 / r.w);
        let within = x >= k.x && x < k.x + k.w && y >= k.y && y < k.y + k.h;
        let at = within.then(|| ((y - k.y) * k.w + x - k.x) as usize);
        let colour = if shape.class[i] == Class::Hidden as u8 { colours.next() } else { None };
        (shape.class[i], shape.alpha[i]) = at.map_or((Class::Empty as u8, 0), |at| (kept.class[at], kept.alpha[at]));
        if shape.class[i] == Class::Hidden as u8 {
            hidden.push(colour.copied().unwrap_or_default());
        }
    }
    TexturedLayer { shape, hidden }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tmpi_core::{Grid, Intrinsics, Plane, Tile, ViewBox};

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
            matted: false,
        };
        (photo, geometry)
    }

    #[test]
    fn pruned_texels_are_missing_in_views_from_outside_the_box() {
        let (photo, geometry) = scene();
        let all = texture(&photo, &geometry, geometry.masks_unpruned());
        let kept = vec![cut(&all[0], &geometry.masks()[0].layers)];
        let compose = |tiles| Arc::new(compose(photo.clone(), &geometry, tiles));
        let (all, kept) = (compose(all), compose(kept));
        assert_eq!((all.validate(), kept.validate()), (Ok(()), Ok(())));
        let camera = Camera { pose: Pose::at(0.2, 0.0, 0.0), intrinsics: all.intrinsics, width: 64, height: 64 };
        let cpu = Cpu::default();
        assert!(max_abs(&cpu.render(&all, &camera).unwrap().rgba, &cpu.render(&kept, &camera).unwrap().rgba) > 50);
    }
}
