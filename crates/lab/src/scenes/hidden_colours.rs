//! True colours of hidden texels, from the exact surface behind the visible one.

use super::Picture;
use tmpi_core::{Class, DisparityMap, LayerMask, TileFrame};

/// A surface within this δ of a layer's plane belongs to the layer.
const NEAR: f32 = 0.01;
/// Two surfaces are separate objects if they differ by this δ. A smaller difference is a fold of one object, behind which
/// [`super::Scene::hidden`] does not show the plane's surface.
const APART: f32 = 0.05;

/// For each hidden texel of a layer, in order: the colour of the `hidden` surface if it lies on the layer's plane, clearly behind the
/// `visible` surface.
pub fn of_layer(shape: &LayerMask, place: TileFrame, visible: &DisparityMap, hidden: &Picture) -> Vec<Option<[u8; 3]>> {
    let (r, w) = (shape.rect, visible.width as usize);
    let texels = shape.class.iter().enumerate().filter(|(_, c)| **c == Class::Hidden as u8);
    let known = texels.map(|(i, _)| {
        let (x, y) = (r.x + i as u32 % r.w, r.y + i as u32 / r.w);
        let (at, plane) = (y as usize * w + x as usize, place.disparity(&shape.plane, x, y));
        let is_known = (plane - hidden.disparity.delta[at]).abs() < NEAR && visible.delta[at] - plane > APART;
        is_known.then(|| hidden.photo.at(x, y))
    });
    known.collect()
}
