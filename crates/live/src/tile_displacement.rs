//! Bounds how far a tile's points move from old planes to new ones: the error of a reader that keeps the old ones.

use tmpi_core::{Geometry, Plane, Rect, Tile, TileFrame};

/// The camera that moves points farthest apart: a corner of the view box.
struct Corner<'a> {
    geometry: &'a Geometry,
    rect: Rect,
    frame: TileFrame,
}

/// Upper bound, in pixels, on the distance between the positions of any point of tile `index` under two sets of planes and labels, for any
/// camera in the view box. Covers the visible pixels, each layer over the whole tile, and the background. Infinite if the numbers of layers
/// differ, because one set then shows content that the other lacks.
pub fn tile_displacement(geometry: &Geometry, index: u32, old: &Tile, new: &Tile) -> f64 {
    let same_layers = old.planes.len() == new.planes.len() && old.background.is_some() == new.background.is_some();
    if !same_layers || old.labels.len() != new.labels.len() {
        return f64::INFINITY;
    }
    let corner = Corner { geometry, rect: geometry.grid.rect(index), frame: TileFrame::of(&geometry.grid, index) };
    let pairs = old.planes.iter().zip(&new.planes).chain(old.background.iter().zip(&new.background));
    let layers = pairs.map(|(a, b)| corner.distance_of_planes(a, b));
    // a pixel that keeps its label moves with its plane, which `layers` covers
    let relabelled = (0..).zip(old.labels.iter().zip(&new.labels)).filter(|(_, (a, b))| a != b);
    let pixels = relabelled.map(|(i, (a, b))| match (old.planes.get(usize::from(*a)), new.planes.get(usize::from(*b))) {
        (Some(a), Some(b)) => corner.distance_of_pixel(i, a, b),
        _ => f64::INFINITY,
    });
    layers.chain(pixels).fold(0.0, f64::max)
}

impl Corner<'_> {
    /// Distance in pixels, seen from the corner, between points of disparity `a` and `b` at `(x, y)` of the frame.
    ///
    /// With `x′(δ) = cx + (x − cx − fx·tx·δ) / (1 − tz·δ)`, `x′(a) − x′(b) = ((x − cx)·tz − fx·tx)·(a − b) / ((1 − tz·a)·(1 − tz·b))`.
    /// The signs of `tx` and `ty` are those that maximise it.
    fn distance(&self, (x, y): (f64, f64), a: f64, b: f64, apart: f64) -> f64 {
        let (k, v) = (&self.geometry.intrinsics, &self.geometry.view_box);
        let (right, down) = (k.fx * v.x + (x - k.cx).abs() * v.z, k.fy * v.y + (y - k.cy).abs() * v.z);
        let nearer = ((1.0 - v.z * a) * (1.0 - v.z * b)).min((1.0 + v.z * a) * (1.0 + v.z * b));
        if apart == 0.0 {
            0.0
        } else if v.z * a.abs().max(b.abs()) >= 1.0 {
            // the camera moves through the plane
            f64::INFINITY
        } else {
            apart * right.hypot(down) / nearer
        }
    }

    /// Distance for pixel `i` of the tile, which changes from plane `a` to plane `b`.
    fn distance_of_pixel(&self, i: u32, a: &Plane, b: &Plane) -> f64 {
        let (x, y) = (self.rect.x + i % self.rect.w, self.rect.y + i / self.rect.w);
        let at = |p: &Plane| self.disparity(p, x, y);
        let (a, b) = (at(a), at(b));
        self.distance((f64::from(x) + 0.5, f64::from(y) + 0.5), a, b, (a - b).abs())
    }

    /// Upper bound for two planes anywhere on the tile: each factor has its maximum at a corner of the tile.
    fn distance_of_planes(&self, a: &Plane, b: &Plane) -> f64 {
        if a == b {
            return 0.0;
        }
        let r = self.rect;
        let (right, lower) = (r.x + r.w - 1, r.y + r.h - 1);
        let corners = [(r.x, r.y), (right, r.y), (r.x, lower), (right, lower)];
        let most = |of: &dyn Fn(u32, u32) -> f64| corners.iter().map(|(x, y)| of(*x, *y)).fold(f64::NEG_INFINITY, f64::max);
        let (nearest_a, nearest_b) = (most(&|x, y| self.disparity(a, x, y).abs()), most(&|x, y| self.disparity(b, x, y).abs()));
        let apart = most(&|x, y| (self.disparity(a, x, y) - self.disparity(b, x, y)).abs());
        most(&|x, y| self.distance((f64::from(x) + 0.5, f64::from(y) + 0.5), nearest_a, nearest_b, apart))
    }

    fn disparity(&self, plane: &Plane, x: u32, y: u32) -> f64 {
        let (u, v) = ((f64::from(x) + 0.5 - self.frame.centre.0) / self.frame.half, self.frame.v(y));
        plane.disparity(u, v)
    }
}

#[cfg(test)]
mod tests;
