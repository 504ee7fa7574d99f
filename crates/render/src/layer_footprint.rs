//! Projects a layer into a picture: its inverse homography, its bounds, and the condition that a pixel of a row is covered.

use tmpi_core::{Camera, Mat3, Scene, homography, mat3_vec};

use super::NEAR;
use super::border::Piece;

/// Linear function of a target pixel position, `f(x, y) = f[0]·x + f[1]·y + f[2]`.
pub(super) type Form = [f64; 3];

fn value(f: &Form, x: f64, y: f64) -> f64 {
    f[0] * x + f[1] * y + f[2]
}

/// A piece of a layer as a camera sees it.
///
/// With `λ = 1/p_z`, the values `λ`, `x·λ`, `y·λ` and the target disparity are linear in the target pixel position. A backend therefore
/// walks a row by increments, with one division per pixel.
#[derive(Clone, Debug)]
pub(super) struct Footprint {
    /// `λ`; positive in front of the camera.
    pub lambda: Form,
    /// `λ` times the distance from the rectangle's left border, in reference pixels.
    pub x: Form,
    /// `λ` times the distance from the rectangle's upper border, in reference pixels.
    pub y: Form,
    /// Target disparity `δ_t`. Values below 0 (beyond infinity) are not yet clamped to 0.
    pub delta: Form,
    /// Start and end of the drawn range, across and down, in texels from the rectangle's upper left corner.
    pub drawn: [[f64; 2]; 2],
    /// First column that may be covered.
    pub x0: u32,
    /// Column after the last that may be covered.
    pub x1: u32,
    /// First row that may be covered.
    pub y0: u32,
    /// Row after the last that may be covered.
    pub y1: u32,
}

/// Position of a sample.
#[derive(Clone, Copy, Debug)]
pub(super) struct SamplePosition {
    /// Distance from the rectangle's left border, in reference pixels.
    pub x: f64,
    /// Distance from the rectangle's upper border, in reference pixels.
    pub y: f64,
    /// Target disparity, at least 0.
    pub delta: f64,
}

impl Footprint {
    /// Projects `piece`; `None` if the camera cannot see it (behind, edge-on, outside the picture, not finite).
    pub fn new(scene: &Scene, piece: &Piece, camera: &Camera) -> Option<Self> {
        let (half, centre, k) = (scene.grid.half(), piece.centre, &scene.intrinsics);
        let p = &piece.plane;
        let h = homography(p.normal(centre, half, k), k, camera);
        let inverse = inverted(&h)?;
        // δ in reference pixels
        let n = [p.b / half, p.c / half, p.a - (p.b * centre.0 + p.c * centre.1) / half];
        let [rx, ry] = piece.corner.map(|v| v as f64);
        let lambda = inverse[2];
        let minus = |row: usize, origin: f64| std::array::from_fn(|j| inverse[row][j] - origin * lambda[j]);
        let delta = std::array::from_fn(|j| (0..3).map(|i| n[i] * inverse[i][j]).sum());
        let drawn = piece.drawn;
        let (x0, x1, y0, y1) = bounds(&h, &n, drawn.map(|d| d[0]), drawn.map(|d| d[1]), [rx, ry], camera)?;
        let footprint = Self { lambda, x: minus(0, rx), y: minus(1, ry), delta, drawn, x0, x1, y0, y1 };
        [footprint.lambda, footprint.x, footprint.y, footprint.delta].iter().flatten().all(|v| v.is_finite()).then_some(footprint)
    }

    /// The conditions for a layer to cover a target position: each must be `≥ 0`.
    pub fn conditions(&self) -> [Form; 6] {
        let after = |f: &Form, from: f64| std::array::from_fn(|j| f[j] - from * self.lambda[j]);
        let before = |f: &Form, to: f64| std::array::from_fn(|j| to * self.lambda[j] - f[j]);
        let [[left, right], [upper, lower]] = self.drawn;
        let near = [-self.delta[0], -self.delta[1], 1.0 / NEAR - self.delta[2]];
        [self.lambda, after(&self.x, left), after(&self.y, upper), before(&self.x, right), before(&self.y, lower), near]
    }

    /// Where the ray through target position `(x, y)` hits the layer; `None` if it misses.
    pub fn hit(&self, x: f64, y: f64) -> Option<SamplePosition> {
        let lambda = value(&self.lambda, x, y);
        let delta = value(&self.delta, x, y);
        if !(lambda > 0.0 && delta * NEAR <= 1.0) {
            return None;
        }
        let (px, py) = (value(&self.x, x, y) / lambda, value(&self.y, x, y) / lambda);
        let [[left, right], [upper, lower]] = self.drawn;
        let inside = px >= left && py >= upper && px <= right && py <= lower;
        inside.then_some(SamplePosition { x: px, y: py, delta: delta.max(0.0) })
    }
}

/// Inverse by cofactors; `None` if it is not finite.
pub(super) fn inverted(m: &Mat3) -> Option<Mat3> {
    let c = |i: usize, j: usize| {
        let (a, b, p, q) = ((i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3);
        m[a][p] * m[b][q] - m[a][q] * m[b][p]
    };
    let det: f64 = (0..3).map(|j| m[0][j] * c(0, j)).sum();
    let inverse: Mat3 = std::array::from_fn(|i| std::array::from_fn(|j| c(j, i) / det));
    inverse.iter().flatten().all(|v| v.is_finite()).then_some(inverse)
}

/// Pixel bounds of a rectangle's visible part. Clips in homogeneous coordinates, so that it projects nothing behind the camera.
fn bounds(h: &Mat3, n: &[f64; 3], from: [f64; 2], to: [f64; 2], origin: [f64; 2], camera: &Camera) -> Option<(u32, u32, u32, u32)> {
    // below this ratio of target depth to reference depth, a direction lies 90° off the axis and projects outside any picture
    const LEAST: f64 = 1e-9;
    let corners = [[from[0], from[1]], [to[0], from[1]], to, [from[0], to[1]]].map(|[x, y]| {
        let r = [origin[0] + x, origin[1] + y, 1.0];
        let q = mat3_vec(h, r);
        let delta: f64 = (0..3).map(|i| n[i] * r[i]).sum();
        [q[0], q[1], q[2], delta]
    });
    let mut polygon = corners.to_vec();
    for distance in [|q: &[f64; 4]| q[2] - LEAST, |q: &[f64; 4]| q[2] - NEAR * q[3]] {
        polygon = clip(&polygon, distance);
    }
    let mut range = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    for q in &polygon {
        for (axis, r) in range.iter_mut().enumerate() {
            let v = q[axis] / q[2];
            *r = [r[0].min(v), r[1].max(v)];
        }
    }
    // pixel centres are at half-integers; one more pixel on each side allows for rounding; `as` saturates
    let first = |v: f64| (v - 1.5).max(0.0) as u32;
    let last = |v: f64, size: u32| ((v + 1.5).max(0.0) as u32).min(size);
    let found = (first(range[0][0]), last(range[0][1], camera.width), first(range[1][0]), last(range[1][1], camera.height));
    (found.0 < found.1 && found.2 < found.3).then_some(found)
}

fn clip(polygon: &[[f64; 4]], distance: impl Fn(&[f64; 4]) -> f64) -> Vec<[f64; 4]> {
    let mut out = Vec::with_capacity(polygon.len() + 2);
    for (i, a) in polygon.iter().enumerate() {
        let b = &polygon[(i + 1) % polygon.len()];
        let (da, db) = (distance(a), distance(b));
        if da >= 0.0 {
            out.push(*a);
        }
        if (da >= 0.0) != (db >= 0.0) {
            let t = da / (da - db);
            out.push(std::array::from_fn(|k| a[k] + t * (b[k] - a[k])));
        }
    }
    out
}
