//! Joins the layers of all tiles into an ordered scene.

use super::layers::PeeledTile;
use crate::tmpi::{Grid, Intrinsics, Layer, Photo, Scene, Texels, ViewBox};

/// Joins tiles (in the order of the grid) into a scene.
#[must_use]
pub fn compose(photo: Photo, grid: Grid, intrinsics: Intrinsics, view_box: ViewBox, tiles: Vec<PeeledTile>) -> Scene {
    let all = || tiles.iter().flat_map(|t| &t.layers);
    let (texel_count, hidden_count) = all().fold((0, 0), |(t, h), l| (t + l.class.len(), h + l.hidden.len()));
    let mut texels =
        Texels { class: Vec::with_capacity(texel_count), alpha: Vec::with_capacity(texel_count), hidden: Vec::with_capacity(hidden_count) };
    let mut layers = Vec::with_capacity(all().count());
    for (tile, t) in tiles.into_iter().enumerate() {
        for l in t.layers {
            layers.push(Layer {
                tile: tile as u32,
                plane: l.plane,
                rect: l.rect,
                first_texel: texels.class.len(),
                first_hidden: texels.hidden.len(),
            });
            texels.class.extend(l.class);
            texels.alpha.extend(l.alpha);
            texels.hidden.extend(l.hidden);
        }
    }
    Scene { grid, intrinsics, view_box, photo, layers, texels }
}
