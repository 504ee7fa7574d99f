//! The section of planes: columns of 16-bit values, low bytes before high bytes.

use super::AtlasError;
use crate::tmpi::{Grid, Layer, Plane, Rect};

/// Columns in the order of the schema: tile, a, b, c, x, y, w, h.
const COLUMNS: usize = 8;

/// Bytes of the section for that many layers.
pub fn bytes(layers: usize) -> usize {
    layers * COLUMNS * 2
}

/// Writes all layers.
pub fn write(grid: &Grid, layers: &[Layer]) -> Vec<u8> {
    let mut out = Vec::with_capacity(bytes(layers.len()));
    let mut column = |value: &mut dyn FnMut(&Layer) -> u16| {
        let values: Vec<u16> = layers.iter().map(value).collect();
        out.extend(values.iter().map(|v| *v as u8));
        out.extend(values.iter().map(|v| (v >> 8) as u8));
    };
    let mut last = 0u32;
    column(&mut |l| {
        let step = l.tile.wrapping_sub(last) as u16;
        last = l.tile;
        step
    });
    column(&mut |l| Plane::to_grid(l.plane.a) as u16);
    column(&mut |l| Plane::to_grid(l.plane.b) as u16);
    column(&mut |l| Plane::to_grid(l.plane.c) as u16);
    column(&mut |l| (l.rect.x - grid.origin(l.tile).0) as u16);
    column(&mut |l| (l.rect.y - grid.origin(l.tile).1) as u16);
    column(&mut |l| l.rect.w as u16);
    column(&mut |l| l.rect.h as u16);
    out
}

/// Reads `count` layers; texel offsets are left 0.
pub fn read(grid: &Grid, count: usize, data: &[u8]) -> Result<Vec<Layer>, AtlasError> {
    if data.len() != bytes(count) {
        return Err(AtlasError::broken("planes: wrong length"));
    }
    let value = |column: usize, i: usize| {
        let at = column * count * 2 + i;
        u16::from_le_bytes([data[at], data[at + count]])
    };
    let coefficient = |column: usize, i: usize| f64::from(value(column, i) as i16) * Plane::STEP;
    let mut layers = Vec::with_capacity(count);
    let mut tile = 0u32;
    for i in 0..count {
        tile = tile
            .checked_add(u32::from(value(0, i)))
            .filter(|t| *t < grid.tiles())
            .ok_or_else(|| AtlasError::broken("planes: tile out of the grid"))?;
        let (x, y) = grid.origin(tile);
        let rect = Rect { x: x + u32::from(value(4, i)), y: y + u32::from(value(5, i)), w: value(6, i).into(), h: value(7, i).into() };
        if rect.area() == 0 || !grid.rect(tile).contains(&rect) {
            return Err(AtlasError::broken("planes: rectangle out of its tile"));
        }
        let plane = Plane { a: coefficient(1, i), b: coefficient(2, i), c: coefficient(3, i) };
        layers.push(Layer { tile, plane, rect, first_texel: 0, first_hidden: 0 });
    }
    Ok(layers)
}
