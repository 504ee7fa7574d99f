//! What the texels that were left out would have shown: the view box's corners drawn with and without them.

use std::sync::Arc;

use tmpi_core::{Camera, Class, Geometry, LayerMask, Photo, Pose, Scene, TexturedLayer, compose, texture};
use tmpi_render::difference::{max_abs, share_off};
use tmpi_render::{Cpu, RenderError, Renderer};

/// Longest side of the views that are compared, in pixels.
const SIDE: u32 = 512;

/// What leaving out changed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Change {
    /// Largest difference of any channel in any view, in levels.
    pub max_abs: u8,
    /// Share of pixels, 0 to 1, that differ by more than [`LEVELS`], in the view where it is largest.
    pub share: f64,
}

/// Levels from which a pixel counts as changed.
const LEVELS: u8 = 8;

/// Compares views with all texels and with those that are kept, over the corners of the view box and the middles of its sides.
/// Both take the same colours, so that nothing but the leaving out is compared.
///
/// # Errors
/// [`RenderError`] where a view cannot be drawn.
pub fn verify(photo: &Photo, geometry: &Geometry) -> Result<Change, RenderError> {
    let all = texture(photo, geometry, geometry.masks_unpruned());
    let kept: Vec<Vec<TexturedLayer>> = all.iter().zip(geometry.masks()).map(|(all, kept)| cut(all, &kept.layers)).collect();
    let compose = |tiles| Arc::new(compose(photo.clone(), geometry, tiles));
    let (all, kept) = (compose(all), compose(kept));
    let cpu = Cpu::default();
    let mut change = Change { max_abs: 0, share: 0.0 };
    for camera in cameras(&all) {
        let (a, b) = (cpu.render(&all, &camera)?.rgba, cpu.render(&kept, &camera)?.rgba);
        change.max_abs = change.max_abs.max(max_abs(&a, &b));
        change.share = change.share.max(share_off(&a, &b, LEVELS));
    }
    Ok(change)
}

/// Corners of the view box and middles of its sides.
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

/// The layers of a tile with nothing but the texels of `kept`.
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

    /// A near square before a far wall, in colours that differ.
    fn scene(view_box: ViewBox) -> (Photo, Geometry) {
        let near = |i: u32| (16..48).contains(&(i % 64)) && (16..48).contains(&(i / 64));
        let photo = Photo { width: 64, height: 64, rgb: (0..4096).map(|i| if near(i) { [200, 20, 20] } else { [20, 90, 200] }).collect() };
        let tile = Tile {
            planes: vec![Plane::fronto_parallel(0.25), Plane::fronto_parallel(1.0)],
            labels: (0..4096).map(|i| u8::from(near(i))).collect(),
            background: None,
        };
        let geometry =
            Geometry { grid: Grid::new(64, 64, 64), intrinsics: Intrinsics::centred(64, 64, 100.0), view_box, tiles: vec![tile] };
        (photo, geometry)
    }

    #[test]
    fn what_is_left_out_is_not_seen_from_the_view_box() {
        let (photo, geometry) = scene(ViewBox { x: 0.05, y: 0.03, z: 0.02 });
        assert!(geometry.masks()[0].never_seen > 0);
        assert_eq!(verify(&photo, &geometry).unwrap(), Change { max_abs: 0, share: 0.0 });
        let count = |b: &Geometry| cameras(&layers_of(&photo, b)).len();
        assert_eq!(count(&geometry), 8 + 6);
    }

    fn layers_of(photo: &Photo, b: &Geometry) -> Scene {
        compose(photo.clone(), b, texture(photo, b, b.masks()))
    }

    #[test]
    fn a_camera_beyond_the_box_sees_what_was_left_out() {
        let (photo, geometry) = scene(ViewBox { x: 0.01, y: 0.01, z: 0.0 });
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
