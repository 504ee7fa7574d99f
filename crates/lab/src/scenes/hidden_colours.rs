//! Which hidden texels of a layer the exact surface behind tells, and what it tells.

use super::Picture;
use tmpi_core::{Class, DisparityMap, LayerMask, TileFrame};

/// Distance in δ from a layer's plane at which a surface still counts as the layer's.
const NEAR: f32 = 0.01;
/// Distance in δ between two things; less is a fold of one thing, behind which [`super::Scene::hidden`] does not tell what the plane shows.
const APART: f32 = 0.05;

/// For every hidden texel of a layer, in the order of its classes: the colour of the `hidden` surface where that lies on the layer's
/// plane, clearly behind what is `visible`.
#[must_use]
pub fn of_layer(shape: &LayerMask, place: TileFrame, visible: &DisparityMap, hidden: &Picture) -> Vec<Option<[u8; 3]>> {
    let (r, w) = (shape.rect, visible.width as usize);
    let texels = shape.class.iter().enumerate().filter(|(_, c)| **c == Class::Hidden as u8);
    let known = texels.map(|(i, _)| {
        let (x, y) = (r.x + i as u32 % r.w, r.y + i as u32 / r.w);
        let (at, plane) = (y as usize * w + x as usize, place.disparity(&shape.plane, x, y));
        let told = (plane - hidden.disparity.delta[at]).abs() < NEAR && visible.delta[at] - plane > APART;
        told.then(|| hidden.photo.at(x, y))
    });
    known.collect()
}
