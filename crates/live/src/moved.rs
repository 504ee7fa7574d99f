//! How far a reader who keeps the planes that it has is from one who gets the new ones.

use tmpi_core::{Geometry, Plane, Rect, Tile, TileFrame};

/// The camera that moves points the farthest apart: a corner of the view box.
struct Corner<'a> {
    geometry: &'a Geometry,
    rect: Rect,
    place: TileFrame,
}

/// Bound in pixels on how far apart any point of tile `index` is shown by two sets of planes and labels, from any camera of the view box:
/// what is visible, each layer as far as the tile goes, and the background. Infinite where they have not as many layers, as one then
/// shows what the other does not have.
#[must_use]
pub fn moved(geometry: &Geometry, index: u32, held: &Tile, new: &Tile) -> f64 {
    let same_layers = held.planes.len() == new.planes.len() && held.background.is_some() == new.background.is_some();
    if !same_layers || held.labels.len() != new.labels.len() {
        return f64::INFINITY;
    }
    let corner = Corner { geometry, rect: geometry.grid.rect(index), place: TileFrame::of(&geometry.grid, index) };
    let pairs = held.planes.iter().zip(&new.planes).chain(held.background.iter().zip(&new.background));
    let layers = pairs.map(|(a, b)| corner.of_planes(a, b));
    // a pixel that stays on its plane goes with it
    let relabelled = (0..).zip(held.labels.iter().zip(&new.labels)).filter(|(_, (a, b))| a != b);
    let pixels = relabelled.map(|(i, (a, b))| match (held.planes.get(usize::from(*a)), new.planes.get(usize::from(*b))) {
        (Some(a), Some(b)) => corner.of_pixel(i, a, b),
        _ => f64::INFINITY,
    });
    layers.chain(pixels).fold(0.0, f64::max)
}

impl Corner<'_> {
    /// Pixels between the places of a point of disparity `a` and one of `b`, seen at `(x, y)` of the frame, from the corner: with
    /// `x′(δ) = cx + (x − cx − fx·tx·δ) / (1 − tz·δ)`, `x′(a) − x′(b) = ((x − cx)·tz − fx·tx)·(a − b) / ((1 − tz·a)·(1 − tz·b))`. `tx` and `ty`
    /// are those that add to the rest.
    fn pixels(&self, (x, y): (f64, f64), a: f64, b: f64, apart: f64) -> f64 {
        let (k, v) = (&self.geometry.intrinsics, &self.geometry.view_box);
        let (right, down) = (k.fx * v.x + (x - k.cx).abs() * v.z, k.fy * v.y + (y - k.cy).abs() * v.z);
        let nearer = ((1.0 - v.z * a) * (1.0 - v.z * b)).min((1.0 + v.z * a) * (1.0 + v.z * b));
        if apart == 0.0 {
            0.0
        } else if v.z * a.abs().max(b.abs()) >= 1.0 {
            // the camera goes through the plane
            f64::INFINITY
        } else {
            apart * right.hypot(down) / nearer
        }
    }

    /// Of a pixel of the tile that goes from one plane to another.
    fn of_pixel(&self, i: u32, a: &Plane, b: &Plane) -> f64 {
        let (x, y) = (self.rect.x + i % self.rect.w, self.rect.y + i / self.rect.w);
        let at = |p: &Plane| self.disparity(p, x, y);
        let (a, b) = (at(a), at(b));
        self.pixels((f64::from(x) + 0.5, f64::from(y) + 0.5), a, b, (a - b).abs())
    }

    /// Of two planes anywhere on the tile: each factor is the greatest in a corner of it.
    fn of_planes(&self, a: &Plane, b: &Plane) -> f64 {
        if a == b {
            return 0.0;
        }
        let r = self.rect;
        let (right, lower) = (r.x + r.w - 1, r.y + r.h - 1);
        let corners = [(r.x, r.y), (right, r.y), (r.x, lower), (right, lower)];
        let most = |of: &dyn Fn(u32, u32) -> f64| corners.iter().map(|(x, y)| of(*x, *y)).fold(f64::NEG_INFINITY, f64::max);
        let (nearest_a, nearest_b) = (most(&|x, y| self.disparity(a, x, y).abs()), most(&|x, y| self.disparity(b, x, y).abs()));
        let apart = most(&|x, y| (self.disparity(a, x, y) - self.disparity(b, x, y)).abs());
        most(&|x, y| self.pixels((f64::from(x) + 0.5, f64::from(y) + 0.5), nearest_a, nearest_b, apart))
    }

    fn disparity(&self, plane: &Plane, x: u32, y: u32) -> f64 {
        let (u, v) = ((f64::from(x) + 0.5 - self.place.centre.0) / self.place.half, self.place.v(y));
        plane.disparity(u, v)
    }
}

#[cfg(test)]
mod tests;
