//! Layers with colours, and their composition into a scene (paper, section 3.2).

use super::{Geometry, Inpainter, LayerMask, LayerMasks, Rows, Surface, matte};
use crate::scene::{Layer, Photo, Scene, Texels};

/// A layer with the colours of its hidden texels.
#[derive(Clone, Debug)]
pub struct TexturedLayer {
    /// Plane, rectangle, classes and alphas.
    pub shape: LayerMask,
    /// Colour of each hidden texel, in the order of the classes.
    pub hidden: Vec<[u8; 3]>,
}

/// Layers whose hidden texels have no colours yet: all that a scene's layers take from its geometry, so that it can be computed before the
/// photo is known.
pub struct Uncoloured {
    masks: Vec<LayerMasks>,
    /// δ of the visible surface, infinite at mixed pixels.
    sources: Surface,
}

impl Uncoloured {
    /// Layers of all tiles.
    pub fn of(geometry: &Geometry) -> Self {
        let mut sources = geometry.surface();
        let masks = geometry.masks_of(0..geometry.tiles.len() as u32, &sources, false);
        sources.exclude_mixed();
        Self { masks, sources }
    }

    /// Colours the hidden texels, as [`texture`] does; `geometry` is the one that the layers are of.
    pub fn texture(self, photo: &Photo, geometry: &Geometry) -> Vec<Vec<TexturedLayer>> {
        texture_from(geometry, self.sources, &photo.rgb, 0, self.masks)
    }
}

/// Colours the hidden texels of all layers from the photo's pixels at or behind each layer. Mattes depth borders within `geometry.matte_band`.
pub fn texture(photo: &Photo, geometry: &Geometry, shapes: Vec<LayerMasks>) -> Vec<Vec<TexturedLayer>> {
    texture_tiles(geometry, geometry.surface(), &photo.rgb, 0, shapes)
}

/// Like [`texture`] for some tiles from index `first` on. `surface` and `rgb` cover the same rows, all that these tiles depend on.
pub(crate) fn texture_tiles(
    geometry: &Geometry,
    mut surface: Surface,
    rgb: &[[u8; 3]],
    first: u32,
    shapes: Vec<LayerMasks>,
) -> Vec<Vec<TexturedLayer>> {
    surface.exclude_mixed();
    texture_from(geometry, surface, rgb, first, shapes)
}

/// Like [`texture_tiles`] with a surface from which mixed pixels are already excluded.
fn texture_from(geometry: &Geometry, sources: Surface, rgb: &[[u8; 3]], first: u32, shapes: Vec<LayerMasks>) -> Vec<Vec<TexturedLayer>> {
    let photo = Rows { top: sources.top(), rgb };
    let colours = Inpainter::with_sources(geometry.grid, sources, rgb).fill_tiles(first, &shapes);
    let tile = |(s, c): (LayerMasks, Vec<_>)| s.layers.into_iter().zip(c).map(|(shape, hidden)| TexturedLayer { shape, hidden }).collect();
    let mut tiles: Vec<Vec<TexturedLayer>> = shapes.into_iter().zip(colours).map(tile).collect();
    if geometry.matte_band > 0 {
        matte(geometry, first, &mut tiles, photo);
    }
    tiles
}

/// Joins the textured layers of all tiles into a scene.
pub fn compose(photo: Photo, geometry: &Geometry, tiles: Vec<Vec<TexturedLayer>>) -> Scene {
    let (layers, texels) = join(0, tiles);
    Scene { grid: geometry.grid, intrinsics: geometry.intrinsics, view_box: geometry.view_box, photo, layers, texels }
}

/// Joins the textured layers of tiles from index `first` on.
pub(crate) fn join(first: u32, tiles: Vec<Vec<TexturedLayer>>) -> (Vec<Layer>, Texels) {
    let (mut layers, mut texels) = (Vec::with_capacity(tiles.iter().map(Vec::len).sum()), Texels::default());
    let all = || tiles.iter().flatten();
    let count = all().map(|l| l.shape.class.len()).sum();
    texels.class.reserve_exact(count);
    texels.alpha.reserve_exact(count);
    texels.hidden.reserve_exact(all().map(|l| l.hidden.len()).sum());
    for (tile, textured) in (first..).zip(tiles) {
        for TexturedLayer { shape, hidden } in textured {
            let (first_texel, first_hidden) = (texels.class.len(), texels.hidden.len());
            layers.push(Layer { tile, plane: shape.plane, rect: shape.rect, first_texel, first_hidden });
            texels.class.extend(shape.class);
            texels.alpha.extend(shape.alpha);
            texels.hidden.extend(hidden);
        }
    }
    (layers, texels)
}
