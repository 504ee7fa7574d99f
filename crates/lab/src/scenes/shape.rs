//! Analytic primitives, intersected in their local frame.

use std::sync::Arc;

use super::bvh::Aabb;
use super::cutout::CutoutShape;
use super::math::{V3, v3};
use super::model::Mesh;

#[derive(Clone, Debug)]
pub(super) enum Shape {
    /// The plane y = 0; solid below (y > 0).
    Plane,
    /// A flat piece of z = 0 with these half extents, of this cut-out shape.
    Card(f64, f64, CutoutShape),
    /// Box with these half extents; from inside, a room.
    Cuboid(V3),
    /// Ellipsoid with these semi-axes.
    Ellipsoid(V3),
    /// Capped cone frustum along y: half height, radius at −y, radius at +y.
    Cylinder(f64, f64, f64),
    /// Torus around the z axis: radius of the ring, radius of the tube.
    Torus(f64, f64),
    /// Height field over the plane y = 0; up is −y.
    Field(Arc<Field>),
    /// Triangle mesh with a scale factor.
    Mesh(Arc<Mesh>, f64),
}

/// Heights on a square lattice, with bilinear interpolation.
#[derive(Debug)]
pub(super) struct Field {
    /// Half the side of the square in x and z.
    pub half: f64,
    /// Points per side.
    pub n: usize,
    /// Heights above y = 0, row-major in z, then x.
    pub height: Vec<f64>,
    /// Bounds of all heights.
    pub low: f64,
    pub high: f64,
}

impl Field {
    pub fn new(half: f64, n: usize, f: impl Fn(f64, f64) -> f64) -> Self {
        let at = |i: usize| (i as f64 / (n - 1) as f64 * 2.0 - 1.0) * half;
        let height: Vec<f64> = (0..n * n).map(|i| f(at(i % n), at(i / n))).collect();
        let low = height.iter().copied().fold(f64::INFINITY, f64::min);
        let high = height.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        Self { half, n, height, low, high }
    }

    /// Height above y = 0 at `(x, z)`.
    pub fn at(&self, x: f64, z: f64) -> f64 {
        let m = (self.n - 1) as f64;
        let q = |c: f64| ((c / self.half + 1.0) * 0.5 * m).clamp(0.0, m - 1e-9);
        let (fx, fz) = (q(x), q(z));
        let (i, j) = (fx as usize, fz as usize);
        let (s, t) = (fx - i as f64, fz - j as f64);
        let row = |j: usize| {
            let a = self.height[j * self.n + i];
            a + (self.height[j * self.n + i + 1] - a) * s
        };
        let a = row(j);
        a + (row(j + 1) - a) * t
    }

    fn hit(&self, o: V3, d: V3, near: f64, far: f64) -> Option<(f64, V3)> {
        let half = v3(self.half, f64::max(self.high - self.low, 1e-6) * 0.5, self.half);
        let mid = v3(0.0, -(self.high + self.low) * 0.5, 0.0);
        let (t0, t1) = slab(o - mid, d, half)?;
        let (mut t, end) = (t0.max(near), t1.min(far));
        let cell = 2.0 * self.half / (self.n - 1) as f64;
        let speed = d.x.hypot(d.z).max(d.y.abs() * 0.5).max(1e-9);
        let above = |t: f64| {
            let p = o + d * t;
            -p.y - self.at(p.x, p.z)
        };
        let mut clearance = above(t);
        while t < end {
            let next = (t + (cell * 0.6).max(clearance * 0.35) / speed).min(end + 1e-9);
            let c = above(next);
            if clearance > 0.0 && c <= 0.0 {
                let (mut a, mut b) = (t, next);
                for _ in 0..40 {
                    let m = 0.5 * (a + b);
                    if above(m) > 0.0 { a = m } else { b = m }
                }
                let p = o + d * b;
                let e = cell * 0.5;
                let slope = |a: f64, b: f64| (b - a) / (2.0 * e);
                let nx = slope(self.at(p.x - e, p.z), self.at(p.x + e, p.z));
                let nz = slope(self.at(p.x, p.z - e), self.at(p.x, p.z + e));
                return Some((b, v3(-nx, -1.0, -nz).unit()));
            }
            clearance = c;
            t = next;
        }
        None
    }
}

/// Entry and exit of a ray through a box with half extents `h` around the origin.
pub(super) fn slab(o: V3, d: V3, h: V3) -> Option<(f64, f64)> {
    let (mut t0, mut t1) = (f64::NEG_INFINITY, f64::INFINITY);
    for (o, d, h) in [(o.x, d.x, h.x), (o.y, d.y, h.y), (o.z, d.z, h.z)] {
        if d == 0.0 {
            if o.abs() > h {
                return None;
            }
            continue;
        }
        let (a, b) = ((-h - o) / d, (h - o) / d);
        t0 = t0.max(a.min(b));
        t1 = t1.min(a.max(b));
    }
    (t0 <= t1).then_some((t0, t1))
}

fn first(mut ts: [f64; 2], near: f64, far: f64, ok: impl Fn(f64) -> bool) -> Option<f64> {
    if ts[0] > ts[1] {
        ts.swap(0, 1);
    }
    ts.into_iter().find(|&t| t > near && t < far && ok(t))
}

fn quadratic(a: f64, half_b: f64, c: f64) -> Option<[f64; 2]> {
    let disc = half_b * half_b - a * c;
    if disc < 0.0 || a == 0.0 {
        return None;
    }
    // numerically stable: subtracts no nearly equal numbers
    let q = -(half_b + disc.sqrt().copysign(half_b));
    let other = if q == 0.0 { 0.0 } else { c / q };
    Some([q / a, other])
}

impl Shape {
    /// First hit with `near < t < far`: `t`, the outward unit normal, and the triangle's index in a mesh.
    pub fn hit_triangle(&self, o: V3, d: V3, near: f64, far: f64) -> Option<(f64, V3, u32)> {
        match self {
            Self::Mesh(mesh, scale) => mesh.hit(o * (1.0 / scale), d * (1.0 / scale), near, far).map(|m| (m.t, m.normal, m.triangle)),
            other => other.hit(o, d, near, far).map(|(t, n)| (t, n, 0)),
        }
    }

    /// Like [`Self::hit_triangle`], without the triangle.
    pub fn hit(&self, o: V3, d: V3, near: f64, far: f64) -> Option<(f64, V3)> {
        match self {
            Self::Mesh(..) => self.hit_triangle(o, d, near, far).map(|(t, n, _)| (t, n)),
            Self::Plane => {
                let t = -o.y / d.y;
                (t > near && t < far).then_some((t, v3(0.0, -1.0, 0.0)))
            }
            Self::Card(hx, hy, cutout) => {
                let t = -o.z / d.z;
                if !(t > near && t < far) {
                    return None;
                }
                let p = o + d * t;
                let (x, y) = (p.x / hx, p.y / hy);
                (x.abs() <= 1.0 && y.abs() <= 1.0 && cutout.contains(x, y)).then_some((t, v3(0.0, 0.0, -1.0)))
            }
            Self::Cuboid(h) => {
                let (t0, t1) = slab(o, d, *h)?;
                let t = if t0 > near { t0 } else { t1 };
                if !(t > near && t < far) {
                    return None;
                }
                let p = o + d * t;
                let q = v3(p.x / h.x, p.y / h.y, p.z / h.z);
                let (ax, ay, az) = (q.x.abs(), q.y.abs(), q.z.abs());
                let n = if ax >= ay && ax >= az {
                    v3(q.x.signum(), 0.0, 0.0)
                } else if ay >= az {
                    v3(0.0, q.y.signum(), 0.0)
                } else {
                    v3(0.0, 0.0, q.z.signum())
                };
                Some((t, n))
            }
            Self::Ellipsoid(r) => {
                let inv = v3(1.0 / r.x, 1.0 / r.y, 1.0 / r.z);
                let (o, d) = (o.mul(inv), d.mul(inv));
                let ts = quadratic(d.dot(d), o.dot(d), o.dot(o) - 1.0)?;
                let t = first(ts, near, far, |_| true)?;
                Some((t, (o + d * t).mul(inv).unit()))
            }
            Self::Cylinder(half, r_up, r_down) => cylinder(o, d, near, far, *half, *r_up, *r_down),
            Self::Torus(ring, tube) => torus(o, d, near, far, *ring, *tube),
            Self::Field(f) => f.hit(o, d, near, far),
        }
    }

    /// Half extents and centre of the local bounding box; `None` for an unbounded shape.
    pub fn bounds(&self) -> Option<(V3, V3)> {
        let zero = V3::default();
        match self {
            Self::Plane => None,
            Self::Card(x, y, _) => Some((v3(*x, *y, 1e-6), zero)),
            Self::Cuboid(h) | Self::Ellipsoid(h) => Some((*h, zero)),
            Self::Cylinder(h, a, b) => Some((v3(a.max(*b), *h, a.max(*b)), zero)),
            Self::Torus(ring, tube) => Some((v3(ring + tube, ring + tube, *tube), zero)),
            Self::Mesh(m, scale) => {
                let Aabb { low, high } = m.bounds;
                Some(((high - low) * (0.5 * scale), (high + low) * (0.5 * scale)))
            }
            Self::Field(f) => Some((v3(f.half, 0.5 * (f.high - f.low) + 1e-6, f.half), v3(0.0, -0.5 * (f.high + f.low), 0.0))),
        }
    }
}

fn cylinder(o: V3, d: V3, near: f64, far: f64, half: f64, r_up: f64, r_down: f64) -> Option<(f64, V3)> {
    let (mid, slope) = (0.5 * (r_up + r_down), 0.5 * (r_down - r_up) / half);
    let (ro, rd) = (mid + slope * o.y, slope * d.y);
    let mut best: Option<(f64, V3)> = None;
    let side = quadratic(d.x * d.x + d.z * d.z - rd * rd, o.x * d.x + o.z * d.z - ro * rd, o.x * o.x + o.z * o.z - ro * ro);
    if let Some(t) = side.and_then(|ts| first(ts, near, far, |t| (o.y + d.y * t).abs() <= half && ro + rd * t >= 0.0)) {
        let p = o + d * t;
        best = Some((t, v3(p.x, -slope * (ro + rd * t), p.z).unit()));
    }
    for (y, r) in [(-half, r_up), (half, r_down)] {
        let t = (y - o.y) / d.y;
        let (x, z) = (o.x + d.x * t, o.z + d.z * t);
        if t > near && t < best.map_or(far, |b| b.0) && x * x + z * z <= r * r {
            best = Some((t, v3(0.0, y.signum(), 0.0)));
        }
    }
    best
}

/// Sphere tracing: every step is safe, because the distance to a torus has a closed form.
fn torus(o: V3, d: V3, near: f64, far: f64, ring: f64, tube: f64) -> Option<(f64, V3)> {
    let (t0, t1) = slab(o, d, v3(ring + tube, ring + tube, tube))?;
    let speed = d.norm();
    let distance = |p: V3| (p.x.hypot(p.y) - ring).hypot(p.z) - tube;
    let (mut t, end) = (t0.max(near), t1.min(far));
    for _ in 0..128 {
        if t > end {
            return None;
        }
        let p = o + d * t;
        let s = distance(p);
        if s.abs() < tube * 1e-7 && t > near {
            let r = p.x.hypot(p.y).max(1e-300);
            let k = (r - ring) / r;
            return Some((t, v3(p.x * k, p.y * k, p.z).unit()));
        }
        t += s.abs().max(tube * 1e-8) / speed;
    }
    None
}
